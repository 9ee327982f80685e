"""Stand-ins around a live loop: a source that follows a script, and a sink that keeps what it is told."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence

from tauext.monitor.source import Sample, SourceCounts, SourceSettings


def samples_of(recording, rows: slice = slice(None)) -> list[Sample]:
    """The recording's samples as if they came in now."""
    signals = (recording.t_ns[rows].tolist(), recording.q[rows], recording.dq[rows], recording.tau[rows])
    return [Sample(t_ns, q, dq, tau, 0) for t_ns, q, dq, tau in zip(*signals, strict=True)]


class Clock:
    """Stands in for `time`: it goes on only while somebody sleeps, however busy the machine is."""

    def __init__(self) -> None:
        self._now_ns = 0

    def monotonic_ns(self) -> int:
        return self._now_ns

    def monotonic(self) -> float:
        return self._now_ns * 1e-9

    def sleep(self, seconds: float) -> None:
        self._now_ns += max(1, math.ceil(seconds * 1e9))


class ScriptedSource:
    """Gives samples as fast as they are taken; where the script holds a function, none until it returns true."""

    name = "script"

    def __init__(self, script: Sequence[Sample | Callable[[], bool]], clock: Clock | None = None):
        """clock: that of the loop, too; None: real time."""
        self.script, self.counts, self.closed = list(script), SourceCounts(), 0
        self._clock = clock or time
        self.said: list[str] = []

    def open(self, settings: SourceSettings) -> None:
        self.settings = settings

    def next_sample(self, timeout_s: float) -> Sample | None:
        while self.script and not isinstance(self.script[0], Sample):
            if not self.script[0]():
                self._clock.sleep(timeout_s)
                return None
            self.script.pop(0)
        if not self.script:
            return None
        one = self.script.pop(0)
        return Sample(one.t_ns, one.q, one.dq, one.tau, self._clock.monotonic_ns())

    @property
    def ended(self) -> bool:
        return not self.script

    def notes(self) -> list[str]:
        said, self.said = self.said, []
        return said

    def close(self) -> None:
        self.closed += 1


class Keeper:
    """A sink that keeps everything; `each` is called with every verdict, too."""

    def __init__(self, each: Callable = lambda verdict: None):
        self.verdicts, self.reports, self.closed, self.each = [], [], 0, each

    def open(self, joints, control) -> None:
        self.joints, self.control = joints, control

    def verdict(self, verdict) -> None:
        self.verdicts.append(verdict)
        self.each(verdict)

    def every_second(self, report) -> None:
        self.reports.append(report)

    def close(self) -> None:
        self.closed += 1

    @property
    def changes(self) -> list:
        return [change for verdict in self.verdicts for change in verdict.changes]
