"""Four stalls of a real servo arm, found by supply current and by goal minus position.

    python packages/lerobot/benchmarks/servo_stalls.py OUT [--data DIR] [--seeds N ...]   every step is a tauext command
    python packages/lerobot/benchmarks/servo_stalls.py OUT --guard    what `tauext guard` makes, beside thresholds
    OPENBLAS_NUM_THREADS=1 python packages/lerobot/benchmarks/servo_stalls.py OUT --others    methods of others

DIR holds the 49 recordings of one SO-101 (github.com/isaac-sim2real/sage, Apache-2.0, joined to Parquet files). A joint
drives against something four times in single_joint_wrist_roll. Five other motions with large, unexplained position
errors are left out. Of the others, at least 0.34 h are drawn for the test, motions whole; the rest, or as many as make
ten minutes, are for training. What is finished is not repeated.

With --guard, joints are also blocked by calculation in the test motions: the position stops while the recorded goal
goes on for up to 3 s, and the supply current follows from goal minus position as it does in these recordings at rest.

With --others, recipe prior, the stall rule of servo users and NEXT are compared at equal measured false alarms.
"""

from __future__ import annotations

import json
import pickle
import random
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))

from common import arguments, head, table_row, tauext, trained, write_tables
from tauext_lab.evaluate.missed_curve import Detected, Scored, detected, equal_false_alarms, held_ratio
from tauext_lab.other_methods import Next, NextConfig, OtherMethod, fit_stall_rule, train_next
from tauext_lerobot.guard import HOLD_S, GuardEvent, StallRule, load_guard, watch

from tauext.bundle.bundle_file import load_bundle
from tauext.data.recording import Recording
from tauext.data.recording_file import load_recording
from tauext.data.servo import servo_of, velocity_and_torque
from tauext.monitor.estimate import estimate_recording

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
STALLS = "single_joint_wrist_roll"
LEFT_OUT = ("prbs_excitation", "static_holding", "step_response", "large_amplitude", "single_joint_elbow", STALLS)
ONSETS_S = ((43.0, 45.6), (51.8, 54.4), (60.3, 63.2), (69.1, 72.0))
"""Begin and end of each stall."""
EARLY_S = 0.05
"""An onset is read off the signals to a few samples."""
AFTER_S = 1.5
"""An alarm so long after a stall is its end."""
ACKNOWLEDGED_S = 1.0
RATE_HZ = 50
SOURCES = ("goal", "supply-current")


@dataclass(frozen=True)
class Trial:
    """One split, one source of the torque, one amount of training [min]; 0: all."""

    split: int
    source: str
    minutes: int

    @property
    def name(self) -> str:
        return f"{self.source}-{self.minutes or 'all'}-{self.split}"


@dataclass(frozen=True)
class Outcome:
    """What a method reported of a trial."""

    delays_s: tuple[float, ...]
    """Of the stalls that were found, from their onsets."""
    false: int
    """Alarms in test motions, and beside the stalls."""
    hours: float
    promised: float | None = None
    """False alarms that the limits promise in these hours, at most; None: nothing."""
    predicted: dict | None = None
    """By training, for motion that it lacks: `limits.other_motion` of the run file."""


def drawn(data: Path, trial: Trial) -> tuple[list[str], list[str]]:
    """Motions for training and test."""
    free = sorted(p.stem for p in data.glob("*.parquet") if p.stem not in LEFT_OUT)
    length_s = {name: np.ptp(column(data, name, "t")) for name in free}
    random.Random(trial.split).shuffle(free)
    test: list[str] = []
    while sum(length_s[name] for name in test) < 0.34 * 3600:
        test.append(free.pop())
    training: list[str] = []
    for name in free:  # where somebody records ten minutes on purpose, every joint travels
        moves = not trial.minutes or all(np.ptp(column(data, name, f"q_{joint}")) > 0.1 for joint in JOINTS)
        if moves and (not trial.minutes or sum(length_s[one] for one in training) < 60 * trial.minutes):
            training.append(name)
    return training, test


def column(data: Path, name: str, signal: str) -> np.ndarray:
    return pq.read_table(data / f"{name}.parquet", columns=[signal])[signal].to_numpy()


def prepare(out: Path, data: Path, trial: Trial) -> Path:
    """The folder of a trial with its dataset."""
    folder = out / trial.name
    folder.mkdir(parents=True, exist_ok=True)
    training, test = drawn(data, trial)
    sets = {"train": training, "validation": [], "test": test, "collisions": [STALLS]}
    split = [f"{name} = {json.dumps([f'{one}.parquet' for one in names])}" for name, names in sets.items()]
    text = f"""\
[robot]
joints = {json.dumps(JOINTS)}

[time]
column = "t"

[servo]
type = "sts3215-7.4v"
torque_from = "{trial.source}"

[signals]
q.columns = "q_{{joint}}"
q_des.columns = "goal_{{joint}}"
current.columns = "current_{{joint}}"

[split]
"""
    (folder / "arm.toml").write_text(text + "\n".join(split) + "\n")
    (folder / "guard.toml").write_text(text + "\n".join([split[0], split[1], "test = []"]) + "\n")
    if not (folder / "data").exists():
        files = [data / f"{name}.parquet" for name in (*training, *test, STALLS)]
        tauext("import", "--source", *files, "--arm", "arm.toml", "--out", "data", folder=folder)
    return folder


def recordings(folder: Path, *sets: str) -> list[Recording]:
    split = json.loads((folder / "data/split.json").read_text())
    return [load_recording(folder / "data" / name) for one in sets for name in split[one]]


def judged(alarms: dict[str, list[float]], hours: float, within_s: float = 0.2) -> Outcome:
    """What of the alarms was a stall, and how soon."""
    at_stalls = alarms.get(STALLS, [])
    found = [[t - on for t in at_stalls if on - EARLY_S <= t <= on + within_s] for on, _ in ONSETS_S]
    beside = [t for t in at_stalls if not any(on - EARLY_S <= t <= off + AFTER_S for on, off in ONSETS_S)]
    false = len(beside) + sum(len(times) for name, times in alarms.items() if name != STALLS)
    held_s = sum(off + AFTER_S - on + EARLY_S for on, off in ONSETS_S)
    return Outcome(tuple(min(delays) for delays in found if delays), false, hours - held_s / 3600)


def by_recipe(folder: Path, recipe: str) -> Outcome:
    """A bundle on the stalls and on the test motions."""
    # By goal and position, and without friction, limits are a large share of the torque; they are measured here.
    bundle = trained(folder / "data", folder / f"{recipe}.tauext", "--accept", "limit-wide", recipe=recipe)
    files = [folder / "data" / f"{one.name}.parquet" for one in recordings(folder, "collisions", "test")]
    alarms: dict[str, list[float]] = {}
    hours = 0.0
    for line in tauext("run", bundle, *files, "--acknowledge-after-s", ACKNOWLEDGED_S, "--json").splitlines():
        event = json.loads(line)
        if event["event"] == "alarm" and event["alarm"] == "collision":
            alarms.setdefault(event["recording"], []).append(event["time_s"])
        if event["event"] == "end":
            hours += event["hours"]
    limits, outcome = json.loads(load_bundle(bundle).provenance).get("limits") or {}, judged(alarms, hours)
    if "promise" not in limits:
        return outcome
    rate, other = limits["promise"]["supported_budget"]["rate_per_hour"], limits.get("other_motion", {})
    return replace(outcome, promised=rate * outcome.hours, predicted=other if "factor" in other else None)


# --- A threshold on the current, and the guard, also on joints that are blocked by calculation.


def by_current(folder: Path, factor: float = 1.0, hold_s: float = 0.0) -> Outcome:
    """An alarm wherever a joint's current is over its largest in training, acknowledged in the same way.

    Args:
        factor: on that current.
        hold_s: time for which the joint must draw it and rest.
    """
    most, alarms, hours = factor * largest_current(folder), {}, 0.0
    for recording in recordings(folder, "collisions", "test"):
        raised: list[float] = []
        for time_s in over_current(recording, most, hold_s):
            if not raised or time_s >= raised[-1] + ACKNOWLEDGED_S:
                raised.append(time_s)
        alarms[recording.name] = raised
        hours += recording.duration_s / 3600
    return judged(alarms, hours, 1.0 if hold_s else 0.2)


def largest_current(folder: Path) -> np.ndarray:
    """Of each joint in training, (joints,)."""
    return np.max([one.current.max(axis=0) for one in recordings(folder, "train")], axis=0)


def over_current(recording: Recording, most: np.ndarray, hold_s: float, joint: int | None = None) -> list[float]:
    """Times at which some joint, or this one, is over its current, [s]."""
    over = recording.current > most
    if joint is not None:
        over[:, np.arange(len(most)) != joint] = False
    if hold_s:
        rule = StallRule(len(most), round(hold_s * 1e9))
        over = np.array([rule.step(t, q, one) for t, q, one in zip(recording.t_ns, recording.q, over, strict=True)])
    return recording.time_s[over.any(axis=1)].tolist()


@dataclass(frozen=True)
class Blocked:
    """A recording in which a joint is blocked for a while."""

    recording: Recording
    joint: int
    from_s: float
    to_s: float


def blocked(recording: Recording, joint: int) -> Blocked | None:
    """The recording with this joint blocked at the first moving sample from which the goal goes on far enough."""
    q, goal, far_rad = recording.q[:, joint], recording.q_des[:, joint], 0.15  # 0.4 of the servo's duty
    for k in range(3 * RATE_HZ, len(q) - 2 * RATE_HZ):
        ahead = np.abs(goal[k : k + 3 * RATE_HZ] - q[k])
        far = ahead >= far_rad
        first = int(np.argmax(far))
        if abs(q[k] - q[k - 10]) < 0.05 or not far.any() or first > 1.5 * RATE_HZ:
            continue
        back = np.flatnonzero(ahead[first:] < 0.7 * far_rad)
        end = k + (first + int(back[0]) if len(back) else len(ahead))
        if end - k - first < 0.6 * RATE_HZ:
            continue
        stands, current = recording.q.copy(), recording.current.copy()
        stands[k:end, joint] = q[k]
        current[k:end, joint] = np.minimum(70.7 * (goal[k:end] - q[k]) ** 2, 9.8)  # as these recordings have at rest
        after = min(end + RATE_HZ, len(q))
        stands[end:after, joint] = np.linspace(q[k], q[after - 1], after - end)
        signals = {"q_des": recording.q_des, "current": current}
        dq, tau = velocity_and_torque(servo_of(recording.provenance["servo"]), recording.t_ns, stands, signals)
        rows = slice(max(0, k - 6 * RATE_HZ), after)
        times = recording.time_s - recording.time_s[rows][0]
        made = {"t_ns": recording.t_ns, "q": stands, "dq": dq, "tau": tau} | signals
        cut = replace(recording, **{name: values[rows] for name, values in made.items()})
        return Blocked(cut, joint, float(times[k]), float(times[min(end, after - 1)]))
    return None


def guarded(folder: Path, data: Path, trial: Trial) -> tuple[Outcome, Callable[[Blocked], list[float]]]:
    """The guard that `tauext guard` makes of the training motions."""
    if not (folder / "guard").exists():
        files = [data / f"{name}.parquet" for name in drawn(data, trial)[0]]
        tauext("guard", "--source", *files, "--arm", "guard.toml", "--out", "guard", folder=folder)
    bundle, _, settings = load_guard(folder / "guard")

    def times(recording: Recording, joint: str = "") -> list[float]:
        events: list[GuardEvent] = watch(bundle, settings, recording)
        of = [e for e in events if e.kind in ("stall", "grip") and joint in ("", e.joint)]
        return [(e.t_ns - recording.t_ns[0]) * 1e-9 for e in of]

    tested = recordings(folder, "collisions", "test")
    hours = sum(one.duration_s for one in tested) / 3600
    outcome = judged({one.name: times(one) for one in tested}, hours, 1.0)  # a joint falls behind slowly
    return outcome, lambda one: times(one.recording, JOINTS[one.joint])


def guard_rows(out: Path, data: Path, seeds: Sequence[int]) -> list[str]:
    """The table of the guard and the thresholds: factor on the current, and time for which it must hold."""
    rows = head(
        "torque from | training, min | method | stalls found of 4 | delay, ms: median (most) | false | in h "
        "| blocked joints found | delay, ms: median (most)"
    )
    for source in SOURCES:
        for minutes in (0, 10):
            made: dict[str, list] = {}
            for trial in (Trial(seed, source, minutes) for seed in seeds):
                folder = prepare(out, data, trial)
                blocks = [b for one in recordings(folder, "test") for j in range(6) if (b := blocked(one, j))]
                ways = {"guard": guarded(folder, data, trial)}
                for factor, hold_s in ((1.0, 0.0), (1.5, 0.0), (1.0, HOLD_S), (1.5, HOLD_S)):
                    if source == "supply-current":
                        most = factor * largest_current(folder)
                        name = f"threshold: {factor:g} times the largest current, at rest for {hold_s:g} s"
                        ways[name] = by_current(folder, factor, hold_s), (
                            lambda b, most=most, hold_s=hold_s: over_current(b.recording, most, hold_s, b.joint)
                        )  # fmt: skip
                for name, (outcome, times) in ways.items():
                    within = [[t - b.from_s for t in times(b) if b.from_s <= t <= b.to_s] for b in blocks]
                    made.setdefault(name, []).append((outcome, within))
            for name, outcomes in made.items():
                every = [one for _, within in outcomes for one in within]
                delays = [one[0] for one in every if one]
                cells = cells_of([one for one, _ in outcomes])
                found = f"{len(delays)}/{len(every)}", in_ms(delays)
                rows.append(table_row(source, minutes or "all", name, *cells, *found))
                print(rows[-1], flush=True)
    return rows


# --- Methods of others, at equal measured false alarms.


Score = Callable[[Recording], np.ndarray]
WITHIN_S = 1.0
"""A stall rule waits until the joint rests."""
RATES_PER_HOUR = (None, 0.0, 10.0)
"""Of false alarms, at most; None: with the method's own limits."""
NEXT_CONFIG = NextConfig(hidden=32, head=64, batch=128, epochs=5)
"""A quarter of the published units, 41 s of a core. Of 2048 windows, ten minutes at 50 Hz have 15 steps an epoch."""


def scores(out: Path, data: Path, seed: int, minutes: int) -> dict[str, Score]:
    """Each method's score after training on one split."""
    made: dict[str, Score] = {}
    for source in SOURCES:
        folder = prepare(out, data, Trial(seed, source, minutes))
        bundle = load_bundle(trained(folder / "data", folder / "prior.tauext", "--accept", "limit-wide"))
        made[f"prior by {source}"] = lambda one, b=bundle: held_ratio(estimate_recording(b, one), b.hold_s)
    training, most = recordings(folder, "train"), largest_current(folder)
    made["largest current in training"] = lambda one: (one.current / most).max(axis=1)
    rule = fit_stall_rule(training)
    others: dict[str, OtherMethod] = {"stall rule": rule}
    others["stall rule without position error"] = replace(rule, error_rad=np.full(len(JOINTS), 1e-9))
    for commanded in (True, False) if minutes else ():
        name = "NEXT" if commanded else "NEXT without goals"
        others[name] = next_of(folder / f"{name.replace(' ', '-')}.pickle", training, commanded)
    return made | {name: lambda one, other=other: other.ratio(one).max(axis=1) for name, other in others.items()}


def next_of(path: Path, training: Sequence[Recording], commanded: bool) -> Next:
    """The trained network, kept in this file."""
    if not path.exists():
        made = train_next(training, config=replace(NEXT_CONFIG, commanded=commanded), report=print)
        path.write_bytes(pickle.dumps(made))
    return pickle.loads(path.read_bytes())


def scored(recording: Recording, score: Score, spans_s: Sequence[tuple[float, float, float]], free: bool) -> Scored:
    """A recording with contacts: begin, end of the time in which an alarm finds them, begin of free time."""
    spans = np.searchsorted(recording.time_s, np.reshape(spans_s, (-1, 3)))
    is_free = np.full(recording.samples, free)
    for begin, _, over in spans.tolist():
        is_free[begin:over] = False
    return Scored(recording.t_ns, score(recording), is_free, [(begin, end) for begin, end, _ in spans.tolist()])


def other_rows(out: Path, data: Path, seeds: Sequence[int]) -> list[str]:
    """The table: of stalls and of joints that are blocked by calculation, at several rates of false alarms."""
    rows = head("training, min | method | limits times | false alarms (95 %, an hour) | stalls found (95 %) "
                "| delay, ms: median (most) | blocked joints found (95 %)")  # fmt: skip
    stalls = [(on - EARLY_S, on + WITHIN_S, off + AFTER_S) for on, off in ONSETS_S]
    for minutes in (0, 10):
        free: dict[str, list[Scored]] = {}
        held: dict[str, list[Scored]] = {}
        for seed in seeds:
            tested = [recordings(prepare(out, data, Trial(seed, source, minutes)), "collisions", "test")
                      for source in SOURCES]  # fmt: skip
            for name, score in scores(out, data, seed, minutes).items():
                of = tested[SOURCES.index("goal") if name == "prior by goal" else -1]
                blocks = [b for one in of[1:] for j in range(6) if (b := blocked(one, j))]
                free.setdefault(name, []).extend(scored(one, score, stalls * (one is of[0]), True) for one in of)
                held.setdefault(name, []).extend(
                    scored(b.recording, score, [(b.from_s, b.to_s, b.to_s)], False) for b in blocks
                )
        for name, recorded in free.items():
            for rate in RATES_PER_HOUR:
                at = detected(recorded) if rate is None else equal_false_alarms(recorded, rate)[1]
                blocked_too = share(detected(held[name], at.factor))
                low, high = at.false_per_hour
                false = f"{at.false} in {at.hours:.2f} h ({low:.2g} to {high:.2g})"
                cells = false, share(at), in_ms([delay - EARLY_S for delay in at.delays_s]), blocked_too
                rows.append(table_row(minutes or "all", name, f"{at.factor:.2f}", *cells))
                print(rows[-1], flush=True)
    return rows


def share(of: Detected) -> str:
    """Found contacts, and their share with its interval."""
    low, high = of.found_share
    return f"{of.found}/{of.contacts} ({100 * low:.0f} to {100 * high:.0f} %)"


def in_ms(delays_s: list[float]) -> str:
    """Median and largest."""
    return f"{1000 * np.median(delays_s):.0f} ({1000 * max(delays_s):.0f})" if delays_s else "–"


def cells_of(outcomes: list[Outcome]) -> list[str]:
    """Stalls found, delay, false alarms, hours."""
    found, false = (
        " ".join(map(str, one)) for one in zip(*((len(o.delays_s), o.false) for o in outcomes), strict=True)
    )
    delays = [delay for one in outcomes for delay in one.delays_s]
    return [found, in_ms(delays), false, f"{sum(one.hours for one in outcomes):.2f}"]


def recipe_rows(out: Path, data: Path, seeds: Sequence[int]) -> list[str]:
    rows = head(
        "torque from | training, min | method | stalls found of 4 | delay, ms: median (most) | false | in h "
        "| false per promised one | predicted by train (upper bound)"
    )
    for source in SOURCES:
        for minutes in (0, 10):
            folders = [prepare(out, data, Trial(split, source, minutes)) for split in seeds]
            ways = {recipe: [by_recipe(folder, recipe) for folder in folders] for recipe in ("prior", "observer")}
            if source == "supply-current":
                ways["threshold: largest current in training"] = [by_current(folder) for folder in folders]
            for method, done in ways.items():
                ratio = [f"{one.false / one.promised:.2g}" if one.promised else "–" for one in done]
                known = [one.predicted for one in done]
                predicted = [f"{one['factor']:.2g} ({one['at_most']:.2g})" if one else "–" for one in known]
                cells = *cells_of(done), ", ".join(ratio), ", ".join(predicted)
                rows.append(table_row(source, minutes or "all", method, *cells))
                print(rows[-1], flush=True)
    return rows


def main() -> None:
    parser = arguments(__doc__, "out", data="so101_sage")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="of the splits, default: 0 1 2")
    kind = parser.add_mutually_exclusive_group()
    kind.add_argument("--guard", action="store_true", help="the guard and the thresholds alone")
    kind.add_argument("--others", action="store_true", help="methods of others, at equal measured false alarms")
    options = parser.parse_args()
    out, data = options.out.resolve(), options.data.resolve()
    if not (data / f"{STALLS}.parquet").exists():
        sys.exit(f"{data}: holds no {STALLS}.parquet; --data names the folder of the recordings")
    rows, name = recipe_rows, "servo_stalls"
    if options.guard or options.others:
        rows, name = (guard_rows, "servo_guard") if options.guard else (other_rows, "servo_others")
    write_tables(out, rows(out, data, options.seeds), name=name)


if __name__ == "__main__":
    main()
