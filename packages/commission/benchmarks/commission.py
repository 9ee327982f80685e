"""Days of `tauext commission` on simulated arms, with touches that nobody reports: a fast simulation without a page.

    python packages/commission/benchmarks/commission.py OUT --arm offset_wrist [--no-model]
        [--plan loads|calm|week] [--hours H] [--touch-every MINUTES] [--seed 0]
    python packages/commission/benchmarks/commission.py OUT --tables      OUT/days.md: tables of all results in OUT

Plan `loads`: four parts of --hours (6), each after a pause of two hours and from a cold start: bare, with one load,
with a heavier one, with another tool. Plan `calm`: the first part, and nothing touches the arm. Plan `week`: seven
days of --hours (4) each. Something touches the arm once in --touch-every minutes (10), and nobody says so. Alarms
without a touch are answered `nothing`; a question about a change of the arm is answered `learn` after two minutes.
Recorder, training process and monitor are those of the command; a training takes the simulated time that it takes
here. After the first part of `loads`, `tauext train` and `tauext calibrate` make a bundle of the same recordings, and
both bundles are evaluated on an hour of new motion with 150 touches.
OUT/ARM-PLAN gets the folder, OUT/ARM-PLAN.json the result.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import sys
import time
from collections import deque
from dataclasses import asdict, dataclass, field, replace
from datetime import date
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command does

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))

from common import COLLISION, arguments, commit, head, save_json, table_row, tauext, write_tables
from made_live import replay as replayed
from tauext_commission.connect import as_data, provenance_of, write_arm
from tauext_commission.folder import CommissionFolder, wall
from tauext_commission.history import promise_of
from tauext_commission.history_file import read_events, read_history, read_question
from tauext_commission.motion_recorder import MotionRecorder
from tauext_commission.trainer import Trainer
from tauext_lab.evaluate.comparison import evaluate
from unseen.working import NAMES, STRETCH_S, Part, Working, working

from tauext import _core
from tauext.bundle.bundle_file import load_bundle
from tauext.bundle.estimates import NONE
from tauext.data.dataset import load_split
from tauext.data.free_motion import cut
from tauext.data.labels import Label
from tauext.data.recording import Recording, runs_of
from tauext.data.servo import RAW_SIGNALS
from tauext.fit.tail import is_kept, rate_interval
from tauext.monitor.changes import AlarmChange

PAUSE_NS, JOIN_NS = round(2 * 3.6e12), 2_000_000_000
"""Between two parts, and between two stretches of one."""
NEAR_NS = 500_000_000
"""An alarm so long after a touch is the touch's."""
ANSWER_S = 120.0
REPEATED_S = 60.0
"""What a new bundle's monitor repeats before it takes over."""
BUSY_S, SELDOM = 1800.0, 6
"""So long after its last bundle the training process is asked after every sixth recording only, to save time here."""
TEST_STRETCHES, TEST_TOUCHES = 6, 50


@dataclass
class Outcome:
    """What happened in one part."""

    name: str
    hours: float = 0.0
    """Monitored."""
    received_h: float = 0.0
    touches: int = 0
    detected: int = 0
    false: int = 0
    """Collisions without a touch."""
    promised: list[float | None] = field(default_factory=list)
    """False alarms an hour that the first and the last bundle of the part promise."""
    allowed: float = 0.0
    """Sum of promised rates over the hours in which one was promised."""
    promised_h: float = 0.0
    false_promised: int = 0
    """False collisions while a rate was promised."""
    bundles: list[str] = field(default_factory=list)
    asked: list[str] = field(default_factory=list)
    waited_s: float | None = None
    """Motion from the start of the part, or from the answer to its question, until a bundle of it monitors."""


class Simulation:
    """One arm, its folder, and what happened."""

    def __init__(self, out: Path, arm: Working, seed: int, disk_bytes: float):
        self.arm, self.seed, self.touch_every_min = arm, seed, 10.0
        self.folder = CommissionFolder.open(out, create=True)
        robot = arm.robot
        if arm.robot_text:
            robot = out.with_suffix(".xml")
            robot.write_text(arm.robot_text)
        write_arm(arm.facts, robot, out)
        self.folder.save(arm=as_data(arm.facts), source="simulated")
        self.settings = arm.facts.settings
        self.trainer = Trainer(self.folder)
        self.outcomes: list[Outcome] = []
        self.sink = MotionRecorder(self.folder, self.settings, "simulated", disk_bytes)
        self.sink.open(self.settings.joints, None)  # type: ignore[arg-type]
        self.sink.worker.patient = True
        self.first_s: float | None = None
        self.busy_s = self.asked_s = 0.0
        self.monitor: _core.Monitor | None = None
        self.bundle = ""
        self.model = 0
        self.recent: deque[tuple[Recording, bytes]] = deque()
        """The last REPEATED_S, and what the monitor carried before each of its recordings."""
        self.newest: dict[str, Any] | None = None
        """The newest alarm's line."""
        self.alarms = self.number = 0
        self.now_ns = self.newest_s = 0
        self.most_bytes = 0
        self.work_s = 0.0

    # Motion.

    def part(self, part: Part) -> None:
        """One part: it starts cold."""
        self.outcomes.append(Outcome(part.name))
        begun_ns, begun_s = self.now_ns, self.folder.seconds()
        self.learned_s = begun_s
        while self.now_ns - begun_ns < part.hours * 3.6e12 - 1e9:
            made = self.arm.stretch(self.seed, self.number, part, 1e-9 * (self.now_ns - begun_ns), self.touches())
            self.number += 1
            self.stretch(replace(made, t_ns=made.t_ns + self.now_ns))
            self.now_ns += round(STRETCH_S * 1e9) + JOIN_NS
            self.most_bytes = max(
                self.most_bytes, sum(one.stat().st_size for one in self.folder.path.rglob("*") if one.is_file())
            )
        self.outcomes[-1].received_h = (self.folder.seconds() - begun_s) / 3600
        self.now_ns += PAUSE_NS

    def touches(self) -> int:
        """Number of touches of the next stretch."""
        if not self.touch_every_min:
            return 0
        minutes = STRETCH_S / 60
        return int((self.number + 1) * minutes / self.touch_every_min) - int(
            self.number * minutes / self.touch_every_min
        )

    def stretch(self, made: Recording) -> None:
        """Send a stretch in recordings of 10 s to monitor and recorder, and let the training process work between."""
        assert made.contact is not None
        found: list[tuple[int, int]] = []
        for a, b in runs_of(made.contact == 1).tolist():
            if found and made.t_ns[a] - made.t_ns[found[-1][1] - 1] < NEAR_NS:
                a = found.pop()[0]
            found.append((a, b))
        spans = [(int(made.t_ns[a]), int(made.t_ns[b - 1])) for a, b in found]
        rows = self.sink._rows
        for begin in range(0, made.samples, rows):
            part = cut(made, slice(begin, begin + rows))
            seconds = self.folder.seconds()
            if seconds >= self.busy_s:  # else the earlier bundle monitors while the training would still run
                self.take_over(seconds)
            carried = b""
            if self.monitor is not None:
                carried = self.monitor.carried()
                self.watch(part, spans)
            self.recent.append((part, carried))
            if len(self.recent) > REPEATED_S * made.rate_hz / rows:
                self.recent.popleft()
            names = ("t_ns", "q", "dq", "tau", *RAW_SIGNALS)
            signals = {name: getattr(part, name) for name in names if getattr(part, name) is not None}
            self.sink._labels = {one.id: one for one in self.folder.labels()}
            self.sink.worker.put(partial(self.sink._write, signals), must=True)
            while self.folder.seconds() < seconds + 0.9 * part.samples / made.rate_hz:
                time.sleep(0.001)
            self.answer(seconds)
            if seconds < self.newest_s + BUSY_S or (begin // rows) % SELDOM == 0:
                self.train()

    def train(self) -> None:
        """Let the training process work, in the simulated time that this takes here."""
        while (seconds := self.folder.seconds()) >= self.busy_s:
            self.take_over(seconds)  # the loop does not wait for the next training
            started = time.monotonic()
            if self.trainer.step() == "nothing":
                return
            took_s = time.monotonic() - started
            self.work_s += took_s
            self.busy_s = self.folder.seconds() + took_s

    def take_over(self, seconds: float) -> None:
        """Let the bundle in charge monitor, after a replay of the last motion."""
        active = self.folder.active()
        if active is None or active.stem == self.bundle:
            return
        bundle, outcome = load_bundle(active), self.outcomes[-1]
        monitor = _core.Monitor(bundle)
        if self.model == bundle.model_digest and self.recent and self.recent[0][1]:
            monitor.carry(self.recent[0][1])
        for part, _ in self.recent:
            monitor.run(part.t_ns, part.q, part.dq, part.tau)
        monitor.acknowledge()
        if self.monitor is not None:
            monitor.set_limit_factors(*(np.array(factors) for factors in self.monitor.limit_factors))
        self.monitor, self.bundle, self.model = monitor, active.stem, bundle.model_digest
        self.first_s = seconds if self.first_s is None else self.first_s
        if outcome.waited_s is None:
            outcome.waited_s = seconds - self.learned_s
        self.newest_s = int(seconds)
        outcome.bundles.append(active.stem)
        print(f"  {seconds / 60:7.1f} min  {self.folder.history()[-1]['words'][:110]}", flush=True)

    def answer(self, seconds: float) -> None:
        """A person lets every change of the arm be learned, after two minutes."""
        question = read_question(self.folder.path)
        if not question or "answer" in question:
            self.asked_s = 0.0
            return
        if not self.asked_s:
            self.asked_s = seconds
            words = str(question["words"])
            self.outcomes[-1].asked.append(words)
            print(f"  {seconds / 60:7.1f} min  asked: {words[:160]}", flush=True)
        elif seconds > self.asked_s + ANSWER_S:
            self.folder.append_reply("learn", "sim")
            self.outcomes[-1].waited_s, self.learned_s = None, seconds
            self.newest_s = int(seconds)

    # The monitor.

    def watch(self, part: Recording, spans: list[tuple[int, int]]) -> None:
        """Monitor 10 s; alarms become events and labels."""
        assert self.monitor is not None
        outcome, hours = self.outcomes[-1], part.samples / part.rate_hz / 3600
        outcome.hours += hours
        promised = promise_of(self.folder.path, self.bundle)[0]
        outcome.promised = [*outcome.promised[:1], promised]
        if promised is not None:
            outcome.promised_h += hours
            outcome.allowed += promised * hours
        stands = self.monitor.last.alarm != _core.Alarm.none  # since the recording before
        found: list[AlarmChange] = []
        beyond, over = [], []
        for chunk in replayed(self.monitor, part, acknowledge_after_s=2.0):
            one = chunk.estimates
            beyond.append((np.abs(one["tau_ext"]) > one["contact_limit_nm"]).any(axis=1))
            over.append(1 - one["margin_nm"] / one["limit_nm"])
            found += [one for one in chunk.changes if isinstance(one, AlarmChange) and one.alarm != NONE]
        for a, b in spans:
            if part.t_ns[0] <= a <= part.t_ns[-1]:
                outcome.touches += 1
                outcome.detected += any(a <= one.t_ns <= b + NEAR_NS for one in found)
        later, ratio = part.t_ns[np.concatenate(beyond)], np.concatenate(over)
        if stands and self.newest is not None:  # its touch may last into this recording
            again = later[later < self.newest["t_ns"] + 2_000_000_000]
            if len(again):
                self.newest["held_ns"] = int(again[-1])
                self.folder.append_event(self.newest)
        for one in found:
            if one.was != NONE or (stands and one.t_ns == part.t_ns[0]):
                continue
            self.alarms += 1
            true = any(a <= one.t_ns <= b + NEAR_NS for a, b in spans)
            collides = any(other.alarm == COLLISION and 0 <= other.t_ns - one.t_ns < 2e9 for other in found)
            outcome.false += collides and not true
            outcome.false_promised += collides and not true and promised is not None
            level = "collision" if collides else "contact"
            content = {"id": self.alarms, "epoch": self.sink.epoch, "t_ns": one.t_ns, "wall": wall(), "level": level}
            lasts = (part.t_ns >= one.t_ns) & (part.t_ns < one.t_ns + 2_000_000_000)
            content["over"] = np.nan_to_num(ratio[lasts].max(axis=0)).round(4).tolist()
            end = int(later[(later >= one.t_ns) & (later < one.t_ns + 2_000_000_000)].max(initial=one.t_ns))
            self.newest = content | {"bundle": self.bundle, "held_ns": end}
            self.folder.append_event(self.newest)
            if not true:
                span = self.sink.epoch, one.t_ns, end
                self.folder.append_label(Label(self.alarms, *span, "nothing", "sim", wall(), self.bundle))

    # Afterwards.

    def compare(self, part: Part, out: Path) -> dict[str, Any]:
        """Detections and false alarms of the bundle in charge, and of one that commands make of the same data."""
        active = self.folder.active()
        assert active is not None
        out.mkdir(exist_ok=True)
        bundles = {"commission": load_bundle(active), "eight commands": self.by_commands(out)}
        touches = [TEST_TOUCHES if k % 2 else 0 for k in range(TEST_STRETCHES)]
        made = [self.arm.stretch(self.seed + 1, 5000 + k, part, 7200.0, count) for k, count in enumerate(touches)]
        made = [replace(one, name=f"test-{k}", provenance=provenance_of(self.arm.facts)) for k, one in enumerate(made)]
        loaders = [lambda one=one: one for one in made]
        results = evaluate(bundles, loaders[::2], loaders[1::2], out / "estimates", 0, 1, keep_free_estimates=0)
        shutil.rmtree(out / "estimates", ignore_errors=True)
        found = {}
        for one in results.bundles:
            free, latched = one.free_motion, one.latched
            assert latched is not None
            delay_ms = None if latched.delay_median_s is None else 1000 * latched.delay_median_s
            counts = {"touches": latched.collisions, "detected": latched.latched, "delay_ms": delay_ms}
            false = {"false": free.false_collisions, "hours": free.hours, "promised_per_hour": free.promised_per_hour}
            found[one.name] = counts | false
        return found

    def by_commands(self, out: Path) -> _core.Bundle:
        """The bundle that `tauext train` and `tauext calibrate` make of the same data."""
        data, bundle = out / "data", out / "trained.tauext"
        shutil.rmtree(data, ignore_errors=True)
        shutil.copytree(self.folder.path, data)
        accepting("train", "--data", data, "--recipe", "prior", "--out", bundle, printed=out / "train.txt")
        if load_split(data).calibration:
            words = ("--bundle", bundle, "--data", data, "--out", out / "eight.tauext")
            accepting("calibrate", *words, printed=out / "calibrate.txt")
            bundle = eight if (eight := out / "eight.tauext").exists() else bundle  # too few peaks: no limits
        shutil.rmtree(data)
        return load_bundle(bundle)


def accepting(*words: object, printed: Path) -> None:
    """Run a command of tauext; faults of the data are accepted as it names them: at 50 Hz an impact is a spike."""
    tauext(*words, printed=printed, accept=(0, 2))
    if faults := re.findall(r"--accept (.+)", printed.read_text()):
        tauext(*words, "--accept", *faults[-1].split(), printed=printed)


BARE = ("bare", 0, False)
PLANS = {
    "loads": (
        [("bare", 0, False), ("first load", 1, False), ("second load", 2, False), ("another tool", 0, True)],
        6.0,
    ),
    "calm": ([("bare", 0, False)], 6.0),
    "week": ([(f"day {number}", 0, False) for number in range(1, 8)], 4.0),
}
"""Name, load and tool of each part, and its hours."""


def main() -> None:
    parser = arguments(__doc__, "out")
    parser.add_argument("--arm", choices=NAMES, default="rig")
    parser.add_argument("--no-model", action="store_true", help="the integrator has no robot file")
    parser.add_argument("--plan", choices=PLANS, default="loads")
    parser.add_argument("--hours", type=float, help="of each part, default: 6, week: 4")
    parser.add_argument("--touch-every", type=float, default=10.0, help="minutes, default: %(default)s; 0: never")
    parser.add_argument("--seed", type=int, default=0, help="of arm, motion and touches")
    parser.add_argument("--tables", action="store_true", help="write OUT/days.md from the results in OUT")
    options = parser.parse_args()
    if options.tables:
        results = []
        for path in sorted(options.out.glob("*.json")):
            results.append(one := json.loads(path.read_text()))
            if (options.out / path.stem).is_dir():
                one["false_by_part"] = false_by_part(options.out / path.stem, one)
                save_json(one, path)
        write_tables(options.out, tables(results), name="days")
        return
    name = f"{options.arm}{'-no-model' * options.no_model}-{options.plan}"
    options.out.mkdir(parents=True, exist_ok=True)
    arm = working(options.arm, options.seed, not options.no_model)
    simulation = Simulation(options.out / name, arm, options.seed, 2e9)
    simulation.touch_every_min = 0.0 if options.plan == "calm" else options.touch_every
    parts, hours = PLANS[options.plan]
    hours = options.hours or hours
    result: dict[str, Any] = {
        "arm": options.arm, "model": not options.no_model, "plan": options.plan, "seed": options.seed, "hours": hours,
        "touch_every_min": simulation.touch_every_min, "date": f"{date.today():%-d %B %Y}", "commit": commit(),
    }  # fmt: skip
    for title, load, tool in parts:
        part = Part(title, hours, load, tool)
        simulation.part(part)
        print(f"{name}: {asdict(simulation.outcomes[-1])}", flush=True)
        if options.plan == "loads" and len(simulation.outcomes) == 1 and simulation.folder.active():
            result["compared"] = simulation.compare(part, options.out / f"{name}-compared")
            print(f"{name}: {result['compared']}", flush=True)
        result |= {
            "first_s": simulation.first_s,
            "parts": [asdict(one) for one in simulation.outcomes],
            "most_bytes": simulation.most_bytes,
            "work_s": simulation.work_s,
        }
        save_json(result, options.out / f"{name}.json")
    simulation.sink.close()


def false_by_part(folder: Path, one: dict[str, Any]) -> list[tuple[int, int]]:
    """False collisions of every part: before a bundle of the changed arm monitored, and all others."""
    stretches = -(-round(one["hours"] * 3600 - 1) // round(STRETCH_S + JOIN_NS * 1e-9))
    length_ns = stretches * (round(STRETCH_S * 1e9) + JOIN_NS) + PAUSE_NS
    changes, changed, waits = set[str](), list[set[str]](), False
    for line in read_history(folder):  # bundles that monitored when a change was learned, in the order of changes
        if line["kind"] == "activation":
            changes, waits = (set(), False) if waits else (changes, False)
            changes.add(str(line["bundle"]))
        elif line.get("learned"):
            changed.append(set(changes))
            waits = True
    asked = [number for number, part in enumerate(one["parts"]) if part["asked"]]
    old = dict(zip(asked, changed, strict=False))
    counts = [[0, 0] for _ in one["parts"]]
    for event in read_events(folder):
        if event.get("level") == "collision" and event.get("answer") == "nothing":
            number = event["t_ns"] // length_ns
            if number < len(counts):  # else of a part that is not over
                counts[number][event["bundle"] not in old.get(number, ())] += 1
    return [(before, after) for before, after in counts]


def tables(results: list[dict[str, Any]]) -> list[str]:
    """The page of all results."""
    lines = head(
        "arm | part | received [h] | bundle after [min] | touches detected | false before that bundle | other false "
        "| in [h] | asked"
    )
    for one in results:
        for part, (before, others) in zip(one["parts"], one["false_by_part"], strict=True):
            waited = "–" if part["waited_s"] is None else f"{part['waited_s'] / 60:.1f}"
            detected, asked = f"{part['detected']} of {part['touches']}", "; ".join(part["asked"])
            received, hours = f"{part['received_h']:.1f}", f"{part['hours']:.1f}"
            name = part["name"] + ", untouched" * (one["plan"] == "calm")
            lines.append(table_row(called(one), name, received, waited, detected, before, others, hours, asked))
    lines += ["", *head(
        "arm | bundle | touches detected | median delay [ms] | false collisions | in [h] | promised an hour"
    )]  # fmt: skip
    for one in results:
        for bundle, found in one.get("compared", {}).items():
            detected = f"{found['detected']} of {found['touches']} ({found['detected'] / found['touches']:.1%})"
            promised = "–" if found["promised_per_hour"] is None else f"{found['promised_per_hour']:.3g}"
            false = found["false"], f"{found['hours']:.1f}", promised
            lines.append(table_row(called(one), bundle, detected, f"{found['delay_ms']:.0f}", *false))
    lines += ["", *head(
        "arm | day | promised an hour, first → last | hours | allowed | happened | 95 % interval [1/h] | kept"
    )]  # fmt: skip
    for one in (one for one in results if one["plan"] == "week"):
        for part in one["parts"]:
            shown = " → ".join("none" if rate is None else f"{rate:.3g}" for rate in part["promised"])
            hours, false, allowed = part["promised_h"], part["false_promised"], part["allowed"]
            low, high = rate_interval(false, hours) if hours else (0.0, 0.0)
            kept = "–" if not hours else "yes" if is_kept(false, hours, allowed / hours) else "NO"
            numbers = f"{hours:.1f}", f"{allowed:.2f}", false, f"{low:.2g} to {high:.2g}", kept
            lines.append(table_row(called(one), part["name"], shown, *numbers))
    each = (
        f"{called(one)}, {one['plan']}: {one['date']}, commit {one['commit']}, at most {one['most_bytes'] / 1e9:.2f} GB"
        for one in results
    )
    return [*lines, "", f"Runs: {'; '.join(each)}."]


def called(one: dict[str, Any]) -> str:
    return one["arm"] + ("" if one["model"] else ", no model")


if __name__ == "__main__":
    main()
