"""A source of samples of your own, and the monitor on it.

    python examples/04_own_source.py ARM.tauext [SECONDS]

No arm is attached: a sine of each joint stands in for it where the comment says YOUR ARM. Prints what changes.
"""

from __future__ import annotations

import sys
import time

import numpy as np

import tauext
from tauext.monitor.loop import Loop, LoopSettings
from tauext.monitor.sink import LoopReport, Verdict
from tauext.monitor.source import Sample, SourceCounts, SourceSettings


class MyArm:
    """A sample a period, by the clock of this computer."""

    name = "my arm"
    ended = False

    def __init__(self) -> None:
        self.counts = SourceCounts()

    def open(self, settings: SourceSettings) -> None:
        self._speed = 1.0 + 0.3 * np.arange(len(settings.joints))
        self._period_ns, self._due_ns = settings.period_ns, time.monotonic_ns()

    def next_sample(self, timeout_s: float) -> Sample | None:
        left_s = (self._due_ns - time.monotonic_ns()) * 1e-9
        time.sleep(max(0.0, min(left_s, timeout_s)))
        if left_s > timeout_s:
            return None
        # YOUR ARM: read q [rad], dq [rad/s], tau in settings.torque_units and the time at which they were measured.
        t_ns, self._due_ns = self._due_ns, self._due_ns + self._period_ns
        angle = self._speed * t_ns * 1e-9
        q, dq = 0.5 * np.sin(angle), 0.5 * self._speed * np.cos(angle)
        self.counts.received += 1
        return Sample(t_ns, q, dq, 2.0 * dq, time.monotonic_ns())

    def notes(self) -> list[str]:
        return []

    def close(self) -> None:
        pass


class Printer:
    """Prints what changes."""

    def open(self, joints: tuple[str, ...], control: object) -> None:
        self._joints = joints

    def verdict(self, verdict: Verdict) -> None:
        for change in verdict.changes:
            print(f"sample {verdict.row}: {change}")

    def every_second(self, report: LoopReport) -> None:
        print(f"{report.rate_hz:.0f} Hz, {report.missing} missing, told after {report.tick_p99_us:.0f} us (p99)")

    def close(self) -> None:
        pass


def main() -> int:
    if len(sys.argv) not in (2, 3):
        print("usage: 04_own_source.py ARM.tauext [SECONDS]", file=sys.stderr)
        return 2
    try:
        settings = LoopSettings(duration_s=float(sys.argv[2]) if len(sys.argv) > 2 else 10.0)
        loop = Loop(tauext.load_bundle(sys.argv[1]), MyArm(), [Printer()], settings=settings)
        loop.run()
    except tauext.TauextError as error:
        print(error, file=sys.stderr)
        return 2
    print(f"{loop.samples} samples")
    return 0


if __name__ == "__main__":
    sys.exit(main())
