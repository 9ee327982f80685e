"""Stand-ins around a live loop: a source that follows a script, and a sink that keeps what it is told."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tauext.monitor.episode import Episode
from tauext.monitor.sink import Verdict
from tauext.monitor.source import SIGNALS, Sample, SourceCounts, SourceSettings
from tauext.sources.replay import ReplaySource


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


class OneByOne:
    """Of a source: no sample is late, however busy the machine is, so the loop takes each alone and executes requests
    in between."""

    def next_sample(self, timeout_s: float) -> Sample | None:
        sample = super().next_sample(timeout_s)
        return None if sample is None else replace(sample, received_ns=sample.received_ns + 1_000_000_000)


class Replayed(OneByOne, ReplaySource):
    """A recording one by one."""


class AllAtOnce:
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


class ScriptedSource(OneByOne, AllAtOnce):
    """A script whose samples are taken one by one."""


@dataclass(frozen=True)
class OfSample:
    """A verdict about one sample, or about one that did not come."""

    row: int
    t_ns: int
    sample: Sample | None
    estimates: dict[str, np.ndarray]
    """One row."""
    changes: tuple
    episode: Episode | None
    """As of the end of its block."""
    news: tuple[Episode, ...]

    @property
    def alarm_number(self) -> int:
        return 0 if self.episode is None else self.episode.number


def of_samples(verdict: Verdict) -> Iterator[OfSample]:
    """The verdict sample by sample."""
    block = verdict.block
    for k, t_ns in enumerate(verdict.t_ns.tolist()):
        sample, row = None, verdict.row + k
        if block is not None:
            signals = {name: None if (one := getattr(block, name)) is None else one[k] for name in SIGNALS}
            sample = Sample(t_ns, received_ns=int(block.received_ns[k]), **signals)
        estimates = {name: values[k : k + 1] for name, values in verdict.estimates.items()}
        changes = tuple(change for change in verdict.changes if change.row == row)
        news = tuple(one for one in verdict.news if one.row == row)
        yield OfSample(row, t_ns, sample, estimates, changes, verdict.episode, news)


class Keeper:
    """A sink that keeps everything sample by sample; `each` is called with every one, too."""

    def __init__(self, each: Callable = lambda verdict: None):
        self.verdicts, self.reports, self.closed, self.each = [], [], 0, each
        self.whole = []
        """Verdicts as they came."""

    def open(self, joints, control) -> None:
        self.joints, self.control = joints, control

    def verdict(self, verdict) -> None:
        self.whole.append(verdict)
        for one in of_samples(verdict):
            self.verdicts.append(one)
            self.each(one)

    def every_second(self, report) -> None:
        self.reports.append(report)

    def close(self) -> None:
        self.closed += 1

    @property
    def changes(self) -> list:
        return [change for verdict in self.verdicts for change in verdict.changes]
