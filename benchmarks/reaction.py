"""From a sample's reception to a callback, in the Python loop and, with the C++ example, in a control loop.

    python benchmarks/reaction.py [--seconds 60] [--core 1] [--priority 80] [--example build/examples/01_control_loop]
    python benchmarks/reaction.py --stop [--seconds 60] [--core 1] [--priority 80]

Seven joints at 1 kHz with a network of the paper's size and random weights. A thread of its own puts a sample into a
SampleQueue every millisecond, as a source of a robot does; the loop takes it, runs the monitor and calls a sink. Half
a second apart a push of 50 ms raises a contact; its reaction is a Python function in a process of its own.
Reported: sample to sink, sample to the reaction's start, in µs; samples lost. The aim is p99 <= 2 ms of the first.

--stop: each contact sends `stop` to a stand-in of a UR's dashboard server in another process, on a connection that was
opened before. Reported: time until the stand-in has received the command, and until the confirmation. Network,
controller and the arm's braking come on top.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import threading
import time
from contextlib import chdir
from pathlib import Path

import numpy as np
from common import ROOT, arguments
from seven_axis import bundle, motion

from tauext import _core
from tauext.monitor.cell_file import Reaction
from tauext.monitor.changes import AlarmChange
from tauext.monitor.latency import Latencies
from tauext.monitor.loop import Loop, LoopSettings
from tauext.monitor.reactions import Reactions, ReactionThread, start_reactions
from tauext.monitor.sink import Control, LoopReport, ReactionEvent, Verdict
from tauext.monitor.source import Sample, SourceCounts, SourceSettings
from tauext.sources.reader import SampleQueue
from tauext.sources.ur_dashboard import Dashboard

PERIOD_NS = 1_000_000
AIM_P99_US = 2000.0
SWING_S = 20.0
PUSH_NM = 100.0


def main() -> None:
    parser = arguments(__doc__, loop=True)
    parser.add_argument("--seconds", type=float, default=60.0, help="default: %(default)s")
    parser.add_argument("--example", type=Path, help="01_control_loop, built (examples/README.md)")
    parser.add_argument("--stop", action="store_true", help="measure the stop of a UR arm instead")
    options = parser.parse_args()
    settings = LoopSettings(core=options.core, priority=options.priority)
    if options.stop:
        measure_stop(options.seconds, settings)
        return
    watching = bundle_with_contacts()
    source, timing = Ticking(options.seconds), Timing()
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "called.py").write_text("def react(facts):\n    pass\n")
        with chdir(folder):
            reactions = start_reactions([Reaction("callback", ("contact",), python="called:react")], source, [])
    loop = Loop(watching, source, [timing], reactions, settings=settings)
    loop.note = print
    loop.run()
    (thread,) = reactions.threads
    print(f"{loop.samples:,} samples, 7 joints, 1 kHz; {source.counts.overrun} overrun, {loop.missing} not in time")
    print(f"sample to callback       {timing.all.text()}")
    print(f"sample to own process    {thread.count.start.text()}, {thread.count.done} times")
    held = timing.all.quantile_us(0.99) <= AIM_P99_US
    print(f"p99 of the callback <= {AIM_P99_US / 1000:g} ms: {'held' if held else 'MISSED'}")
    if options.example is not None:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "seven.tauext"
            watching.save(str(path))
            print(f"C++, {options.example.name}:", flush=True)
            subprocess.run([options.example, path, f"{options.seconds:g}"], check=True)


def measure_stop(seconds: float, settings: LoopSettings) -> None:
    """From a sample's reception to the stop of a UR arm, through a stand-in of its dashboard server."""
    with subprocess.Popen(
        [sys.executable, ROOT / "tests" / "made_ur.py"], stdout=subprocess.PIPE, text=True
    ) as controller:
        dashboard = Dashboard("127.0.0.1", int(controller.stdout.readline()))
        dashboard.check()
        received_ns, confirmed = [], Latencies()

        def stop(event: ReactionEvent) -> None:
            dashboard.stop()
            received_ns.append(event.received_ns)
            confirmed.add(time.monotonic_ns() - event.received_ns)

        reactions = Reactions([ReactionThread(Reaction("stop", ("contact",), stop=True), stop)])
        loop = Loop(bundle_with_contacts(), Ticking(seconds), [], reactions, settings=settings)
        loop.note = print
        loop.run()
        reactions.end()
        controller.terminate()
        sent = Latencies()
        for at_ns, began_ns in zip(map(int, controller.stdout.read().split()), received_ns, strict=True):
            sent.add(at_ns - began_ns)
    print(f"{loop.samples:,} samples, {len(received_ns)} stops, {reactions.threads[0].count.failed} failed")
    print(f"sample to command at the controller  {sent.text()}")
    print(f"sample to confirmation               {confirmed.text()}")


class Timing:
    """Last of the sinks: delays of all samples and of those that raised an alarm, and samples judged in blocks."""

    def __init__(self) -> None:
        self.all, self.alarms, self.in_blocks = Latencies(), Latencies(), 0

    def open(self, joints: tuple[str, ...], control: Control) -> None:
        pass

    def verdict(self, verdict: Verdict) -> None:
        now_ns = time.monotonic_ns()
        if verdict.block is None:
            return
        sent_ns = verdict.block.received_ns.tolist()
        self.in_blocks += len(sent_ns) * (len(sent_ns) > 1)
        for one in sent_ns:
            self.all.add(now_ns - one)
        for change in verdict.changes:
            if isinstance(change, AlarmChange) and change.alarm > change.was:
                self.alarms.add(now_ns - sent_ns[change.row - verdict.row])

    def every_second(self, report: LoopReport) -> None:
        pass

    def close(self) -> None:
        pass


class Ticking:
    """A sample every millisecond, from a thread of its own."""

    name = "ticking"

    def __init__(self, seconds: float):
        self.counts = SourceCounts()
        self._samples = round(seconds * 1e9 / PERIOD_NS)
        self._waiting = SampleQueue(self.counts)
        self._swing = motion(SWING_S)

    def open(self, settings: SourceSettings) -> None:
        threading.Thread(target=self._work, daemon=True).start()

    def next_sample(self, timeout_s: float) -> Sample | None:
        return self._waiting.take(timeout_s)

    @property
    def ended(self) -> bool:
        return self._waiting.ended

    def notes(self) -> list[str]:
        return []

    def close(self) -> None:
        pass

    def _work(self) -> None:
        begin_ns = time.monotonic_ns()
        for k in range(self._samples):
            due_ns = begin_ns + k * PERIOD_NS
            left_s = (due_ns - time.monotonic_ns()) * 1e-9
            if left_s > 0:
                time.sleep(left_s)
            row = k % self._swing.samples
            tau = self._swing.tau[row] + (PUSH_NM if k % 500 > 450 else 0.0)
            self._waiting.put(Sample(due_ns, self._swing.q[row], self._swing.dq[row], tau, time.monotonic_ns()))
        self._waiting.close()


def bundle_with_contacts() -> _core.Bundle:
    """seven_axis's, with contact limits over what it says of its motion; no collision, which would hide contacts."""
    made, swing = bundle(), motion(SWING_S)
    said = _core.estimate(made, swing.t_ns, swing.q, swing.dq, swing.tau, 1)["tau_ext"][2000:]
    limits = (1.2 * np.abs(said).max(axis=0)).tolist()
    made.contact_sliding_limit_nm = made.contact_near_stiction_limit_nm = limits
    made.contact_release_s = 0.05
    return made


if __name__ == "__main__":
    main()
