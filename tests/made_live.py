"""Stand-ins around a live loop: a source that follows a script, and a sink that keeps what it is told."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
from made_bundles import pushed

from tauext import _core
from tauext.monitor.episode import Episode
from tauext.monitor.event_stream import Chunk, EventStream
from tauext.monitor.loads import TimedLoad
from tauext.monitor.loop import Loop, LoopSettings, chunk_of
from tauext.monitor.phases import Phases
from tauext.monitor.sink import Verdict
from tauext.monitor.source import Block, Sample, SourceCounts, SourceSettings
from tauext.monitor.touch_place import PlaceFinder
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

    def next_block(self, timeout_s: float, most_rows: int) -> Block | None:
        return super().next_block(timeout_s, 1)


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
            sample = block.sample(k)
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


class Samples(ReplaySource):
    """A replay of a recording, or of its fields with anything in them."""

    def __init__(self, samples, speed: float | None = None):
        super().__init__(pushed(seconds=0.002), speed, is_made=True)
        names = ("t_ns", "q", "dq", "tau", "temperature")
        self.recording = SimpleNamespace(**{name: getattr(samples, name, None) for name in names})
        self.recording.name, self.recording.duration_s = "samples", float(np.ptp(samples.t_ns)) * 1e-9

    def open(self, settings: SourceSettings) -> None:
        pass


def replay(
    monitor: _core.Monitor,
    samples,
    recorder: _core.FlightRecorder | None = None,
    acknowledge_after_s: float | None = None,
    chunk_s: float = 1.0,
    loads: Sequence[TimedLoad] = (),
    places: PlaceFinder | None = None,
    phases: Phases | None = None,
    each: Callable[[Chunk], object] = lambda chunk: None,
) -> list[Chunk]:
    """The loop of `tauext run` with this monitor; its verdicts as chunks, with each of which `each` is called, too."""
    arm = SourceSettings(tuple(monitor.joint_names), monitor.sample_period_ns, tuple(monitor.torque_units))
    chunks: list[Chunk] = []

    class Sink(Keeper):
        def verdict(self, verdict: Verdict) -> None:
            chunks.append(chunk_of([verdict]))
            each(chunks[-1])

    settings = LoopSettings(missing_after_s=1e6, acknowledge_after_s=acknowledge_after_s, block_s=chunk_s)
    loop = Loop(None, Samples(samples), [], None, None, recorder, settings, arm, loads=loads)
    loop.sinks.append(Sink())
    loop.monitor, loop._changes = monitor, EventStream(monitor, places, phases)
    loop._turns = SimpleNamespace(made=lambda block: block, notes=list)
    loop._each_sink = lambda call: [call(sink) for sink in loop.sinks]  # an error of a test is raised
    loop.run()
    return chunks
