"""Cells of text in tables: numbers, dates and times, words for missing values, and rates that a file states."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from tauext.data.clock import ARM_HZ

# --- Kinds of cells.


MISSING = frozenset(
    ["", "-", "--", "---", "?", "*", "n/a", "na", "<na>", "#n/a", "#na", "nan", "-nan", "+nan", "nan(ind)", "-nan(ind)",
     "nan(snan)", "-nan(snan)", "1.#qnan", "-1.#qnan", "1.#ind", "-1.#ind", "1.#inf", "-1.#inf", "#div/0!", "#value!",
     "#ref!", "#num!", "null", "none", "nil", "nat", "missing", "undefined", "inf", "-inf", "+inf"]
)  # fmt: skip
"""Words that stand for a missing value, in lower case."""
_EXPONENT = r"(?:[eEdD][-+]?\d+)?"
NUMBER = {".": rf"[-+]?(?:\d+\.?\d*|\.\d+){_EXPONENT}", ",": rf"[-+]?(?:\d+(?:,\d+)?|,\d+){_EXPONENT}"}
"""Numbers by their decimal mark; Fortran writes the exponent as D."""
STAMP = (
    r"(?:(?P<year>\d{4})[-/.](?P<month>\d{1,2}|[A-Za-z]{3})[-/.](?P<day>\d{1,2})"
    r"|(?P<first>\d{1,2})[-/. ](?P<second>\d{1,2}|[A-Za-z]{3})[-/. ](?P<last>\d{4})|(?P<days>\d+) days?)?"
    r"[T ,_]{0,3}(?P<h>\d{1,2}):(?P<m>\d{2}):(?P<s>\d{2})(?:[.,:](?P<part>\d{1,9})\d*)?"
    r" ?(?P<noon>[AaPp][Mm])?(?: ?(?P<zone>Z|UTC|GMT|[-+]\d{2}:?\d{2}))?(?:\[.*\])?"
)
"""A date with a time of day, a time of day, or a duration."""
BASIC, EXTENDED = r"^(\d{4})(\d{2})(\d{2})[T _](\d{2}):?(\d{2}):?(\d{2})", r"\1-\2-\3T\4:\5:\6"
"""Beginning of a stamp in the basic format of ISO 8601, `20260301T100000`, and what STAMP reads in its place."""
DAY_NS = 86_400 * 10**9


def is_number(cell: str, decimal: str = ".") -> bool:
    """Whether the cell is a finite number with this decimal mark."""
    return re.fullmatch(NUMBER[decimal], cell) is not None


def is_stamp(cell: str) -> bool:
    """Whether the cell has a time of day, with or without a date."""
    return re.fullmatch(STAMP, re.sub(BASIC, EXTENDED, cell)) is not None


def has_thousands(cell: str, decimal: str) -> bool:
    """Whether the cell is a number with separators between its thousands."""
    marks = {".": r"[-+]?[1-9]\d{0,2}(?:,\d{3})+(?:\.\d*)?", ",": r"[-+]?[1-9]\d{0,2}(?:[. ']\d{3})+(?:,\d*)?"}
    return re.fullmatch(marks[decimal], cell) is not None


def list_cells(cell: str) -> list[str]:
    """Numbers of a list in one cell, `[0.1, 0.2]`; empty where the cell is none."""
    cell = re.sub(r"^array\('\w', ?(.*)\)$", r"\1", cell)
    if cell[:1] not in ("[", "(") or cell[-1:] not in ("]", ")"):
        return []
    cells = [one for one in re.split(r"[,;\s]+", cell[1:-1]) if one]
    return cells if all(is_number(one) or is_missing(one) for one in cells) else []


def list_words(cell: str) -> tuple[str, ...]:
    """Words of a list in one cell, `['shoulder', 'elbow']`; empty where the cell is none."""
    if not re.fullmatch(r"[\[(].*[A-Za-z].*[\])]", cell):
        return ()
    return tuple(re.findall(r"[^\s'\",;\[\]()]+", cell))


def is_missing(cell: str) -> bool:
    """Whether the cell stands for a missing value."""
    return cell.lower() in MISSING


def kind_of(cells: Sequence[str], decimal: str = ".") -> str:
    """Kind of a column by a sample of its cells: number, stamp, flag, list, or text.

    A column has the kind of at least half of the cells that are not missing; one without any value is of numbers.
    """
    known = [cell for cell in cells if not is_missing(cell)]
    for kind, fits in (
        ("number", lambda cell: is_number(cell, decimal)),
        ("stamp", is_stamp),
        ("flag", lambda cell: cell.lower() in ("true", "false")),
        ("list", lambda cell: bool(list_cells(cell))),
    ):
        if 2 * sum(map(fits, known)) >= len(known):
            return kind
    return "text"


# --- Columns of text cells, converted by Arrow.


def numbers_of(column: Any, decimal: str = ".") -> np.ndarray:
    """Numbers of a column of text, float64; NaN where a cell is no finite number."""
    text = pc.utf8_trim_whitespace(column.cast(pa.string()))
    fits = pc.match_substring_regex(text, f"^(?:{NUMBER[decimal]})$")
    text = pc.replace_substring_regex(pc.if_else(fits, text, None), "[dD]", "e")
    if decimal != ".":
        text = pc.replace_substring(text, decimal, ".")
    return np.asarray(text.cast(pa.float64()).to_numpy(zero_copy_only=False), dtype=np.float64)


def flags_of(column: Any) -> np.ndarray:
    """1 and 0 of a column of true and false, float64; NaN where a cell is neither, or a number."""
    text = pc.utf8_lower(pc.utf8_trim_whitespace(column.cast(pa.string())))
    values = numbers_of(text)
    values[_equal(text, "true")], values[_equal(text, "false")] = 1.0, 0.0
    return values


def lists_of(column: Any, count: int) -> np.ndarray:
    """Numbers of a column of lists in text, (samples, count); NaN where a list has another length."""
    text = pc.replace_substring_regex(column.cast(pa.string()), r"^\s*(?:array\('\w', ?)?[\[(]\s*|\s*[\])]+\s*$", "")
    lists = pc.split_pattern_regex(text, r"\s*[,;]\s*|\s+")
    if isinstance(lists, pa.ChunkedArray):
        lists = lists.combine_chunks()
    fits = pc.fill_null(pc.equal(pc.list_value_length(lists), count), False)
    values = np.full((len(lists), count), np.nan)
    values[_flags(fits)] = numbers_of(lists.filter(fits).flatten()).reshape(-1, count)
    return values


class StampReader:
    """Converts cells with dates and times of day to stamps, block by block.

    Times of day without a date continue over midnight.
    """

    def __init__(self) -> None:
        self._days_ns = 0
        self._newest: int | None = None

    def stamps(self, column: Any) -> tuple[np.ndarray, np.ndarray]:
        """(samples,) int64 [ns], and which cells are stamps."""
        text = pc.replace_substring_regex(pc.utf8_trim_whitespace(column.cast(pa.string())), BASIC, EXTENDED)
        found = pc.extract_regex(text, f"^(?:{STAMP})$")
        if isinstance(found, pa.ChunkedArray):
            found = found.combine_chunks()
        known = _flags(found.is_valid())
        part = {name: found.field(k) for k, name in enumerate(field.name for field in found.type)}
        day, dated, valid = _days(part)
        hours = _whole(part["h"])
        noon = pc.utf8_lower(part["noon"])
        if _has(noon).any():
            hours = np.where(_has(noon), hours % 12 + 12 * _equal(noon, "pm"), hours)
        fraction = pc.utf8_rpad(part["part"], 9, "0")
        ns = (day * 86_400 + hours * 3600 + _whole(part["m"]) * 60 + _whole(part["s"])) * 10**9 + _whole(fraction)
        if (zoned := _has(part["zone"]) & ~_equal(part["zone"], "Z")).any():
            zone = pc.replace_substring(part["zone"], ":", "")
            minutes = _whole(pc.utf8_slice_codeunits(zone, 1, 3)) * 60 + _whole(pc.utf8_slice_codeunits(zone, 3, 5))
            sign = np.where(_equal(pc.utf8_slice_codeunits(zone, 0, 1), "-"), -1, 1)
            ns -= np.where(zoned, sign * minutes * 60 * 10**9, 0)
        known &= valid
        return self.over_midnight(ns, known & ~dated), known

    def over_midnight(self, ns: np.ndarray, of_day: np.ndarray) -> np.ndarray:
        """Stamps [ns] with the days since the first block added to the rows that are times of day."""
        if not of_day.any():
            return ns
        times = ns[of_day]
        before = np.r_[times[0] if self._newest is None else self._newest, times[:-1]]
        self._newest = int(times[-1])
        days = np.cumsum((times - before < -DAY_NS // 2).astype(np.int64) - (times - before > DAY_NS // 2))
        ns = ns.copy()
        ns[of_day] += self._days_ns + days * DAY_NS
        self._days_ns += int(days[-1]) * DAY_NS
        return ns


def _days(part: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Days since 1970 (of a duration: its days; 0: none), whether there is a date or days, and whether it is valid."""
    count = len(part["h"])
    year_first, year_last, days = (_has(part[name]) for name in ("year", "last", "days"))
    dated = year_first | year_last
    if not dated.any():
        return _whole(part["days"]), days, np.ones(count, bool)
    year = _whole(part["year"]) + _whole(part["last"])
    month, day = _month(part["month"]) + _month(part["second"]), _whole(part["day"]) + _whole(part["first"])
    # With AM or PM, or where the second number is no month, the month is the first.
    turned = year_last & (_has(part["noon"]) | (month > 12)) & (day <= 12)
    month, day = np.where(turned, day, month), np.where(turned, month, day)
    valid = ~dated | ((month >= 1) & (month <= 12) & (day >= 1) & (day <= 31) & (year >= 1970) & (year < 2200))
    months = np.where(dated & valid, (year - 1970) * 12 + month - 1, 0)
    since = months.astype("datetime64[M]").astype("datetime64[D]").astype(np.int64) + day - 1
    return np.where(dated, since, _whole(part["days"])), dated | days, valid


def _flags(column: Any) -> np.ndarray:
    return np.asarray(pc.fill_null(column, False).to_numpy(zero_copy_only=False), bool)


def _has(text: Any) -> np.ndarray:
    return _flags(pc.not_equal(text, ""))


def _equal(text: Any, word: str) -> np.ndarray:
    return _flags(pc.equal(text, word))


def _whole(text: Any) -> np.ndarray:
    """Digits as int64; 0 where there are none."""
    digits = pc.if_else(pc.fill_null(pc.match_substring_regex(text, r"^\d+$"), False), text, "0")
    return np.asarray(digits.cast(pa.int64()).to_numpy(zero_copy_only=False), np.int64)


def _month(text: Any) -> np.ndarray:
    text = pc.utf8_lower(text)
    for number, name in enumerate("jan feb mar apr may jun jul aug sep oct nov dec".split(), 1):
        text = pc.if_else(pc.equal(text, name), str(number), text)
    return _whole(text)


USUAL_CLOCK = re.compile(r".*(time|stamp|date|clock).*", re.IGNORECASE)


def choose_clock(candidates: Mapping[str, int]) -> str:
    """Name of the column of stamps that serves as the clock: the most different stamps, then a usual name."""
    return max(candidates, key=lambda name: (candidates[name], bool(USUAL_CLOCK.fullmatch(name))))


def clock_notes(candidates: Mapping[str, int], clock: str) -> list[str]:
    """Sentences that name the clock, and the further columns of stamps that are left out."""
    others = [name for name in candidates if name != clock]
    notes = [f"stamps from column '{clock}', which has dates or times"]
    return notes + [f"further columns of dates or times left out: {', '.join(others)}"] * bool(others)


def unread_times(columns: Mapping[str, Sequence[str]]) -> dict[str, str]:
    """Columns of text that may hold times in a form that is not read, and a cell of each.

    Most of their cells have digits and differ.
    """
    found = {}
    for name, cells in columns.items():
        known = {cell for cell in cells if not is_missing(cell) and sum(map(str.isdigit, cell)) >= 4}
        if len(cells) > 1 and 2 * len(known) > len(cells):
            found[name] = next(cell for cell in cells if cell in known)
    return found


def paired_stamps(names: Sequence[str], columns: np.ndarray) -> np.ndarray | None:
    """Stamps [ns] of columns such as `sec` and `nanosec`, `stamp.secs` and `stamp.nsecs`; None: there are none."""
    for whole, name in enumerate(names):
        if not (match := re.fullmatch(r"(|.*[\W_])secs?", name)):
            continue
        for part in ("nanosec", "nanosecs", "nsec", "nsecs", "nanoseconds"):
            if f"{match[1]}{part}" in names:
                at = [whole, names.index(f"{match[1]}{part}")]
                seconds, rest = np.nan_to_num(columns[:, at]).astype(np.int64).T
                return seconds * 10**9 + rest
    return None


def stated_hz(name: str, value: float) -> float | None:
    """Rate that an entry of this name states, [Hz]; None: the entry is no rate or sample time of an arm's log."""
    name = re.sub(r"[\s.-]+", "_", name.strip()).lower()
    period = re.fullmatch(r"(ts|dt|(sample|sampling|cycle)_?(time|period|interval)|period)(_?(s|sec|ms|us|ns))?", name)
    rates = r"(fs|fps|rate|(sample|sampling|update|control|recording|log)_?(rate|freq(uency)?)|frequency)(_?hz)?"
    if period and value > 0:
        value = 1.0 / (value * {"ms": 1e-3, "us": 1e-6, "ns": 1e-9}.get(period[5], 1.0))
    elif not re.fullmatch(rates, name):
        return None
    return value if ARM_HZ[0] <= value <= ARM_HZ[1] else None
