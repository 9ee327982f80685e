"""Output of `tauext monitor`: lines, JSON or panel, written beside the loop."""

from __future__ import annotations

import math
import queue
import sys
import threading
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Any, Protocol, Self

from tauext import _core
from tauext.cli.live_view import LiveView
from tauext.cli.run_json import JsonLines
from tauext.cli.run_settings import RunSettings
from tauext.cli.run_text import FlightCount, TextLines, summary_lines
from tauext.monitor.flight_files import FlightNews
from tauext.monitor.latency import Latencies
from tauext.monitor.loop import ProfileSwitch, chunk_of
from tauext.monitor.reactions import ReactionCount, ReactionNews, Reactions
from tauext.monitor.record_sink import FlightSink, RecordCount
from tauext.monitor.replay import PACED_CHUNK_S, Chunk, StatusClock, Tally
from tauext.monitor.sink import Control, LoopReport, Verdict
from tauext.monitor.source import SourceCounts

# --- Output beside the loop: a terminal that draws, or a pipe that nobody reads, delays no sample.


MOST_WAITING = 1000
"""Things to tell before those that may be left out are: twenty seconds of chunks."""
END_S = 5.0
"""A reader has so long for what is left at the end."""


class Aside:
    """Does one thing after the other in a thread: a context, whose end waits for what is left.

    The first thing that raises ends it: the rest is left out, `failed` is called, and the end of the context raises it.
    """

    def __init__(self, failed: Callable[[], None]):
        self.left_out = 0
        """Things that were not told, as too many waited."""
        self._failed = failed
        self._error: BaseException | None = None
        self._waiting: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._work, name="output", daemon=True)

    def __enter__(self) -> Aside:
        self._thread.start()
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: object) -> None:
        self._waiting.put(None)
        self._thread.join(END_S)
        if self._error is not None and error is None:
            raise self._error

    def do(self, what: Callable[[], None], may_be_left_out: bool = False) -> None:
        """Returns at once."""
        if may_be_left_out and self._waiting.qsize() > MOST_WAITING:
            self.left_out += 1
        else:
            self._waiting.put(what)

    def _work(self) -> None:
        while (what := self._waiting.get()) is not None:
            try:
                what()
            except BaseException as error:
                self._error = error
                self._failed()
                return


# --- What `tauext monitor` tells: the lines, JSON and panel of `tauext run`, with what only a live arm has beside them.


QUIET_S = 10
"""Between two notes that nothing has come yet."""


@dataclass
class Outcome:
    """What a monitor came to."""

    tally: Tally
    tick: Latencies
    missing: int
    counts: SourceCounts
    flights: FlightCount = field(default_factory=FlightCount)
    reactions: dict[str, ReactionCount] = field(default_factory=dict)
    recorded: RecordCount | None = None


class MonitorOutput(Protocol):
    """A context, as the output of `tauext run` is one."""

    def __enter__(self) -> Self: ...
    def __exit__(self, *error: object) -> None: ...
    def begin(self, source: str, bundle: _core.Bundle) -> None: ...
    def first(self, t_ns: int) -> None: ...
    def note(self, text: str) -> None: ...
    def switched(self, switch: ProfileSwitch) -> None: ...
    def reaction(self, news: ReactionNews) -> None: ...
    def chunk(self, chunk: Chunk, tally: Tally) -> None: ...
    def flight(self, news: FlightNews) -> None: ...
    def finish(self, outcome: Outcome) -> None: ...


class LiveWords(TextLines):
    """In words; TextLines or LiveView comes behind it."""

    def begin(self, source: str, bundle: _core.Bundle) -> None:
        self._joints, self._units = tuple(link.joint_name for link in bundle.links), bundle.estimate_units
        self._start_ns, self._of, self._has_begun = 0, 1, False
        self._begin_events()
        self._title, self._began, self._duration_s = source, 0.0, math.inf
        rate_hz = 1e9 / bundle.observer.sample_period_ns
        self.say(f"{source}: {len(self._joints)} joints at {rate_hz:g} Hz, bundle {bundle.name}; Ctrl-C ends")

    def first(self, t_ns: int) -> None:
        self._start_ns, self._has_begun = t_ns, True

    def note(self, text: str) -> None:
        self.say(f"{'':13}  {text}")

    def switched(self, switch: ProfileSwitch) -> None:
        text = f"profile {switch.new}" + (f" (was {switch.old})" if switch.old else "") + f", by {switch.by}"
        if switch.t_ns is None or not self._has_begun:
            self.note(text)
        else:
            self._event(switch.t_ns, text)

    def reaction(self, news: ReactionNews) -> None:
        event = news.event
        what = f"{event.kind}{f' of {event.joint}' if event.joint else ''}"
        merged = f", for {event.merged} events" if event.merged > 1 else ""
        when = f"began {news.start_us * 1e-3:.2f} ms after the sample" if news.start_us is not None else ""
        failed = f"FAILED: {news.error}" if news.error is not None else ""
        self._event(
            event.t_ns, f"reaction {news.reaction} to the {what}{merged}: {', '.join(filter(None, (failed, when)))}"
        )

    def heading(self, time_s: float, wall_s: float) -> str:
        return f"{self._title}  {time_s:.1f} s"

    def finish(self, outcome: Outcome) -> None:
        self._tell_healths()
        self._tell_latched()
        counts = outcome.counts
        self.say("ended")
        timing = f"told after {outcome.tick.text()}"
        lines = summary_lines(outcome.tally, outcome.flights, self._settings.flights, timing)
        gone = [f"{n} {what}" for what, n in asdict(counts).items() if n and what != "received"]
        gone += [f"{outcome.missing} times none in time"] if outcome.missing else []
        lines.insert(1, f"source        {counts.received:,} received, {', '.join(gone) if gone else 'none lost'}")
        for name, count in outcome.reactions.items():
            told = [f"{n} {what.replace('_', ' ')}" for what, n in count.summary().items() if what != "start" and n]
            start = f"; began after {count.start.text()}" if count.start.count else ""
            lines.append(f"reaction      {name}: {', '.join(told) if told else 'no event'}{start}")
        if (kept := outcome.recorded) is not None:
            left = f", {kept.unfit} unfit" if kept.unfit else ""
            lost = f", {kept.lost} LOST: {kept.error}" if kept.lost else ""
            lines.append(f"recorded      {kept.samples:,} samples in {kept.files} files{left}{lost}")
        for line in lines:
            self.say(f"  {line}")


class MonitorText(LiveWords, TextLines):
    """A line an event and a summary."""


class MonitorView(LiveWords, LiveView):
    """The same above a panel."""

    def finish(self, outcome: Outcome) -> None:
        self._live.update("", refresh=True)
        super().finish(outcome)


class MonitorJson(JsonLines):
    """JSON lines: those of `tauext run`, and note, profile and reaction."""

    def begin(self, source: str, bundle: _core.Bundle) -> None:
        self._recording, self._joints = source, tuple(link.joint_name for link in bundle.links)
        self._start_ns, self._clock = 0, None
        rate_hz = 1e9 / bundle.observer.sample_period_ns
        units = bundle.estimate_units
        self._write("start", bundle=bundle.name, joints=self._joints, estimate_units=units, rate_hz=rate_hz)

    def first(self, t_ns: int) -> None:
        self._start_ns = t_ns
        self._clock = StatusClock(t_ns, self._status_ns) if self._status_ns else None

    def note(self, text: str) -> None:
        self._write("note", text=text)

    def switched(self, switch: ProfileSwitch) -> None:
        when = {} if switch.t_ns is None else self._when(switch.t_ns)
        self._write("profile", **when, by=switch.by, old=switch.old, new=switch.new)

    def reaction(self, news: ReactionNews) -> None:
        event = news.event
        told = {"what": event.kind, "joint": event.joint, "merged": event.merged}
        self._write(
            "reaction", name=news.reaction, **self._when(event.t_ns), **told, start_us=news.start_us, error=news.error
        )

    def finish(self, outcome: Outcome) -> None:
        content: dict[str, Any] = outcome.tally.summary()
        del content["us_per_sample"]
        content |= {"source": asdict(outcome.counts), "missing": outcome.missing, "told_after": outcome.tick.summary()}
        content |= {"flights": outcome.flights.summary()}
        content |= {"reactions": {name: count.summary() for name, count in outcome.reactions.items()}}
        content |= {"recorded": asdict(outcome.recorded)} if outcome.recorded else {}
        self._write("summary", **content)


def open_output(as_json: bool, status_hz: float, settings: RunSettings) -> MonitorOutput:
    """JSON lines where asked for, a panel on a terminal, else lines of text."""
    if as_json:
        return MonitorJson(status_hz)
    return MonitorView(settings) if sys.stdout.isatty() else MonitorText(settings)


class OutputSink:
    """Counts verdicts, and has them told aside in chunks of a viewer's eye-blink, ended early by every change."""

    def __init__(
        self,
        output: MonitorOutput,
        aside: Aside,
        monitor: _core.Monitor,
        reactions: Reactions,
        flights: FlightSink | None = None,
    ):
        self.tally = Tally(tuple(monitor.joint_names), monitor.sample_period_ns, tuple(monitor.estimate_units))
        self.flights = FlightCount()
        self._output, self._aside, self._monitor = output, aside, monitor
        self._reactions, self._flight_sink = reactions, flights
        self._most = max(1, round(PACED_CHUNK_S * 1e9 / monitor.sample_period_ns))
        self._verdicts: list[Verdict] = []
        self._seen, self._silent_s = False, 0

    def open(self, joints: tuple[str, ...], control: Control) -> None:
        pass

    def verdict(self, verdict: Verdict) -> None:
        if not self._seen:
            self._seen = True
            self._aside.do(partial(self._output.first, verdict.t_ns))
        self._verdicts.append(verdict)
        if verdict.changes or len(self._verdicts) >= self._most:
            self._tell()

    def every_second(self, report: LoopReport) -> None:
        if not self._seen:
            if self._silent_s % QUIET_S == 0:
                self.note("no sample yet")
            self._silent_s += 1
        self._tell()

    def close(self) -> None:
        self._tell()

    def note(self, text: str) -> None:
        """For the loop."""
        self._aside.do(partial(self._output.note, text))

    def switched(self, switch: ProfileSwitch) -> None:
        """For the loop."""
        self._aside.do(partial(self._output.switched, switch))

    def tell_news(self) -> None:
        """What became of reactions and flights."""
        for news in self._reactions.news():
            self._aside.do(partial(self._output.reaction, news))
        for flight in self._flight_sink.news() if self._flight_sink else ():
            self.flights.add(flight)
            self._aside.do(partial(self._output.flight, flight))

    def _tell(self) -> None:
        """Samples that did not come are shown, and not counted."""
        self.tell_news()
        told, self._verdicts = self._verdicts, []
        if not told:
            return
        chunk = chunk_of(told)
        self.tally.add(chunk, self._monitor, [one.sample is not None for one in told])
        self._aside.do(partial(self._output.chunk, chunk, self.tally), may_be_left_out=not chunk.changes)
