"""Peaks of calibration recordings that a killed process had picked already."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tauext.files.half_done import HalfDone


class KeptPeaks:
    """Peaks of the first recordings, from a process that was killed, and what this one does of it."""

    def __init__(self, half_done: HalfDone):
        self._half_done = half_done
        self.collectors: list[Any]
        self.names: list[str]
        self.collectors, self.names = half_done.load() or ([], [])
        self._taken = len(self.names)

    def offer(self, collectors: list[Any], names: Sequence[str]) -> None:
        """One more recording is taken in; names of these and of the next few, which are estimated already."""
        self._taken += 1
        self._half_done.offer((collectors, list(names[: self._taken])))
