"""False collisions of arms whose friction has changed: before a refit, after one on a minute, after one on half of it,
and after one that a monitor kept the minute for.

    python packages/lab/benchmarks/refit.py BUNDLE MODELS OUT [--hours 1] [--arms ur5 panda ...] [--workers 1]

BUNDLE: of recipe prior, with limits from calibration recordings, trained on a dataset that the virtual rig made with
its default settings. MODELS: folder of the arms' URDFs, as of unseen_arms.py. OUT gets what the unseen arms take (used
again where it is there), a file a row (used again where it is newer than the bundle) and refit.md. Rows are of the same
motion, and none of it is the minute that was fitted.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))

from common import (
    arguments,
    checkpoint,
    collisions_begin,
    head,
    in_parallel,
    joined,
    runs,
    table_row,
    trained,
    write_tables,
)
from tauext_lab.evaluate.collisions import find_collisions, judge_latched
from tauext_lab.evaluate.errors import sensor_reference
from tauext_lab.sim.collect import simulate_recording
from tauext_lab.sim.config import RigConfig
from unseen.arms import Maker, makers
from unseen.recordings import STRONG, Take, make_dataset, nearest, nm_per_given

from tauext import _core
from tauext.data.dataset import load_split
from tauext.data.free_motion import cut
from tauext.data.recording import Recording
from tauext.data.recording_file import load_recording
from tauext.fit.tail import rate_interval
from tauext.monitor.estimate import estimate_recording
from tauext.train.refit import refit_motion, refit_recordings

ARMS = ["ur5", "panda", "kinova", "seven_axis"]
ALL = ("coulomb_nm", "static_nm", "viscous_nm_s_rad")
LENGTH_S, TOUCHES = 90.0, 8
WARM_UP_S = 3.0
MORNINGS_S = (60.0, 30.0)
OLD, MINUTE, HALF, INSIDE = range(4)
"""Bundles: the old one, refitted on MORNINGS_S each, and inside the monitor on the first of these."""
LEAST_H = 1.0
"""Of free motion a row; longer than that only MINUTE is judged."""
FREE_SEED, TOUCH_SEED, MORNING_SEED = 11, 12, 13
AFTER_S = 0.5


@dataclass(frozen=True)
class Change:
    """A change of the rig's friction since training."""

    words: str
    factor: float
    names: tuple[str, ...] = ALL
    joints: tuple[int, ...] = (0, 1)

    def config(self) -> RigConfig:
        """The rig with it."""
        usual = RigConfig()
        friction = [
            replace(one, **{name: self.factor * getattr(one, name) for name in self.names}) if j in self.joints else one
            for j, one in enumerate(usual.friction)
        ]
        return replace(usual, friction=tuple(friction))


CHANGES = (
    Change("none", 1.0),
    *(Change(f"all x {factor:g}", factor) for factor in (0.7, 0.85, 1.15, 1.3, 1.4)),
    Change("Coulomb x 1.3", 1.3, ("coulomb_nm",)),
    Change("viscous x 1.3", 1.3, ("viscous_nm_s_rad",)),
    Change("static x 1.3", 1.3, ("static_nm",)),
    Change("all x 1.3, joint 1", 1.3, ALL, (0,)),
    Change("all x 0.7, joint 2", 0.7, ALL, (1,)),
)


@dataclass
class Row:
    """Of one change: false collisions and hours of each bundle, and while a monitor keeps the minute."""

    words: str
    hours: list[float] = field(default_factory=lambda: [0.0] * 4)
    false: list[int] = field(default_factory=lambda: [0] * 4)
    strong: int = 0
    latched: list[int] = field(default_factory=lambda: [0] * 4)
    meanwhile: tuple[int, int] = (0, 0)
    """False collisions of the minute, and strong collisions latched, at widened limits."""
    found: str = ""
    raised: str = ""
    promise: str = ""


def main() -> None:
    parser = arguments(__doc__, "bundle", "models", "out", seed=0, workers=1)
    parser.add_argument("--hours", type=float, default=1.0, help="of free motion a row, default: %(default)s")
    parser.add_argument("--arms", nargs="*", default=ARMS)
    options = parser.parse_args()
    jobs = [(options.bundle, options.hours, options.out, change) for change in CHANGES]
    rows = in_parallel(options.workers, row_of, jobs)
    cold = []
    for name in options.arms:
        maker = makers(options.models)[name]
        data = make_dataset(maker, options.seed, options.out / name, TAKES, options.workers)
        bundle = trained(data, options.out / name / "warm.tauext")
        facts = partial(judge_cold, maker, options.seed, bundle, MORNINGS_S)
        cold.append(checkpoint(options.out / f"{name}.json", facts, bundle))
    write_tables(options.out, [*rig_table(rows), "", *cold_table(cold)], name="refit")


def row_of(path: Path, hours: float, out: Path, change: Change) -> Row:
    """The row of a change, from OUT where the same bundle has been judged for so long."""
    file = out / f"rig {change.words} {hours:g} h.json"
    return Row(**checkpoint(file, lambda: asdict(judge_rig(path, hours, change)), path))


def judge_rig(path: Path, hours: float, change: Change) -> Row:
    """One change, on its own recordings."""
    old = _core.Bundle.load(str(path))
    config, row = change.config(), Row(change.words)
    mornings = [simulate_recording(config, "free", s + WARM_UP_S, MORNING_SEED, 0) for s in MORNINGS_S]
    refitted = [refit_recordings(old, [morning], threads=1) for morning in mornings]
    minute, kept = during_refit(old, mornings[0])
    bundles = [old, *(one.bundle for one in refitted), refit_motion(old, kept).bundle]
    for number in range(round(hours * 3600 / LENGTH_S)):
        free = simulate_recording(config, "free", LENGTH_S, FREE_SEED, number)
        for k, bundle in enumerate(bundles):
            if k == MINUTE or number < round(LEAST_H * 3600 / LENGTH_S):
                one = estimate_recording(bundle, free, 1)
                row.hours[k] += float(one.healthy.sum()) / free.rate_hz / 3600
                row.false[k] += len(collisions_begin(one.held_alarm, free.t_ns))
    caught = 0
    for number in range(TOUCHES):
        touched = simulate_recording(config, "pads", LENGTH_S, TOUCH_SEED, number)
        reference = sensor_reference(touched, old.observer.gain_per_s)
        said = [estimate_recording(bundle, touched, 1) for bundle in bundles]
        said.append(replace(said[0], held_alarm=during_refit(old, touched)[0]["held_alarm"].astype(np.int8)))
        for touch in find_collisions(touched):
            verdicts = [judge_latched(touch, touched, one, old.hold_s, reference) for one in said]
            if verdicts[MINUTE].strong:
                row.strong += 1
                *latched, of_wide = (verdict.latched for verdict in verdicts)
                row.latched = [a + b for a, b in zip(row.latched, latched, strict=True)]
                caught += of_wide
    row.meanwhile = (len(collisions_begin(minute["held_alarm"], mornings[0].t_ns)), caught)
    row.found = " · ".join(f"{j.coulomb[0]:.3f}, {j.viscous[0]:.3f}" for j in refitted[0].joints)
    row.raised = joined(j.limit_factor for j in refitted[0].joints)
    row.promise = " · ".join(j.promise.partition(":")[0] for j in refitted[0].joints)
    return row


AFTER = "before | after 60 s | after 30 s | inside"


def rig_table(rows: Sequence[Row]) -> list[str]:
    """Table of the virtual rig, and whether all rows together keep the promise."""
    lines = head(
        f"change | false collisions an hour: {AFTER} | strong collisions latched: {AFTER} | meanwhile: false "
        "| strong latched | found: friction, viscous | limits | promise"
    )
    for one in rows:
        counted = zip(one.false, one.hours, strict=True)
        false = [f"{count / hours:.2g} ({count} in {hours:.2f} h)" for count, hours in counted]
        latched = [f"{count}/{one.strong}" for count in one.latched]
        meanwhile = one.meanwhile[0], f"{one.meanwhile[1]}/{one.strong}"
        lines.append(table_row(one.words, *false, *latched, *meanwhile, one.found, one.raised, one.promise))
    return [*lines, "", "All rows together:", "", *promises(rows)]


def promises(rows: Sequence[Row]) -> list[str]:
    """Over all rows: false collisions of each refit, strong ones latched, and whether the promise is kept."""
    words = []
    strong = sum(row.strong for row in rows)
    for k, title in ((MINUTE, "after 60 s"), (HALF, "after 30 s"), (INSIDE, "inside the monitor")):
        count, hours, latched = (sum(getattr(row, name)[k] for row in rows) for name in ("false", "hours", "latched"))
        low, high = rate_interval(count, hours)
        words.append(
            f"- {title}: {count} false collisions in {hours:.1f} h, {low:.2g} to {high:.2g} an hour (95 %), promised "
            f"1 in 8 h; {latched / max(1, strong):.1%} of {strong} strong collisions latched"
        )
    return words


def cold_table(rows: Sequence[dict]) -> list[str]:
    """Table of arms that were trained warm."""
    lines = head(
        f"arm | hours | false collisions an hour: {AFTER} | strong found: {AFTER} | meanwhile: false "
        "| friction found | limits"
    )
    for one in rows:
        rates = [f"{count / one['hours']:.2g} ({count})" for count in one["false"]]
        found = [f"{count}/{one['strong']}" for count in one["found"]]
        last = (one[name] for name in ("meanwhile", "factors", "raised"))
        lines.append(table_row(one["arm"], f"{one['hours']:.2f}", *rates, *found, *last))
    return lines


# --- Arms that were trained warm and are met cold.


WARM_S = 1800.0
"""Five times the slowest warm-up: nothing falls any more."""
MORNING_S = 70.0
TAKES = (
    Take("warm-1", "train", 3, 0, WARM_S),
    Take("warm-2", "train", 3, 6, WARM_S),
    Take("warm-3", "train", 3, 0, WARM_S),
    Take("morning", "test", MORNING_S / 60, 0, 0),
    Take("cold-1", "test", 5, 0, MORNING_S),
    Take("cold-2", "test", 5, 0, MORNING_S),
    Take("cold-3", "test", 5, 0, MORNING_S),
    Take("touched", "collisions", 5, 25, MORNING_S),
)
"""The morning's minute, and what follows it, drawn several times."""


def judge_cold(maker: Maker, seed: int, path: Path, mornings_s: Sequence[float]) -> dict:
    """False collisions and strong contacts that were found: of the old bundle, after a refit on so many seconds each,
    and after one inside a monitor on the first of these."""
    old = _core.Bundle.load(str(path))
    data = path.parent / "data"
    split = load_split(data)
    tests = {name: load_recording(data / name) for name in split.test}
    morning = next(one for name, one in tests.items() if name.startswith("morning"))
    free = [one for name, one in tests.items() if name.startswith("cold")]
    refits = [refit_recordings(old, [first(morning, s + WARM_UP_S)], threads=1) for s in mornings_s]
    told, kept = during_refit(old, first(morning, mornings_s[0] + WARM_UP_S))
    bundles = [old, *(one.bundle for one in refits), refit_motion(old, kept).bundle]
    false, hours = [0] * len(bundles), 0.0
    for recording in free:
        for k, bundle in enumerate(bundles):
            said = estimate_recording(bundle, recording, 1)
            false[k] += len(collisions_begin(said.held_alarm, recording.t_ns))
            hours += float(said.healthy.sum()) / recording.rate_hz / 3600 if k == 0 else 0.0
    meanwhile = len(collisions_begin(told["held_alarm"], morning.t_ns))
    strong, found = strong_found(maker, seed, path, [load_recording(data / name) for name in split.collisions], bundles)
    return {
        "arm": maker.name,
        "hours": hours,
        "false": false,
        "strong": strong,
        "found": found,
        "meanwhile": meanwhile,
        "factors": joined(joint.coulomb[0] for joint in refits[0].joints),
        "raised": joined(joint.limit_factor for joint in refits[0].joints),
    }


def during_refit(bundle: _core.Bundle, recording: Recording) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Results of a monitor that keeps this motion for a refit, its limits raised by the usual share of friction; and
    the motion."""
    monitor = _core.Monitor(bundle)
    monitor.reserve_refit(recording.duration_s + 1)
    monitor.start_refit()
    said = monitor.run(recording.t_ns, recording.q, recording.dq, recording.tau)
    return said, monitor.finish_refit()


def strong_found(
    maker: Maker, seed: int, path: Path, recordings: Sequence[Recording], bundles: Sequence[_core.Bundle]
) -> tuple[int, list[int]]:
    """How many contacts turn some joint by STRONG times its error in training or more, and how many each found."""
    facts = json.loads(bundles[0].provenance)
    error = np.array([facts["prior"]["error_nm"][joint] for joint in maker.joints])
    true = nm_per_given(maker, seed) / np.array(bundles[0].observer.nm_per_unit or 1.0)
    truths = json.loads((path.parent / "csv" / "touched.truth.json").read_text())
    strong, found = 0, [0] * len(bundles)
    for recording in recordings:
        assert recording.contact is not None
        start_s = 1e-9 * float(recording.t_ns[0])
        said = [estimate_recording(bundle, recording, 1) for bundle in bundles]
        for begin, end in runs(recording.contact == 1):
            truth = nearest(truths, start_s + float(recording.time_s[begin]))
            if np.max(np.array(truth["peak_nm"]) / (true * error)) < STRONG:
                continue
            strong += 1
            last = end + round(AFTER_S * recording.rate_hz)
            for k, one in enumerate(said):
                found[k] += len(collisions_begin(one.held_alarm[begin:last], recording.t_ns[begin:last])) > 0
    return strong, found


def first(recording: Recording, seconds: float) -> Recording:
    """Its first seconds."""
    return cut(recording, slice(0, int(np.searchsorted(recording.time_s, seconds))))


if __name__ == "__main__":
    main()
