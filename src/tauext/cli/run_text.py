"""`tauext run` as text: one line an event, and a summary."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, Self

from tauext._core import Bundle, cause_names
from tauext.bundle.estimates import HEALTHS
from tauext.bundle.units import short
from tauext.cli.run_settings import RunSettings
from tauext.data.recording import Recording
from tauext.files.places import Place
from tauext.monitor.changes import (
    ALARMS,
    TOUCHES,
    AlarmChange,
    DriftChange,
    FoundLoad,
    HealthChange,
    HiddenCollision,
    LoadChange,
    TouchChange,
    WeighChange,
    with_article,
)
from tauext.monitor.explanation import unseen_words
from tauext.monitor.flight_files import FlightNews
from tauext.monitor.loads import load_words
from tauext.monitor.places import PlaceChange, place_words
from tauext.monitor.replay import Chunk, Tally

# --- What `tauext run` tells while it goes on: JSON lines, text lines and the live view do.


@dataclass
class FlightCount:
    """What became of flights."""

    written: int = 0
    failed: int = 0
    missed: int = 0
    error: str = ""
    """Of the first that failed."""

    def add(self, news: FlightNews) -> None:
        """Count one more."""
        self.written += news.error is None
        self.failed += news.error is not None
        self.error = self.error or news.error or ""

    def merge(self, other: FlightCount) -> None:
        """Add another recording's."""
        self.written, self.failed = self.written + other.written, self.failed + other.failed
        self.missed += other.missed
        self.error = self.error or other.error

    def summary(self) -> dict[str, int]:
        return {"written": self.written, "failed": self.failed, "missed": self.missed}


class Output(Protocol):
    """What a replay tells while it goes on; a context, which the live view needs."""

    def __enter__(self) -> Output: ...
    def __exit__(self, *error: object) -> None: ...
    def start(self, bundle: Bundle, recording: Recording, number: int, of: int) -> None: ...
    def chunk(self, chunk: Chunk, tally: Tally) -> None: ...
    def flight(self, news: FlightNews) -> None: ...
    def end(self, tally: Tally, flights: FlightCount, complete: bool) -> None: ...
    def total(self, tally: Tally, flights: FlightCount, recordings: int, interrupted: bool) -> None: ...


# --- `tauext run` in lines of text, for people: a line an event and a summary.


WARNS_FROM = 0.01
"""Share of the motion that is unfamiliar: of motion like that of training a few thousandths may be."""
MOST_UNFAMILIAR = 3
"""Of what training never saw."""
MOST_BEHIND_LINES = 10
"""About collisions behind one alarm that stands."""


class TextLines:
    """A line an event and a summary."""

    def __init__(self, settings: RunSettings):
        self._settings = settings

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        pass

    def say(self, line: str) -> None:
        print(line, flush=True)

    def start(self, bundle: Bundle, recording: Recording, number: int, of: int) -> None:
        self._joints, self._start_ns, self._of = recording.joints, int(recording.t_ns[0]), of
        self._units = bundle.estimate_units
        self._begin_events()
        which = f" ({number} of {of})" if of > 1 else ""
        self.say(
            f"{recording.name}{which}: {recording.duration_s:.1f} s, {recording.samples:,} samples at "
            f"{recording.rate_hz:g} Hz, bundle {bundle.name}"
        )

    def _begin_events(self) -> None:
        self._latched_s: float | None = None
        self._behind = 0
        self._healths: dict[tuple[int, int, int], tuple[int, HealthChange]] = {}

    def chunk(self, chunk: Chunk, tally: Tally) -> None:
        for change in sorted(chunk.changes, key=lambda event: event.t_ns):
            if isinstance(change, HiddenCollision):
                self._hide(change)
            elif isinstance(change, HealthChange):
                self._health(change)
            elif isinstance(change, LoadChange):
                self._event(change.t_ns, load_change_words(change))
            elif isinstance(change, FoundLoad):
                self._event(change.t_ns, found_load_words(change))
            elif isinstance(change, WeighChange):
                for words in weigh_words(change):
                    self._event(change.t_ns, words)
            elif isinstance(change, TouchChange):
                self._event(change.t_ns, touch_words(change))
            elif isinstance(change, PlaceChange):
                self._event(change.t_ns, place_words(change, self._joints))
            elif isinstance(change, DriftChange):
                self._event(change.t_ns, f"recalibrate: joint {self._joints[change.joint]}'s drift is at its bound")
            elif isinstance(change, AlarmChange):
                self._alarm(change)

    def flight(self, news: FlightNews) -> None:
        self._event(news.t_ns, f"flight: {news.path}" if news.path else f"flight of the {news.what} lost: {news.error}")

    def end(self, tally: Tally, flights: FlightCount, complete: bool) -> None:
        self._tell_healths()
        self._tell_latched()
        if self._of > 1:
            for line in summary_lines(tally, flights, self._settings.flights):
                self.say(f"  {line}")

    def total(self, tally: Tally, flights: FlightCount, recordings: int, interrupted: bool) -> None:
        if tally.samples:
            stopped = ", interrupted" if interrupted else ""
            self.say(f"{recordings} recording{'s' * (recordings != 1)} to the end{stopped}")
            for line in summary_lines(tally, flights, self._settings.flights):
                self.say(f"  {line}")

    def _event(self, t_ns: int, text: str) -> None:
        self.say(f"{(t_ns - self._start_ns) * 1e-9:11.3f} s  {text}")

    def _health(self, change: HealthChange) -> None:
        """The first of its kind, and a line at the end about the others: a bad cable can fail at every sample."""
        kind = change.health, change.causes, change.joint
        times = self._healths.get(kind, (0, change))[0]
        if not times:
            self._event(change.t_ns, health_words(change, self._joints))
        self._healths[kind] = times + 1, change

    def _tell_healths(self) -> None:
        for times, last in self._healths.values():
            if times > 1 and HEALTHS[last.health] in ("stale", "fault"):
                at_s = (last.t_ns - self._start_ns) * 1e-9
                words = health_words(replace(last, was=last.health), self._joints)
                self.say(f"  {words}: {times:,} times, the last at {at_s:.3f} s")

    def _tell_latched(self) -> None:
        """What an alarm hid that stands at the end, and how to see it."""
        if self._latched_s is None or self._settings.acknowledge_after_s is not None:
            return
        count = collisions_text(self._behind) if self._behind else "what came after it"
        self.say(
            f"  the collision alarm stood from {self._latched_s:.3f} s to the end and hid {count}; "
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

    def _alarm(self, change: AlarmChange) -> None:
        if change.alarm == ALARMS.index("collision"):
            self._latched_s, self._behind = (change.t_ns - self._start_ns) * 1e-9, 0
        elif change.was == ALARMS.index("collision"):
            self._latched_s = None
        self._event(change.t_ns, alarm_words(change, self._joints, self._units))


def health_words(change: HealthChange, joints: tuple[str, ...]) -> str:
    """`fault: not finite, joint2 (was ok)`."""
    causes = ", ".join(cause_names(change.causes))
    where = f", {joints[change.joint]}" if change.joint >= 0 else ""
    why = f": {causes}{where}" if causes else ""
    was = f" (was {HEALTHS[change.was]})" if change.was != change.health else ""
    return f"{HEALTHS[change.health]}{why}{was}"


def alarm_words(change: AlarmChange, joints: tuple[str, ...], units: Sequence[str]) -> str:
    """`COLLISION joint1: |tau_ext| 6.21 Nm (standard error 0.35 Nm), collision limit 4.62 Nm`.

    units: of the answers, a joint.
    """
    if change.acknowledged:
        return f"{ALARMS[change.was]} acknowledged"
    if change.joint < 0:
        return f"no {ALARMS[change.was]} any more" if change.alarm == 0 else ALARMS[change.alarm]
    level, unit = ALARMS[change.alarm], short(units[change.joint])
    region = " near stiction" if change.near_stiction else ""
    error = f" (standard error {change.sigma_nm:.2f} {unit})" if math.isfinite(change.sigma_nm) else ""
    return (
        f"{level.upper()} {joints[change.joint]}: |tau_ext| {abs(change.tau_ext_nm):.2f} {unit}{error}, "
        f"{level} limit{region} {change.limit_nm:.2f} {unit}"
    )


def touch_words(change: TouchChange) -> str:
    """`the collision is a clamp, 164 ms after the alarm`."""
    kind = TOUCHES[change.touch]
    was = f" (was taken for {TOUCHES[change.was]})" if TOUCHES[change.was] not in ("none", "unknown") else ""
    return f"the {ALARMS[change.alarm]} is {with_article(kind)}, {change.since_s * 1e3:.0f} ms after the alarm{was}"


def summary_lines(tally: Tally, flights: FlightCount, folder: Place | None, timing: str = "") -> list[str]:
    """The summary of one recording or of all. timing: said of the samples instead of the core's time for each."""
    told = tally.summary()
    if not tally.samples:
        return ["no samples"]
    shares = [f"{name} {share:.2%}" for name, share in told["health_share"].items() if share]
    alarms = []
    for level, counts in told["alarms"].items():
        raised = [f"{joint} {count}" for joint, count in counts.items() if count]
        alarms.append(f"{level} {', '.join(raised) if raised else 'none'}")
    margins = [
        f"{joint} {margin:+.2f} {short(unit)}"
        for (joint, margin), unit in zip(told["worst_margin_nm"].items(), tally.units, strict=True)
        if margin is not None
    ]
    lines = [
        f"samples       {tally.samples:,} ({duration_text(tally.hours)}), "
        + (timing or f"{told['us_per_sample']:.2f} µs each"),
        f"health        {', '.join(shares)}",
        f"alarms        {'; '.join(alarms)}"
        + (f"; {tally.acknowledged} acknowledged" if tally.acknowledged else "")
        + (f"; {collisions_text(tally.hidden)} hidden by an alarm that stood" if tally.hidden else ""),
        f"worst margin  {', '.join(margins) if margins else 'none: there was no estimate'}",
        f"chain         {tally.bridged_ticks} bridged ticks, {tally.restarts} restarts",
    ]
    if tally.unfamiliar:
        lines.append(f"unfamiliar    {unfamiliar_text(tally)}")
    if folder is not None:
        lost = f", {flights.failed} could not be written" if flights.failed else ""
        missed = f", {flights.missed} missed: they came too fast one after the other" if flights.missed else ""
        lines.append(f"flights       {flights.written} written to {folder}{lost}{missed}")
    return lines


def unfamiliar_text(tally: Tally) -> str:
    """How much of the motion training never saw, what of it, and what to do where that is no accident."""
    most = tally.unfamiliar.most_common(MOST_UNFAMILIAR)
    words = [f"{unseen_words(unseen, tally.joints)} {count / tally.samples:.2%}" for unseen, count in most]
    more = len(tally.unfamiliar) - len(most)
    text = f"{tally.unfamiliar_share:.2%} of the motion is none that training saw: {', '.join(words)}"
    text += f" and {more} more" if more else ""
    if tally.unfamiliar_share < WARNS_FROM:
        return text
    return f"{text}. WARNING: estimates may be wrong there, and limits are up to half higher; train with such motion"


def load_change_words(change: LoadChange) -> str:
    since = f" since {(change.t_ns - change.since_ns) * 1e-9:.3f} s" if change.since_ns is not None else ""
    told = f"carries {load_words(change.load)}{since}" + (f", by {change.by}" if change.by else "")
    if not change.left_out or change.load.mass == 0:
        return told
    return f"{told}; limits of {', '.join(change.left_out)}, not in Nm, are higher by all that it may show there"


def found_load_words(change: FoundLoad) -> str:
    if change.mass_kg == 0:
        return "the load that was expected to go is gone: carries nothing"
    return f"the load that was expected: carries {change.mass_kg:.2f} ± {max(change.error_kg, 0.005):.2f} kg"


def weigh_words(change: WeighChange) -> list[str]:
    """What was found, sentence by sentence."""
    from tauext.monitor.weighing import load_sentences

    if change.found is None:
        return [f"weighs what the arm carries beside {load_words(change.beside)}, by {change.by}"]
    sentences = load_sentences(change.found, change.frame, "N m")
    if change.beside.mass > 0 and change.found.verdict == "load":
        sentences.append(f"with the {change.beside.mass:.4g} kg that are set: {load_words(change.found.load)}")
    return sentences


def collisions_text(count: int) -> str:
    return f"{count} more collision{'s' * (count != 1)}"


def duration_text(hours: float) -> str:
    return f"{hours:.2f} h" if hours >= 1 else f"{hours * 60:.1f} min" if hours >= 1 / 60 else f"{hours * 3600:.1f} s"
