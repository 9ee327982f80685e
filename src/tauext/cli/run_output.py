"""What `tauext run` tells while it goes on: JSON lines, text lines and the live view do."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from tauext._core import Bundle
from tauext.data.recording import Recording
from tauext.monitor.flight_writer import FlightNews
from tauext.monitor.replay import Chunk
from tauext.monitor.tally import Tally


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
