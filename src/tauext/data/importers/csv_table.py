"""CSV files, plain or gzipped: separator and decimal mark are detected, numbers read block by block."""

from __future__ import annotations

import csv
import gzip
import re
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tauext.data.importers.raw import RawRecording, RawSignals, readable, short_list
from tauext.errors import RecordingError

GZIP_MAGIC = b"\x1f\x8b"
SEPARATORS = (",", ";", "\t", " ")
BLOCK_BYTES = 1 << 22
MOST_BROKEN = 0.01
"""Largest share of broken lines; a crash leaves one."""


@dataclass(frozen=True)
class Dialect:
    names: tuple[str, ...]
    separator: str
    decimal: str
    skip_lines: int
    marked: bool = False
    """Whether the file begins with the byte order mark of UTF-8, which only its decoder removes."""

    def cells(self, line: str) -> list[str]:
        """The cells of a line, without quotes."""
        return _cells(line.strip("\r\n"), self.separator)


def open_csv(path: Path) -> list[RawRecording]:
    """Read a CSV file as one raw recording with every column of numbers; columns of text are left out.

    The first line names the columns (a leading # is ignored); if it is all numbers, they are `column1`, `column2`...
    Empty cells are NaN. A line with too few or too many cells is left out and counted.

    Columns `name0`, `name1`... have the joint names of a sensor_msgs/JointState, and `position0` becomes
    `position[NAME]`, `velocity0` and `effort0` too. Columns `sec` and `nanosec` are the stamps. `ros2 topic echo --csv`
    writes these columns without a header; such a file is recognised by its first line.

    Raises:
        RecordingError: on opening or reading: no table, truncated, or more than 1 % broken lines.
    """
    with readable(path, "CSV to its end", (OSError, EOFError, zlib.error)), _text(path) as file:
        lines = [line for _ in range(20) if (line := file.readline())]
    with path.open("rb") as raw:
        marked = raw.read(3) == b"\xef\xbb\xbf"
    dialect = replace(_dialect(path, lines), marked=marked)
    numeric = _numeric_columns(dialect, lines)
    if not numeric:
        raise RecordingError(f"{path}: no table of numbers; {_why_no_table(dialect, lines)}")
    others = [name for name in dialect.names if name not in numeric]
    notes = [f"columns of text left out: {short_list(others)}"] if others else []
    dialect, numeric = _by_joint(dialect, numeric, lines)
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


def _dialect(path: Path, lines: list[str]) -> Dialect:
    if not lines or not lines[0].strip():
        raise RecordingError(f"{path}: it is empty; a CSV file begins with the names of its columns")
    first = lines[0].lstrip("#").strip()
    separator = next((s for s in SEPARATORS if s in first), ",")
    names = tuple(_cells(first, separator))
    decimal = "," if separator != "," and any("," in line for line in lines[1:]) else "."
    if all(_is_number(name, decimal) for name in names):
        return Dialect(tuple(f"column{k + 1}" for k in range(len(names))), separator, decimal, 0)
    if echoed := _echoed_names(names):
        return Dialect(echoed, separator, decimal, 0)
    for name in names:
        if names.count(name) > 1:
            raise RecordingError(f"{path}: {names.count(name)} columns are named {name!r}; names must differ")
    return Dialect(names, separator, decimal, 1)


def _cells(line: str, separator: str) -> list[str]:
    return [
        cell.strip() for cell in next(csv.reader([line], delimiter=separator, skipinitialspace=separator != " "), [])
    ]


def _echoed_names(cells: tuple[str, ...]) -> tuple[str, ...]:
    """Column names for a JointState printed by `ros2 topic echo --csv`; empty for other lines."""
    joints, rest = divmod(len(cells) - 3, 4)
    names = cells[3 : 3 + joints]
    numbers = (*cells[:2], *cells[3 + joints :])
    whole = all(cell.isdigit() for cell in cells[:2])
    if joints < 1 or rest or not whole or not all(_is_number(cell, ".") for cell in numbers):
        return ()
    if len(set(names)) < joints or any(_is_number(name, ".") for name in names):
        return ()
    arrays = [f"{array}{k}" for array in ("name", "position", "velocity", "effort") for k in range(joints)]
    return ("sec", "nanosec", "frame_id", *arrays)


def _by_joint(dialect: Dialect, numeric: tuple[str, ...], lines: list[str]) -> tuple[Dialect, tuple[str, ...]]:
    """Rename columns of a JointState by joint name, where text columns `name0`, `name1`... have the names."""
    held: dict[str, list[str]] = {
        m[1]: [] for name in dialect.names if (m := re.fullmatch(r"(.*\b)name0", name)) and name not in numeric
    }
    row = next(cells for line in lines[dialect.skip_lines :] if len(cells := dialect.cells(line)) == len(dialect.names))
    by_name = dict(zip(dialect.names, row, strict=True))
    renamed: dict[str, str] = {}
    for prefix, joints in held.items():
        while f"{prefix}name{len(joints)}" in by_name:
            joints.append(by_name[f"{prefix}name{len(joints)}"])
        for array in ("position", "velocity", "effort"):
            renamed |= {f"{prefix}{array}{k}": f"{prefix}{array}[{joint}]" for k, joint in enumerate(joints)}
    names, numeric = (tuple(renamed.get(name, name) for name in listed) for listed in (dialect.names, numeric))
    return replace(dialect, names=names), numeric


def _why_no_table(dialect: Dialect, lines: list[str]) -> str:
    first = f"its first line is {lines[0].strip()[:60]!r}"
    others = [line for line in lines[dialect.skip_lines :] if line.strip()]
    if not others or len(dialect.cells(others[0])) == len(dialect.names):
        return first
    return (
        f"its first line has {len(dialect.names)} cells between {dialect.separator!r}, its next has "
        f"{len(dialect.cells(others[0]))}: {others[0].strip()[:60]!r}; use one separator, and a name for every column"
    )


def _numeric_columns(dialect: Dialect, lines: list[str]) -> tuple[str, ...]:
    """Columns whose first lines are numbers or empty."""
    rows = [dialect.cells(line) for line in lines[dialect.skip_lines :]]
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


def _stamps_ns(names: tuple[str, ...], columns: np.ndarray) -> np.ndarray | None:
    """Stamps of a JointState's columns `sec` and `nanosec`, [ns]; None where the file has none."""
    if not {"sec", "nanosec"} <= set(names):
        return None
    whole, part = (np.nan_to_num(columns[:, names.index(name)]).astype(np.int64) for name in ("sec", "nanosec"))
    return whole * 10**9 + part


def _blocks(path: Path, dialect: Dialect, numeric: tuple[str, ...], counts: Counter[str]) -> Iterator[RawSignals]:
    import pyarrow as pa
    from pyarrow import csv as arrow_csv

    key = "lines with a wrong number of cells left out"
    rows = 0

    def broken(_: Any) -> str:
        counts[key] += 1
        return "skip"

    with readable(path, "CSV to its end", (pa.ArrowException, OSError)):
        reader = arrow_csv.open_csv(
            pa.input_stream(str(path), compression="gzip" if path.open("rb").read(2) == GZIP_MAGIC else None),
            read_options=arrow_csv.ReadOptions(
                column_names=list(dialect.names),
                skip_rows=dialect.skip_lines,
                block_size=BLOCK_BYTES,
                # Latin-1 reads the same numbers, and a damaged line need not be valid UTF-8.
                encoding="utf8" if dialect.marked else "latin-1",
            ),
            parse_options=arrow_csv.ParseOptions(delimiter=dialect.separator, invalid_row_handler=broken),
            convert_options=arrow_csv.ConvertOptions(
                column_types=dict.fromkeys(numeric, pa.float64()),
                include_columns=list(numeric),
                decimal_point=dialect.decimal,
                null_values=["", "nan", "NaN", "NA", "null"],
            ),
        )
        for batch in reader:
            columns = np.column_stack([column.to_numpy(zero_copy_only=False) for column in batch.columns])
            rows += len(columns)
            columns = columns.astype(np.float64, copy=False)
            yield RawSignals("", numeric, _stamps_ns(numeric, columns), columns)
    if not rows:
        raise RecordingError(f"{path}: it has no rows under its names")
    if counts[key] > max(1, MOST_BROKEN * rows):
        raise RecordingError(
            f"{path}: {counts[key]} of {rows + counts[key]} lines lack the {len(dialect.names)} cells of the first"
        )
