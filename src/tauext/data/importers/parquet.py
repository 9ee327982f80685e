"""Parquet and Arrow files: columns of numbers, of lists and structs of numbers, and of times."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from tauext.data.importers.cells import (
    USUAL_CLOCK,
    StampReader,
    choose_clock,
    clock_notes,
    flags_of,
    kind_of,
    numbers_of,
    paired_stamps,
)
from tauext.data.importers.raw import BLOCK_ROWS, RawRecording, RawSignals, short_list, whole
from tauext.data.recording_file import Description, check_columns, read_head
from tauext.errors import RecordingError
from tauext.files.unpacking import Unpacked

MAGIC, ARROW_MAGIC = b"PAR1", b"ARROW1"
BROKEN = (pa.ArrowException, OSError, struct.error)
MOST_VALUES = 1 << 24
"""Values of the columns of a batch, all together."""
UNIT_NS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}


def open_parquet(path: Path) -> list[RawRecording]:
    """Read columns of numbers under their names; missing is NaN.

    Elements of a list are `name[0]`, `name[1]`, ..., also of lists of lists; a list of another length than the others
    is missing. Fields of a struct are `name.field`. A column of timestamps, times of day or their text is the clock.
    """
    table = _Table(path)
    with whole(path, table.kind, BROKEN):
        table.expect_unpacked()
        leaves, others = table.leaves()
    stamps = {leaf.name: leaf.different for leaf in leaves if leaf.kind == "stamp"}
    clock = choose_clock(stamps) if stamps else ""
    used = [leaf for leaf in leaves if leaf.kind != "stamp" or leaf.name == clock]
    if not [leaf for leaf in used if leaf.kind != "stamp"]:
        listed = short_list([*others, *stamps])
        raise RecordingError(f"{path}: no column has numbers; its columns are {listed}")
    notes = clock_notes(stamps, clock) if clock else []
    if others:
        notes.append(f"columns without numbers left out: {short_list(others)}")
    clocks, units, recorded = (clock, ""), table.units(), table.recorded()
    how = (path.stem, path, table.kind, lambda: table.blocks(used, raw), notes)
    raw: RawRecording = RawRecording(*how, clocks=clocks, units=units, recorded=recorded)
    return [raw]


# --- Columns of a table: each leaf of lists and structs is one signal or array.


@dataclass(frozen=True)
class Leaf:
    """A column of numbers, or a field of a struct."""

    name: str
    column: str
    """Column of the file that holds it."""
    kind: str
    """number, flag, stamp, list, or number in text: "digits"."""
    count: int = 1
    """Elements of a list."""
    labels: tuple[str, ...] = ()
    """Names of the elements; empty: they are numbered."""
    different: int = 0
    """Different stamps in the first rows."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its signals."""
        labels = self.labels or tuple(map(str, range(self.count)))
        return tuple(f"{self.name}[{label}]" for label in labels) if self.kind == "list" else (self.name,)


@dataclass(frozen=True)
class _Table:
    path: Path
    kind: str = field(init=False)

    def __post_init__(self) -> None:
        with self.path.open("rb") as file:
            kind = "Arrow" if file.read(len(ARROW_MAGIC)) == ARROW_MAGIC else "Parquet"
        object.__setattr__(self, "kind", kind)

    def expect_unpacked(self) -> None:
        """Refuse a file that states far more numbers than is stored.

        Raises:
            RecordingError: it does, or it is damaged.
        """
        unpacked = Unpacked(self.path)
        if self.kind == "Parquet":
            with pq.ParquetFile(self.path) as file:
                unpacked.add(8 * sum(self._values(file.metadata)))
            return
        with self._stream() as stream:
            for message in pa.ipc.MessageReader.open_stream(stream):
                unpacked.add(_stated_bytes(message))

    @contextmanager
    def _stream(self) -> Iterator[Any]:
        """What lies between the marks of an Arrow file: the messages of a stream, which alone are read."""
        with pa.memory_map(str(self.path)) as source:
            yield pa.BufferReader(source.read_buffer()[8:])

    @staticmethod
    def _values(metadata: Any) -> list[int]:
        """Values of each column."""
        groups = [metadata.row_group(k) for k in range(metadata.num_row_groups)]
        return [sum(group.column(k).num_values for group in groups) for k in range(metadata.num_columns)]

    def _rows_at_a_time(self, metadata: Any) -> int:
        """Rows of a batch, fewer where a row has many values."""
        widest = sum(self._values(metadata)) // max(1, metadata.num_rows)
        return max(1, min(BLOCK_ROWS, MOST_VALUES // max(1, widest)))

    def batches(self, columns: list[str] | None = None) -> Iterator[Any]:
        """Record batches of up to BLOCK_ROWS rows, with these columns; None: all."""
        if self.kind == "Parquet":
            with pq.ParquetFile(self.path) as file:
                yield from file.iter_batches(self._rows_at_a_time(file.metadata), columns=columns)
            return
        with self._stream() as stream, pa.ipc.open_stream(stream) as batches:
            for batch in batches:
                batch = batch if columns is None else batch.select(columns)
                batch.validate(full=True)  # wrong offsets of a damaged file would end the process
                for first in range(0, len(batch), BLOCK_ROWS):
                    yield batch.slice(first, BLOCK_ROWS)

    def leaves(self) -> tuple[list[Leaf], list[str]]:
        """Leaves with numbers or times, and the names of the others."""
        schema = self._schema()
        readable = [field.name for field in schema if not _is_binary(field.type)]  # images are not read
        first = next((batch for batch in self.batches(readable) if len(batch)), None)
        if first is None:
            raise RecordingError(f"{self.path}: it has no rows")
        leaves, others = [], []
        words: dict[int, tuple[str, ...]] = {}
        for column, values in zip(first.schema.names, first.columns, strict=True):
            for name, leaf in _flat(column, values):
                named = _words(leaf)
                words |= {len(named): named} if named else {}
                kind, count = _kind(name, leaf)
                if kind in ("text", "long"):
                    others.append(f"{name} (lists of changing length)" if kind == "long" else name)
                    continue
                different = len(leaf.unique()) if kind == "stamp" else 0
                leaves.append(Leaf(name, column, kind, count, different=different))
        leaves = [replace(one, labels=words.get(one.count, ())) for one in leaves]
        return leaves, others + [name for name in schema.names if name not in first.schema.names]

    def units(self) -> dict[str, str]:
        """Units that the metadata of columns state."""
        fields = ((field.name, field.metadata or {}) for field in self._schema())
        stated = ((name, held.get(b"unit", held.get(b"units", b""))) for name, held in fields)
        return {name: unit.decode(errors="replace") for name, unit in stated if unit}

    def recorded(self) -> Description | None:
        """Metadata of a recording that tauext wrote; None: the file is none, or damaged."""
        if self.kind == "Parquet":
            with pq.ParquetFile(self.path) as file, suppress(RecordingError):
                head = read_head(self.path, file)
                check_columns(self.path, head, file.schema_arrow)
                return head
        return None

    def _schema(self) -> Any:
        if self.kind == "Parquet":
            with pq.ParquetFile(self.path) as file:
                return file.schema_arrow
        with pa.memory_map(str(self.path)) as source, pa.ipc.open_file(source) as file:
            return file.schema

    def blocks(self, leaves: list[Leaf], raw: RawRecording) -> Iterator[RawSignals]:
        """Yield the leaves' numbers, block by block.

        Raises:
            RecordingError: damaged.
        """
        columns = list(dict.fromkeys(leaf.column for leaf in leaves))
        signals = [leaf for leaf in leaves if leaf.kind != "stamp"]
        names = tuple(name for leaf in signals for name in leaf.names)
        stamps, row, all_known = StampReader(), 0, True
        with whole(self.path, self.kind, BROKEN):
            for batch in self.batches(columns):
                held = dict(one for name in columns for one in _flat(name, batch.column(name)))
                numbers = np.column_stack([_numbers(leaf, held[leaf.name], raw.counts) for leaf in signals])
                t_ns, rows = paired_stamps(names, numbers), None
                for leaf in (leaf for leaf in leaves if leaf.kind == "stamp"):
                    t_ns, known = _stamps_ns(held[leaf.name], stamps)
                    if not known.all():
                        why = f"'{leaf.name}', its time, is missing"
                        raw.lost.add(why, int((~known).sum()), raw.position(row + int(np.argmin(known))))
                        t_ns, numbers, all_known = t_ns[known], numbers[known], False
                    rows = None if all_known else row + np.flatnonzero(known)
                row += len(batch)
                if len(numbers):
                    yield RawSignals("", names, t_ns, numbers, rows=rows)


def _stated_bytes(message: Any) -> int:
    """Bytes to which a message of an Arrow stream unpacks, by its metadata: those of its buffers, or of its elements.

    The metadata are FlatBuffers [Message.fbs of Apache Arrow]: a table is a list of offsets to its fields. Compressed
    buffers begin with their size, -1 for one that is stored as it is.
    """
    data, body = message.metadata.to_pybytes(), message.body

    def number(form: str, at: int) -> int:
        (value,) = struct.unpack_from(f"<{form}", data, at)
        return int(value)

    def field(table: int, k: int) -> int:
        """Position of the table's field; 0: it has none."""
        fields = table - number("i", table)
        offset = number("H", fields + 4 + 2 * k) if 4 + 2 * k < number("H", fields) else 0
        return table + offset if offset else 0

    def pairs(table: int, k: int) -> list[tuple[int, int]]:
        """Pairs of integers in a list of the table."""
        if not (at := field(table, k)):
            return []
        at += number("I", at)
        return list(struct.iter_unpack("<qq", data[at + 4 : at + 4 + 16 * number("I", at)]))

    if message.type not in ("record batch", "dictionary"):
        return 0
    batch = field(number("I", 0), 2)
    batch += number("I", batch)
    if message.type == "dictionary":
        batch = field(batch, 1)
        batch += number("I", batch)
    elements, buffers = sum(length for length, _ in pairs(batch, 1)), 0
    for offset, length in pairs(batch, 2):
        packed = body[offset : offset + 8].to_pybytes() if field(batch, 3) and length >= 8 else b""
        size = int.from_bytes(packed, "little", signed=True) if len(packed) == 8 else -1
        buffers += length if size < 0 else size
    return max(buffers, 8 * elements)


def _is_binary(kind: pa.DataType) -> bool:
    if pa.types.is_nested(kind) and not pa.types.is_map(kind):
        within = [_is_binary(kind.field(k).type) for k in range(kind.num_fields)]
        return all(within) if pa.types.is_struct(kind) else any(within)
    binary = (pa.types.is_binary, pa.types.is_large_binary, pa.types.is_fixed_size_binary, pa.types.is_map)
    return any(test(kind) for test in binary)


def _flat(name: str, column: Any) -> Iterator[tuple[str, Any]]:
    """The column, or the fields of its structs, with plain types."""
    if isinstance(column, pa.ExtensionArray):
        column = column.storage
    if isinstance(column, pa.DictionaryArray):
        column = column.dictionary_decode()
    if pa.types.is_struct(column.type):
        for child, values in zip(column.type, column.flatten(), strict=True):
            yield from _flat(f"{name}.{child.name}", values)
    else:
        yield name, column


def is_list(kind: pa.DataType) -> bool:
    return pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind)


def _is_numeric(kind: pa.DataType) -> bool:
    tests = (pa.types.is_integer, pa.types.is_floating, pa.types.is_boolean, pa.types.is_decimal, pa.types.is_null)
    return any(test(kind) for test in tests)


def _kind(name: str, column: Any) -> tuple[str, int]:
    """Kind of a leaf, and the number of its elements."""
    kind = column.type
    if pa.types.is_timestamp(kind) or pa.types.is_time(kind):
        return "stamp", 1
    if pa.types.is_duration(kind):
        return ("stamp" if USUAL_CLOCK.fullmatch(name) else "number"), 1
    if pa.types.is_string(kind) or pa.types.is_large_string(kind) or kind == pa.string_view():
        found = kind_of([str(cell or "").strip() for cell in column[:1000].to_pylist()])
        return {"number": "digits", "list": "text"}.get(found, found), 1
    if is_list(kind):
        values, counts = _elements(column)
        if not _is_numeric(values.type) or not counts.any():
            return "text", 1
        count, share = usual_length(counts)
        is_signal = share >= 0.5 and count <= 1000  # longer ones are images or point clouds
        return ("list", count) if is_signal else ("long", 1)
    return ("number" if _is_numeric(kind) else "text"), 1


def _words(column: Any) -> tuple[str, ...]:
    """Names in a column of lists of text that are the same in every row, as those of a JointState; else empty."""
    if not is_list(column.type) or not pa.types.is_string(column.type.value_type):
        return ()
    different = {tuple(row or ()) for row in column.to_pylist()}
    names = next(iter(different)) if len(different) == 1 else ()
    return names if len(names) == len(set(names)) > 1 else ()


def _elements(column: Any) -> tuple[Any, np.ndarray]:
    """All elements of lists, also of lists of lists, and their number a row."""
    if isinstance(column, pa.ExtensionArray):
        column = column.storage
    if not is_list(column.type):
        return column, np.ones(len(column), np.int64)
    values, inner = _elements(column.flatten())
    lengths = column.value_lengths().fill_null(0).to_numpy(zero_copy_only=False).astype(np.int64)
    total, ends = np.r_[0, np.cumsum(inner)], np.cumsum(lengths)
    return values, total[ends] - total[ends - lengths]


def _numbers(leaf: Leaf, column: Any, counts: Counter[str]) -> np.ndarray:
    """(samples, elements) float64; NaN where a value is missing."""
    plain = {"digits": numbers_of, "flag": flags_of, "number": floats_of}
    if leaf.kind in plain:
        return plain[leaf.kind](column)[:, None]
    rows, odd = rows_of_lists(column, leaf.count)
    if odd:
        counts[f"lists of '{leaf.name}' without {leaf.count} elements are missing values"] += odd
    return rows


def usual_length(lengths: np.ndarray) -> tuple[int, float]:
    """The most common length of lists that are not empty, and its share among them; (0, 0): all are empty."""
    known, counts = np.unique(lengths[lengths > 0], return_counts=True)
    if not len(known):
        return 0, 0.0
    return int(known[counts.argmax()]), float(counts.max() / counts.sum())


def rows_of_lists(column: Any, count: int = 0) -> tuple[np.ndarray, int]:
    """Numbers of a column of lists, (samples, count) float64, and the number of lists of another length.

    Args:
        count: elements of a row; 0: the usual number. A row with another number, or without a list, is NaN.
    """
    values, lengths = _elements(column)
    floats = floats_of(values)
    count = count or usual_length(lengths)[0]
    good = lengths == count
    if good.all():
        return floats.reshape(-1, count), 0
    rows = np.full((len(column), count), np.nan)
    first = (np.cumsum(lengths) - lengths)[good]
    rows[good] = floats[first[:, None] + np.arange(count)]
    return rows, int((~good & (lengths > 0)).sum())


def floats_of(column: Any) -> np.ndarray:
    """(samples,) float64 of a column of numbers, flags or durations [s]; NaN where one is missing."""
    if pa.types.is_duration(column.type):
        return floats_of(column.cast(pa.int64())) * (UNIT_NS[column.type.unit] * 1e-9)
    floats = column.cast(pa.float64(), safe=False).to_numpy(zero_copy_only=False)
    return np.asarray(floats, dtype=np.float64)


def _stamps_ns(column: Any, reader: StampReader) -> tuple[np.ndarray, np.ndarray]:
    """Stamps [ns] of a column of timestamps, times of day, durations or their text, and which are known."""
    kind = column.type
    if not pa.types.is_temporal(kind):
        return reader.stamps(column)
    known = np.asarray(column.is_valid().to_numpy(zero_copy_only=False), bool)
    whole_units = column.cast(pa.int32()) if pa.types.is_time32(kind) else column
    numbers = whole_units.cast(pa.int64()).fill_null(0).to_numpy(zero_copy_only=False)
    t_ns = np.asarray(numbers, np.int64) * UNIT_NS[kind.unit]
    return (reader.over_midnight(t_ns, known) if pa.types.is_time(kind) else t_ns), known
