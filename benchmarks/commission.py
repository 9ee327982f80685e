"""Learning on the rig with touches that nobody reports: a fast simulation of `tauext commission` without a page.

    python benchmarks/commission.py OUT [--days 3] [--hours 1.0] [--seed 0] [--every 600] [--cold 1.3]

The arm moves for --hours a day. Each day it starts with --cold times its friction, which falls to 1 within 20 minutes.
Every --every seconds something touches it, and nobody says so; alarms without a touch are answered `nothing`. The
recorder, the training process and the monitor are those of the command. A training takes the simulated time that it
takes here. It prints minutes until the first bundle, by day the touches that were detected and the promised and actual
false alarms, and the share of touched motion that was trained on.
"""

import json
import time
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from common import head, table_row

from tauext import _core
from tauext.bundle.bundle_file import load_bundle
from tauext.bundle.estimates import NONE
from tauext.commission.folder import CommissionFolder, wall
from tauext.commission.history import promise_of
from tauext.commission.keep import KeepSink
from tauext.commission.trainer import Trainer
from tauext.data.free_motion import cut, free_samples
from tauext.data.labels import Label
from tauext.data.recording import Recording, runs_of
from tauext.data.recording_file import load_recording
from tauext.files.append_file import append_line
from tauext.monitor.changes import AlarmChange
from tauext.monitor.replay import replay as replayed
from tauext.monitor.source import SourceSettings
from tauext.sim.arms import rig_arm
from tauext.sim.collect import simulate_recording
from tauext.sim.config import RigConfig, changed_friction

BLOCK_S = 60.0
"""Length of one simulated stretch of motion."""
PAUSE_NS = 2_000_000_000
WARM_S = 1200.0
NEAR_NS = 500_000_000
"""An alarm so long after a touch is the touch's."""
GIGABYTE = 1e9


@dataclass
class Day:
    hours: float = 0.0
    """Monitored."""
    touches: int = 0
    detected: int = 0
    false: int = 0
    promised: list[float] = field(default_factory=list)
    bundles: list[str] = field(default_factory=list)


class Simulation:
    """One arm, its folder, and what happened."""

    def __init__(self, out: Path, seed: int, every_s: float, cold: float):
        self.seed, self.every_s, self.cold = seed, every_s, cold
        self.folder = CommissionFolder.open(out, create=True)
        arm = rig_arm()
        (out / "robot.xml").write_text(arm.xml)
        self.settings = SourceSettings(arm.joints, 1_000_000, ("N m",) * len(arm.joints), "held")
        self.trainer = Trainer(self.folder)
        self.days: list[Day] = []
        self.truth: dict[int, list[tuple[int, int]]] = {}
        """Touches by epoch: first and last stamp."""
        self.first_s: float | None = None
        self.in_charge: Path | None = None
        self.busy_s = 0.0
        self.alarms = self.block = 0
        self.peaks: list[tuple[int, float, float]] = []
        """Epoch, begin and largest torque of every touch."""

    def motion(self, day_s: float) -> Recording:
        """The next stretch, with its touches."""
        friction = 1 + (self.cold - 1) * np.exp(-3 * day_s / WARM_S)
        config = RigConfig()
        touches = round(BLOCK_S / self.every_s) if self.every_s <= BLOCK_S else int(
            (self.block + 1) * BLOCK_S // self.every_s - self.block * BLOCK_S // self.every_s
        )  # fmt: skip
        config = replace(
            config, friction=changed_friction(config.friction, float(friction)), collisions_per_recording=touches
        )
        self.block += 1
        return simulate_recording(config, "pulses" if touches else "free", BLOCK_S, self.seed, self.block)

    def day(self, hours: float) -> None:
        """One day: an epoch of its own."""
        self.days.append(Day())
        sink = KeepSink(self.folder, self.settings, "sim:rig", 5 * GIGABYTE)
        sink.open(self.settings.joints, None)  # type: ignore[arg-type]
        sink.patient = True
        start_ns = 0
        while start_ns < hours * 3.6e12:
            made = self.motion(1e-9 * start_ns)
            moved = replace(made, t_ns=made.t_ns + start_ns)
            self.stretch(moved, sink)
            start_ns = int(moved.t_ns[-1]) + PAUSE_NS
        sink.close()

    def stretch(self, made: Recording, sink: KeepSink) -> None:
        """Send a stretch in recordings of 10 s to monitor and recorder, and let the training process work between."""
        touched = runs_of(made.contact == 1)
        spans = [(int(made.t_ns[a]), int(made.t_ns[b - 1])) for a, b in touched.tolist()]
        self.truth.setdefault(sink.epoch, []).extend(spans)
        for a, b in touched.tolist():
            peak = float(np.abs(made.tau_ext[a:b]).max())
            self.peaks.append((sink.epoch, 1e-9 * int(made.t_ns[a]), round(peak, 2)))
        rows, monitored, begin = sink._rows, "", 0
        while begin < made.samples:
            seconds = self.folder.seconds()
            if seconds >= self.busy_s:  # else the earlier bundle monitors while the training would still run
                self.in_charge = self.folder.active()
            if (active := self.in_charge) is not None:
                if self.first_s is None:
                    self.first_s = seconds
                if active.stem != monitored:  # between two recordings; a new monitor warms up on the 10 s before
                    monitored, monitor = active.stem, _core.Monitor(load_bundle(active))
                    if begin:
                        before = cut(made, slice(begin - rows, begin))
                        monitor.run(before.t_ns, before.q, before.dq, before.tau)
                self.watch(monitor, monitored, cut(made, slice(begin, begin + rows)), spans, sink.epoch)
            part = cut(made, slice(begin, begin + rows))
            signals = {name: getattr(part, name) for name in ("t_ns", "q", "dq", "tau")}
            sink._labels = {one.id: one for one in self.folder.labels()}
            sink._waiting.put(signals | {"contact": np.zeros(part.samples, dtype=np.int8)})
            while self.folder.seconds() < seconds + 0.9 * part.samples / made.rate_hz:
                time.sleep(0.002)
            begin += rows
            while self.folder.seconds() >= self.busy_s:
                started = time.monotonic()
                if self.trainer.step() == "nothing":
                    break
                self.busy_s = self.folder.seconds() + time.monotonic() - started

    def watch(self, monitor: _core.Monitor, name: str, part: Recording, spans: list, epoch: int) -> None:
        """Monitor 10 s; alarms become events and labels."""
        day = self.days[-1]
        day.hours += part.samples / part.rate_hz / 3600
        if name not in day.bundles:
            day.bundles.append(name)
        promised = promise_of(self.folder.path, name)[0]
        day.promised.append(np.nan if promised is None else promised)
        found: list[AlarmChange] = []
        over = []
        for chunk in replayed(monitor, part, acknowledge_after_s=2.0):
            beyond = (np.abs(chunk.estimates["tau_ext"]) > chunk.estimates["contact_limit_nm"]).any(axis=1)
            over.append(chunk.t_ns[beyond])
            found += [one for one in chunk.changes if isinstance(one, AlarmChange) and one.alarm != NONE]
        for a, b in spans:
            if part.t_ns[0] <= a <= part.t_ns[-1]:
                day.touches += 1
                day.detected += any(a <= one.t_ns <= b + NEAR_NS for one in found)
        for one in found:
            if one.was != NONE:
                continue
            self.alarms += 1
            true = any(a <= one.t_ns <= b + NEAR_NS for a, b in spans)
            collides = any(other.alarm == 2 and 0 <= other.t_ns - one.t_ns < 2e9 for other in found)
            day.false += collides and not true
            answer = None if true else "nothing"
            level = "collision" if collides else "contact"
            content = {"id": self.alarms, "epoch": epoch, "t_ns": one.t_ns, "wall": wall(), "level": level}
            append_line(self.folder.events_file, content | {"bundle": name, "answer": answer})
            later = np.concatenate(over)
            end = int(later[(later >= one.t_ns) & (later < one.t_ns + 2_000_000_000)].max(initial=one.t_ns))
            label = Label(self.alarms, epoch, one.t_ns, end, answer or "unanswered", "sim", wall(), name)
            self.folder.append_label(label)

    def trained_on(self) -> tuple[float, float]:
        """Touched seconds in training recordings: all, and those that labels do not leave out."""
        touched = used = 0.0
        self.left: list[tuple[int, float, float]] = []
        """Epoch, time and seconds of touches that were trained on."""
        for one in self.folder.segments():
            if one.set != "train":
                continue
            recording = load_recording(self.folder.path / one.name)
            true = np.zeros(recording.samples, dtype=bool)
            for a, b in self.truth[one.epoch]:
                true |= (recording.t_ns >= a) & (recording.t_ns <= b)
            touched += true.sum() / recording.rate_hz
            trained = true & free_samples(recording)
            used += trained.sum() / recording.rate_hz
            if trained.any():
                place = int(trained.argmax())
                self.left.append(
                    (one.epoch, round(1e-9 * int(recording.t_ns[place]), 2), float(trained.sum() / recording.rate_hz))
                )
        return touched, used


def main() -> None:
    import argparse

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--days", type=int, default=3)
    parser.add_argument("--hours", type=float, default=1.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--every", type=float, default=600.0)
    parser.add_argument("--cold", type=float, default=1.3)
    options = parser.parse_args()
    simulation = Simulation(options.out, options.seed, options.every, options.cold)
    titles = "day | monitored [h] | touches | detected | false collisions | promised an hour | bundles"
    print("\n".join(head(titles)), flush=True)
    for number in range(1, options.days + 1):
        simulation.day(options.hours)
        day = simulation.days[-1]
        promised = "–" if not day.promised else f"{day.promised[0]:.3g} → {day.promised[-1]:.3g}"
        bundles = ", ".join(day.bundles)
        print(table_row(str(number), f"{day.hours:.2f}", str(day.touches), str(day.detected), str(day.false),
                        promised, bundles), flush=True)  # fmt: skip
    touched, used = simulation.trained_on()
    first = "none" if simulation.first_s is None else f"{simulation.first_s / 60:.1f} min"
    suspects = [one for one in simulation.folder.labels() if one.answer == "suspect"]
    true = sum(any(a - NEAR_NS <= one.to_ns and b + NEAR_NS >= one.from_ns for a, b in simulation.truth[one.epoch])
               for one in suspects)  # fmt: skip
    print(f"\nfirst bundle after {first} of received motion; suspects: {len(suspects)}, of them touches: {true}")
    print(f"touched motion in training recordings: {touched:.2f} s, trained on: {used:.2f} s")
    print("trained on (epoch, at s, for s, peak Nm):", [
        (*one, next(peak for epoch, at, peak in simulation.peaks if epoch == one[0] and at - 2 < one[1] < at + 2))
        for one in simulation.left
    ])  # fmt: skip
    print(json.dumps({"first_s": simulation.first_s, "touched_s": touched, "trained_on_s": used}))


if __name__ == "__main__":
    main()
