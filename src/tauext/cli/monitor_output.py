"""Output of `tauext monitor`: lines, JSON or panel, written beside the loop."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial

from tauext import _core
from tauext.cli.json_lines import Output
from tauext.cli.text_lines import Outcome
from tauext.errors import ConfigError
from tauext.monitor.background import BackgroundWorker
from tauext.monitor.event_stream import Tally
from tauext.monitor.flight_files import FlightCount
from tauext.monitor.loop import Loop, ProfileSwitch, chunk_of
from tauext.monitor.monitored_time import Monitored, MonitoredNews
from tauext.monitor.reactions import Reactions
from tauext.monitor.record_sink import FlightSink, RecordCount
from tauext.monitor.sink import Control, LoopReport, Losing, Verdict
from tauext.monitor.source import SourceCounts

# --- Output beside the loop: a terminal that draws, or a pipe without a reader, delays no sample.


@contextmanager
def output_thread(failed: Callable[[], object], patient: bool = False) -> Iterator[BackgroundWorker]:
    """A thread for output, whose first error is raised at the end.

    Args:
        failed: called after that error.
        patient: see BackgroundWorker.
    """
    # Outputs that may wait: of a replay four, of a second each; else twenty seconds of chunks.
    worker = BackgroundWorker("output", 4 if patient else 1000, failed)
    worker.patient = patient
    worker.start()
    try:
        yield worker
    finally:
        worker.end(5.0)  # time for a reader to take the outputs that still wait
    if worker.error is not None:
        raise worker.error


def expect_nothing_lost(sinks: Sequence[Losing]) -> None:
    """Raise ConfigError where a sink could not write samples."""
    for sink in sinks:
        if why := sink.loss():
            raise ConfigError(why)


# --- Reports of the loop, printed in another thread.


CHUNK_S = 0.02
"""Time of a chunk of samples, short enough for viewers."""


class OutputSink:
    """Counts verdicts and prints them in another thread, in chunks; every change ends a chunk early."""

    def __init__(
        self,
        output: Output,
        worker: BackgroundWorker,
        loop: Loop,
        reactions: Reactions,
        flights: FlightSink | None = None,
        remedy: str = "",
        chunk_s: float = CHUNK_S,
        is_live: bool = True,
    ):
        """
        Args:
            remedy: what a person can do if samples come late or not at all.
            chunk_s: shortest chunk, in the time of the samples, [s].
            is_live: False: of a recording, which has no time of its own to report.
        """
        period_ns = loop.monitor.sample_period_ns
        self.tally = Tally(loop.joints, period_ns, tuple(loop.monitor.estimate_units))
        self.flights = FlightCount()
        self._output, self._worker, self._loop = output, worker, loop
        self._reactions, self._flight_sink = reactions, flights
        self._most = max(1, round(chunk_s * 1e9 / period_ns))
        self._verdicts: list[Verdict] = []
        self._is_live, self._seen, self._silent_s = is_live, not is_live, 0
        self.monitored, self._news = Monitored(), MonitoredNews(remedy)

    def open(self, joints: tuple[str, ...], control: Control) -> None:
        pass

    def verdict(self, verdict: Verdict) -> None:
        if not self._seen:
            self._seen = True
            self._worker.put(partial(self._output.first, int(verdict.t_ns[0])), must=True)
        self._verdicts.append(verdict)
        if verdict.changes or sum(len(one.t_ns) for one in self._verdicts) >= self._most:
            self._print()

    def follow(self, bundle: _core.Bundle, monitor: _core.Monitor) -> None:
        """Print what belongs to the bundle before; totals from here on are in the units of this one."""
        self._print()
        self.tally.units = tuple(monitor.estimate_units)

    def every_second(self, report: LoopReport) -> None:
        if not self._is_live:
            self.print_news()
            return
        if not self._seen:
            if self._silent_s % 10 == 0:
                self.note("no sample yet")
            self._silent_s += 1
        self.monitored = report.monitored
        if line := self._news.line(report.t_ns * 1e-9, report.monitored):
            self.note(line)
        self._worker.put(partial(self._output.watched, report.monitored))
        self._print()

    def close(self) -> None:
        self._print()

    def note(self, text: str) -> None:
        """For the loop."""
        self._worker.put(partial(self._output.note, text), must=True)

    def switched(self, switch: ProfileSwitch) -> None:
        """For the loop."""
        self._worker.put(partial(self._output.switched, switch), must=True)

    def print_news(self) -> None:
        """Print the outcome of reactions and flights."""
        for news in self._reactions.news():
            self._worker.put(partial(self._output.reaction, news), must=True)
        for flight in self._flight_sink.news() if self._flight_sink else ():
            self.flights.add(flight)
            self._worker.put(partial(self._output.flight, flight), must=True)

    def outcome(self, counts: SourceCounts, recorded: RecordCount | None) -> Outcome:
        """The summary after the loop has ended."""
        loop, flights = self._loop, self._flight_sink
        if flights is not None:
            self.flights.missed, self.flights.repeated = flights.recorder.missed, flights.repeated
        reactions = {thread.reaction.name: thread.count for thread in self._reactions.threads}
        of_loop = (loop.tick, loop.missing, counts)
        return Outcome(self.tally, *of_loop, self.flights, reactions, recorded, loop.monitored)

    def _print(self) -> None:
        """Samples that did not come are shown, and not counted."""
        self.print_news()
        verdicts, self._verdicts = self._verdicts, []
        if not verdicts:
            return
        chunk = chunk_of(verdicts)
        came = [one.block is not None for one in verdicts for _ in one.t_ns]
        self.tally.add(chunk, self._loop.monitor, came)
        self._worker.put(partial(self._output.chunk, chunk, self.tally), must=bool(chunk.changes))
