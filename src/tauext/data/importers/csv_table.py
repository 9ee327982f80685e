"""CSV files, plain or gzipped: the dialect is found from the rows, numbers are read block by block."""

from __future__ import annotations

import codecs
import csv
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from tauext.data.importers.cells import (
    StampReader,
    choose_clock,
    clock_notes,
    flags_of,
    has_thousands,
    is_missing,
    is_number,
    is_stamp,
    kind_of,
    list_cells,
    list_words,
    lists_of,
    numbers_of,
    paired_stamps,
    stated_hz,
    unread_times,
)
from tauext.data.importers.raw import Lost, RawRecording, RawSignals, short_list
from tauext.errors import RecordingError
from tauext.files.unpacking import Unpacked

GZIP_MAGIC = b"\x1f\x8b"
UTF16_MAGIC = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
BLOCK_BYTES = 1 << 21
LONGEST_LINE = 1 << 24
"""Largest line, [bytes]: ten thousand signals need a hundredth of it."""
MOST_OTHER = 1 << 20, 20
"""Lines that are no rows: so many, or so many a row. They are read one by one, which takes minutes for a hundred MB."""
COMMENT = re.compile(r"\s*(#+|//+|%+(?=[\s%]))\s*")
"""Beginning of a line of comment, or of commented names; `%time` is a name of rostopic."""
_SEPARATORS = (",", ";", "\t", "|", " ")
_UNIT = re.compile(
    r"(\W*(rad|deg|°|m|mm|s|sec|seconds?|ms|us|µs|ns|n\W?m|mn\W?m|a|ma|v|mv|hz|%|n|kg|k|°?c|1|unitless|bool|int|double|"
    r"float|string)(\W*/\W*(s|sec|s2|s\^2|min|a)\W?2?)?\W*|\W*)",
    re.IGNORECASE,
)


@dataclass(frozen=True)
class Dialect:
    """How the lines of a file are read."""

    separator: str
    decimal: str
    names: tuple[str, ...] = ()
    """A name for every cell of a row."""
    kinds: tuple[str, ...] = ()
    """Kind of every column: number, other (with the other decimal mark), flag, stamp, list, text, or blank."""
    wide: tuple[tuple[str, tuple[str, ...]], ...] = ()
    """Columns of lists, with the names of their elements."""
    first_line: int = 0
    """Number of lines before the first row."""
    header: bytes = b""
    """Line of the names, as logs that are appended to repeat it; empty: none."""
    notes: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    """Cells of the line of units under the names; empty: there is none."""

    @property
    def kept(self) -> tuple[str, ...]:
        """Columns that are read, without the clock."""
        return self.of_kind("number", "other", "flag", "list")

    def cells(self, line: str) -> list[str]:
        """The cells of a line, without quotes and blanks around them."""
        return _cells(line, self.separator)

    def of_kind(self, *kinds: str) -> tuple[str, ...]:
        """Names of the columns of these kinds."""
        return tuple(name for name, kind in zip(self.names, self.kinds, strict=True) if kind in kinds)


def open_csv(path: Path) -> list[RawRecording]:
    """Read a CSV file as one raw recording with every column of numbers; columns of text are left out.

    Separator, decimal mark and the line of the names are found from the rows: the first run of lines with as many
    cells, most of them numbers. Lines before the names and a line of units under them are skipped; without names, they
    are `column1`, `column2`... A cell that is no number is NaN, `true` is 1. Columns of the same name are its elements
    `name[0]`, `name[1]`... A line with too few or too many cells is left out and counted.

    A column of dates or times of day gives the stamps. Columns `name0`, `name1`... have the joint names of a
    sensor_msgs/JointState, and `position0` becomes `position[NAME]`, `velocity0` and `effort0` too. Columns `sec` and
    `nanosec` are the stamps. `ros2 topic echo --csv` writes these columns without a header; such a file is recognised
    by its first line.
    """
    text = _Text(path)
    lines = text.first()
    if not any(map(str.strip, lines)):
        raise RecordingError(f"{path}: it is empty; a CSV file begins with the names of its columns")
    dialect, rows = _dialect(path, lines, text.middle())
    stamps = dialect.of_kind("stamp")
    candidates = {name: len({row[dialect.names.index(name)] for row in rows}) for name in stamps}
    clock = choose_clock(candidates) if candidates else ""
    notes = [*dialect.notes, *(clock_notes(candidates, clock) if clock else ())]
    if others := dialect.of_kind("text"):
        notes.append(f"columns of text left out: {short_list(others)}")
    reader, name = _Reader(text, dialect, clock, Lost()), path.name.removesuffix(".gz").removesuffix(".csv")
    unread = unread_times({name: [row[dialect.names.index(name)] for row in rows] for name in others})
    stated, row_word = _stated(lines[: dialect.first_line]), ("line", dialect.first_line + 1)
    clocks, counts = (clock, ""), Counter[str]()
    units = dict(zip(dialect.names, dialect.units, strict=True)) if dialect.units else {}
    how = (notes, counts, reader.lost, clocks, stated, row_word, units, unread)
    return [RawRecording(name, path, "CSV", reader.blocks, *how)]


def _stated(preamble: Sequence[str]) -> dict[str, float]:
    """Rates in lines such as `# rate_hz: 100` before the names."""
    found = {}
    for line in preamble:
        match = re.fullmatch(
            r"\W*([A-Za-z][\w .]*?)\s*(?:\[?\(?(?:s|Hz)\]?\)?)?\s*[:=,;\t]\s*([-+.\deE]+)\W*(Hz|s)?\W*", line
        )
        if match and is_number(match[2]) and (hz := stated_hz(match[1], float(match[2]))):
            found[match[1]] = hz
    return found


# --- Lines of a file, in UTF-8 where the encoding shows, with one line feed each.


@dataclass(frozen=True)
class _Text:
    path: Path

    def chunks(self) -> Iterator[bytes]:
        """Whole lines, about BLOCK_BYTES at a time.

        Raises:
            RecordingError: truncated or damaged.
        """
        with self.path.open("rb") as raw:
            zipped = raw.read(2) == GZIP_MAGIC
        held, rest, convert = b"", b"", None
        unpacked = Unpacked(self.path) if zipped else None
        try:
            with pa.input_stream(str(self.path), compression="gzip" if zipped else None) as file:
                while data := file.read(BLOCK_BYTES):
                    if unpacked:
                        unpacked.add(len(data))
                    convert = convert or _converter(data)
                    data = rest + convert(data)
                    end = data.rfind(b"\n") + 1
                    rest = data[end:]
                    if len(rest) > LONGEST_LINE:
                        raise RecordingError(
                            f"{self.path}: a line has more than {LONGEST_LINE >> 20} MB: these are no rows of numbers"
                        )
                    if end:
                        if held:
                            yield held
                        held = data[:end]
        except (OSError, pa.ArrowException) as error:
            what = "gzipped CSV" if zipped else "CSV"
            raise RecordingError(
                f"{self.path}: cannot be read as {what} to its end: it is truncated or damaged; copy it again"
            ) from error
        if rest.strip(b"\r\n \t\0\x1a"):
            held += rest
        if held:
            yield held

    def first(self, most: int = 1000) -> list[str]:
        """Up to so many lines from the beginning, among which the first row is found."""
        begin = b""
        for chunk in self.chunks():
            begin += chunk
            if begin.count(b"\n") >= most or len(begin) > LONGEST_LINE:
                break
        return [_decoded(line) for line in begin.split(b"\n", most)[:most]]

    def middle(self) -> list[str]:
        """Lines from the middle of a large plain file; empty for others."""
        with self.path.open("rb") as file:
            size = self.path.stat().st_size
            if size < 1 << 20 or file.read(2) in (GZIP_MAGIC, *UTF16_MAGIC):
                return []
            file.seek(size // 2)
            return [_decoded(line) for line in file.read(1 << 16).split(b"\n")[1:-1]][:60]


def _converter(begin: bytes) -> Callable[[bytes], bytes]:
    """Function that converts blocks of a file, of which this is the first, to UTF-8 with line feeds."""
    if begin.startswith(UTF16_MAGIC):
        decoder = codecs.getincrementaldecoder("utf-16")(errors="replace")
        returns = "\n" not in begin.decode("utf-16", "replace")

        def decoded(data: bytes) -> bytes:
            text = decoder.decode(data)
            return (text.replace("\r", "\n") if returns else text).encode("utf-8", "replace")

        return decoded
    if b"\r" in begin and b"\n" not in begin:
        return lambda data: data.replace(b"\r", b"\n")
    return lambda data: data


def _decoded(line: bytes) -> str:
    line = line.removeprefix(codecs.BOM_UTF8)
    try:
        return line.decode().strip("\r\n")
    except UnicodeDecodeError:
        return line.decode("latin-1").strip("\r\n")


def _cells(line: str, separator: str) -> list[str]:
    if separator == " ":
        line = " ".join(line.split())
    if '"' not in line:
        return [cell.strip() for cell in line.split(separator)]
    try:
        row = next(csv.reader([line], delimiter=separator, skipinitialspace=separator != " "), [])
    except csv.Error:
        return line.split(separator)
    return [cell.strip() for cell in row]


# --- The dialect: separator and decimal mark from the rows, then the line of the names.


def _dialect(path: Path, lines: list[str], middle: list[str]) -> tuple[Dialect, list[list[str]]]:
    """The dialect, and the sample's rows."""
    declared = re.fullmatch(r'"?sep=(.)"?', lines[0].strip("\ufeff \r"), re.IGNORECASE)
    separators = (declared[1],) if declared else _SEPARATORS
    step = max(len(lines) // 60, 1)
    sample = [line for line in [*lines[::step], *lines[:20], *middle] if line.strip()]
    separator, decimal, count, typical = _best(sample, separators)
    if not typical:
        raise RecordingError(f"{path}: {_why_no_table(lines, separator)}")
    dialect = Dialect(separator, decimal)

    def row_of(line: str) -> list[str]:
        """Cells of a row; empty for other lines."""
        cells = [] if COMMENT.match(line) else dialect.cells(line)
        values = sum(_is_value(cell, decimal) for cell in cells) if len(cells) == count else 0
        missing = sum(map(is_missing, cells)) if values else 0
        return cells if values and 2 * (values + missing) >= typical else []

    first = _first_row(lines, row_of)
    above = [k for k in range(first) if lines[k].strip() and not (declared and k == 0)]
    if not above and first + 1 < len(lines) and _are_names(row_of(lines[first]), row_of(lines[first + 1])):
        above, first = [first], first + 1
    rows = [row for line in [*lines[first : first + 200], *middle] if (row := row_of(line))]
    if not rows:
        raise RecordingError(f"{path}: {_why_no_table(lines, separator)}")
    dialect = _named(path, replace(dialect, first_line=first), lines, above, rows)
    columns = dict(zip(dialect.names, zip(*rows, strict=True), strict=True))
    # Columns without a name and a value are those of a separator at the end of each line.
    empty = {f"column{k + 1}" for k, values in enumerate(columns.values()) if not any(values)}
    kinds = (_kind(path, name, values, dialect) for name, values in columns.items())
    kinds = ("blank" if name in empty else kind for name, kind in zip(columns, kinds, strict=True))
    dialect = replace(dialect, kinds=tuple(kinds))
    dialect = replace(dialect, wide=tuple((name, _labels(name, columns)) for name in dialect.of_kind("list")))
    if not dialect.of_kind("number", "list", "other"):
        raise RecordingError(f"{path}: {_why_no_table(lines, separator)}")
    return _by_joint(dialect, rows[0]), rows


def _are_names(line: list[str], row: list[str]) -> bool:
    """Whether a line with numbers has names: words over numbers, or numbers from 0 on as pandas numbers columns."""
    counted = [*map(str, range(len(line)))]
    if len(line) > 1 and line in (counted, ["", *counted[:-1]]):
        return True
    over = zip(line, row, strict=False)
    words = [cell[:1].isalpha() and not is_missing(cell) and is_number(below) for cell, below in over]
    return any(words) and all(cell.isdigit() for cell in line if is_number(cell))


def _kind(path: Path, name: str, values: Sequence[str], dialect: Dialect) -> str:
    """Kind of a column by its values; thousands separators are refused."""
    decimal, other = dialect.decimal, "." if dialect.decimal == "," else ","
    kind = kind_of(values, decimal)
    if kind != "text":
        return kind
    known = [value for value in values if not is_missing(value)]
    odd = next((value for value in known if has_thousands(value, decimal)), "")
    if odd and all(is_number(value, decimal) or has_thousands(value, decimal) for value in known):
        raise RecordingError(f"{path}: column '{name}' {_thousands('such as', odd)}")
    return "other" if dialect.separator != "," and kind_of(values, other) == "number" else kind


def _thousands(where: str, cell: str) -> str:
    return f"has separators between thousands, {where} '{cell}'; write numbers without"


def _labels(name: str, columns: Mapping[str, Sequence[str]]) -> tuple[str, ...]:
    """Names of the elements of a column of lists: those of a list of words that is the same in every row."""
    count = Counter(len(list_cells(value)) for value in columns[name] if value).most_common(1)[0][0]
    for values in columns.values():
        words = list_words(values[0]) if len(set(values)) == 1 else ()
        if len(words) == len(set(words)) == count > 1:
            return words
    return tuple(map(str, range(count)))


def _is_value(cell: str, decimal: str) -> bool:
    return is_number(cell, decimal) or is_stamp(cell) or bool(list_cells(cell))


def _best(sample: list[str], separators: Sequence[str]) -> tuple[str, str, int, float]:
    """Separator, decimal mark, number of cells and usual number of numbers of the rows: most numbers, least else."""
    best, choice = (0, 0.0), (separators[0], ".", 0, 0.0)
    for separator in separators:
        rows = [_cells(line, separator) for line in sample if not COMMENT.match(line)]
        for decimal in (".", ","):
            if decimal == "," and separator == "," and '"' not in "".join(sample):
                continue
            numbers: dict[int, list[int]] = {}
            for row in rows:
                good = sum(is_number(cell, decimal) or is_stamp(cell) or len(list_cells(cell)) for cell in row)
                if good:
                    numbers.setdefault(len(row), []).append(good)
            if not numbers:
                continue
            count = max(numbers, key=lambda n: (sum(numbers[n]), n))
            commas = [cell for row in rows if len(row) == count for cell in row if "," in cell]
            if decimal == "," and commas and all(has_thousands(cell, ".") for cell in commas):
                continue  # all are groups of three digits
            total, lines = sum(numbers[count]), len(numbers[count])
            if (total, total / (lines * count)) > best:
                best = total, total / (lines * count)
                choice = separator, decimal, count, float(np.median(numbers[count]))
        if best[1] >= 1 and choice[0] == separator and choice[2] > 1:
            break  # every cell is a number
    return choice


def _first_row(lines: list[str], row_of: Callable[[str], list[str]]) -> int:
    """Index of the first row that another row follows, with nothing but blank lines between."""
    before, single = -1, -1
    for k, line in enumerate(lines):
        if not line.strip():
            continue
        is_row = bool(row_of(line))
        if is_row and before >= 0:
            return before
        before = k if is_row else -1
        single = k if is_row and single < 0 else single
    return max(single, 0)


def _named(path: Path, dialect: Dialect, lines: list[str], above: list[int], rows: list[list[str]]) -> Dialect:
    """The dialect with the names of its columns, from the nearest line above the rows that fits."""
    count, notes, rule = len(rows[0]), [], re.compile(r"[\s\-=+|:*_.#]*")
    trailing = all(not row[-1] for row in rows)
    fitting: list[tuple[int, list[str]]] = []
    for k in reversed(above):
        cells = _header_cells(lines[k], dialect.separator, rows)
        if cells and not rule.fullmatch(lines[k]):
            fitting.append((k, cells))
            if not all(_UNIT.fullmatch(cell) or is_missing(cell) for cell in cells):
                break
        elif not fitting and not COMMENT.match(lines[k]) and not rule.fullmatch(lines[k]):
            _expect_title(path, dialect, lines, k, count)
    names = fitting[-1][1] if fitting else list(_echoed_names(tuple(rows[0])))
    if not names:
        names = [""] * count
    elif len(names) < count:
        notes.append("the first column has no name" if not trailing else "")
        names = [*names, ""] if trailing else ["", *names]
    header = lines[fitting[-1][0]].strip().encode() if fitting else b""
    names = [name or f"column{k + 1}" for k, name in enumerate(names)]
    units = tuple(fitting[0][1]) if len(fitting) > 1 and len(fitting[0][1]) == count else ()
    for name, times in Counter(names).items():
        if times > 1:
            notes.append(f"{times} columns are named '{name}': they are {name}[0] to {name}[{times - 1}]")
            for number, k in enumerate([k for k, one in enumerate(names) if one == name]):
                names[k] = f"{name}[{number}]"
    return replace(dialect, names=tuple(names), header=header, notes=tuple(filter(None, notes)), units=units)


def _header_cells(line: str, separator: str, rows: list[list[str]]) -> list[str]:
    """Names in a line, one a cell of a row, or one less; empty where the line does not fit."""
    count = len(rows[0])
    text = COMMENT.sub("", line, count=1) if COMMENT.match(line) else line.strip("\ufeff")
    splits = [_cells(text if one == "\t" else text.strip(), one) for one in _SEPARATORS]
    splits.append(re.split(r"\s{2,}", text.strip()))
    splits.append(re.split(r"\s+(?![\[(])", text.strip()))  # units in brackets belong to the name before
    for cells in (_cells(text if separator == "\t" else text.strip(), separator), *splits):
        if len(cells) > count and not any(cells[count:]):
            cells = cells[:count]
        if any(is_number(cell) and not cell.isdigit() for cell in cells):
            continue
        if len(cells) == count or (len(cells) == count - 1 > 0 and (_is_index(rows) or not any(r[-1] for r in rows))):
            return cells
    return []


def _is_index(rows: list[list[str]]) -> bool:
    """Whether the first column may lack a name: it counts the rows, or has dates."""
    cells = [row[0] for row in rows[:60]]
    if all(cell.isdigit() for cell in cells):
        return all(int(b) - int(a) == 1 for a, b in zip(cells, cells[1:], strict=False))
    return all(is_stamp(cell) or is_stamp(f"{cell} 00:00:00") for cell in cells)


def _expect_title(path: Path, dialect: Dialect, lines: list[str], k: int, count: int) -> None:
    """Refuse a line above the rows that has names, but not one for every cell."""
    by_separator = {s: _cells(lines[k].strip(), s) for s in _SEPARATORS if s != " " or dialect.separator == " "}
    separator = max(by_separator, key=lambda s: len(by_separator[s]))
    cells = by_separator[separator]
    prose = separator == " " and len(cells) < count - 2
    if len(cells) < 2 or prose or ":" in lines[k] or "=" in lines[k] or any(map(is_number, cells)):
        return
    row = lines[dialect.first_line].strip()[:60]
    raise RecordingError(
        f"{path}: line {k + 1} has {len(cells)} names between {separator!r}, line {dialect.first_line + 1} has "
        f"{count} cells between {dialect.separator!r}: {row!r}; use one separator, and a name for every column"
    )


def _echoed_names(cells: tuple[str, ...]) -> tuple[str, ...]:
    """Column names for a JointState printed by `ros2 topic echo --csv`; empty for other lines."""
    joints, rest = divmod(len(cells) - 3, 4)
    names = cells[3 : 3 + joints]
    numbers = (*cells[:2], *cells[3 + joints :])
    whole = all(cell.isdigit() for cell in cells[:2])
    if joints < 1 or rest or not whole or not all(is_number(cell) or is_missing(cell) for cell in numbers):
        return ()
    if len(set(names)) < joints or any(is_number(name) for name in names):
        return ()
    arrays = [f"{array}{k}" for array in ("name", "position", "velocity", "effort") for k in range(joints)]
    return ("sec", "nanosec", "frame_id", *arrays)


def _by_joint(dialect: Dialect, row: list[str]) -> Dialect:
    """Rename columns of a JointState by joint name, where text columns `name0`, `name1`... have the names."""
    text = dialect.of_kind("text")
    held: dict[str, list[str]] = {m[1]: [] for name in text if (m := re.fullmatch(r"(.*\b)name0", name))}
    by_name = dict(zip(dialect.names, row, strict=True))
    renamed: dict[str, str] = {}
    for prefix, joints in held.items():
        while f"{prefix}name{len(joints)}" in by_name:
            joints.append(by_name[f"{prefix}name{len(joints)}"])
        for array in ("position", "velocity", "effort"):
            renamed |= {f"{prefix}{array}{k}": f"{prefix}{array}[{joint}]" for k, joint in enumerate(joints)}
    return replace(dialect, names=tuple(renamed.get(name, name) for name in dialect.names))


def _why_no_table(lines: list[str], separator: str) -> str:
    filled = [line.strip() for line in lines if line.strip()]
    shown = f"its first line is {filled[0][:60]!r}" if filled else "it is blank"
    if len(filled) == 1 and separator in filled[0]:
        return f"it has no rows under its names; {shown}"
    return f"no table of numbers; {shown}"


# --- Rows: by Arrow, a block of lines at a time; a block with odd lines or cells is read more carefully.


@dataclass
class _Reader:
    text: _Text
    dialect: Dialect
    clock: str
    lost: Lost

    def blocks(self) -> Iterator[RawSignals]:
        """Yield the rows block by block; another thread reads one block ahead."""
        rows, blocks = 0, self._blocks()
        with ThreadPoolExecutor(1) as pool:
            waiting = pool.submit(next, blocks, None)
            while (read := waiting.result()) is not None:
                waiting = pool.submit(next, blocks, None)
                signals, lost = read
                for reason, (count, first) in lost.reasons.items():
                    self.lost.add(reason, count, first)
                rows += len(signals.columns)
                if len(signals.columns):
                    yield signals
        if not rows:
            raise RecordingError(f"{self.text.path}: it has no rows under its names")

    def _blocks(self) -> Iterator[tuple[RawSignals, Lost]]:
        skip, line, stamps, whole, others = self.dialect.first_line, 0, StampReader(), True, 0
        for chunk in self.text.chunks():
            while skip and chunk:
                chunk, skip = chunk[chunk.find(b"\n") + 1 :] if b"\n" in chunk else b"", skip - 1
            if not chunk:
                continue
            count, lost = chunk.count(b"\n") + (not chunk.endswith(b"\n")), Lost()
            table, at = self._table(chunk, count, line, lost)
            rows = np.arange(line, line + count) if at is None else at + line
            line += count
            others += count - len(rows)
            if others > max(MOST_OTHER[0], MOST_OTHER[1] * (line - others)):
                raise RecordingError(
                    f"{self.text.path}: {others:,} of its first {line:,} lines are blank, comments or broken: this is "
                    "no recording"
                )
            signals = self._signals(table, rows, stamps, lost)
            whole &= at is None and len(signals.columns) == count
            yield (replace(signals, rows=None) if whole else signals), lost

    def _signals(self, table: Any, rows: np.ndarray, stamps: StampReader, lost: Lost) -> RawSignals:
        wide = dict(self.dialect.wide)
        elements = {name: [f"{name}[{label}]" for label in labels] for name, labels in wide.items()}
        names = tuple(one for name in self.dialect.kept for one in elements.get(name, [name]))
        columns, k = np.empty((len(rows), len(names)), order="F"), 0
        if not len(rows):
            return RawSignals("", names, None, columns, rows=rows)
        for name in self.dialect.kept:
            count = len(wide.get(name, "1"))
            columns[:, k : k + count] = self._values(name, table.column(name), rows, count)
            k += count
        t_ns = paired_stamps(names, columns)
        if self.clock:
            t_ns, known = stamps.stamps(table.column(self.clock))
            if not known.all():
                first = self._line(int(rows[np.argmin(known)]))
                lost.add(f"'{self.clock}', its time, is missing", int((~known).sum()), first)
                t_ns, columns, rows = t_ns[known], columns[known], rows[known]
        return RawSignals("", names, t_ns, columns, rows=rows)

    def _line(self, row: int) -> str:
        return f"line {row + self.dialect.first_line + 1}"

    def _values(self, name: str, column: Any, rows: np.ndarray, count: int) -> np.ndarray:
        """Numbers of a column (rows, count), as Arrow converted them or cell by cell."""
        if pa.types.is_floating(column.type):
            return np.asarray(column.to_numpy(), dtype=np.float64)[:, None]
        kind = self.dialect.kinds[self.dialect.names.index(name)]
        if kind == "flag":
            return flags_of(column)[:, None]
        if kind == "list":
            return lists_of(column, count)
        if kind == "other":
            return numbers_of(column, "." if self.dialect.decimal == "," else ",")[:, None]
        values = numbers_of(column, self.dialect.decimal)
        for k in np.flatnonzero(np.isnan(values)):
            cell = str(column[int(k)].as_py() or "").strip()
            if has_thousands(cell, self.dialect.decimal):
                at = f"in {self._line(int(rows[k]))}:"
                raise RecordingError(f"{self.text.path}: column '{name}' {_thousands(at, cell)}")
        return values[:, None]

    def _table(self, chunk: bytes, count: int, line: int, lost: Lost) -> tuple[Any, np.ndarray | None]:
        """The columns of a block of lines, and the indices of its rows among the lines; None: all are."""
        if self.dialect.separator == " ":
            chunk = _single_blanks(chunk)
        if not (self.dialect.header and self.dialect.header in chunk):
            with suppress(pa.ArrowException):  # a line or a cell is odd
                table = self._parsed(chunk, pa.float64())
                if table.num_rows == count:
                    return table, None
        chunk, at = self._good_lines(chunk, line, lost)
        if not len(at):
            return None, at
        try:
            table = self._parsed(chunk, pa.float64())
        except pa.ArrowException:
            try:
                table = self._parsed(chunk.decode("utf-8", "replace").encode(), pa.string())
            except pa.ArrowException as error:
                begin, end = (self._line(line + int(k)) for k in (at[0], at[-1]))
                raise RecordingError(
                    f"{self.text.path}: {begin} to {end}: cannot be split into {len(self.dialect.names)} cells between "
                    f"{self.dialect.separator!r}; write one separator, and quotes in pairs"
                ) from error
        return table, None if len(at) == count else at

    def _parsed(self, chunk: bytes, numbers: pa.DataType) -> Any:
        from pyarrow import csv as arrow_csv

        wanted = [*self.dialect.kept, *([self.clock] if self.clock else [])]
        text = {*self.dialect.of_kind("other", "flag", "list"), self.clock}
        types = {name: pa.string() if name in text else numbers for name in wanted}
        return arrow_csv.read_csv(
            pa.BufferReader(chunk),
            read_options=arrow_csv.ReadOptions(column_names=list(self.dialect.names), block_size=len(chunk) + 1),
            parse_options=arrow_csv.ParseOptions(delimiter=self.dialect.separator),
            convert_options=arrow_csv.ConvertOptions(
                column_types=types,
                include_columns=wanted,
                decimal_point=self.dialect.decimal,
                null_values=["", "nan", "NaN", "None", "null", "NA"],  # a block with others is read cell by cell
                strings_can_be_null=True,
            ),
        )

    def _good_lines(self, chunk: bytes, line: int, lost: Lost) -> tuple[bytes, np.ndarray]:
        """The block without lines that are no rows, and the indices of those that are; broken ones are counted."""
        separator, count = self.dialect.separator.encode(), len(self.dialect.names)
        good, at, broken, header = [], [], list[int](), self.dialect.header
        for k, text in enumerate(chunk.split(b"\n")):
            text = text.strip(b"\r")
            bare = text.strip()
            if not bare or bare == header or COMMENT.match(bare[:9].decode("latin-1")):
                continue
            if b'"' in text:
                cells = len(_cells(_decoded(text), self.dialect.separator)) if text.count(b'"') % 2 == 0 else -1
            else:
                cells = text.count(separator) + 1
                surplus = text.split(separator)[count - 1 :] if cells > count else []
                if self.dialect.kinds[-1] == "text" and surplus and not re.search(rb"\d", b"".join(surplus)):
                    cells, text = count, separator.join(text.split(separator)[:count])  # the text has the separator too
            if cells == count and b"\0" not in text:
                good.append(text)
                at.append(k)
            else:
                broken.append(k)
        if broken:
            lost.add("a wrong number of cells", len(broken), self._line(line + broken[0]))
        return b"\n".join(good) + b"\n", np.array(at, dtype=np.int64)


def _single_blanks(chunk: bytes) -> bytes:
    """One blank between cells, none at the ends of a line."""
    chunk = chunk.replace(b"\t", b" ")
    while b"  " in chunk:
        chunk = chunk.replace(b"  ", b" ")
    return chunk.removeprefix(b" ").replace(b"\n ", b"\n").replace(b" \r", b"\r").replace(b" \n", b"\n").rstrip(b" ")
