"""MATLAB files: version 5 to 7 by SciPy, version 7.3 as the HDF5 that it is."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from tauext.data.importers.hdf5 import columns_of, open_hdf5, sample_count
from tauext.data.importers.raw import RawRecording, RawSignals, short_list
from tauext.errors import RecordingError

MAGIC_5, MAGIC_73 = b"MATLAB 5.0 MAT-file", b"MATLAB 7.3 MAT-file"


def open_matlab(path: Path) -> list[RawRecording]:
    """Arrays of a MATLAB file, in structs or not, as one raw recording; a field's name is `struct.field`.

    Raises:
        RecordingError: damaged, or without signals; MATLAB objects (timeseries, table) cannot be read.
    """
    with path.open("rb") as file:
        if file.read(len(MAGIC_73)) == MAGIC_73:
            return open_hdf5(path, ".", "MATLAB 7.3")
    from scipy.io import loadmat

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # an opaque object beside the data is no fault of the data
            content = loadmat(path, struct_as_record=False, squeeze_me=True)
    except Exception as error:  # SciPy meets damaged bytes with many types
        cause = " ".join(str(error).split()) or type(error).__name__
        raise RecordingError(
            f"{path}: cannot be read as a MATLAB file ({cause}); it is truncated or damaged: copy it again"
        ) from error
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
