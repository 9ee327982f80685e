"""The interface of importers, and their common output: numbers with times and names, as in the file."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from tauext.data.recording import Recording
from tauext.data.recording_file import Description
from tauext.errors import RecordingError

MOST_COLUMNS = 20_000
"""Columns of all streams: their names are compared with each other."""
BLOCK_ROWS = 8192
"""Samples in a block: enough for NumPy's speed, few enough for memory."""


def short_list(names: Iterable[str], most: int = 8) -> str:
    """List at most so many names, and the number of the rest."""
    names = list(names)
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


@dataclass
class Lost:
    """Rows or messages that an import leaves out, by reason: their number and the position of the first."""

    reasons: dict[str, tuple[int, str]] = field(default_factory=dict)

    def add(self, reason: str, count: int, first: str) -> None:
        """Count rows of this reason; `first` is the position of the first of them, such as "line 701"."""
        if count:
            before, at = self.reasons.get(reason, (0, first))
            self.reasons[reason] = before + count, at

    @property
    def count(self) -> int:
        """Number of all rows left out."""
        return sum(count for count, _ in self.reasons.values())

    def sentences(self) -> list[str]:
        """A sentence a reason: number, reason, position of the first."""
        return [f"{n} row{'s' * (n > 1)} left out: {why}, first {at}" for why, (n, at) in self.reasons.items()]


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
    """(samples, names) float64; NaN where a value is missing or no number."""
    other_ns: np.ndarray | None = None
    """(samples,) int64, stamps of a second clock of the same rows, [ns]; None: there is none."""
    rows: np.ndarray | None = None
    """(samples,) int64, number of each row or message in its stream, from 0; None: they follow the block before."""


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
    lost: Lost = field(default_factory=Lost)
    """Rows that the reader leaves out; complete after the last block."""
    clocks: tuple[str, str] = ("", "")
    """Names of the clocks of t_ns and other_ns, as [time] column may choose them: ("header", "log")."""
    stated_hz: dict[str, float] = field(default_factory=dict)
    """Rates that the file states beside its stamps, [Hz], by the name of the entry."""
    row_word: tuple[str, int] = ("row", 1)
    """What a row is called, and the number of the first: ("line", 2) of a CSV file with a header."""
    units: dict[str, str] = field(default_factory=dict)
    """Units that the file states beside the names of columns: in a line under them, or as an attribute."""
    unread_times: dict[str, str] = field(default_factory=dict)
    """Columns of text that may hold times in a form that is not read, with a cell of each."""
    recorded: Description | None = None
    """Metadata of a recording that tauext wrote."""

    def hints(self) -> list[str]:
        """What the file has in place of a clock, a clause each: unread times, and stated rates."""
        times = [
            f"column '{name}' is text such as '{cell[:60]}', no form of date or time that is read"
            for name, cell in self.unread_times.items()
        ]
        return times + [f"the file states {name} = {hz:g} Hz" for name, hz in self.stated_hz.items()]

    def position(self, row: int) -> str:
        """Position of a row, counted from 0, as a person finds it in the file."""
        word, first = self.row_word
        return f"{word} {row + first}"

    @cached_property
    def streams(self) -> dict[str, tuple[str, ...]]:
        """Column names of every stream, found once, by reading each stream's first block.

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
            if sum(map(len, found.values())) > MOST_COLUMNS:
                raise RecordingError(f"{self.path}: it has more than {MOST_COLUMNS:,} columns; an arm has hundreds")
        self.counts.clear()
        self.lost.reasons.clear()
        return {stream: tuple(names) for stream, names in found.items()}


BEGIN = 1024
"""Bytes at the beginning of a file from which importers recognise it."""
Export = Callable[[Iterable[Recording], Path], int]
"""Writes recordings into an empty folder, and returns the number of episodes."""


@dataclass(frozen=True)
class Importer:
    """A format of recordings. Packages add their own as entry points of the group tauext.importers."""

    format: str
    """The format in words, for messages."""
    fits: Callable[[Path, bytes], bool]
    """Whether a file, by its first BEGIN bytes, or a folder, with b"", has this format."""
    open: Callable[[Path, Sequence[str]], list[RawRecording]]
    """Opens the recordings in it: one, or one an episode. The second argument names the topics to read; it is empty for
    formats without topics. Raises RecordingError: damaged or empty."""
    export: Export | None = None
    """None: the format is only read."""


def too_large(path: object) -> RecordingError:
    """The error about a file that needs more memory than there is."""
    return RecordingError(
        f"{path}: what it states or unpacks to needs more memory than is free; split the file, or use a computer with "
        "more memory"
    )


@contextmanager
def whole(path: object, kind: str, broken: tuple[type[Exception], ...]) -> Iterator[None]:
    """Convert a library's exceptions on truncated or damaged files to RecordingError.

    Args:
        kind: what the file is read as: "Parquet", "episode 3 of a LeRobot dataset".
        broken: the library's exceptions.
    """
    try:
        yield
    except RecordingError:
        raise
    except MemoryError as error:
        raise too_large(path) from error
    except broken as error:
        if re.search("memory allocation failed|unable to allocate|out of memory", str(error), re.IGNORECASE):
            raise too_large(path) from error  # HDF5 and others report it as any other error
        raise RecordingError(f"{path}: cannot be read as {kind}: it is truncated or damaged; copy it again") from error
