"""What every importer gives: numbers with times and names, as the file has them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from tauext.errors import RecordingError

BLOCK_ROWS = 8192
"""Samples that an importer hands over at once: long enough for NumPy, short enough for memory."""


def short_list(names: Iterable[str], most: int = 8) -> str:
    """The names, at most so many, and how many more there are."""
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
    """RecordingError in place of what a library raises on damaged bytes."""
    try:
        yield
    except RecordingError:
        raise
    except broken as error:
        cause = " ".join(str(error).split()) or type(error).__name__
        raise RecordingError(f"{path}: cannot be read as {kind} ({cause}); {advice}") from error


@dataclass(frozen=True)
class RawSignals:
    """A run of samples that share their stamps; no unit, sign, order or gap was touched."""

    stream: str
    """Topic, or empty where the file has one clock only."""
    names: tuple[str, ...]
    """Of the columns; an element of an array is `array[joint name]` where the file names it, else `array[index]`."""
    t_ns: np.ndarray | None
    """(samples,) int64, in the order of the file, [ns]; None: the file has no clock but perhaps a column of times."""
    columns: np.ndarray
    """(samples, names) float64."""


@dataclass(frozen=True)
class RawRecording:
    """One recording in a file of any format; `blocks()` reads it from its beginning, a block at a time."""

    name: str
    """For the recording's file: the stem of the file, with the episode where there are several."""
    path: Path
    format: str
    blocks: Callable[[], Iterator[RawSignals]]
    notes: list[str] = field(default_factory=list)
    """What the reader had to do to open it."""
    counts: Counter[str] = field(default_factory=Counter)
    """What the reader met while reading, as text and how often; complete after the last block."""

    def streams(self) -> dict[str, tuple[str, ...]]:
        """Names of the columns of every stream, found by reading until each stream's first block has come.

        A stream that begins later than a block after all others is found late or, at the end of the file, never.
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
