"""Events of `tauext run` and `tauext monitor` as JSON lines; docs/reference/files-results.md lists them."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from tauext._core import Bundle
from tauext.bundle.estimates import sample_facts
from tauext.bundle.units import not_monitored
from tauext.cli.progress import PrintContext
from tauext.cli.text_lines import Outcome, TextLines
from tauext.data.recording import Recording
from tauext.monitor.event_stream import Chunk, StatusClock, Tally
from tauext.monitor.flight_files import FlightCount, FlightNews
from tauext.monitor.monitored_time import Monitored

if TYPE_CHECKING:
    from tauext.monitor.loop import ProfileSwitch
    from tauext.monitor.reactions import ReactionNews


class JsonLines(PrintContext):
    """One object an event, each written at once; times count from the recording's first sample."""

    def __init__(self, status_hz: float):
        self._status_ns = round(1e9 / status_hz) if status_hz else 0

    def start(self, bundle: Bundle, recording: Recording, number: int, of: int) -> None:
        self._recording, self._joints, self._start_ns = recording.name, recording.joints, int(recording.t_ns[0])
        self._clock = StatusClock(self._start_ns, self._status_ns) if self._status_ns else None
        self._write(
            "start",
            bundle=bundle.name,
            joints=recording.joints,
            estimate_units=bundle.estimate_units,
            not_monitored=not_monitored(bundle),
            samples=recording.samples,
            duration_s=recording.duration_s,
            rate_hz=recording.rate_hz,
            t_ns=self._start_ns,
        )

    def start_live(self, source: str, bundle: Bundle) -> None:
        self._recording, self._joints = source, tuple(link.joint_name for link in bundle.links)
        self._start_ns, self._clock = 0, None
        rate_hz = 1e9 / bundle.observer.sample_period_ns
        units, blind = bundle.estimate_units, not_monitored(bundle)
        self._write(
            "start", bundle=bundle.name, joints=self._joints, estimate_units=units, not_monitored=blind, rate_hz=rate_hz
        )

    def first(self, t_ns: int) -> None:
        self._start_ns = t_ns
        self._clock = StatusClock(t_ns, self._status_ns) if self._status_ns else None

    def chunk(self, chunk: Chunk, tally: Tally) -> None:
        """Changes and status lines in the order of their samples."""
        lines = [
            (change.row, change.t_ns, change.event, change.facts(self._joints))
            for change in chunk.changes
            if change.event != "hidden"
        ]
        for k in self._clock.rows(chunk.t_ns) if self._clock else ():
            lines.append((chunk.first_row + k, int(chunk.t_ns[k]), "status", sample_facts(chunk.estimates, k)))
        for row, t_ns, event, content in sorted(lines, key=lambda line: line[0]):
            self._write(event, row=row, **self._when(t_ns), **content)

    def flight(self, news: FlightNews) -> None:
        outcome = {"file": str(news.path)} if news.path else {"file": None, "error": news.error}
        self._write("flight", what=news.what, number=news.number or None, **self._when(news.t_ns), **outcome)

    def note(self, text: str) -> None:
        self._write("note", text=text)

    def switched(self, switch: ProfileSwitch) -> None:
        when = {} if switch.t_ns is None else self._when(switch.t_ns)
        self._write("profile", **when, by=switch.by, old=switch.old, new=switch.new)

    def reaction(self, news: ReactionNews) -> None:
        event = news.event
        facts = {"what": event.kind, "joint": event.joint, "merged": event.merged}
        self._write(
            "reaction", name=news.reaction, **self._when(event.t_ns), **facts, start_us=news.start_us, error=news.error
        )

    def end(self, tally: Tally, flights: FlightCount, complete: bool) -> None:
        self._write("end", complete=complete, **tally.summary(), flights=flights.summary())

    def total(self, tally: Tally, flights: FlightCount, recordings: int, interrupted: bool) -> None:
        content = {"recordings": recordings, "interrupted": interrupted, **tally.summary()}
        print(json.dumps({"event": "summary", **content, "flights": flights.summary()}, allow_nan=False), flush=True)

    def _when(self, t_ns: int) -> dict[str, Any]:
        return {"t_ns": int(t_ns), "time_s": (int(t_ns) - self._start_ns) * 1e-9}

    def watched(self, monitored: Monitored) -> None:
        pass

    def finish(self, outcome: Outcome) -> None:
        content: dict[str, Any] = outcome.tally.summary()
        del content["us_per_sample"]
        content |= {
            "source": asdict(outcome.counts),
            "missing": outcome.missing,
            "monitored_s": round(outcome.monitored.seconds, 3),
            "monitored_of_s": round(outcome.monitored.of_seconds, 3),
            "reported_after": outcome.tick.summary(),
            "flights": outcome.flights.summary(),
        }
        content |= {"reactions": {name: count.summary() for name, count in outcome.reactions.items()}}
        content |= {"recorded": asdict(outcome.recorded)} if outcome.recorded else {}
        self._write("summary", **content)

    def _write(self, event: str, **content: Any) -> None:
        print(json.dumps({"event": event, "recording": self._recording, **content}, allow_nan=False), flush=True)


Output = TextLines | JsonLines
