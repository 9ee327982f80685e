"""HDF5 files, and MATLAB files of version 7.3, which are HDF5 inside."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from tauext.data.importers.named_arrays import columns_of, sample_count
from tauext.data.importers.raw import BLOCK_ROWS, RawRecording, RawSignals, short_list
from tauext.errors import RecordingError

BROKEN = (OSError, RuntimeError, ValueError, KeyError, TypeError, MemoryError)
"""What h5py meets in damaged bytes."""
MAGIC = b"\x89HDF\r\n\x1a\n"


def open_hdf5(path: Path, separator: str = "/", kind: str = "HDF5") -> list[RawRecording]:
    """Datasets (samples,), (samples, joints) or (joints, samples) of numbers as one raw recording, groups in its names.

    Datasets of another length than most are left out and named in the notes.

    Raises:
        RecordingError: now or while it is read: damaged, or without signals.
    """
    import h5py

    try:
        with h5py.File(path) as file:
            shapes = _numeric(file, separator)
    except BROKEN as error:
        raise _unreadable(path, kind, error) from error
    samples = sample_count(path, {name: shape for name, (_, shape) in shapes.items()})
    columns = {name: columns_of(name, shape, samples) for name, (_, shape) in shapes.items()}
    others = [f"{name} ({max(shape, default=1)})" for name, (_, shape) in shapes.items() if columns[name] is None]
    notes = [f"arrays of another length than {samples} left out: {short_list(others)}"] if others else []

    def blocks() -> Iterator[RawSignals]:
        names = tuple(name for array in columns.values() for name in array or ())
        try:
            with h5py.File(path) as file:
                for first in range(0, samples, BLOCK_ROWS):
                    rows = slice(first, min(first + BLOCK_ROWS, samples))
                    parts = [_rows(file[shapes[a][0]], rows, samples) for a in columns if columns[a]]
                    yield RawSignals("", names, None, np.column_stack(parts).astype(np.float64, copy=False))
        except BROKEN as error:
            raise _unreadable(path, kind, error) from error

    return [RawRecording(path.stem, path, kind, blocks, notes)]


def _numeric(file: Any, separator: str) -> dict[str, tuple[str, tuple[int, ...]]]:
    """Name with this separator: path in the file and shape of every dataset of numbers."""
    import h5py

    found: dict[str, tuple[str, tuple[int, ...]]] = {}

    def visit(name: str, item: Any) -> None:
        hidden = name.startswith("#")  # MATLAB keeps the innards of its objects there
        text = isinstance(item, h5py.Dataset) and item.attrs.get("MATLAB_class") in (b"char", b"cell")
        if isinstance(item, h5py.Dataset) and item.dtype.kind in "fiu" and not hidden and not text:
            found[name.replace("/", separator)] = (name, tuple(int(n) for n in item.shape))

    file.visititems(visit)
    return found


def _rows(dataset: Any, rows: slice, samples: int) -> np.ndarray:
    if dataset.ndim == 1:
        return dataset[rows]
    values = dataset[rows] if dataset.shape[0] == samples else dataset[:, rows].T
    return values


def _unreadable(path: Path, kind: str, error: Exception) -> RecordingError:
    cause = " ".join(str(error).split())
    return RecordingError(f"{path}: cannot be read as {kind} ({cause}); it is truncated or damaged: copy it again")
