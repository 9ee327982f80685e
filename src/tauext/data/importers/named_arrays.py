"""Named arrays of HDF5 and MATLAB files as one table: which of them are signals, and which way they lie."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path

from tauext.errors import RecordingError

MOST_WIDE = 64
"""A signal has at most so many elements a sample."""


def sample_count(path: Path, shapes: Mapping[str, tuple[int, ...]]) -> int:
    """Number of samples: the length that most numbers of the file have in common.

    Raises:
        RecordingError: no array looks like a signal.
    """
    votes: Counter[int] = Counter()
    for shape in shapes.values():
        if _is_signal(shape):
            votes[max(shape)] += min(shape) if len(shape) == 2 else 1
    if not votes:
        listed = ", ".join(f"{name} {shape}" for name, shape in list(shapes.items())[:12]) or "none"
        raise RecordingError(
            f"{path}: no array of numbers in it looks like a signal, (samples,) or (samples, joints); "
            f"its arrays: {listed}. MATLAB objects (timeseries, table) must be saved as plain arrays"
        )
    return max(votes, key=lambda length: (votes[length], length))


def columns_of(name: str, shape: tuple[int, ...], samples: int) -> tuple[str, ...] | None:
    """Names of an array's columns: `name`, or `name[0]`, `name[1]`, ... ; None where it has another length."""
    if not _is_signal(shape) or max(shape) != samples:
        return None
    if len(shape) == 1 or min(shape) == 1:
        return (name,)
    return tuple(f"{name}[{k}]" for k in range(min(shape)))


def _is_signal(shape: tuple[int, ...]) -> bool:
    if len(shape) == 1:
        return shape[0] > 1
    return len(shape) == 2 and max(shape) > min(shape) > 0 and min(shape) <= MOST_WIDE
