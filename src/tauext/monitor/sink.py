"""Receivers of samples, events and reports of the loop, and events for reactions."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np

from tauext._core import Bundle, Load, LoadFound, Monitor
from tauext.bundle.estimates import COLLISION, FAULT, NONE, OK
from tauext.monitor.changes import AlarmChange, Change, HealthChange, TouchChange
from tauext.monitor.episode import Episode
from tauext.monitor.events import sample_facts
from tauext.monitor.loads import Expected
from tauext.monitor.monitored_time import Monitored
from tauext.monitor.phases import Announced
from tauext.monitor.source import Sample, SourceCounts
from tauext.monitor.touch_place import PlaceChange, newtons, place_facts

# --- Receivers of every sample and event: publishers, outputs, recordings.


EventKind = Literal["collision", "contact", "fault", "cleared"]
EVENT_KINDS: tuple[EventKind, ...] = ("collision", "contact", "fault", "cleared")


@dataclass(frozen=True, slots=True)
class Verdict:
    """The monitor's result for one sample or, with sample None, for one that did not come."""

    row: int
    """Number of samples before it."""
    t_ns: int
    """Time by the source's clock, [ns]; for a missing sample the last stamp plus the time since then."""
    sample: Sample | None
    estimates: Mapping[str, np.ndarray]
    """One row of Monitor.run: tau_ext (1, joints) [N m], health (1,), ..."""
    changes: tuple[Change, ...]
    episode: Episode | None = None
    """The alarm that stands at this sample, as of the newest news; None: none stands."""
    news: tuple[Episode, ...] = ()
    """Alarms of which something is new at this sample, or that have ended."""

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
    """Force at the most probable place on the most probable link, [N]; None: unknown."""
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

    A sink that raises is reported once and not called again; the loop continues.
    """

    def open(self, joints: tuple[str, ...], control: Control) -> None:
        """Called before the first sample."""
        ...

    def verdict(self, verdict: Verdict) -> None:
        """Called after every sample and for every missing one."""
        ...

    def every_second(self, report: LoopReport) -> None:
        """Called about once a second, also without samples."""
        ...

    def close(self) -> None:
        """Called after the last sample."""
        ...


@runtime_checkable
class Follows(Protocol):
    """A sink that uses the bundle or its monitor, and must follow when others take their place."""

    def follow(self, bundle: Bundle, monitor: Monitor) -> None:
        """Called in the loop's thread between two samples, before the first verdict of each monitor.

        Within verdict() the monitor holds the sample of that verdict.
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
        """Events of this verdict, usually none. At one sample a fault precedes an alarm."""
        if not verdict.changes and not self._unsettled:
            return []
        events = []
        for change in verdict.changes:
            if isinstance(change, HealthChange):
                if change.health == FAULT and change.was != FAULT:
                    events.append(self._event("fault", change.joint, verdict))
            elif isinstance(change, AlarmChange | TouchChange | PlaceChange) and change.alarm and change.joint >= 0:
                kind: EventKind = "collision" if change.alarm == COLLISION else "contact"
                episode = next((one for one in verdict.news if one.number == change.number), None)
                event = self._event(kind, change.joint, verdict, episode)
                news, of_place = isinstance(change, AlarmChange), isinstance(change, PlaceChange)
                events.append(replace(event, news=news, of_place=of_place))
        if events:
            self._unsettled = True
        elif self._unsettled and verdict.estimates["health"][0] == OK and verdict.estimates["alarm"][0] == NONE:
            self._unsettled = False
            events.append(self._event("cleared", -1, verdict))
        return events

    def _event(self, kind: EventKind, joint: int, verdict: Verdict, episode: Episode | None = None) -> ReactionEvent:
        """episode: of a collision or contact."""
        received_ns = time.monotonic_ns() if verdict.sample is None else verdict.sample.received_ns
        place, number = (None, 0) if episode is None else (episode.place, episode.number)
        facts = self._facts | {"joints": list(self._joints), "row": verdict.row} | sample_facts(verdict.estimates, 0)
        facts |= {"number": number or None, "place": place and place_facts(place, self._joints)}
        return ReactionEvent(
            kind,
            self._joints[joint] if joint >= 0 else None,
            verdict.t_ns,
            received_ns,
            facts,
            touch=facts["touch"] if episode else None,
            links=() if place is None else tuple((self._joints[link], share) for link, share in place.links),
            newtons=None if place is None else newtons(place.best),
            number=number,
        )
