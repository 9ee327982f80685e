"""Alarms as the journal keeps them, and answers that count once the disk holds them."""

from __future__ import annotations

import calendar
import math
import queue
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from tauext.bundle.history_file import read_events
from tauext.commission.folder import CommissionFolder
from tauext.data.labels import Label
from tauext.errors import ConfigError
from tauext.monitor.flight_files import FlightNews
from tauext.monitor.sink import Answer, AnswerKind, Control, LoopReport, Verdict

ASKING_S = 600.0
"""Time after which an alarm without an answer is not asked about any more, and is acknowledged."""
STORED_S = 10.0
"""Longest wait of an answer for the disk."""
MOST_EVENTS = 1000
"""Events in memory."""
KEPT = ("answer", "by", "flight")
"""Facts of an event that do not come from the monitor."""


def age_s(at: Any) -> float:
    """Age of a date and time of wall(), [s]."""
    try:
        return time.time() - calendar.timegm(time.strptime(str(at), "%Y-%m-%dT%H:%M:%SZ"))
    except ValueError:
        return math.inf


class EventKeeper:
    """Writes alarms to the folder in a thread of its own; the loop and the page never wait for the disk."""

    def __init__(self, folder: CommissionFolder, epoch: Callable[[], int], note: Callable[[str], None]):
        """
        Args:
            epoch: number of the source's present clock.
            note: receives messages for the user.
        """
        self._folder, self._epoch, self._note = folder, epoch, note
        self.learn: Callable[[bool, str], None] = lambda yes, by: None
        """Called in the keeper's thread with the answer about a named change of the arm, and its origin; may raise
        ConfigError."""
        self._events = {one["id"]: one for one in read_events(folder.path)[-MOST_EVENTS:] if isinstance(one["id"], int)}
        self._done: deque[tuple[int, str, str, int, str]] = deque(maxlen=100)
        """Number, kind, origin and alarm of the last answers that were stored, and why one was not."""
        self._news = threading.Condition()
        self._waiting: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._work, name="events", daemon=True)
        self._thread.start()

    @property
    def newest(self) -> int:
        """Number of the newest alarm; 0: there was none."""
        return max(self._events, default=0)

    def event(self, alarm: int) -> dict[str, Any] | None:
        """Facts of an alarm."""
        event = self._events.get(alarm)
        return None if event is None else dict(event)

    def answer_to(self, alarm: int) -> str | None:
        """The stored answer to an alarm."""
        event = self._events.get(alarm)
        return None if event is None else event.get("answer")

    def __contains__(self, alarm: int) -> bool:
        return alarm in self._events

    @property
    def unanswered(self) -> dict[str, Any] | None:
        """The newest alarm, if it has no answer."""
        event = self._events.get(self.newest)
        return None if event is None or event.get("answer") else event

    # Sink: the loop's thread.

    def open(self, joints: tuple[str, ...], control: Control) -> None:
        pass

    def verdict(self, verdict: Verdict) -> None:
        pass

    def answered(self, answer: Answer) -> None:
        if answer.what in ("learn", "leave"):
            self._waiting.put(answer)

    def every_second(self, report: LoopReport) -> None:
        pass

    def close(self) -> None:
        """The loop has ended; what still comes is written."""

    # Any thread.

    def changed(self, event: dict[str, Any]) -> None:
        """The facts of an alarm have changed."""
        self._waiting.put(event)

    def labelled(self, label: Label) -> None:
        """The disk holds a label."""
        self._waiting.put(label)

    def flown(self, news: FlightNews) -> None:
        """A flight was written."""
        self._waiting.put(news)

    @property
    def done(self) -> int:
        """Number of answers that were stored so far."""
        return self._done[-1][0] if self._done else 0

    def wait_for(self, what: AnswerKind, by: str, since: int, alarm: int | None = None) -> str:
        """Wait until an answer from there is on disk; why it is not, empty if it is.

        Args:
            since: `done` before the answer was given.
            alarm: alarm of the answer; None: any.
        """
        limit_s = time.monotonic() + STORED_S
        with self._news:
            while (left_s := limit_s - time.monotonic()) > 0:
                for number, kind, origin, about, error in self._done:
                    if number > since and (kind, origin) == (what, by) and alarm in (None, about):
                        return error
                self._news.wait(left_s)
        return "not stored yet: the disk is full or does not answer"

    def end(self) -> None:
        """Write what is left."""
        self._waiting.put(None)
        self._thread.join(STORED_S)

    # The keeper's thread.

    def _work(self) -> None:
        while (one := self._waiting.get()) is not None:
            error = ""
            try:
                if isinstance(one, Answer):
                    self.learn(one.what == "learn", one.by)
                elif isinstance(one, Label):
                    if one.id in self._events and one.answer != "unanswered":
                        self._events[one.id] |= {"answer": one.answer, "by": one.by}
                elif isinstance(one, FlightNews):
                    self._flown(one)
                else:
                    self._changed(one)
            except ConfigError as refused:
                error = str(refused)
            except Exception as failed:  # a full disk, for example: the label is stored, the event's line is not
                error = (failed.strerror if isinstance(failed, OSError) else "") or str(failed)
                self._note(f"an event is not stored: {error}")
            if isinstance(one, Answer | Label):
                kind, about = (one.what, one.alarm) if isinstance(one, Answer) else (one.answer, one.id)
                with self._news:
                    why = error if isinstance(one, Answer) else ""
                    self._done.append((self.done + 1, kind, one.by, about, why))
                    self._news.notify_all()

    def _changed(self, event: dict[str, Any]) -> None:
        known = self._events.get(event["id"], {})
        self._events[event["id"]] = (
            known | {"epoch": self._epoch()} | event | {name: known[name] for name in ("epoch", *KEPT) if name in known}
        )
        if event.get("level") != known.get("level") and event.get("sentence"):
            number = event["id"]
            details = f" ({event['details']})" if event.get("details") else ""
            self._note(
                f"alarm {number}: {event['sentence']}{details}; answer: `touched {number}` or `nothing {number}`"
            )
        if self._events[event["id"]] != known:
            self._folder.append_event(self._events[event["id"]])
        if len(self._events) > MOST_EVENTS:
            del self._events[min(self._events)]

    def _flown(self, news: FlightNews) -> None:
        """A flight belongs to the alarm that stood at its event."""
        for event in reversed(self._events.values()):
            is_its = news.what != "fault" and event["epoch"] == self._epoch()  # a contact may have become a collision
            if news.path is not None and is_its and event["t_ns"] <= news.t_ns <= event["held_ns"]:
                event["flight"] = str(news.path).rpartition("/")[2]
                return self._folder.append_event(event)


class Steering:
    """The control of whatever loop runs now. An answer comes back once it is on the disk."""

    def __init__(self, keeper: EventKeeper, stop: Callable[[str], None]):
        """stop: ends the command, not the loop alone."""
        self._keeper, self.stop = keeper, stop
        self._answering = threading.Lock()
        self.loop: Control | None = None

    def answer(self, what: AnswerKind, by: str, alarm: int | None = None) -> None:
        loop, keeper = self._present, self._keeper
        if alarm is not None and alarm not in keeper:
            raise ConfigError(f"{what}: there is no alarm {alarm}; the newest is {keeper.newest}")
        if what in ("touched", "nothing") and alarm is None and (asked := keeper.unanswered) is not None:
            alarm = asked["id"] if what == "nothing" or age_s(asked.get("wall")) < ASKING_S else None
        if what == "nothing" and alarm is None:
            newest = f"the newest alarm ({keeper.newest}) has an answer" if keeper.newest else "there was no alarm"
            raise ConfigError(f"nothing: {newest}{'; give the number of another' if keeper.newest > 1 else ''}")
        with self._answering:
            since = keeper.done
            loop.answer(what, by, alarm)
            if error := keeper.wait_for(what, by, since, alarm):
                raise ConfigError(f"{what}: {error}")

    def __getattr__(self, name: str) -> Any:
        return getattr(self._present, name)

    @property
    def _present(self) -> Control:
        if self.loop is None:
            raise ConfigError("no arm is connected")
        return self.loop
