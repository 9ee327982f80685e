"""Events of `tauext run` and `tauext monitor` as text: one line an event, and a summary."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tauext._core import Bundle
from tauext.bundle.estimates import COLLISION, HEALTHS
from tauext.bundle.units import not_monitored, short
from tauext.cli.progress import PrintContext
from tauext.data.recording import Recording
from tauext.monitor.changes import Change, HealthChange, HiddenCollision
from tauext.monitor.event_stream import Chunk, Tally
from tauext.monitor.explanation import unseen_words
from tauext.monitor.flight_files import FlightCount, FlightNews
from tauext.monitor.monitored_time import Monitored, percent
from tauext.progress import in_plain_letters

if TYPE_CHECKING:
    from tauext.monitor.latency import Latencies
    from tauext.monitor.loop import ProfileSwitch
    from tauext.monitor.reactions import ReactionCount, ReactionNews
    from tauext.monitor.record_sink import RecordCount
    from tauext.monitor.source import SourceCounts

MOST_BEHIND_LINES = 10
"""About collisions behind one alarm that stands."""


@dataclass
class Outcome:
    """Summary of a `tauext monitor` run."""

    tally: Tally
    tick: Latencies
    missing: int
    counts: SourceCounts
    flights: FlightCount
    reactions: dict[str, ReactionCount] = field(default_factory=dict)
    recorded: RecordCount | None = None
    monitored: Monitored = Monitored()


class TextLines(PrintContext):
    """A line an event and a summary."""

    def __init__(self, flights: Path | None = None, acknowledges: bool = False):
        """
        Args:
            flights: folder of flights, as the user gave it.
            acknowledges: alarms are acknowledged after a set time.
        """
        self._flights, self._acknowledges = flights, acknowledges
        self._start_ns: int | None = None
        self._monitored = Monitored()
        self._counted: dict[str, Callable[[Any], None]] = {"health": self._health, "hidden": self._hide}
        """What prints the first changes of an event, and counts the others."""

    def print_line(self, line: str) -> None:
        print(in_plain_letters(line), flush=True)

    def start(self, bundle: Bundle, recording: Recording, number: int, of: int) -> None:
        """A recording begins."""
        self._of = of
        self._begin(recording.name, bundle, int(recording.t_ns[0]), recording.duration_s)
        which = f" ({number} of {of})" if of > 1 else ""
        self.print_line(
            f"{recording.name}{which}: {recording.duration_s:.1f} s, {recording.samples:,} samples at "
            f"{recording.rate_hz:g} Hz, bundle {bundle.name}{self._blind}"
        )

    def start_live(self, source: str, bundle: Bundle) -> None:
        """A live source begins."""
        self._begin(source, bundle, None, math.inf)
        self._rate_hz = 1e9 / bundle.observer.sample_period_ns
        self.print_line(f"{source}: waiting for the first sample, bundle {bundle.name}{self._blind}; Ctrl-C ends")

    def first(self, t_ns: int) -> None:
        """The first live sample."""
        self._start_ns = t_ns
        self.print_line(f"{self._title}: {len(self._joints)} joints at {self._rate_hz:g} Hz")

    def _begin(self, title: str, bundle: Bundle, start_ns: int | None, duration_s: float) -> None:
        self._title, self._duration_s, self._began = title, duration_s, time.monotonic()
        self._joints, self._units = tuple(link.joint_name for link in bundle.links), bundle.estimate_units
        self._start_ns = start_ns
        self._latched_s: float | None = None
        self._behind = 0
        self._blind = "".join(f"; {joint} is not monitored" for joint in not_monitored(bundle))
        self._healths: dict[tuple[int, int, int], tuple[int, HealthChange]] = {}

    def chunk(self, chunk: Chunk, tally: Tally) -> None:
        for change in sorted(chunk.changes, key=lambda event: event.t_ns):
            if change.event in self._counted:
                self._counted[change.event](change)
                continue
            self._latch(change)
            for words in change.words(self._joints, self._units):
                self._event(change.t_ns, words)

    def flight(self, news: FlightNews) -> None:
        self._event(
            news.t_ns, f"event log: {news.path}" if news.path else f"event log of the {news.what} lost: {news.error}"
        )

    def note(self, text: str) -> None:
        self.print_line(f"{'':13}  {text}")

    def watched(self, monitored: Monitored) -> None:
        """The share of a live arm's time that was monitored, once a second."""
        self._monitored = monitored

    def switched(self, switch: ProfileSwitch) -> None:
        text = f"profile {switch.new}" + (f" (was {switch.old})" if switch.old else "") + f", by {switch.by}"
        if switch.t_ns is None or self._start_ns is None:
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

    def end(self, tally: Tally, flights: FlightCount, complete: bool) -> None:
        """The end of one recording."""
        self._print_rest()
        if self._of > 1:
            self._print_all(summary_lines(tally, flights, self._flights))

    def total(self, tally: Tally, flights: FlightCount, recordings: int, interrupted: bool) -> None:
        """The end of all recordings."""
        if tally.samples:
            stopped = ", interrupted" if interrupted else ""
            self.print_line(f"{recordings} recording{'s' * (recordings != 1)} to the end{stopped}")
            self._print_all(summary_lines(tally, flights, self._flights))

    def finish(self, outcome: Outcome) -> None:
        """The end of a live source."""
        self._print_rest()
        self.print_line("ended")
        counts = outcome.counts
        lines = summary_lines(outcome.tally, outcome.flights, self._flights, f"reported after {outcome.tick.text()}")
        gone = [f"{n} {what}" for what, n in asdict(counts).items() if n and what != "received"]
        gone += [f"{outcome.missing} times none in time"] if outcome.missing else []
        lines.insert(1, f"source        {counts.received:,} received, {', '.join(gone) if gone else 'none lost'}")
        if (watched := outcome.monitored).of_seconds:
            share = watched.seconds / watched.of_seconds
            lines.insert(2, f"monitored     {percent(share)} of {duration_text(watched.of_seconds / 3600)}")
        for name, count in outcome.reactions.items():
            events = [f"{n} {what.replace('_', ' ')}" for what, n in count.summary().items() if what != "start" and n]
            start = f"; began after {count.start.text()}" if count.start.count else ""
            lines.append(f"reaction      {name}: {', '.join(events) if events else 'no event'}{start}")
        if (kept := outcome.recorded) is not None:
            left = f", {kept.unfit} unfit" if kept.unfit else ""
            lost = f", {kept.lost} LOST: {kept.error}" if kept.lost else ""
            lines.append(f"recorded      {kept.samples:,} samples in {kept.files} files{left}{lost}")
        self._print_all(lines)

    def _print_all(self, lines: list[str]) -> None:
        for line in lines:
            self.print_line(f"  {line}")

    def _time_s(self, t_ns: int) -> float:
        return (t_ns - (self._start_ns or 0)) * 1e-9

    def _event(self, t_ns: int, text: str) -> None:
        self.print_line(f"{self._time_s(t_ns):11.3f} s  {text}")

    def _health(self, change: HealthChange) -> None:
        """The first of its kind, and a line at the end about the others: a bad cable can fail at every sample."""
        kind = change.health, change.causes, change.joint
        times = self._healths.get(kind, (0, change))[0]
        if not times:
            self._event(change.t_ns, *change.words(self._joints))
        self._healths[kind] = times + 1, change

    def _print_rest(self) -> None:
        """How often health failed, and what an alarm hid that stands at the end."""
        for times, last in self._healths.values():
            if times > 1 and HEALTHS[last.health] in ("stale", "fault"):
                (words,) = replace(last, was=last.health).words(self._joints)
                self.print_line(f"  {words}: {times:,} times, the last at {self._time_s(last.t_ns):.3f} s")
        if self._latched_s is None or self._acknowledges:
            return
        count = collisions_text(self._behind) if self._behind else "what came after it"
        self.print_line(
            f"  the collision alarm lasted from {self._latched_s:.3f} s to the end and hid {count}; "
            "--acknowledge-after-s 1 ends each alarm after a second and shows all"
        )

    def _hide(self, collision: HiddenCollision) -> None:
        """One more behind the alarm that stands."""
        self._behind += 1
        if self._latched_s is None or self._behind > MOST_BEHIND_LINES:
            return
        until = ", which stands until it is acknowledged" if self._behind == 1 else ""
        last = "; more like it are only counted" if self._behind == MOST_BEHIND_LINES else ""
        joint = self._joints[collision.joint]
        self._event(
            collision.t_ns, f"another collision, {joint}: hidden by the alarm of {self._latched_s:.3f} s{until}{last}"
        )

    def _latch(self, change: Change) -> None:
        if change.raised is not None and change.raised[0] == COLLISION:
            self._latched_s, self._behind = self._time_s(change.t_ns), 0
        elif change.ends_alarm:
            self._latched_s = None


def summary_lines(tally: Tally, flights: FlightCount, folder: Path | None, timing: str = "") -> list[str]:
    """The summary of one recording or of all. timing: printed with the samples instead of the core's time for each."""
    summary = tally.summary()
    if not tally.samples:
        return ["no samples"]
    shares = [f"{name} {share:.2%}" for name, share in summary["health_share"].items() if share]
    alarms = []
    for level, counts in summary["alarms"].items():
        raised = [f"{joint} {count}" for joint, count in counts.items() if count]
        alarms.append(f"{level} {', '.join(raised) if raised else 'none'}")
    margins = [
        f"{joint} {margin:+.2f} {short(unit)}"
        for (joint, margin), unit in zip(summary["worst_margin_nm"].items(), tally.units, strict=True)
        if margin is not None
    ]
    lines = [
        f"samples       {tally.samples:,} ({duration_text(tally.hours)}), "
        + (timing or f"{summary['us_per_sample']:.2f} µs each"),
        f"health        {', '.join(shares)}",
        f"alarms        {'; '.join(alarms)}"
        + (f"; {tally.acknowledged} acknowledged" if tally.acknowledged else "")
        + (f"; {collisions_text(tally.hidden)} hidden by an alarm that stood" if tally.hidden else ""),
        f"worst margin  {', '.join(margins) if margins else 'none: there was no estimate'}",
        f"chain         {tally.bridged_ticks} bridged ticks, {tally.restarts} restarts",
    ]
    if tally.unfamiliar:
        lines.append(f"coverage      {unfamiliar_text(tally)}")
    if folder is not None:
        lost = f", {flights.failed} could not be written" if flights.failed else ""
        missed = f", {flights.missed} missed: too many in a short time" if flights.missed else ""
        like = f", {flights.repeated} faults like those of the minute before have none" if flights.repeated else ""
        lines.append(f"event logs    {flights.written} written to {folder}{like}{lost}{missed}")
    return lines


def unfamiliar_text(tally: Tally) -> str:
    """Share of the motion that training never saw, its kinds, and what to do if it is intended."""
    most = tally.unfamiliar.most_common(3)
    words = [f"{unseen_words(unseen, tally.joints)} {count / tally.samples:.2%}" for unseen, count in most]
    more = len(tally.unfamiliar) - len(most)
    text = f"{tally.unfamiliar_share:.2%} of the motion was out-of-distribution: {', '.join(words)}"
    text += f" and {more} more" if more else ""
    if tally.unfamiliar_share < 0.01:  # of motion like that of training a few thousandths may be unfamiliar
        return text
    advice = "estimates may be wrong there, and thresholds are up to 1.5 times as high; train with such motion"
    return f"{text}. WARNING: {advice}"


def collisions_text(count: int) -> str:
    return f"{count} more collision{'s' * (count != 1)}"


def duration_text(hours: float) -> str:
    return f"{hours:.2f} h" if hours >= 1 else f"{hours * 60:.1f} min" if hours >= 1 / 60 else f"{hours * 3600:.1f} s"
