"""Picks and places with expect_load(): false collisions, what was weighed, and collisions within the same windows.

    python benchmarks/picks.py MODELS OUT [--arms ur5 panda ...] [--picks 80 80 ...] [--seed 0]

Each arm is trained on nine minutes of ordinary motion and eight of picks of nothing. Then it picks loads of 0.5 to 3 kg
off tables, suddenly and gradually, moves with them and puts them down; and it is hit within such a window, without a
load and with one in hand. OUT/picks.md and OUT/picks.json get the tables. What is there is used again.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from carrying import APART_S, FIRST_S, load_of
from common import arguments, head, in_parallel, quantiles_ms, table_row, trained, write_tables
from unseen.arms import Maker, makers, true_arm
from unseen.loads import TRAIN
from unseen.picks import WINDOW_S, write_pick
from unseen.recordings import STRONG, description, import_csv, simulate_takes

from tauext import Monitor, Recording, load_bundle
from tauext.data.recording_file import load_recording

EMPTY = 24
"""Picks of nothing to train on, twenty seconds each."""


def main() -> None:
    parser = arguments(__doc__, "models", "out", arms=("ur5", "panda"), seed=0)
    parser.add_argument("--picks", nargs="+", type=int, default=[80, 80], help="of each arm; as many collisions")
    options = parser.parse_args()
    outcomes: list[Outcome] = []
    for name, picks in zip(options.arms, options.picks, strict=True):
        maker, folder = makers(options.models)[name], options.out / name
        takes = plan(picks)
        simulate_all(maker, folder, options.seed, takes)
        data = dataset(maker, folder, options.seed, takes)
        bundle = trained(data, folder / "arm.tauext", "--fit-torque-constants", "False")
        free = errors(bundle, data, [f"empty-{k:03d}" for k in range(EMPTY)])
        jobs = [(name, bundle, data, folder / "csv", take, free) for take in names(takes)]
        outcomes += in_parallel(os.cpu_count(), watch, jobs)
    write_tables(options.out, tables(outcomes), [_rounded(asdict(one)) for one in outcomes], "picks")


def plan(picks: int) -> dict[str, int]:
    """Takes by their kind."""
    return {"empty": EMPTY, "pick": picks, "any": 3 * picks // 4, "any-hand": picks // 4, "down": picks // 4}


def names(takes: dict[str, int]) -> list[str]:
    """Of the takes that are watched."""
    return [f"{kind}-{k:03d}" for kind, count in takes.items() if kind != "empty" for k in range(count)]


def simulate_all(maker: Maker, folder: Path, seed: int, takes: dict[str, int]) -> None:
    """Recordings to train on, and takes of every kind; not those that exist."""
    raw = folder / "csv"
    simulate_takes(maker, seed, raw, TRAIN, os.cpu_count())
    jobs = []
    for kind, count in takes.items():
        what, _, hand = kind.partition("-")
        contact = "none" if what == "pick" else what
        jobs += [(maker, seed, k, raw, k % 2 == 0, contact, hand == "hand") for k in range(count)]
    in_parallel(os.cpu_count(), write_pick, jobs)


def dataset(maker: Maker, folder: Path, seed: int, takes: dict[str, int]) -> Path:
    """Imported with constants that are true."""
    out = folder / "data"
    if out.is_dir():
        return out
    arm = true_arm(maker, maker.random(seed, 0))
    text = description(maker, seed, model=True, takes=TRAIN)
    text = re.sub(r"torque_constant = .*", f"torque_constant = {arm.nm_per_ampere.tolist()}", text)
    ordinary = [f"{take.name}.csv" for take in TRAIN]
    empty = [f"empty-{k:03d}.csv" for k in range(takes["empty"])]
    watched = [f"{name}.csv" for name in names(takes)]
    text = re.sub(r"\ntrain = .*", f"\ntrain = {json.dumps(ordinary + empty)}", text)
    touched = [name for name in watched if not name.startswith("pick")]
    text = re.sub(r"\ntest = .*", f"\ntest = {json.dumps([name for name in watched if name not in touched])}", text)
    text = re.sub(r"\ncollisions = .*", f"\ncollisions = {json.dumps(touched)}", text)
    files = [folder / "csv" / name for name in ordinary + empty + watched]
    import_csv(text, files, folder / "csv" / "arm.toml", out)
    return out


# --- What the monitor reports of a take, and tables.


AT_MOST_KG = 3.5
"""What the gripper says that it may pick up."""
LATE_S = 0.7
"""After the end of a contact its alarm may still come: the observer, and a decision."""
EARLY_S = 0.2
"""Before a table takes the load the gripper says that it will open."""
DOWN = 0.9
"""Cosine of the angle to gravity, 26 degrees, within which a force on the arm is listed apart: a load pulls so."""


@dataclass(frozen=True)
class Outcome:
    """Of one take."""

    arm: str
    take: str
    truth: dict[str, Any]
    seconds: float
    in_windows: int = 0
    """False collisions while a load, or its going, is expected."""
    elsewhere: int = 0
    told_elsewhere: int = 0
    """The same outside those windows where the load is told exactly (set_load) by somebody who sees it."""
    untold: int = 0
    mass_kg: float = 0.0
    """When the window is over."""
    error_kg: float = 0.0
    carried_kg: float = 0.0
    """Before it is put down."""
    left_kg: float = 0.0
    """At the end."""
    strength: float = 0.0
    """Of a contact: the largest of its torques, each over that joint's error in free motion."""
    down: bool = False
    delay_s: float | None = None
    plain_delay_s: float | None = None
    """Without the window."""


class Watch:
    """A monitor on a recording, told things on the way."""

    def __init__(self, bundle: Any, recording: Recording) -> None:
        self.monitor, self.recording, self.at = Monitor(bundle), recording, 0
        self.said: list[dict[str, np.ndarray]] = []

    def to(self, time_s: float) -> None:
        end = int(np.searchsorted(self.recording.time_s, time_s))
        rows, r = slice(self.at, end), self.recording
        if end > self.at:
            self.said.append(self.monitor.run(r.t_ns[rows], r.q[rows], r.dq[rows], r.tau[rows]))
        self.at = max(self.at, end)

    def collisions(self) -> np.ndarray:
        """Whether each sample shows one: over a limit, or an alarm that was held back until then."""
        self.to(np.inf)
        alarm = np.concatenate([said["alarm"] for said in self.said]) == 2
        detection = np.concatenate([said["detection"] for said in self.said]).astype(bool)
        return detection | (alarm & ~np.append(False, alarm[:-1]))

    def times(self) -> np.ndarray:
        """Of the collisions, [s], those that begin less than APART_S after another one left out."""
        at = self.recording.time_s[self.collisions() & (self.recording.time_s >= FIRST_S)]
        return at[np.append(True, np.diff(at) > APART_S)] if len(at) else at


def watch(arm: str, path: Path, data: Path, raw: Path, take: str, error_nm: list[float]) -> Outcome:
    bundle, recording = load_bundle(path), load_recording(data / f"{take}.parquet")
    truth = json.loads((raw / f"{take}.truth.json").read_text())
    facts = (
        picked(bundle, recording, truth) if truth["contact"] is None else touched(bundle, recording, truth, error_nm)
    )
    return Outcome(arm, take, truth, float(recording.time_s[-1] - FIRST_S), **facts)


def picked(bundle: Any, recording: Recording, truth: dict[str, Any]) -> dict[str, Any]:
    grasp, put = truth["grasp_s"], truth["put_s"]
    expects = Watch(bundle, recording)
    expects.to(grasp)
    expects.monitor.expect_load(WINDOW_S, AT_MOST_KG)
    expects.to(grasp + WINDOW_S + 0.1)
    found = expects.monitor.load.mass, expects.monitor.last.load_error_kg
    expects.to(put - EARLY_S)
    carried = expects.monitor.load.mass
    expects.monitor.expect_load(WINDOW_S, 0.0)
    at = expects.times()
    told = Watch(bundle, recording)
    told.to(truth["lift_s"] + truth["lifts_s"])
    told.monitor.set_load(**load_of(bundle, truth, 1.0, 0.03), since_ns=int(recording.t_ns[told.at - 1]))
    told.to(truth["put_s"])
    told.monitor.clear_load()
    told_at = told.times()
    begins = [grasp, put - EARLY_S]
    inside, told_inside = (
        np.any([(when >= begin) & (when <= begin + WINDOW_S + 0.5) for begin in begins], axis=0)
        for when in (at, told_at)
    )
    return {
        "in_windows": int(inside.sum()),
        "elsewhere": int((~inside).sum()),
        "told_elsewhere": int((~told_inside).sum()),
        "untold": len(Watch(bundle, recording).times()),
        "mass_kg": found[0],
        "error_kg": found[1],
        "carried_kg": carried,
        "left_kg": expects.monitor.load.mass,
    }


def touched(bundle: Any, recording: Recording, truth: dict[str, Any], error_nm: list[float]) -> dict[str, Any]:
    contact = truth["contact"]
    delays = {}
    for how in ("plain", "expects"):
        watched = Watch(bundle, recording)
        if truth["in_hand"]:
            watched.monitor.set_load(**load_of(bundle, truth, 1.0, 0.03))
        watched.to(truth["grasp_s"])
        if how == "expects":
            watched.monitor.expect_load(WINDOW_S, 0.0 if truth["in_hand"] else AT_MOST_KG)
        t = recording.time_s
        during = (t > contact["start_s"]) & (t < contact["end_s"] + LATE_S)
        at = t[watched.collisions() & during]
        delays[how] = float(at[0] - contact["start_s"]) if len(at) else None
    return {
        "strength": float(np.max(np.array(truth["peak_nm"]) / error_nm)),
        "down": -contact["direction"][2] >= DOWN,
        "delay_s": delays["expects"],
        "plain_delay_s": delays["plain"],
    }


def errors(path: Path, data: Path, takes: list[str]) -> list[float]:
    """RMS of tau_ext of each joint in free motion, [N m]."""
    squares = []
    for take in takes:
        recording = load_recording(data / f"{take}.parquet")
        said = Monitor(load_bundle(path)).run(recording.t_ns, recording.q, recording.dq, recording.tau)
        squares.append(np.nanmean(said["tau_ext"] ** 2, axis=0))
    return np.sqrt(np.mean(squares, axis=0)).tolist()


# --- Tables of the trial.


def right(found_kg: float, true_kg: float) -> bool:
    return abs(found_kg - true_kg) <= max(0.05 * true_kg, 0.1)


def _rounded(facts: dict[str, Any]) -> dict[str, Any]:
    whole = {key: _rounded(value) if isinstance(value, dict) else value for key, value in facts.items()}
    return {key: round(value, 4) if isinstance(value, float) else value for key, value in whole.items()}


def tables(outcomes: Sequence[Outcome]) -> list[str]:
    arms = list(dict.fromkeys(one.arm for one in outcomes))
    groups = [(arm, [one for one in outcomes if one.arm == arm]) for arm in arms] + [("**all**", list(outcomes))]
    picks = [(arm, [one for one in group if one.truth["contact"] is None]) for arm, group in groups]
    false = "false collisions in the windows | elsewhere | elsewhere, exact `set_load` | without announcements"
    lines = [*head(f"arm | picks and places | {false} | hours"), *(_picks(arm, group) for arm, group in picks), ""]
    lines += head(
        "arm | right after the window | right before it is put down | error, median | error, 90 % "
        "| within two standard errors | not adopted | not cleared at the end"
    )
    lines += [*(_masses(arm, group) for arm, group in picks), ""]
    lines += head(
        "arm | contacts | found without the window | of these with it | delay without it, ms: median, 90 % "
        "| delay with it, ms | largest extra delay"
    )
    for words, chosen in (
        ("strong", lambda one: one.strength >= STRONG and not one.down),
        ("weak", lambda one: one.strength < STRONG and not one.down),
        ("along gravity", lambda one: one.down),
    ):
        for arm, group in groups:
            hit = [one for one in group if one.truth["contact"] is not None and chosen(one)]
            if hit:
                lines.append(_hits(f"{arm}, {words}", hit))
    return lines


def _picks(arm: str, group: Sequence[Outcome]) -> str:
    counted = ("in_windows", "elsewhere", "told_elsewhere", "untold")
    cells = [sum(getattr(one, name) for one in group) for name in counted]
    return table_row(arm, len(group), *cells, f"{sum(one.seconds for one in group) / 3600:.2f}")


def _masses(arm: str, group: Sequence[Outcome]) -> str:
    true = np.array([one.truth["mass_kg"] for one in group])
    found, error = np.array([one.mass_kg for one in group]), np.array([one.error_kg for one in group])
    off = np.abs(found - true)[found > 0]
    after = sum(right(one.mass_kg, one.truth["mass_kg"]) for one in group)
    before = sum(right(one.carried_kg, one.truth["mass_kg"]) for one in group)
    within = np.mean((np.abs(found - true) <= 2 * error)[found > 0])
    left = sum(one.left_kg > 0 for one in group)
    sizes = f"{np.median(off):.2f} kg", f"{np.percentile(off, 90):.2f} kg"
    of = f"{after}/{len(group)}", f"{before}/{len(group)}"
    return table_row(arm, *of, *sizes, f"{within:.0%}", np.sum(found == 0), left)


def _hits(label: str, hit: Sequence[Outcome]) -> str:
    plain = [one for one in hit if one.plain_delay_s is not None]
    found = [one for one in plain if one.delay_s is not None]
    if not found:
        return f"| {label} | {len(hit)} | {len(plain)} | 0 | | | |"
    delays = [[getattr(one, name) for one in found] for name in ("plain_delay_s", "delay_s")]
    quantiles = [quantiles_ms(one, (0.5, 0.9)) for one in delays]
    more = max(one.delay_s - one.plain_delay_s for one in found)
    return table_row(label, len(hit), len(plain), len(found), *quantiles, f"{more:.2f} s")


if __name__ == "__main__":
    main()
