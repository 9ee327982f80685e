"""Bundles exchanged in a running loop: samples without an answer, changes of health, latency, equality to the last bit.

    python benchmarks/exchange.py [--exchanges 200] [--ring 60] [--check 10] [--core 1] [--priority 80]

Seven joints at 1 kHz with a network of the paper's size, as benchmarks/reaction.py. Three bundles take turns: the
second has other limits than the first, the third another network. A push raises a collision before the first exchange;
it stays latched. As soon as one bundle is in the loop, the next is asked for. All of it runs twice: alone, and beside
a training at nice 19 in another process. Latency is from a sample's reception until every sink has its verdict; the
first ten seconds are without exchanges. At the end, every --check'th exchange is repeated in a plain monitor from what
was carried, and the estimates until the next exchange are compared.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
import tempfile
import time
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
from common import arguments
from reaction import PERIOD_NS, SWING_S, Ticking, bundle_with_contacts
from seven_axis import HIDDEN, JOINTS, motion
from train import BATCH, STEPS, in_the_loop, made_windows

from tauext import _core
from tauext.fit.core_backend import CoreBackend
from tauext.monitor import exchange
from tauext.monitor import loop as live
from tauext.monitor.exchange import Exchanged
from tauext.monitor.latency import Latencies
from tauext.monitor.loop import Loop, LoopSettings
from tauext.monitor.sink import Verdict
from tauext.monitor.source import Sample, settings_of

QUIET_FIRST_S = 10.0
OK, COLLISION = 1, 2


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--exchanges", type=int, default=200, help="default: %(default)s")
    parser.add_argument("--check", type=int, default=10, help="repeat every so many exchanges, default: %(default)s")
    parser.add_argument("--core", type=int, help="pin the loop and the thread that receives to this core")
    parser.add_argument("--priority", type=int, help="SCHED_FIFO for both")
    parser.add_argument("--ring", type=float, default=exchange.RING_S, help="seconds repeated, default: %(default)s")
    options = parser.parse_args()
    exchange.RING_S, live.QUIET_S = options.ring, options.ring * live.QUIET_S / exchange.RING_S
    with tempfile.TemporaryDirectory() as folder:
        paths = bundles(Path(folder))
        for beside in (False, True):
            alive, held = multiprocessing.get_context("spawn").Pipe(duplex=False)
            training = multiprocessing.get_context("spawn").Process(target=train, args=(alive,), daemon=True)
            if beside:
                training.start()
                alive.close()  # the training has the only reading end
            try:
                watch = Watch(paths, options.exchanges)
                settings = LoopSettings(core=options.core, priority=options.priority)
                watch.run(settings)
            finally:
                held.close()
                if beside:
                    training.kill()
                    training.join()
            print("beside a training" if beside else "alone", flush=True)
            watch.report(options.check)


def bundles(folder: Path) -> list[Path]:
    """Three bundles of one arm."""
    first = bundle_with_contacts()
    swing = motion(SWING_S)
    for one in (first, other_limits := copy(first), other_network := copy(first)):
        if one is other_network:
            rng = np.random.default_rng(2)
            one.parameters = rng.normal(0, 0.3, one.shape.parameter_count).astype(np.float32).tolist()
            one.answer_reference()
        said = _core.estimate(one, swing.t_ns, swing.q, swing.dq, swing.tau, 1)["tau_ext"][2000:]
        limits = (1.2 * np.abs(said).max(axis=0)).tolist()
        one.contact_sliding_limit_nm = one.contact_near_stiction_limit_nm = limits
        one.sliding_limit_nm = one.near_stiction_limit_nm = [1.1 * limit for limit in limits]
    other_limits.name, other_network.name = "other limits", "other network"
    other_limits.sliding_limit_nm = [1.2 * limit for limit in other_limits.sliding_limit_nm]
    paths = []
    for one in (first, other_limits, other_network):
        settings = one.drift
        settings.time_constant_s, settings.size_nm, settings.rate_share_per_s = 120.0, [5.0] * 7, 1 / 60
        one.drift = settings
        paths.append(folder / f"{one.name}.tauext")
        one.save(str(paths[-1]))
    return paths


def copy(bundle: _core.Bundle) -> _core.Bundle:
    return _core.Bundle.from_bytes(bundle.to_bytes())


def train(alive: Connection) -> None:
    """Steps of a network's training on one thread, until killed or the other end of this pipe is gone."""
    if hasattr(os, "SCHED_OTHER"):  # a process inherits the loop's priority and core
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        os.sched_setaffinity(0, range(os.cpu_count() or 1))
    os.nice(19)
    setup, windows = made_windows(len(JOINTS), 30_000)
    step = in_the_loop(CoreBackend(setup, windows, HIDDEN, STEPS, targets=1, threads=1), windows.ends[:BATCH])
    while not alive.poll():
        step()


class Pushing(Ticking):
    """Samples without the pushes of reaction.py, but one in the ninth second."""

    def __init__(self) -> None:
        super().__init__(seconds=1e6)
        self.stopped = False

    def _work(self) -> None:
        self.begin_ns, k = time.monotonic_ns(), 0
        while not self.stopped:
            due_ns = self.begin_ns + k * PERIOD_NS
            left_s = (due_ns - time.monotonic_ns()) * 1e-9
            if left_s > 0:
                time.sleep(left_s)
            self._waiting.put(self.sample(k, due_ns))
            k += 1
        self._waiting.close()

    def sample(self, k: int, t_ns: int) -> Sample:
        row = k % self._swing.samples
        tau = self._swing.tau[row] + (1000.0 if 8000 < k < 8100 else 0.0)
        return Sample(t_ns, self._swing.q[row], self._swing.dq[row], tau, time.monotonic_ns())


class Watch:
    """A sink that keeps what the loop answers, and asks for the next exchange."""

    KEPT = ("tau_ext", "drift", "limit_nm", "contact_limit_nm", "sigma_nm", "alarm", "health")

    def __init__(self, paths: list[Path], exchanges: int):
        self._paths, self._exchanges = paths, exchanges
        self.source = Pushing()
        self.before, self.during, self.took = Latencies(), Latencies(), Latencies()
        self.health: list[int] = []
        self.rows: list[tuple[int, int, bytes]] = []
        """Stamp of each sample, whether it was missing, and the answer."""
        self.exchanged: list[tuple[int, Exchanged]] = []
        self.refused: list[str] = []

    def run(self, settings: LoopSettings) -> None:
        bundle = _core.Bundle.load(str(self._paths[0]))
        self.loop = Loop(bundle, self.source, [self], settings=settings, arm=settings_of(bundle))
        self.loop.note = print
        self.loop.exchanged = lambda one: self.exchanged.append((len(self.rows), one))
        self.loop.run()

    def _next(self, answer: str = "") -> None:
        if answer:
            self.refused.append(answer)
        done = len(self.exchanged) + len(self.refused)
        print(
            f"\r  {done} of {self._exchanges}", end="" if done < self._exchanges else "\n", file=sys.stderr, flush=True
        )
        if done < self._exchanges:
            self.loop.exchange(self._paths[(len(self.exchanged) + 1) % len(self._paths)], self._next)
        else:
            self.loop.stop("the benchmark")

    def open(self, joints: tuple[str, ...], control: object) -> None:
        pass

    def verdict(self, verdict: Verdict) -> None:
        estimates = verdict.estimates
        self.rows.append((verdict.t_ns, verdict.sample is None, b"".join(estimates[k].tobytes() for k in self.KEPT)))
        self.health.append(int(estimates["health"][0]))
        if verdict.row == QUIET_FIRST_S * 1e9 / PERIOD_NS and verdict.sample is not None:
            self._next()
        if verdict.sample is not None:
            into = self.during if verdict.row > QUIET_FIRST_S * 1e9 / PERIOD_NS else self.before
            into.add(time.monotonic_ns() - verdict.sample.received_ns)

    def every_second(self, report: object) -> None:
        pass

    def close(self) -> None:
        self.source.stopped = True
        waiting = 0
        while self.source.next_sample(0.05) is not None:  # put, and not taken before the end
            waiting += 1
        self.unanswered = self.source.counts.received - self.source.counts.overrun - self.loop.samples - waiting

    def report(self, check: int) -> None:
        loop, counts = self.loop, self.source.counts
        for _, one in self.exchanged:
            self.took.add(round(one.took_us * 1e3))
        warm = self.health.index(OK)
        changes = int(np.count_nonzero(np.diff(self.health[warm:])))
        at = [index for index, _ in self.exchanged]
        came = [index for index in at if index < len(self.rows) and not self.rows[index - 1][1] | self.rows[index][1]]
        at_exchange = sum(self.health[index] != self.health[index - 1] for index in came)
        seconds = len(self.rows) * PERIOD_NS * 1e-9
        print(
            f"  {len(self.exchanged)} exchanges, {len(self.refused)} refused; {loop.samples:,} samples, {seconds:.0f} s"
        )
        print(f"  without an answer {self.unanswered}, overrun {counts.overrun}, not in time {loop.missing}")
        print(f"  changes of health: {changes}, of these at an exchange {at_exchange}")
        print(f"  sample to sink, before  {self.before.text()}; p99.9 {self.before.quantile_us(0.999):.0f} µs")
        print(f"  sample to sink, during  {self.during.text()}; p99.9 {self.during.quantile_us(0.999):.0f} µs")
        print(f"  an exchange in the loop's thread  {self.took.text()}")
        alarms = {self.rows[index][2][-2] for index in at}
        print(f"  alarm at the exchanges: {sorted(alarms)} ({COLLISION}: the collision of before)")
        compared = different = 0
        for number in range(0, len(self.exchanged), check):
            rows, unequal = self.repeat(number)
            compared, different = compared + rows, different + unequal
        print(f"  {len(range(0, len(self.exchanged), check))} repeated: {different} of {compared:,} answers differ")
        print("  " + "; ".join(self.refused[:3]))

    def repeat(self, number: int) -> tuple[int, int]:
        """Number of answers until the next exchange, and of those that a plain monitor gives otherwise."""
        index, one = self.exchanged[number]
        end = self.exchanged[number + 1][0] if number + 1 < len(self.exchanged) else len(self.rows)
        path = next(p for p in self._paths if p.stem == one.bundle)
        monitor = _core.Monitor(_core.Bundle.load(str(path)))
        if one.carried:
            monitor.carry(one.carried)
        begin_ns = self.source.begin_ns
        differ = 0
        for k in range(index - one.replayed, end):
            t_ns, missing, said = self.rows[k]
            if k == index:
                monitor.carry_alarm(one.left)
            if missing:
                estimates = monitor.run_missing(t_ns)
            else:
                s = self.source.sample(round((t_ns - begin_ns) / PERIOD_NS), t_ns)
                estimates = monitor.run(np.array([t_ns]), s.q[None], s.dq[None], s.tau[None])
            differ += k >= index and b"".join(estimates[name].tobytes() for name in self.KEPT) != said
        return end - index, differ


if __name__ == "__main__":
    main()
