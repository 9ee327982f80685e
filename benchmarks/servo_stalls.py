"""Four stalls of a real servo arm, found by supply current and by goal minus position.

python benchmarks/servo_stalls.py OUT [--data DIR] [--splits N] [--only METHOD ...]   every step is a tauext command

DIR holds the 49 recordings of one SO-101 (github.com/isaac-sim2real/sage, Apache-2.0, joined to Parquet files). A joint
drives against something four times in single_joint_wrist_roll. Five other motions with large, unexplained position
errors are left out. Of the others, at least 0.34 h are drawn for the test, motions whole; the rest, or as many as make
ten minutes, are for training. What is finished is not repeated.
"""

from __future__ import annotations

import json
import random
import re
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
from common import ROOT, arguments, head, table_row, tauext, write_tables

from tauext.bundle.bundle_file import load_bundle
from tauext.data.recording_file import load_recording

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
STALLS = "single_joint_wrist_roll"
UNEXPLAINED = ("prbs_excitation", "static_holding", "step_response", "large_amplitude", "single_joint_elbow")
ONSETS_S = ((43.0, 45.6), (51.8, 54.4), (60.3, 63.2), (69.1, 72.0))
WITHIN_S = 0.2
EARLY_S = 0.05  # an onset is read off the signals to a few samples
AFTER_S = 1.5  # what is raised so long after a stall is its end
TEST_S = 0.34 * 3600
ACKNOWLEDGED_S = 1.0
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


def by_current(folder: Path) -> Outcome:
    """An alarm wherever a joint's current is over its largest in training, acknowledged in the same way."""
    split = json.loads((folder / "data/split.json").read_text())
    largest = np.max([load_recording(folder / "data" / name).current.max(axis=0) for name in split["train"]], axis=0)
    alarms, hours = {}, 0.0
    for name in (f"{STALLS}.parquet", *split["test"]):
        recording = load_recording(folder / "data" / name)
        over = recording.time_s[(recording.current > largest).any(axis=1)]
        raised: list[float] = []
        for time_s in over:
            if not raised or time_s >= raised[-1] + ACKNOWLEDGED_S:
                raised.append(float(time_s))
        alarms[recording.name] = raised
        hours += recording.duration_s / 3600
    return judged(alarms, hours)


def judged(alarms: dict[str, list[float]], hours: float) -> Outcome:
    """What of the alarms was a stall, and how soon."""
    delays: list[float | None] = []
    for onset_s, _ in ONSETS_S:
        delay = [t - onset_s for t in alarms.get(STALLS, []) if onset_s - EARLY_S <= t <= onset_s + WITHIN_S]
        delays.append(min(delay) if delay else None)
    beside = [t for t in alarms.get(STALLS, []) if not any(on - EARLY_S <= t <= off + AFTER_S for on, off in ONSETS_S)]
    false = len(beside) + sum(len(times) for name, times in alarms.items() if name != STALLS)
    held_s = sum(off + AFTER_S - on + EARLY_S for on, off in ONSETS_S)
    return Outcome(tuple(delays), false, hours - held_s / 3600)


def row(source: str, minutes: int, method: str, outcomes: list[Outcome]) -> str:
    found = " ".join(str(sum(d is not None for d in one.delays_s)) for one in outcomes)
    delays = [d for one in outcomes for d in one.delays_s if d is not None]
    delay = f"{1000 * np.median(delays):.0f} ({1000 * max(delays):.0f})" if delays else "–"
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
    parser.add_argument("--splits", type=int, default=3)
    parser.add_argument("--only", nargs="+", choices=tuple(METHODS), default=tuple(METHODS))
    options = parser.parse_args()
    out, data = options.out.resolve(), options.data.resolve()
    if not (data / f"{STALLS}.parquet").exists():
        sys.exit(f"{data}: holds no {STALLS}.parquet; --data names the folder of the recordings")
    rows = []
    for source in SOURCES:
        for minutes in MINUTES:
            folders = [prepare(out, data, Trial(split, source, minutes)) for split in range(options.splits)]
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
