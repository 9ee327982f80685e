"""Receivers of samples, events and reports of the loop, and events for reactions."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np

from tauext._core import Bundle, Load, LoadFound, Monitor
from tauext.bundle.estimates import NONE, OK, sample_facts
from tauext.monitor.changes import Change, Trigger
from tauext.monitor.episode import Episode
from tauext.monitor.loads import Expected
from tauext.monitor.monitored_time import Monitored
from tauext.monitor.phases import Announced
from tauext.monitor.source import Block, SourceCounts

# --- Receivers of every sample and event: publishers, outputs, recordings.


EventKind = Literal["collision", "contact", "fault", "cleared"]


@dataclass(frozen=True, slots=True)
class Verdict:
    """The monitor's result for the samples that had come, at least one, or, with block None, for one that had not."""

    row: int
    """Number of samples before it."""
    t_ns: np.ndarray
    """Times by the source's clock, (rows,) [ns]; for a missing sample the last stamp plus the time since then."""
    block: Block | None
    estimates: Mapping[str, np.ndarray]
    """Result of Monitor.run, a row a sample: tau_ext (rows, joints) [N m], health (rows,), ..."""
    changes: tuple[Change, ...]
    """Changes at these samples, by rising row."""
    episode: Episode | None = None
    """The alarm that stands at the last sample, as of the newest news; None: none stands."""
    news: tuple[Episode, ...] = ()
    """Alarms of which something is new at these samples, or that have ended, in order."""
    core_s: float = 0.0
    """Time spent in the core, [s]."""

    @property
    def alarm_number(self) -> int:
        """Number of the alarm that stands; 0: none stands."""
        return 0 if self.episode is None else self.episode.number


@dataclass(frozen=True, slots=True)
class ReactionEvent:
    """An event that starts reactions."""

    kind: EventKind
    """collision, contact: the alarm rose to this level; fault: health became a fault; cleared: healthy and no alarm,
    for the first time after any of the three."""
    joint: str | None
    """The joint that raised the alarm, or that the fault concerns."""
    t_ns: int
    """Time of the sample, by the source's clock, [ns]."""
    received_ns: int
    """Reception of that sample by time.monotonic_ns(); for a missing sample, when it was detected as missing."""
    facts: Mapping[str, Any] = field(default_factory=dict)
    """Content as plain JSON: alarm, kind of touch, health, causes, torques and limits a joint."""
    merged: int = 1
    """Number of events of this kind and joint that this one, the newest, replaces: more than 1 if they had to wait."""
    touch: str | None = None
    """Kind of touch of a collision or contact, as known at this sample; None for other events."""
    news: bool = True
    """Whether the alarm is new; False: only its kind of touch or place is."""
    links: tuple[tuple[str, float], ...] = ()
    """Joints that carry the touched link of a collision or contact, with probabilities, most probable first; empty
    while unknown."""
    newtons: float | None = None
    """Median of the force, [N]; None: unknown."""
    number: int = 0
    """Number of the alarm: the same for all events of one alarm."""
    of_place: bool = False
    """Whether only the place is new."""

    @property
    def content(self) -> dict[str, Any]:
        """The event as plain JSON, for commands, functions and publishers."""
        own = {"event": self.kind, "joint": self.joint, "t_ns": self.t_ns, "merged": self.merged}
        return {**own, **self.facts}


@dataclass(frozen=True)
class LoopReport:
    """Counts and timing of the loop in the last second, and since its start."""

    t_ns: int
    """time.monotonic_ns() of the report."""
    samples: int
    """Number of samples since the start."""
    missing: int
    """Missing samples since the start."""
    rate_hz: float
    """Rate of the samples in the last second."""
    counts: SourceCounts
    """The source's counts since the start."""
    tick_p50_us: float
    """Time from a sample's reception until every sink has its verdict, in the last second; NaN without a sample."""
    tick_p99_us: float
    tick_max_us: float
    profile: str
    """The active profile; empty without profiles."""
    monitored: Monitored = Monitored()
    """Share of the time in which the arm was monitored."""


class Sink(Protocol):
    """Receives every verdict, in the loop's thread and in order: it must return at once; slow work belongs in a thread.

    A verdict has one sample, or all that had come if the loop was late.

    A sink that raises is reported once and not called again; the loop continues.
    """

    def open(self, joints: tuple[str, ...], control: Control) -> None:
        """Called before the first sample."""
        ...

    def verdict(self, verdict: Verdict) -> None:
        """Called after the samples that had come, and for every missing one."""
        ...

    def every_second(self, report: LoopReport) -> None:
        """Called about once a second, also without samples."""
        ...

    def close(self) -> None:
        """Called after the last sample."""
        ...


class Losing(Protocol):
    """A sink that may lose samples."""

    def loss(self) -> str:
        """How many samples were lost, and why; empty: none. The command then ends with status 2."""
        ...


class AddedSink(Sink, Losing, Protocol):
    """A sink that an option of `tauext run` and `tauext monitor` adds; see tauext.monitor.sink_kind.SinkKind."""

    def summary(self) -> str:
        """What was written, for the user; called after close()."""
        ...


@runtime_checkable
class Follows(Protocol):
    """A sink that uses the bundle or its monitor, and must follow when others take their place."""

    def follow(self, bundle: Bundle, monitor: Monitor) -> None:
        """Called in the loop's thread between two samples, before the first verdict of each monitor.

        Within verdict() the monitor holds the last sample of that verdict.
        """
        ...


AnswerKind = Literal["touched", "nothing", "learn", "leave"]
"""touched, nothing: what an alarm was, or without an alarm: the arm was touched in the last seconds. learn, leave:
whether a named change of the arm may be learned."""


@runtime_checkable
class Publisher(Protocol):
    """A sink that reactions with `publish = true` also use."""

    def publish_event(self, event: ReactionEvent) -> None:
        """Called by the thread of the reaction, beside verdict() of the loop."""
        ...


USUAL_REACH_M: float = LoadFound.USUAL_REACH_M
"""Default for the largest distance of a load's centre of mass from the load frame."""


class Control(Protocol):
    """Requests to the loop, from any thread: each is executed before the next sample, and logged."""

    note: Callable[[str], None]
    """Passes a message on to the user; sinks call it in the loop's thread."""

    def use_profile(self, name: str, by: str) -> None:
        """Change to this profile. by: origin of the request, for the log: `control socket`.

        Raises:
            ConfigError: the profile does not exist.
        """
        ...

    def acknowledge(self, by: str) -> None:
        """End a latched alarm; it is raised again if its cause lasts."""
        ...

    def resume(self, by: str) -> None:
        """End a latched alarm once nothing touches the arm any more, so that it can continue.

        A push changes static friction: limits of joints at rest are higher until they have slid.
        """
        ...

    def set_load(self, load: Load, by: str, ago_s: float | None = None) -> None:
        """Set the load from the next sample on; mass 0: none.

        Args:
            ago_s: the load applies from this time before the last sample on, [s]; None: from now on.

        Raises:
            ConfigError: the bundle refuses the load; the message gives the reason.
        """
        ...

    def expect_load(self, expected: Expected, by: str) -> None:
        """Announce a gripper's grasp or release: Monitor.expect_load() before the next sample.

        Raises:
            ConfigError: the bundle cannot expect the load; the message gives the reason.
        """
        ...

    def declare(self, announced: Announced, by: str) -> None:
        """Declare a contact that the task means, or end some: Monitor.expect_contact() before the next sample.

        Raises:
            ConfigError: there is no such phase, or the bundle refuses the contact; the message gives the reason.
        """
        ...

    def weigh(self, what: str, by: str, reach_m: float = USUAL_REACH_M) -> None:
        """Weigh the load from `start` to `stop`; `stop` and `report` report the result as a change.

        Args:
            what: `start`, `report` or `stop`.
            reach_m: largest distance of the centre of mass from the load frame, [m].

        Raises:
            ConfigError: the bundle cannot weigh loads, or the reach is invalid; the message gives the reason.
        """
        ...

    def answer(self, what: AnswerKind, by: str, alarm: int | None = None) -> None:
        """Store an answer; one about the alarm that stands also acknowledges it, see Loop.settle().

        Args:
            alarm: number of the alarm of `touched` or `nothing`; None: the newest one, if it has no answer.

        Raises:
            ConfigError: nothing keeps answers, there was no such alarm, or the answer is not on the disk.
        """
        ...

    def command(self, text: str, by: str) -> None:
        """Pass a line to a source that takes commands, see Commanded.

        Raises:
            ConfigError: the source takes no commands, or not this one.
        """
        ...

    def stop(self, by: str) -> None:
        """End the loop cleanly."""
        ...


# --- From verdicts to events for reactions.


class EventFinder:
    """Finds the events of one verdict after the other."""

    def __init__(self, joints: tuple[str, ...], facts: dict[str, Any]):
        """facts: further content of every event: bundle, source."""
        self._joints, self._facts = joints, facts
        self._unsettled = False

    def find(self, verdict: Verdict) -> list[ReactionEvent]:
        """Events of this verdict by rising row, usually none. At one sample a fault precedes an alarm."""
        events: list[ReactionEvent] = []
        begin = 0
        for change in verdict.changes:
            if (trigger := change.trigger) is None:
                continue
            row = change.row - verdict.row
            events += self._cleared(verdict, begin, row)
            events.append(self._event(trigger, verdict, row))
            self._unsettled, begin = True, row + 1
        return events + self._cleared(verdict, begin, len(verdict.t_ns))

    def _cleared(self, verdict: Verdict, begin: int, end: int) -> list[ReactionEvent]:
        """The end of all that was reported, if it is at one of these rows."""
        if not self._unsettled or begin >= end:
            return []
        rows = slice(begin, end)
        is_clear = (verdict.estimates["health"][rows] == OK) & (verdict.estimates["alarm"][rows] == NONE)
        if not is_clear.any():
            return []
        self._unsettled = False
        return [self._event(None, verdict, begin + int(is_clear.argmax()))]

    def _event(self, trigger: Trigger | None, verdict: Verdict, row: int) -> ReactionEvent:
        """trigger: None: all is cleared."""
        kind, joint, of_alarm, is_news, of_place = trigger or ("cleared", -1, 0, True, False)
        is_fault, news = kind not in ("collision", "contact"), verdict.news
        found = [] if is_fault else [one for one in news if (one.number, one.row) == (of_alarm, verdict.row + row)]
        episode = found[0] if found else None
        received_ns = time.monotonic_ns() if verdict.block is None else int(verdict.block.received_ns[row])
        place, number = (None, 0) if episode is None else (episode.place, episode.number)
        facts = self._facts | {"joints": list(self._joints), "row": verdict.row + row}
        facts |= sample_facts(verdict.estimates, row)
        facts |= {"number": number or None, "place": place and place.place_facts(self._joints)}
        return ReactionEvent(
            kind,
            self._joints[joint] if joint >= 0 else None,
            int(verdict.t_ns[row]),
            received_ns,
            facts,
            touch=facts["touch"] if episode else None,
            links=() if place is None else tuple((self._joints[link], share) for link, share in place.links),
            newtons=None if place is None else place.newtons,
            number=number,
            news=is_news,
            of_place=of_place,
        )
