"""HDF5 and MATLAB files: named arrays to signals."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tauext.data.importers.raw import BLOCK_ROWS, RawRecording, RawSignals, readable, short_list
from tauext.errors import RecordingError

# --- Named arrays of HDF5 and MATLAB files as one table: which are signals, and their orientation.


MOST_WIDE = 64
"""Largest number of elements of a signal a sample."""


def sample_count(path: Path, shapes: Mapping[str, tuple[int, ...]]) -> int:
    """Number of samples: the most common length, weighted by the count of numbers.

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
    """Names of an array's columns: `name`, or `name[0]`, `name[1]`, ... ; None if its length differs."""
    if not _is_signal(shape) or max(shape) != samples:
        return None
    if len(shape) == 1 or min(shape) == 1:
        return (name,)
    return tuple(f"{name}[{k}]" for k in range(min(shape)))


def _is_signal(shape: tuple[int, ...]) -> bool:
    if len(shape) == 1:
        return shape[0] > 1
    return len(shape) == 2 and max(shape) > min(shape) > 0 and min(shape) <= MOST_WIDE


# --- HDF5 files, and MATLAB files of version 7.3, which are HDF5 inside.


BROKEN = (OSError, RuntimeError, ValueError, KeyError, TypeError, MemoryError)
"""Exceptions of h5py on damaged files."""
MAGIC = b"\x89HDF\r\n\x1a\n"


def open_hdf5(path: Path, separator: str = "/", kind: str = "HDF5") -> list[RawRecording]:
    """Read datasets (samples,), (samples, joints) or (joints, samples) as one raw recording, with groups in the names.

    Datasets of other lengths are left out and listed in the notes.

    Raises:
        RecordingError: on opening or reading: damaged, or without signals.
    """
    import h5py

    with readable(path, kind, BROKEN), h5py.File(path) as file:
        shapes = _numeric(file, separator)
    samples = sample_count(path, {name: shape for name, (_, shape) in shapes.items()})
    columns = {name: columns_of(name, shape, samples) for name, (_, shape) in shapes.items()}
    others = [f"{name} ({max(shape, default=1)})" for name, (_, shape) in shapes.items() if columns[name] is None]
    notes = [f"arrays of another length than {samples} left out: {short_list(others)}"] if others else []

    def blocks() -> Iterator[RawSignals]:
        names = tuple(name for array in columns.values() for name in array or ())
        with readable(path, kind, BROKEN), h5py.File(path) as file:
            for first in range(0, samples, BLOCK_ROWS):
                rows = slice(first, min(first + BLOCK_ROWS, samples))
                parts = [_rows(file[shapes[a][0]], rows, samples) for a in columns if columns[a]]
                yield RawSignals("", names, None, np.column_stack(parts).astype(np.float64, copy=False))

    return [RawRecording(path.stem, path, kind, blocks, notes)]


def _numeric(file: Any, separator: str) -> dict[str, tuple[str, tuple[int, ...]]]:
    """Path in the file and shape of every numeric dataset, by its name with this separator."""
    import h5py

    found: dict[str, tuple[str, tuple[int, ...]]] = {}

    def visit(name: str, item: Any) -> None:
        hidden = name.startswith("#")  # internal data of MATLAB objects
        text = isinstance(item, h5py.Dataset) and item.attrs.get("MATLAB_class") in (b"char", b"cell")
        if isinstance(item, h5py.Dataset) and item.dtype.kind in "fiu" and not hidden and not text:
            found[name.replace("/", separator)] = (name, tuple(int(n) for n in item.shape))

    file.visititems(visit)
    return found


def _rows(dataset: Any, rows: slice, samples: int) -> np.ndarray:
    if dataset.ndim == 1:
        return dataset[rows]
    return dataset[rows] if dataset.shape[0] == samples else dataset[:, rows].T


# --- MATLAB files: version 5 to 7 by SciPy, version 7.3 as HDF5.


MAGIC_5, MAGIC_73 = b"MATLAB 5.0 MAT-file", b"MATLAB 7.3 MAT-file"


def open_matlab(path: Path) -> list[RawRecording]:
    """Read the arrays of a MATLAB file, in structs or not, as one raw recording; a field's name is `struct.field`.

    Raises:
        RecordingError: damaged, or without signals; MATLAB objects (timeseries, table) cannot be read.
    """
    with path.open("rb") as file:
        if file.read(len(MAGIC_73)) == MAGIC_73:
            return open_hdf5(path, ".", "MATLAB 7.3")
    from scipy.io import loadmat

    # SciPy raises many types on damaged files; opaque objects beside the data are ignored.
    with readable(path, "a MATLAB file", (Exception,)), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        content = loadmat(path, struct_as_record=False, squeeze_me=True)
    arrays = {name: array for key, value in content.items() for name, array in _arrays(str(key), value)}
    samples = sample_count(path, {name: array.shape for name, array in arrays.items()})
    names: list[str] = []
    columns: list[np.ndarray] = []
    for name, array in arrays.items():
        if held := columns_of(name, array.shape, samples):
            names += held
            columns.append(array if array.shape[0] == samples else array.T)
    others = [
        f"{name} ({max(array.shape)})"
        for name, array in arrays.items()
        if array.size > 1 and columns_of(name, array.shape, samples) is None
    ]
    notes = [f"arrays of another length than {samples} left out: {short_list(others)}"] if others else []

    def blocks() -> Iterator[RawSignals]:
        yield RawSignals("", tuple(names), None, np.column_stack(columns).astype(np.float64, copy=False))

    return [RawRecording(path.stem, path, "MATLAB", blocks, notes)]


def _arrays(name: str, value: Any) -> Iterator[tuple[str, np.ndarray]]:
    if name.startswith("__"):
        return
    if isinstance(value, np.ndarray) and value.dtype.kind in "fiub":
        yield name, value
    elif hasattr(value, "_fieldnames"):
        for field in value._fieldnames:
            yield from _arrays(f"{name}.{field}", getattr(value, field))
