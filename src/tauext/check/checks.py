"""The table of checks: each corrects what it finds for those after it; and which findings explain others."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from tauext.check import clock, corrections, effort, odd_motion, odd_torque, robot_file, sensors, spikes
from tauext.check import torque_changes as torque
from tauext.check.examination import SEARCH_S, Examination
from tauext.check.finding import SEVERITIES, Finding, run_added
from tauext.data.servo import from_amperes, in_amperes, makes_torque

# --- Checks that need others' findings.


def _added(x: Examination) -> list[Finding]:
    """Faults by the checks of packages on recorded values."""
    x.recorded, (x.added, recordings) = x.recordings, run_added(x.recordings, corrected=False)
    x.correct(recordings=recordings)
    return [finding for one in x.added for finding in one.findings if finding.severity == "fault"]


def _added_last(x: Examination) -> list[Finding]:
    """Findings by the checks of packages on corrected recordings."""
    last, _ = run_added(x.recordings, corrected=True)
    x.added += last
    return [finding for one in last for finding in one.findings]


def _scales(x: Examination) -> list[Finding]:
    """Findings of a payload if it explains all factors of torque, else of the factors."""
    if (unit := robot_file.unit_findings(x, effort.factors_of)) is not None:
        return [unit]
    found, judged = effort.kind_findings(x)
    found += [*effort.far_findings(x), *effort.no_current_findings(x)]
    factors = effort.scale_findings(x, judged)
    loaded = robot_file.payload_of(x, judged) if judged and not found else None
    if loaded is None:
        return found + (factors or ([] if found else effort.common_findings(x, judged)))
    off, before = [x.joints.index(finding.joint or "") for finding in factors], x.tree
    payload, tree = loaded
    x.correct(tree=tree)
    if not effort.scale_findings(x, off):
        return [payload]
    x.correct(tree=before)
    return factors


def _odd_torques(x: Examination) -> Sequence[Finding]:
    """Leaves out recordings whose torque is odd by nothing that the signals explain."""
    odd = list(odd_torque.odd_torques(x))
    left = without_symptoms([*x.all_found, *odd])
    return x.leave_out([finding for finding in odd if finding in left])


OF_CURRENTS = ("effort-scale", "effort-motor-side", "position-offset")
"""Faults of a torque that are warnings of a current, whose constant training finds."""


def _contacts(x: Examination) -> list[Finding]:
    harmless = OF_CURRENTS if in_amperes(x.recordings) or from_amperes(x.recordings) else ()
    found = [finding for step in STEPS[2:] for finding in x.found.get(step, [])]
    faulty = any(finding.severity == "fault" and finding.code not in harmless for finding in found)
    if x.spoiled or faulty:
        return []
    if x.tree is None:
        return [] if not NEEDS["measured torque"](x) else torque.contacts_at_rest(x.motion, x.recordings)
    return torque.unlabelled_findings(x.recordings, x.tree, x.lag_s)


# --- The table.


NEEDS: dict[str, Callable[[Examination], bool]] = {
    "robot file": lambda x: x.robot is not None,
    "model": lambda x: x.tree is not None,
    "no model": lambda x: x.tree is None,
    "motion": lambda x: bool(x.motion),
    "sign": lambda x: not x.unsigned,
    "fit": lambda x: x.has_fit,
    "no fit": lambda x: not x.has_fit,
    "half a minute": lambda x: x.moving_s >= SEARCH_S,
    "measured torque": lambda x: not any(one.drive for one in x.added) and not any(map(makes_torque, x.recordings)),
}
"""What a check may need. A torque that is not measured is a drive's signal: it reverses before the joint leaves
stiction, and lags."""


@dataclass(frozen=True)
class Row:
    """A row of the table: one check of tauext, or the place of those that packages add (`finding.Check`)."""

    codes: tuple[str, ...]  # codes of its findings, keys of CODES
    step: str  # one of STEPS
    find: Callable[[Examination], Iterable[Finding]]
    """Returns findings, and corrects in the examination what later checks could not bear."""
    needs: tuple[str, ...] = ()  # keys of NEEDS; without all of them the check is skipped
    quick: bool = False
    """Whether it runs on each recording of a training or calibration alone, too: it needs neither fit nor others."""
    spoils: bool = False  # whether its fault may look like a contact, so that contacts are not searched for


def run(checks: Iterable[Row], x: Examination, begin: Callable[[str], None]) -> list[Finding]:
    """Run the checks whose needs are met; `begin` is called with the step of each."""
    for check in checks:
        if all(NEEDS[need](x) for need in check.needs):
            begin(check.step)
            found = list(check.find(x))
            x.spoiled |= check.spoils and bool(found)
            x.found.setdefault(check.step, []).extend(found)
    return x.all_found


SIGNALS, VELOCITIES, ORDER, PLACES, SIGNS, DELAYS, SCALES, CHANGES = STEPS = (
    "signals",
    "velocities",
    "order of the torques",
    "order and zero of the joints",
    "signs",
    "delays",
    "gravity, scale and payload",
    "drift and contacts",
)
"""Names of the steps, reported as progress: signals, then motion, then torque against model."""

CHECKS = [
    Row(("joint-names", "model-unusable", "inertia-impossible", "robot-file-changed"), SIGNALS,
        robot_file.file_findings, ("robot file",)),
    Row(("contact-in-free-motion", "contact-unknown"), SIGNALS, torque.contact_findings),
    Row(("time-unit",), SIGNALS, clock.time_findings, quick=True),
    Row(("position-wraps",), SIGNALS, clock.wrap_findings, quick=True),
    Row(("odd-recording",), SIGNALS, lambda x: x.leave_out(odd_motion.odd_rates(x))),
    Row((), SIGNALS, _added, quick=True),
    Row((), SIGNALS, lambda x: [f for one in x.added for f in one.findings if f.severity != "fault"]),
    Row(("resolution",), SIGNALS, sensors.coarse_velocities),
    Row(("spike",), SIGNALS, spikes.spike_findings, quick=True),
    Row(("odd-recording",), SIGNALS, lambda x: x.leave_out(odd_motion.odd_motions(x))),
    Row(("rows-dropped",), SIGNALS, clock.lost_findings, quick=True),
    Row(("clock-gaps",), SIGNALS, clock.gap_findings, quick=True),
    Row(("clock-irregular",), SIGNALS, clock.jitter_findings, quick=True, spoils=True),
    Row(("repeated-rows",), SIGNALS, clock.repeat_findings, quick=True, spoils=True),
    Row(("saturated",), SIGNALS, sensors.saturated_findings, spoils=True),
    Row(("dead-band",), SIGNALS, sensors.dead_findings, quick=True, spoils=True),
    Row(("refresh-slow",), SIGNALS, sensors.refresh_findings),
    Row(("stuck",), SIGNALS, sensors.stuck_findings, quick=True, spoils=True),
    Row(("resolution",), SIGNALS, sensors.coarse_torques, spoils=True),
    Row(("resolution",), SIGNALS, sensors.smoothed_findings, spoils=True),
    Row(("degrees", "velocity-sign", "velocity-unit", "velocity-delay", "velocity-mismatch", "joint-order"),
        VELOCITIES, clock.velocity_findings, ("motion",)),
    Row(("degrees",), VELOCITIES, clock.degree_findings, quick=True),
    Row(("odd-recording",), VELOCITIES, _odd_torques, ("motion", "sign")),
    Row(("never-moves", "excitation-low", "too-short"), VELOCITIES, effort.excitation_findings),
    Row(("beyond-limit",), VELOCITIES, robot_file.limit_findings, ("robot file",)),
    Row(("effort-sign",), VELOCITIES, effort.pose_findings, ("model", "sign", "no fit")),
    Row(("joint-order",), ORDER, corrections.exchanged_efforts, ("fit", "half a minute")),
    Row(("joint-order", "joint-axis", "position-offset"), PLACES, corrections.rearranged,
        ("fit", "half a minute", "model")),
    Row(("effort-sign",), SIGNS, effort.sign_findings, ("fit",)),
    Row(("torque-delay",), DELAYS, effort.delay_findings, ("fit", "measured torque")),
    Row(("inertia-impossible",), SCALES, robot_file.inertia_findings, ("model",)),
    Row(("gravity-direction",), SCALES, robot_file.gravity_findings, ("fit", "model")),
    Row(("effort-scale", "effort-motor-side", "effort-compensated", "payload", "inertia-impossible"), SCALES,
        _scales, ("fit", "model")),
    Row(("effort-scale",), SCALES, effort.unit_findings, ("fit", "no model")),
    Row(("torque-changes",), CHANGES, torque.friction_findings, ("fit",)),
    Row(("torque-changes",), CHANGES, torque.growth_findings, ("fit", "measured torque")),
    Row(("torque-changes",), CHANGES, torque.step_findings, ("fit", "measured torque")),
    Row(("contact-in-free-motion",), CHANGES, _contacts, ("fit",)),
    Row(("robot-file-other",), CHANGES, robot_file.other_robot_findings, ("fit", "model", "measured torque")),
    Row((), CHANGES, _added_last)
]  # fmt: skip
"""All checks, in the order in which they run."""


# --- Findings that another one explains are not printed beside it: one remedy at a time, the first to do.


_TORQUE = ("effort-sign", "effort-scale", "effort-motor-side", "effort-compensated")
_LOAD = ("gravity-direction", "payload")
_PLACES = ("joint-axis", "position-offset", "beyond-limit")
_VELOCITY = ("velocity-sign", "velocity-unit", "velocity-mismatch", "velocity-delay")
EXPLAINED: dict[str, tuple[str, ...]] = {
    "time-unit": (*_VELOCITY, *_TORQUE, "torque-delay", "clock-irregular"),
    "position-wraps": ("spike", "degrees", *_VELOCITY, "effort-sign", "effort-scale", "excitation-low"),
    "degrees": ("velocity-unit", *_TORQUE, *_LOAD, *_PLACES),
    "joint-names": (*_TORQUE, *_LOAD, *_PLACES),
    "joint-order": (*_VELOCITY, *_TORQUE, *_LOAD, *_PLACES, "torque-delay"),
    "velocity-mismatch": ("effort-sign", "torque-delay", "velocity-delay"),
    "velocity-sign": ("effort-sign",),
    "robot-file-other": (*_TORQUE, *_LOAD, *_PLACES, "joint-order", "torque-delay"),
}
"""Codes that each cause explains; the causes in the order in which they are to be mended."""


SYMPTOMS: dict[str, tuple[str, ...]] = {
    "dead-band": (*_TORQUE, "torque-delay", "torque-changes", "odd-recording", "resolution"),
    "refresh-slow": ("torque-delay", "velocity-delay", "velocity-mismatch", "resolution"),
}
"""Codes that a warning explains at its joint; without a joint, at all."""


def without_symptoms(found: Sequence[Finding]) -> list[Finding]:
    """Findings without those that a warning among them explains."""
    told = {(effect, f.joint) for f in found for effect in SYMPTOMS.get(f.code, ())}
    return [f for f in found if not told & {(f.code, f.joint), (f.code, None)}]


def causes_only(found: Sequence[Finding]) -> list[Finding]:
    """Findings, worst first and causes before others, without those that a fault among them explains."""
    explained: set[str] = set()
    for code in EXPLAINED:
        if code not in explained and any(f.code == code and f.severity == "fault" for f in found):
            explained.update(EXPLAINED[code])
    order = {code: k for k, code in enumerate(EXPLAINED)}
    left = [finding for finding in without_symptoms(found) if finding.code not in explained]
    return sorted(left, key=lambda f: (SEVERITIES.index(f.severity), order.get(f.code, len(order))))
