"""Share of the time that is monitored, and delay of the alarm, on a computer whose cores are all busy.

    python packages/commission/benchmarks/busy_computer.py OUT [--seconds 120] [--joints 2 7] [--busy N]

A process of its own stands in for the arm and sends a sample a millisecond through a pipe; it gets the priority of a
device where that is permitted, since an arm does not wait for this computer. The loop of `tauext commission` takes the
samples, with its page in a third process and a reader of the page in a fourth. As many processes as there are cores
(--busy) do nothing but arithmetic. Every half second a push of 50 ms raises a contact.

Reported: the monitored share as the loop counts it; samples that came in time, were lost, or were judged in blocks of
more than one; time from the sending of a sample to the sinks, of all samples and of those that raised an alarm.
"""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import sys
import tempfile
import time
from contextlib import ExitStack, suppress
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))

import seven_axis
from common import arguments, head, table_row, write_tables
from made_bundles import pushed, watching_bundle
from reaction import Timing, bundle_with_contacts
from tauext_commission.live import LiveSink
from tauext_commission.page import serve
from tauext_commission.page.access import listening_socket

from tauext import _core
from tauext.data.recording import Recording
from tauext.monitor.loop import Loop, LoopSettings
from tauext.monitor.source import Sample, SourceCounts, SourceSettings, settings_of

PERIOD_NS = 1_000_000
SWING_S, PUSH_EVERY, PUSH_FROM = 20.0, 500, 450
PUSH_NM = {2: 2.5, 7: 100.0}
"""Torque that raises a contact, by number of joints."""
PORT = 8890
AIM = 0.995
DEVICE_NICE = -20


# --- Processes around the loop.


def send(pipe: Connection, made: Recording, push_nm: float, seconds: float) -> None:
    """The arm: each sample at its time."""
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, DEVICE_NICE)
    signals = np.stack([made.q, made.dq, made.tau], axis=1)
    began_ns = time.monotonic_ns() + 500_000_000
    with suppress(OSError):
        for k in range(round(seconds * 1e9 / PERIOD_NS)):
            row = signals[k % made.samples].copy()
            row[2] += push_nm * (k % PUSH_EVERY > PUSH_FROM)
            due_ns = began_ns + k * PERIOD_NS
            time.sleep(max(0, due_ns - time.monotonic_ns()) * 1e-9)
            pipe.send_bytes(np.array([due_ns, time.monotonic_ns()]).tobytes() + row.tobytes())


def read_page(port: int) -> None:
    """A browser with the page, as far as the server is concerned."""
    from aiohttp import ClientSession

    async def read() -> None:
        async with ClientSession() as session, session.ws_connect(f"http://127.0.0.1:{port}/live") as lines:
            async for _ in lines:
                pass

    while True:
        with suppress(Exception):
            asyncio.run(read())
        time.sleep(0.3)


def work() -> None:
    """Other work: as much of a core as there is."""
    while True:
        sum(range(100_000))


class Sent:
    """The samples of the sending process."""

    name = "sent"

    def __init__(self, pipe: Connection, joints: int):
        self.counts, self._pipe, self._joints, self.ended = SourceCounts(), pipe, joints, False

    def open(self, settings: SourceSettings) -> None:
        pass

    def next_sample(self, timeout_s: float) -> Sample | None:
        try:
            if not self._pipe.poll(timeout_s):
                return None
            data = self._pipe.recv_bytes()
        except (EOFError, OSError):
            self.ended = True
            return None
        self.counts.received += 1
        t_ns, sent_ns = np.frombuffer(data[:16], np.int64).tolist()
        return Sample(t_ns, *np.frombuffer(data[16:]).reshape(3, self._joints), sent_ns)

    def notes(self) -> list[str]:
        return []

    def close(self) -> None:
        self._pipe.close()


# --- A run.


def measured(bundle: _core.Bundle, made: Recording, seconds: float, busy: int) -> tuple[Loop, Timing]:
    """The loop among the other processes, for so long."""
    context, joints = multiprocessing.get_context("spawn"), len(made.joints)
    here, there = context.Pipe()
    folder = Path(tempfile.mkdtemp())
    listening = listening_socket("127.0.0.1", PORT)
    live, timing = LiveSink(folder / "live.sock"), Timing()
    live.describe(made.joints, bundle.estimate_units)
    ends = context.Pipe()
    page = (ends[1], folder, folder / "live.sock", folder / "control.sock", "127.0.0.1", listening, "")
    targets = [(send, (there, made, PUSH_NM[joints], seconds)), (serve, page)]
    targets += [(read_page, (listening.getsockname()[1],)), *[(work, ())] * busy]
    processes = [context.Process(target=target, args=given, daemon=True) for target, given in targets]
    with ExitStack() as stack:
        stack.callback(live.end)
        for process in processes:
            process.start()
            stack.callback(process.kill)
        there.close()
        settings = LoopSettings(duration_s=seconds)
        loop = Loop(bundle, Sent(here, joints), [live, timing], settings=settings, arm=settings_of(bundle))
        loop.run()
    return loop, timing


def main() -> None:
    parser = arguments(__doc__, "out")
    parser.add_argument("--seconds", type=float, default=120.0, help="of each run, default: %(default)s")
    parser.add_argument("--joints", type=int, nargs="+", choices=(2, 7), default=[2, 7], help="default: 2 7")
    parser.add_argument("--busy", type=int, default=os.cpu_count() or 1, help="processes, default: %(default)s")
    options = parser.parse_args()
    lines = head("joints | monitored | missing | in blocks | delay p50 | p99 | max | alarms | delay p50 | p99 | max")
    missed = False
    for joints in options.joints:
        seven = joints == 7
        bundle = bundle_with_contacts() if seven else watching_bundle()
        made = seven_axis.motion(SWING_S) if seven else pushed(seconds=SWING_S, pushes=())
        loop, timing = measured(bundle, made, options.seconds, options.busy)
        share = loop.monitored.seconds / loop.monitored.of_seconds
        missed |= share < AIM
        delays = [
            f"{one.quantile_us(p) / 1e3:.2f} ms" if p else f"{one.max_ns / 1e6:.2f} ms"
            for one in (timing.all, timing.alarms)
            for p in (0.5, 0.99, None)
        ]
        blocks = f"{timing.in_blocks / max(loop.samples, 1):.1%}"
        cells = (joints, f"{share:.2%}", loop.missing, blocks, *delays[:3], timing.alarms.count, *delays[3:])
        lines.append(table_row(*cells))
    write_tables(options.out, lines, name="busy-computer")
    sys.exit(1 if missed else 0)


if __name__ == "__main__":
    main()
