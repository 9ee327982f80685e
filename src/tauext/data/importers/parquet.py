"""Parquet files: columns of numbers, and columns of lists of one length."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from tauext.data.importers.raw import BLOCK_ROWS, RawRecording, RawSignals, readable, short_list
from tauext.errors import RecordingError

MAGIC = b"PAR1"
BROKEN = (pa.ArrowException, OSError)


def open_parquet(path: Path) -> list[RawRecording]:
    """Read columns of numbers under their names, lists of numbers as `name[0]`, `name[1]`, ...; missing is NaN.

    Raises:
        RecordingError: on opening or reading: damaged, or without numbers.
    """
    with readable(path, "Parquet", BROKEN), pq.ParquetFile(path) as file:
        names = [field.name for field in file.schema_arrow if _is_numeric(field.type)]
        others = [field.name for field in file.schema_arrow if not _is_numeric(field.type)]
    if not names:
        raise RecordingError(f"{path}: no column has numbers; its columns are {', '.join(others)}")
    notes = [f"columns without numbers left out: {short_list(others)}"] if others else []

    def blocks() -> Iterator[RawSignals]:
        yield from parquet_blocks(path, names)

    return [RawRecording(path.stem, path, "Parquet", blocks, notes)]


def parquet_blocks(path: Path, names: list[str]) -> Iterator[RawSignals]:
    """Yield the columns of these names, block by block.

    Raises:
        RecordingError: damaged, or a list of changing length.
    """
    with readable(path, "Parquet", BROKEN), pq.ParquetFile(path) as file:
        if not file.metadata.num_rows:
            raise RecordingError(f"{path}: it has no rows")
        for batch in file.iter_batches(BLOCK_ROWS, columns=names):
            columns: dict[str, np.ndarray] = {}
            for name, column in zip(batch.schema.names, batch.columns, strict=True):
                columns |= _expanded(path, name, column)
            yield RawSignals("", tuple(columns), None, np.column_stack(list(columns.values())))


def _is_numeric(kind: pa.DataType) -> bool:
    if pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind):
        return _is_numeric(kind.value_type)
    return pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind)


def _expanded(path: Path, name: str, column: Any) -> dict[str, np.ndarray]:
    if not hasattr(column.type, "value_type"):
        return {name: _floats(column)}
    values = _floats(column.flatten())
    lengths = column.value_lengths().to_numpy(zero_copy_only=False)
    if column.null_count or len(set(lengths.tolist())) > 1:
        raise RecordingError(f"{path}: the lists in column '{name}' are of changing length; they must stay the same")
    rows = values.reshape(len(column), -1)
    return {f"{name}[{k}]": rows[:, k] for k in range(rows.shape[1])}


def _floats(column: Any) -> np.ndarray:
    return column.cast(pa.float64(), safe=False).to_numpy(zero_copy_only=False)
