"""A thread that writes flights to disk while the samples go on."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

from tauext import _core
from tauext.errors import TauextError
from tauext.files.place import Place
from tauext.monitor.flight_content import Flight, event_kind

POLL_S = 0.05
MOST_WAITING = 4
"""Flights in memory before a replay waits for the disk."""


@dataclass(frozen=True)
class FlightNews:
    """A flight that was written, or why it was not."""

    what: str
    """collision, contact or fault."""
    t_ns: int
    """Of the event."""
    path: Place | None
    error: str | None = None


class FlightWriter:
    """Takes flights from a recorder and writes them: `with FlightWriter(recorder, write) as writer: ...`.

    A flight that cannot be written is told in news() and the thread goes on: the next one may fit. Leaving the block
    takes the event that still waits for its samples, writes everything and ends the thread; nothing is lost.
    """

    def __init__(self, recorder: _core.FlightRecorder, write: Callable[[Flight], Path], poll_s: float = POLL_S):
        """write: writes one flight and returns its path; raises TauextError where it cannot."""
        self._recorder, self._write, self._poll_s = recorder, write, poll_s
        self._waiting: deque[Flight] = deque()
        self._news: deque[FlightNews] = deque()
        self._taking = threading.Lock()
        self._wake = threading.Event()
        self._ended = threading.Event()
        self._broken: BaseException | None = None
        self._thread = threading.Thread(target=self._work, name="flight writer", daemon=True)

    def __enter__(self) -> FlightWriter:
        self._thread.start()
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        try:
            self._take()
            self._recorder.finish()
            self._take()
        finally:
            self._ended.set()
            self._wake.set()
            self._thread.join()
        if self._broken is not None and error is None:
            raise self._broken

    def catch_up(self) -> None:
        """For a replay, which can wait: take what is ready now, and wait while too many flights are in memory."""
        self._take()
        while self.waiting > MOST_WAITING and self._thread.is_alive():
            self._wake.set()
            self._thread.join(timeout=0.01)

    @property
    def waiting(self) -> int:
        """Flights that were taken and are not on disk yet."""
        return len(self._waiting)

    def news(self) -> list[FlightNews]:
        """What became of flights since the last call."""
        told = []
        while self._news:
            told.append(self._news.popleft())
        return told

    def _take(self) -> None:
        with self._taking:
            flight = self._recorder.take()
            if flight is not None:
                self._waiting.append(flight)
                self._wake.set()

    def _work(self) -> None:
        try:
            while True:
                ended = self._ended.is_set()
                self._wake.clear()
                self._take()
                while self._waiting:
                    self._news.append(self._written(self._waiting[0]))
                    self._waiting.popleft()
                if ended:
                    return
                self._wake.wait(self._poll_s)
        except BaseException as broken:  # a mistake of ours: told by the thread that waits for this one
            self._broken = broken

    def _written(self, flight: Flight) -> FlightNews:
        what, t_ns = event_kind(flight), int(flight["event"].t_ns)
        try:
            return FlightNews(what, t_ns, self._write(flight))
        except TauextError as error:
            return FlightNews(what, t_ns, None, str(error))
