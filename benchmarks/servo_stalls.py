"""Four stalls of a real servo arm, found by supply current and by goal minus position.

python benchmarks/servo_stalls.py OUT [--data DIR] [--seeds N ...] [--only METHOD ...]   every step is a tauext command
python benchmarks/servo_stalls.py OUT --guard    what `tauext guard` makes, beside thresholds on the current

DIR holds the 49 recordings of one SO-101 (github.com/isaac-sim2real/sage, Apache-2.0, joined to Parquet files). A joint
drives against something four times in single_joint_wrist_roll. Five other motions with large, unexplained position
errors are left out. Of the others, at least 0.34 h are drawn for the test, motions whole; the rest, or as many as make
ten minutes, are for training. What is finished is not repeated.

With --guard, joints are also blocked by calculation in the test motions: the position stops while the recorded goal
goes on for up to 3 s, and the supply current follows from goal minus position as it does in these recordings at rest.
"""

from __future__ import annotations

import json
import random
import re
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
from common import ROOT, arguments, head, table_row, tauext, write_tables
from tauext_lerobot.guard import HOLD_S, GuardEvent, StallRule, load_guard, watch

from tauext.bundle.bundle_file import load_bundle
from tauext.data.recording import Recording
from tauext.data.recording_file import load_recording
from tauext.data.servo import servo_of, velocity_and_torque

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
STALLS = "single_joint_wrist_roll"
UNEXPLAINED = ("prbs_excitation", "static_holding", "step_response", "large_amplitude", "single_joint_elbow")
ONSETS_S = ((43.0, 45.6), (51.8, 54.4), (60.3, 63.2), (69.1, 72.0))
WITHIN_S = 0.2
EARLY_S = 0.05  # an onset is read off the signals to a few samples
AFTER_S = 1.5  # what is raised so long after a stall is its end
TEST_S = 0.34 * 3600
ACKNOWLEDGED_S = 1.0
GUARD_WITHIN_S = 1.0  # of what waits for 0.3 s; a joint falls behind slowly before it stands
RATE_HZ = 50
TRAVELS_RAD = 0.1
SOURCES = ("goal", "supply-current")
MINUTES = (0, 10)
METHODS = {
    "tauext": ["--recipe", "tauext"],
    "prior": ["--recipe", "prior"],
    "friction": ["--recipe", "friction"],
    "observer": ["--recipe", "observer"],
    "paper": ["--recipe", "paper"],
}
ONCE = (("tauext", 0), ("tauext", 10), ("paper", 10))
"""Methods, and minutes of training, that the first split alone is tried with."""
CURRENT = "threshold: largest current in training"
AMPERE_A_RAD2 = 70.7
MOST_AMPERE = 9.8
"""Supply current at rest, (goal - position)^2 times this up to its largest value, in the unit of the recordings."""
BLOCKED_RAD = 0.15
"""Least way of the goal beyond a blocked joint, held for 0.6 s: 0.4 of the servo's duty."""


@dataclass(frozen=True)
class Trial:
    """One split, one source of the torque, one amount of training."""

    split: int
    source: str
    minutes: int

    @property
    def name(self) -> str:
        return f"{self.source}-{self.minutes or 'all'}-{self.split}"


@dataclass(frozen=True)
class Outcome:
    """What a method said of a trial."""

    delays_s: tuple[float | None, ...]
    """Of each stall, from its onset; None: not within WITHIN_S."""
    false: int
    """Alarms in test motions, and beside the stalls."""
    hours: float
    promised: float | None = None
    """False alarms that the limits promise in these hours, at most; None: nothing."""
    predicted: dict | None = None
    """By training, for motion that it lacks: `limits.other_motion` of the run file."""
    better: str = ""
    """Signal that training names as better, and the size of its pushes beside this one's."""


def drawn(data: Path, trial: Trial) -> tuple[list[str], list[str]]:
    """Motions for training and test."""
    free = sorted(p.stem for p in data.glob("*.parquet") if p.stem not in (*UNEXPLAINED, STALLS))
    length_s = {name: span_s(data / f"{name}.parquet") for name in free}
    random.Random(trial.split).shuffle(free)
    test: list[str] = []
    while sum(length_s[name] for name in test) < TEST_S:
        test.append(free.pop())
    training: list[str] = []
    for name in free if not trial.minutes else [name for name in free if all_move(data / f"{name}.parquet")]:
        if not trial.minutes or sum(length_s[one] for one in training) < 60 * trial.minutes:
            training.append(name)
    return training, test


def all_move(path: Path) -> bool:
    """Whether every joint travels, as it does where somebody records ten minutes on purpose."""
    columns = pq.read_table(path, columns=[f"q_{joint}" for joint in JOINTS])
    return all(np.ptp(columns[f"q_{joint}"].to_numpy()) > TRAVELS_RAD for joint in JOINTS)


def span_s(path: Path) -> float:
    times = pq.read_table(path, columns=["t"])["t"].to_numpy()
    return float(times[-1] - times[0])


def description(trial: Trial, training: list[str], test: list[str]) -> str:
    def listed(names: list[str]) -> str:
        return json.dumps([f"{name}.parquet" for name in names])

    return f"""\
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
train = {listed(training)}
validation = []
test = {listed(test)}
collisions = {listed([STALLS])}
"""


def prepare(out: Path, data: Path, trial: Trial) -> Path:
    """The dataset of a trial."""
    folder = out / trial.name
    folder.mkdir(parents=True, exist_ok=True)
    training, test = drawn(data, trial)
    (folder / "arm.toml").write_text(description(trial, training, test))
    if not (folder / "data").exists():
        files = [data / f"{name}.parquet" for name in (*training, *test, STALLS)]
        tauext("import", "--source", *files, "--arm", "arm.toml", "--out", "data", folder=folder)
    return folder


def carry_out(folder: Path, method: str) -> Outcome:
    """Train a bundle and run it on the stalls and on the test motions."""
    bundle = Path(f"{method}.tauext")
    if not (folder / bundle).exists():
        tauext("train", "--data", "data", *METHODS[method], "--out", bundle, folder=folder)
    test = json.loads((folder / "data/split.json").read_text())["test"]
    said = tauext(
        "run", bundle, *(f"data/{name}" for name in (f"{STALLS}.parquet", *test)),
        "--acknowledge-after-s", ACKNOWLEDGED_S, "--json", folder=folder,
    )  # fmt: skip
    alarms: dict[str, list[float]] = {}
    hours = 0.0
    for line in said.splitlines():
        event = json.loads(line)
        if event["event"] == "alarm" and event["alarm"] == "collision":
            alarms.setdefault(event["recording"], []).append(event["time_s"])
        if event["event"] == "end":
            hours += event["hours"]
    limits = json.loads(load_bundle(folder / bundle).provenance).get("limits") or {}
    outcome = judged(alarms, hours)
    if "promise" not in limits:
        return outcome
    rate = limits["promise"]["supported_budget"]["rate_per_hour"]
    other = limits.get("other_motion", {})
    predicted = other if "factor" in other else None
    return replace(
        outcome, promised=rate * outcome.hours, predicted=predicted, better=better(limits.get("signals", {}))
    )


def better(signals: dict) -> str:
    """The signal that a training's comparison recommends, and the ratio of detectable pushes; empty: none."""
    named = re.search(r'torque_from = "([\w-]+)"', signals.get("sentence", ""))
    if named is None:
        return ""
    of = {one["torque_from"].replace("_", "-"): one for one in signals["compared"]}
    own, other = signals["compared"][0], of[named[1]]
    ratio = np.median(np.divide(other["limit_shares"], own["limit_shares"])) * other["kept_by"] / own["kept_by"]
    return f"{named[1]} {ratio:.2g}"


def by_current(folder: Path, factor: float = 1.0, hold_s: float = 0.0) -> Outcome:
    """An alarm wherever a joint's current is over its largest in training, acknowledged in the same way.

    Args:
        factor: on that current.
        hold_s: time for which the joint must draw it and rest.
    """
    split = json.loads((folder / "data/split.json").read_text())
    most = factor * largest_current(folder)
    alarms, hours = {}, 0.0
    for name in (f"{STALLS}.parquet", *split["test"]):
        recording = load_recording(folder / "data" / name)
        raised: list[float] = []
        for time_s in over_current(recording, most, hold_s):
            if not raised or time_s >= raised[-1] + ACKNOWLEDGED_S:
                raised.append(time_s)
        alarms[recording.name] = raised
        hours += recording.duration_s / 3600
    return judged(alarms, hours, GUARD_WITHIN_S if hold_s else WITHIN_S)


def largest_current(folder: Path) -> np.ndarray:
    """Of each joint in training, (joints,)."""
    split = json.loads((folder / "data/split.json").read_text())
    return np.max([load_recording(folder / "data" / name).current.max(axis=0) for name in split["train"]], axis=0)


def over_current(recording: Recording, most: np.ndarray, hold_s: float, joints: Sequence[int] = ()) -> list[float]:
    """Times at which some joint, or some of these, is over its current, [s]."""
    over = recording.current > most
    if joints:
        over[:, [j for j in range(len(most)) if j not in joints]] = False
    if hold_s:
        rule = StallRule(len(most), round(hold_s * 1e9))
        over = np.array([rule.step(t, q, one) for t, q, one in zip(recording.t_ns, recording.q, over, strict=True)])
    return recording.time_s[over.any(axis=1)].tolist()


# --- The guard, on the same recordings and on joints that are blocked by calculation.


@dataclass(frozen=True)
class Blocked:
    """A recording in which a joint is blocked for a while."""

    recording: Recording
    joint: int
    from_s: float
    to_s: float


def blocked(recording: Recording, joint: int) -> Blocked | None:
    """The recording with this joint blocked at the first moving sample from which the goal goes on far enough."""
    q, goal = recording.q[:, joint], recording.q_des[:, joint]
    for k in range(3 * RATE_HZ, len(q) - 2 * RATE_HZ):
        ahead = np.abs(goal[k : k + 3 * RATE_HZ] - q[k])
        far = ahead >= BLOCKED_RAD
        first = int(np.argmax(far))
        if abs(q[k] - q[k - 10]) < 0.05 or not far.any() or first > 1.5 * RATE_HZ:
            continue
        back = np.flatnonzero(ahead[first:] < 0.7 * BLOCKED_RAD)
        end = k + (first + int(back[0]) if len(back) else len(ahead))
        if end - k - first < 0.6 * RATE_HZ:
            continue
        stands, current = recording.q.copy(), recording.current.copy()
        stands[k:end, joint] = q[k]
        current[k:end, joint] = np.minimum(AMPERE_A_RAD2 * (goal[k:end] - q[k]) ** 2, MOST_AMPERE)
        after = min(end + RATE_HZ, len(q))
        stands[end:after, joint] = np.linspace(q[k], q[after - 1], after - end)
        signals = {"q_des": recording.q_des, "current": current}
        dq, tau = velocity_and_torque(servo_of(recording.provenance["servo"]), recording.t_ns, stands, signals)
        rows = slice(max(0, k - 6 * RATE_HZ), after)
        times = recording.time_s - recording.time_s[rows][0]
        cut = replace(
            recording, t_ns=recording.t_ns[rows], q=stands[rows], dq=dq[rows], tau=tau[rows], current=current[rows],
            q_des=recording.q_des[rows],
        )  # fmt: skip
        return Blocked(cut, joint, float(times[k]), float(times[min(end, after - 1)]))
    return None


@dataclass(frozen=True)
class GuardOutcome:
    """What a guard or a threshold found of a trial."""

    stalls: Outcome
    blocked: int
    delays_s: list[float]
    """Of the blocked joints that were found, from the moment of blocking."""
    by_joint: Counter[str]
    """Blocked joints that were found."""
    of_joint: Counter[str]


def make_guard(out: Path, data: Path, trial: Trial) -> Path:
    """The dataset of a trial, with a guard that `tauext guard` made of its training motions."""
    folder = prepare(out, data, trial)
    if not (folder / "guard").exists():
        training, _ = drawn(data, trial)
        kept = [line for line in description(trial, training, []).splitlines() if not line.startswith("collisions")]
        (folder / "guard.toml").write_text("\n".join(kept))
        files = [data / f"{name}.parquet" for name in training]
        tauext("guard", "--source", *files, "--arm", "guard.toml", "--out", "guard", folder=folder)
    return folder


def blocked_joints(folder: Path) -> list[Blocked]:
    """Every joint blocked once in every test motion that moves it far enough."""
    test = json.loads((folder / "data/split.json").read_text())["test"]
    motions = [load_recording(folder / "data" / name) for name in test]
    return [one for motion in motions for j in range(len(JOINTS)) if (one := blocked(motion, j)) is not None]


def by_guard(folder: Path, declared: bool, blocks: list[Blocked]) -> GuardOutcome:
    """The guard, with the gripper's grip declared or not."""
    bundle, _, settings = load_guard(folder / "guard")
    settings = settings if declared else replace(settings, grip=None)
    test = json.loads((folder / "data/split.json").read_text())["test"]
    alarms, hours = {}, 0.0
    for name in (f"{STALLS}.parquet", *test):
        recording = load_recording(folder / "data" / name)
        alarms[recording.name] = began(watch(bundle, settings, recording), recording)
        hours += recording.duration_s / 3600

    def times(one: Blocked) -> list[float]:
        return began(watch(bundle, settings, one.recording), one.recording, JOINTS[one.joint])

    return with_blocked(judged(alarms, hours, GUARD_WITHIN_S), blocks, times)


def began(events: list[GuardEvent], recording: Recording, joint: str = "") -> list[float]:
    """Times at which stalls and grips begin, of one joint or of all, [s]."""
    kinds = ("stall", "grip")
    return [(e.t_ns - recording.t_ns[0]) * 1e-9 for e in events if e.kind in kinds and joint in ("", e.joint)]


def with_blocked(stalls: Outcome, blocks: list[Blocked], times: Callable[[Blocked], list[float]]) -> GuardOutcome:
    """Add what was found of the blocked joints."""
    delays, found = [], Counter[str]()
    for one in blocks:
        within = [t - one.from_s for t in times(one) if one.from_s <= t <= one.to_s]
        if within:
            delays.append(within[0])
            found[JOINTS[one.joint]] += 1
    return GuardOutcome(stalls, len(blocks), delays, found, Counter(JOINTS[one.joint] for one in blocks))


def guard_rows(out: Path, data: Path, seeds: Sequence[int]) -> list[str]:
    """The table of the guard and the thresholds."""
    thresholds = {
        CURRENT: (1.0, 0.0), "that times 1.5": (1.5, 0.0), "largest current, at rest for 0.3 s": (1.0, HOLD_S),
        "that times 1.5, at rest for 0.3 s": (1.5, HOLD_S),
    }  # fmt: skip
    rows = []
    for source in SOURCES:
        for minutes in MINUTES:
            folders = [make_guard(out, data, Trial(seed, source, minutes)) for seed in seeds]
            blocks = [blocked_joints(folder) for folder in folders]
            pairs = list(zip(folders, blocks, strict=True))
            made = {
                "guard": [by_guard(folder, True, one) for folder, one in pairs],
                "guard, gripper not declared": [by_guard(folder, False, one) for folder, one in pairs],
            }
            for name, (factor, hold_s) in thresholds.items() if source == SOURCES[-1] else ():
                made[name] = [by_threshold(folder, factor, hold_s, one) for folder, one in pairs]
            for name, outcomes in made.items():
                rows.append(guard_row(source, minutes, name, outcomes))
                print(rows[-1], flush=True)
    return rows


def by_threshold(folder: Path, factor: float, hold_s: float, blocks: list[Blocked]) -> GuardOutcome:
    """A threshold on the current."""
    most = factor * largest_current(folder)
    return with_blocked(
        by_current(folder, factor, hold_s), blocks, lambda one: over_current(one.recording, most, hold_s, [one.joint])
    )


def guard_row(source: str, minutes: int, name: str, outcomes: list[GuardOutcome]) -> str:
    stalls = [one.stalls for one in outcomes]
    found = " ".join(str(sum(d is not None for d in one.delays_s)) for one in stalls)
    false, hours = [one.false for one in stalls], sum(one.hours for one in stalls)
    delays = [d for one in stalls for d in one.delays_s if d is not None]
    of = sum((one.of_joint for one in outcomes), Counter())
    by = sum((one.by_joint for one in outcomes), Counter())
    missed = ", ".join(f"{joint} {of[joint] - by[joint]} of {of[joint]}" for joint in JOINTS if by[joint] < of[joint])
    blocks = [d for one in outcomes for d in one.delays_s]
    return table_row(
        source, minutes or "all", name, found, in_ms(delays), " ".join(map(str, false)), f"{hours:.2f}",
        f"{sum(false) / hours:.1f}", f"{len(blocks)}/{sum(one.blocked for one in outcomes)}", in_ms(blocks),
        missed or "–",
    )  # fmt: skip


def in_ms(delays_s: list[float]) -> str:
    """Median and largest."""
    return f"{1000 * np.median(delays_s):.0f} ({1000 * max(delays_s):.0f})" if delays_s else "–"


def judged(alarms: dict[str, list[float]], hours: float, within_s: float = WITHIN_S) -> Outcome:
    """What of the alarms was a stall, and how soon."""
    delays: list[float | None] = []
    for onset_s, _ in ONSETS_S:
        delay = [t - onset_s for t in alarms.get(STALLS, []) if onset_s - EARLY_S <= t <= onset_s + within_s]
        delays.append(min(delay) if delay else None)
    beside = [t for t in alarms.get(STALLS, []) if not any(on - EARLY_S <= t <= off + AFTER_S for on, off in ONSETS_S)]
    false = len(beside) + sum(len(times) for name, times in alarms.items() if name != STALLS)
    held_s = sum(off + AFTER_S - on + EARLY_S for on, off in ONSETS_S)
    return Outcome(tuple(delays), false, hours - held_s / 3600)


def row(source: str, minutes: int, method: str, outcomes: list[Outcome]) -> str:
    found = " ".join(str(sum(d is not None for d in one.delays_s)) for one in outcomes)
    delays = [d for one in outcomes for d in one.delays_s if d is not None]
    delay = in_ms(delays)
    false, hours = " ".join(str(one.false) for one in outcomes), sum(one.hours for one in outcomes)
    promised = " ".join("–" if one.promised is None else f"{one.promised:.1f}" for one in outcomes)
    predicted = [
        f"{one.predicted['factor']:.2g} ({one.predicted['at_most']:.2g})" if one.predicted else "–" for one in outcomes
    ]
    seen = [f"{one.false / one.promised:.2g}" if one.promised else "–" for one in outcomes]
    cells = [source, minutes or "all", method, found, delay, false, f"{hours:.2f}", promised]
    better = ", ".join(one.better or "–" for one in outcomes)
    return table_row(*cells, ", ".join(seen), ", ".join(predicted), better)


def main() -> None:
    parser = arguments(__doc__, "out")
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data" / "so101_sage")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="of the splits, default: 0 1 2")
    parser.add_argument("--guard", action="store_true", help="the guard and the thresholds alone")
    parser.add_argument("--only", nargs="+", choices=tuple(METHODS), default=tuple(METHODS))
    options = parser.parse_args()
    out, data = options.out.resolve(), options.data.resolve()
    if not (data / f"{STALLS}.parquet").exists():
        sys.exit(f"{data}: holds no {STALLS}.parquet; --data names the folder of the recordings")
    if options.guard:
        columns = (
            "torque from | training, min | method | stalls found of 4 | delay, ms: median (most) | false | in h | "
        )
        columns += "false an hour | blocked joints found | delay, ms: median (most) | blocked joints missed"
        write_tables(out, [*head(columns), *guard_rows(out, data, options.seeds)], name="servo_guard")
        return
    rows = []
    for source in SOURCES:
        for minutes in MINUTES:
            folders = [prepare(out, data, Trial(split, source, minutes)) for split in options.seeds]
            for method in options.only:
                done = [carry_out(folder, method) for folder in (folders[:1] if (method, minutes) in ONCE else folders)]
                rows.append(row(source, minutes, method, done))
                print(rows[-1], flush=True)
            if source == SOURCES[-1]:
                rows.append(row(source, minutes, CURRENT, [by_current(folder) for folder in folders]))
                print(rows[-1], flush=True)
    columns = "torque from | training, min | method | stalls found of 4 | delay, ms: median (most) | false | in h | "
    columns += "promised | false per promised one | predicted by train (upper bound) | better by train, its pushes"
    write_tables(out, [*head(columns), *rows], name="servo_stalls")


if __name__ == "__main__":
    main()
