"""CSV files, plain or gzipped: separator and decimal mark found by looking, numbers read block by block."""

from __future__ import annotations

import gzip
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tauext.data.importers.raw import RawRecording, RawSignals, short_list
from tauext.errors import RecordingError

GZIP_MAGIC = b"\x1f\x8b"
SEPARATORS = (",", ";", "\t", " ")
BLOCK_BYTES = 1 << 22
MOST_BROKEN = 0.01
"""Share of lines that may be broken before the file is refused: a crash leaves one."""


@dataclass(frozen=True)
class Dialect:
    names: tuple[str, ...]
    separator: str
    decimal: str
    skip_lines: int
    marked: bool = False
    """Begins with the mark of UTF-8, which only its decoder knows."""


def open_csv(path: Path) -> list[RawRecording]:
    """A CSV file as one raw recording with every column that holds numbers; columns of text are left out.

    The first line names the columns (a leading # is ignored); where it is all numbers, they are `column1`, `column2`...
    Empty cells are NaN. A line with too few or too many cells is left out and counted.

    Raises:
        RecordingError: now or while it is read: no table, truncated, or more than 1 % broken lines.
    """
    try:
        with _text(path) as file:
            lines = [line for _ in range(20) if (line := file.readline())]
    except (OSError, EOFError, zlib.error) as error:
        raise _unreadable(path, error) from error
    with path.open("rb") as raw:
        marked = raw.read(3) == b"\xef\xbb\xbf"
    dialect = replace(_dialect(path, lines), marked=marked)
    numeric = _numeric_columns(dialect, lines)
    if not numeric:
        raise RecordingError(f"{path}: no table of numbers; its first line is {lines[0].strip()[:60]!r}")
    others = [name for name in dialect.names if name not in numeric]
    notes = [f"columns of text left out: {short_list(others)}"] if others else []
    counts: Counter[str] = Counter()
    stem = path.name.removesuffix(".gz").removesuffix(".csv")

    def blocks() -> Iterator[RawSignals]:
        yield from _blocks(path, dialect, numeric, counts)

    return [RawRecording(stem, path, "CSV", blocks, notes, counts)]


def _text(path: Path) -> Any:
    with path.open("rb") as raw:
        zipped = raw.read(2) == GZIP_MAGIC
    opened = gzip.open if zipped else open
    return opened(path, "rt", encoding="utf-8-sig", errors="replace", newline="")


def _unreadable(path: Path, error: BaseException) -> RecordingError:
    cause = " ".join(str(error).split())
    return RecordingError(f"{path}: cannot be read to its end ({cause}); it is truncated or damaged: copy it again")


def _dialect(path: Path, lines: list[str]) -> Dialect:
    if not lines or not lines[0].strip():
        raise RecordingError(f"{path}: it is empty; a CSV file begins with the names of its columns")
    first = lines[0].lstrip("#").strip()
    separator = next((s for s in SEPARATORS if s in first), ",")
    names = tuple(cell.strip().strip('"') for cell in first.split(separator))
    decimal = "," if separator != "," and any("," in line for line in lines[1:]) else "."
    if all(_is_number(name, decimal) for name in names):
        return Dialect(tuple(f"column{k + 1}" for k in range(len(names))), separator, decimal, 0)
    for name in names:
        if names.count(name) > 1:
            raise RecordingError(f"{path}: {names.count(name)} columns are named {name!r}; names must differ")
    return Dialect(names, separator, decimal, 1)


def _numeric_columns(dialect: Dialect, lines: list[str]) -> tuple[str, ...]:
    """Columns whose first lines hold numbers or nothing."""
    rows = [line.strip("\r\n").split(dialect.separator) for line in lines[dialect.skip_lines :]]
    rows = [row for row in rows if len(row) == len(dialect.names)]
    if not rows:
        return ()
    return tuple(
        name for k, name in enumerate(dialect.names) if all(_is_number(row[k], dialect.decimal) for row in rows)
    )


def _is_number(cell: str, decimal: str) -> bool:
    try:
        float(cell.strip().strip('"').replace(decimal, ".") or "nan")
    except ValueError:
        return False
    return True


def _blocks(path: Path, dialect: Dialect, numeric: tuple[str, ...], counts: Counter[str]) -> Iterator[RawSignals]:
    import pyarrow as pa
    from pyarrow import csv

    key = "lines with a wrong number of cells left out"
    rows = 0

    def broken(_: Any) -> str:
        counts[key] += 1
        return "skip"

    try:
        reader = csv.open_csv(
            pa.input_stream(str(path), compression="gzip" if path.open("rb").read(2) == GZIP_MAGIC else None),
            read_options=csv.ReadOptions(
                column_names=list(dialect.names),
                skip_rows=dialect.skip_lines,
                block_size=BLOCK_BYTES,
                # Numbers are the same in both; a damaged line need not be UTF-8, which the reader would stumble over.
                encoding="utf8" if dialect.marked else "latin-1",
            ),
            parse_options=csv.ParseOptions(delimiter=dialect.separator, invalid_row_handler=broken),
            convert_options=csv.ConvertOptions(
                column_types=dict.fromkeys(numeric, pa.float64()),
                include_columns=list(numeric),
                decimal_point=dialect.decimal,
                null_values=["", "nan", "NaN", "NA", "null"],
            ),
        )
        for batch in reader:
            columns = np.column_stack([column.to_numpy(zero_copy_only=False) for column in batch.columns])
            rows += len(columns)
            yield RawSignals("", numeric, None, columns.astype(np.float64, copy=False))
    except (pa.ArrowException, OSError) as error:
        raise _unreadable(path, error) from error
    if not rows:
        raise RecordingError(f"{path}: it has no rows under its names")
    if counts[key] > max(1, MOST_BROKEN * rows):
        raise RecordingError(
            f"{path}: {counts[key]} of {rows + counts[key]} lines have not {len(dialect.names)} cells, as the first has"
        )
