"""Alarms in the journal, and what a person answered about them.

An alarm's line is written in a thread beside the loop, and again whenever its facts change. An answer is written in the
thread that gives it, which gets `ok` once the disk holds it. An alarm without an answer is a label `unanswered`.
"""

from __future__ import annotations

import calendar
import math
import queue
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from tauext import _core
from tauext.data.labels import Label
from tauext.errors import ConfigError
from tauext.monitor.episode import Episode
from tauext.monitor.flight_files import FlightNews
from tauext.monitor.loop import Loop
from tauext.monitor.sink import AnswerKind, Control, LoopReport, Verdict
from tauext_commission.folder import CommissionFolder, wall
from tauext_commission.history_file import label_of_alarm, read_events

ASKING_S = 600.0
"""Time after which an alarm without an answer is not asked about any more, and is acknowledged."""
NOTICED_S = 3.0
"""An answer `touched` without any alarm is about the last 3 s."""
AGAIN_S, END_S = 1.0, 10.0
"""Time after which a line that the disk did not take is tried again, and longest wait for the disk at the end."""
MOST_EVENTS = 1000
"""Alarms in memory."""


def age_s(at: Any) -> float:
    """Age of a date and time of wall(), [s]."""
    try:
        return time.time() - calendar.timegm(time.strptime(str(at), "%Y-%m-%dT%H:%M:%SZ"))
    except ValueError:
        return math.inf


def is_whole(event: dict[str, Any]) -> bool:
    """Whether the line of an alarm has what its label needs."""
    return all(isinstance(event.get(name), int) for name in ("id", "epoch", "t_ns"))


class AlarmJournal:
    """A sink that keeps alarms, the answers to them and their flights in the folder's journal.

    Neither the loop nor the page waits for the disk.
    """

    def __init__(self, folder: CommissionFolder, epoch: Callable[[], int], note: Callable[[str], None]):
        """
        Args:
            epoch: number of the source's present clock.
            note: receives messages for the user.
        """
        self._folder, self._epoch, self._note = folder, epoch, note
        self.learn: Callable[[bool, str], None] = lambda yes, by: None
        """Stores the answer about a named change of the arm, and its origin; may raise ConfigError."""
        self._events = {one["id"]: one for one in read_events(folder.path)[-MOST_EVENTS:] if is_whole(one)}
        self._changing = threading.Lock()
        """Guards what is in memory; never held while the disk is written."""
        self._joints: tuple[str, ...] = ()
        self._units: Sequence[str] = ()
        self._now = (0, 0, 0)
        """Epoch and stamp of the newest sample, and number of the alarm that stands."""
        self._waiting: queue.SimpleQueue[dict[str, Any] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._work, name="events", daemon=True)
        self._thread.start()

    # Any thread.

    @property
    def newest(self) -> int:
        """Number of the newest alarm; 0: there was none."""
        return max(self._events, default=0)

    def event(self, alarm: int) -> dict[str, Any] | None:
        """Facts of an alarm, with its answer; None: there is no such alarm."""
        return self._events.get(alarm)

    @property
    def unanswered(self) -> dict[str, Any] | None:
        """The newest alarm, if it has no answer."""
        event = self._events.get(self.newest)
        return None if event is None or event.get("answer") else event

    def answer(self, what: AnswerKind, by: str, alarm: int | None = None) -> int:
        """Store an answer; the disk holds it on return. Returns the number of its alarm, 0 without one.

        Args:
            alarm: None: the newest alarm, if it has no answer and, for `touched`, stands or is recent; else `touched`
                is about the last NOTICED_S.

        Raises:
            ConfigError: there is no such alarm or question, or the disk did not take the answer.
        """
        try:
            if what in ("learn", "leave"):
                self.learn(what == "learn", by)
                return 0
            number = self._asked(what, alarm)
            self._folder.append_label(self._label("touched" if what == "touched" else "nothing", by, number))
        except OSError as error:
            raise ConfigError(f"{what}: not stored: {error.strerror or error}; please answer again") from error
        if number:
            self._put(number, answer=what, by=by)
        return number

    def flown(self, news: FlightNews) -> None:
        """A flight was written."""
        if news.path is not None and news.number in self._events:
            self._waiting.put(self._put(news.number, flight=str(news.path).rpartition("/")[2]))

    def end(self) -> None:
        """Write what is left."""
        self._waiting.put(None)
        self._thread.join(END_S)

    def _asked(self, what: AnswerKind, alarm: int | None) -> int:
        """Number of the alarm that an answer is about; 0: none."""
        if alarm is not None:
            if alarm not in self._events:
                raise ConfigError(f"{what}: there is no alarm {alarm}; the newest is {self.newest}")
            return alarm
        if (asked := self.unanswered) is not None:
            number = int(asked["id"])
            if what == "nothing" or number == self._now[2] or age_s(asked.get("wall")) < ASKING_S:
                return number
        if what == "nothing":
            newest = f"the newest alarm ({self.newest}) has an answer" if self.newest else "there was no alarm"
            raise ConfigError(f"nothing: {newest}{'; give the number of another' if self.newest > 1 else ''}")
        return 0

    def _label(self, answer: Any, by: str, number: int) -> Label:
        event = self._events.get(number)
        if event is not None:
            return replace(label_of_alarm(event), answer=answer, by=by, wall=wall())
        epoch, t_ns, _ = self._now
        own = min([-1, *(one.id - 2 for one in self._folder.labels() if one.id < 0 and one.id % 2)])
        return Label(own, epoch, t_ns - round(NOTICED_S * 1e9), t_ns, answer, by, wall())

    def _put(self, number: int, **facts: Any) -> dict[str, Any]:
        """Add facts to an alarm."""
        with self._changing:
            self._events[number] = self._events.get(number, {}) | facts
            if len(self._events) > MOST_EVENTS:
                del self._events[min(self._events)]
            return self._events.get(number, {})

    # Sink: the loop's thread.

    def open(self, joints: tuple[str, ...], control: Control) -> None:
        self._joints = joints

    def follow(self, bundle: _core.Bundle, monitor: _core.Monitor) -> None:
        self._units = tuple(bundle.estimate_units)

    def verdict(self, verdict: Verdict) -> None:
        self._now = self._epoch(), int(verdict.t_ns[-1]), verdict.alarm_number
        for one in verdict.news:
            self.learned(one)

    def every_second(self, report: LoopReport) -> None:
        pass

    def close(self) -> None:
        """The loop has ended; what still comes is written."""

    def learned(self, one: Episode) -> None:
        """Keep new facts of an alarm."""
        facts, known = one.facts(self._joints, self._units), self._events.get(one.number)
        if known is None and one.t_ns is None:
            return  # the line of an earlier process is lost
        if known is None:
            facts |= {"wall": wall(), "epoch": self._now[0], "answer": None, "flight": None}
        elif known.get("epoch") != self._now[0]:  # the touch goes on under another clock
            facts = {key: value for key, value in facts.items() if key not in ("t_ns", "held_ns", "over")}
        if known is None or known | facts != known:
            self._waiting.put(self._put(one.number, **facts))

    # The keeper's thread.

    def _work(self) -> None:
        owed: dict[int, dict[str, Any]] = {}
        has_ended, failed, levels = False, "", dict[int, str]()
        while not has_ended:
            try:
                event = self._waiting.get(timeout=AGAIN_S if owed else None)
                has_ended = event is None
            except queue.Empty:
                event = None
            if event is not None:
                owed[event["id"]] = event
                if event.get("level") not in (None, levels.get(event["id"])):
                    levels = {event["id"]: event["level"]}
                    if not event.get("answer"):
                        self._note(question(event))
            for number, event in list(owed.items()):
                try:
                    self._folder.append_event(event)
                    failed = ""
                except OSError as error:  # a full disk, for example: it is tried again
                    if (words := error.strerror or str(error)) != failed:
                        self._note(f"an event is not stored: {words}")
                    failed = words
                    break
                except Exception as error:
                    self._note(f"an event is not stored: {error}")
                del owed[number]


def question(event: dict[str, Any]) -> str:
    """The terminal's line about an alarm, with the ways to answer it."""
    number, details = event["id"], f" ({event['details']})" if event.get("details") else ""
    return f"alarm {number}: {event.get('sentence')}{details}; answer: `touched {number}` or `nothing {number}`"


class CurrentLoop:
    """The control of whatever loop runs now. An answer comes back once it is on the disk."""

    def __init__(self, keeper: AlarmJournal, stop: Callable[[str], None]):
        """stop: ends the command, not the loop alone."""
        self._alarm_journal, self.stop = keeper, stop
        self._answering = threading.Lock()
        self.loop: Loop | None = None

    def answer(self, what: AnswerKind, by: str, alarm: int | None = None) -> None:
        loop = self._present
        with self._answering:
            number = self._alarm_journal.answer(what, by, alarm)
        if number:
            loop.settle(number, f"{what}, by {by}")

    def __getattr__(self, name: str) -> Any:
        return getattr(self._present, name)

    @property
    def _present(self) -> Loop:
        if self.loop is None:
            raise ConfigError("no arm is connected")
        return self.loop
