"""False collisions of a rig whose friction has changed: before a refit, after one on a minute, after one on half of it,
and after one that a monitor kept the minute for.

    python packages/lab/benchmarks/refit.py BUNDLE OUT [--hours 1] [--workers 1]

BUNDLE: of recipe prior, with limits from calibration recordings, trained on a dataset that the virtual rig made with
its default settings. OUT gets a file a row (used again where it is newer than the bundle) and refit.md. Rows are of the
same motion, and none of it is the minute that was fitted.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))

from common import arguments, checkpoint, collisions_begin, head, in_parallel, joined, table_row, write_tables
from tauext_lab.evaluate.collisions import find_collisions, judge_latched
from tauext_lab.evaluate.errors import sensor_reference
from tauext_lab.sim.collect import simulate_recording
from tauext_lab.sim.config import RigConfig

from tauext import _core
from tauext.data.recording import Recording
from tauext.fit.tail import rate_interval
from tauext.monitor.estimate import estimate_recording
from tauext.train.refit import refit_motion, refit_recordings

ALL = ("coulomb_nm", "static_nm", "viscous_nm_s_rad")
LENGTH_S, TOUCHES = 90.0, 8
WARM_UP_S = 3.0
MORNINGS_S = (60.0, 30.0)
OLD, MINUTE, HALF, INSIDE = range(4)
"""Bundles: the old one, refitted on MORNINGS_S each, and inside the monitor on the first of these."""
LEAST_H = 1.0
"""Of free motion a row; longer than that only MINUTE is judged."""
FREE_SEED, TOUCH_SEED, MORNING_SEED = 11, 12, 13


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
    parser = arguments(__doc__, "bundle", "out", workers=1)
    parser.add_argument("--hours", type=float, default=1.0, help="of free motion a row, default: %(default)s")
    options = parser.parse_args()
    jobs = [(options.bundle, options.hours, options.out, change) for change in CHANGES]
    write_tables(options.out, rig_table(in_parallel(options.workers, row_of, jobs)), name="refit")


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


def during_refit(bundle: _core.Bundle, recording: Recording) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Results of a monitor that keeps this motion for a refit, its limits raised by the usual share of friction; and
    the motion."""
    monitor = _core.Monitor(bundle)
    monitor.reserve_refit(recording.duration_s + 1)
    monitor.start_refit()
    said = monitor.run(recording.t_ns, recording.q, recording.dq, recording.tau)
    return said, monitor.finish_refit()


if __name__ == "__main__":
    main()
