"""A FLEET.toml to begin with."""

EXAMPLE = """\
# A fleet: which arms there are, and what is done with their recordings. Places count from this file's folder.
# `tauext fleet run FLEET.toml --out fleet` does it; --dry-run says what it would do, and why.

stages = ["import", "check", "train", "calibrate", "evaluate"]   # or fewer; these are all, and what holds if left out

# date = 2026-05-04         # day of the recordings, for `tauext fleet report`; an arm's own table may have another one

# For all arms. [types.NAME] says it for the arms of a type, an arm's own table for it alone: the last one counts.
[train]                     # the options of `tauext train`, without dashes: max-steps is max_steps
recipe = "tauext"
alarm = { false_alarms = 1.0, in_hours = 8.0 }

[evaluate]                  # the options of `tauext evaluate`: seed, keep_free_estimates, shortest_event_s, tolerance_s
keep_free_estimates = 5

[types.ur10e]
arm = "ur10e.toml"          # description of its recordings: `tauext import --new ur10e.toml` writes one
# robot = "ur10e.urdf"      # instead of the dataset's own, as for `tauext train`
# train.like = "ur10e.prior.json"   # what a fleet of this type knows: a minute of a new arm is enough
# case = "none"             # model case: exact, mass, com, mass+com, none
# accept = ["payload-missing"]      # codes of the doctor that are no fault on your word

[[arms]]
name = "cell-01"            # names its folder and its bundle
type = "ur10e"
sources = ["bags/cell-01/*.mcap"]   # files and folders of any format that `tauext import` reads; *, ? and ** as usual

[[arms]]
name = "cell-02"
type = "ur10e"
sources = ["bags/cell-02"]
arm = "cell-02.toml"        # another tool, another logger
train.max_steps = 20000     # what differs for this arm

[[arms]]
name = "cell-03"
type = "ur10e"
dataset = "datasets/cell-03"        # imported or simulated already, instead of sources
calibration = "datasets/cell-03-nights"  # the stage calibrate: limits anew, on the calibration recordings of another
calibrate = { false_alarms = 1.0, in_hours = 24.0 }   # dataset, for another promise, or both; else train's limits stay
"""
