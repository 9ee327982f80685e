"""Common output of all importers: numbers with times and names, as in the file."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from tauext.errors import RecordingError

BLOCK_ROWS = 8192
"""Samples in a block: enough for NumPy's speed, few enough for memory."""


def short_list(names: Iterable[str], most: int = 8) -> str:
    """List at most so many names, and the number of the rest."""
    names = list(names)
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


@contextmanager
def readable(
    path: object,
    kind: str,
    broken: tuple[type[Exception], ...],
    advice: str = "it is truncated or damaged: copy it again",
) -> Iterator[None]:
    """Convert a library's exceptions on damaged files to RecordingError."""
    try:
        yield
    except RecordingError:
        raise
    except broken as error:
        cause = " ".join(str(error).split()) or type(error).__name__
        raise RecordingError(f"{path}: cannot be read as {kind} ({cause}); {advice}") from error


@dataclass(frozen=True)
class RawSignals:
    """A block of samples with common stamps, with units, signs, order and gaps as in the file."""

    stream: str
    """Topic; empty if the file has only one clock."""
    names: tuple[str, ...]
    """Column names; an array's element is `array[joint name]` where the file names it, else `array[index]`."""
    t_ns: np.ndarray | None
    """(samples,) int64, in the order of the file, [ns]; None: no stamps, though a column may contain times."""
    columns: np.ndarray
    """(samples, names) float64."""


@dataclass(frozen=True)
class RawRecording:
    """One recording in a file of any format; `blocks()` reads it from the beginning, block by block."""

    name: str
    """Name for the recording's file: the stem of the source, with the episode if there are several."""
    path: Path
    format: str
    blocks: Callable[[], Iterator[RawSignals]]
    notes: list[str] = field(default_factory=list)
    """Notes on how the file was opened."""
    counts: Counter[str] = field(default_factory=Counter)
    """Irregularities found while reading, with their number; complete after the last block."""

    def streams(self) -> dict[str, tuple[str, ...]]:
        """Column names of every stream, found by reading each stream's first block.

        A stream that begins much later than the others may not be found.
        """
        found: dict[str, dict[str, None]] = {}
        quiet = 0
        for block in self.blocks():
            before = sum(map(len, found.values()))
            found.setdefault(block.stream, {}).update(dict.fromkeys(block.names))
            quiet = quiet + 1 if sum(map(len, found.values())) == before else 0
            if quiet > 2 * len(found):
                break
        self.counts.clear()
        return {stream: tuple(names) for stream, names in found.items()}
