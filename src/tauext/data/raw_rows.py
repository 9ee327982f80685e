"""Rows of a raw recording for its signals: their clock, which are left out, and pieces that fit into memory."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from tauext.data.clock import SHARED_STAMPS, RowRules, Runs, Table, TwoClocks, expect_no_counter, expect_same_rate
from tauext.data.description import TIME_UNITS, Arm
from tauext.data.importers.raw import Lost, RawRecording, RawSignals, short_list
from tauext.data.recording import REPEATED, SORTED, Recording
from tauext.data.unmeasured import UNMEASURED
from tauext.errors import RecordingError

_LOCK = "take {joints} out of [robot] joints, and list it in locked and ignored there; or record it"
WAYS_ON = {"q": _LOCK, "dq": 'columns = "" in [signals.dq] derives the velocity from the position', "tau": _LOCK}
"""What a person can do about a signal that is missing throughout; others are optional."""


@dataclass(frozen=True)
class Columns:
    """Names of the columns to read from every stream, and the indices of each signal's columns."""

    streams: dict[str, tuple[str, ...]]
    signals: dict[str, tuple[str, list[int]]]
    """Stream and column indices in that stream's list, by signal, `contact` or `time`."""


@dataclass(frozen=True)
class Piece:
    """Rows of every stream in one stretch of time of one run."""

    tables: dict[str, Table]
    run: int
    last: bool
    joined: bool = False
    """Whether another stretch was joined before or after it."""

    @property
    def begin_ns(self) -> int:
        """First stamp, [ns]."""
        return min(int(t_ns.min()) for t_ns, _ in self.tables.values() if len(t_ns))


class RowReader:
    """Reads the needed columns of a raw recording once, and counts what is left out."""

    def __init__(self, raw: RawRecording, arm: Arm, columns: Columns, rules: RowRules = RowRules()):
        self._raw, self._arm, self._columns, self._rules = raw, arm, columns, rules
        self._rows, self._missing = Counter[str](), Counter[str]()
        self._clocks, self._lost = TwoClocks(raw.clocks), Lost()
        self._stamped = self._by_rate = False
        self._total = Counter[str]()
        """Rows read into recordings, repeated stamps and sorted rows so far."""

    @property
    def remedy(self) -> str:
        """What to do where the stamps in use are no clock."""
        names = self._raw.clocks
        if names[1] and self._arm.time.column in ("", names[0]):
            return f'use the other clock instead: [time] column = "{names[1]}"'
        return 'give the rate of the rows instead: [time] column = "" and rate_hz'

    def pieces(self) -> Iterator[Piece]:
        """Yield the pieces in order of runs and time.

        Raises:
            RecordingError: the reader's; no clock, or a stream without samples.
        """
        joints: dict[str, list[int]] = {stream: [] for stream in self._columns.streams}
        for key, (stream, indices) in self._columns.signals.items():
            joints[stream] += indices if key in self._arm.signals else []
        runs = {stream: Runs(partial(self._odd_stamp, stream), self._rules) for stream in joints}
        rules = self._rules
        waiting: dict[int, dict[str, list[Table]]] = {}
        present, begin = 0, None
        for block in self._raw.blocks():
            table = self._needed(block, joints)
            if table is None or not len(table[0]):
                continue
            for number, part in runs[block.stream].split(table):
                waiting.setdefault(number, {stream: [] for stream in joints})[block.stream].append(part)
            while min(one.number for one in runs.values()) > present:
                yield from self._run(waiting.pop(present, {}), present, last=False, alone=False)
                present, begin = present + 1, None
            tables = waiting.get(present, {})
            if not tables or not all(tables.values()):
                continue
            newest = [max(int(t[-1]) for t, _ in parts) for parts in tables.values()]
            if begin is None:
                begin = min(int(t.min()) for parts in tables.values() for t, _ in parts)
            passed = min(newest) - begin - int(rules.late_s * 1e9)
            rows = sum(len(t) for parts in tables.values() for t, _ in parts)
            if rows > rules.most_waiting and passed <= 0:
                raise RecordingError(
                    f"{self._raw.path}: more than {rules.most_waiting:,} rows have stamps within {rules.late_s:g} s, "
                    f"so they are no clock; {self.remedy}"
                )
            if passed > 1.5e9 * rules.piece_s or (rows > 1.5 * rules.piece_rows and passed > 0):
                begin += passed * 2 // 3
                yield Piece({stream: _taken(parts, begin) for stream, parts in tables.items()}, present, False)
        for stream, one in runs.items():
            for number, part in one.split(None):
                waiting.setdefault(number, {s: [] for s in joints})[stream].append(part)
        for number in sorted(waiting):
            last = number == max(waiting)
            yield from self._run(waiting[number], number, last, alone=last and number == 0)

    def _run(self, tables: Mapping[str, list[Table]], number: int, last: bool, alone: bool) -> Iterator[Piece]:
        """Yield the rest of a run; a run beside others that is short, or lacks a stream, is left out."""
        if not any(tables.values()):
            return
        missing = [stream for stream, parts in tables.items() if not parts]
        rows = {stream: sum(len(t) for t, _ in parts) for stream, parts in tables.items()}
        if alone and missing:
            raise RecordingError(f"{self._raw.path}: no samples of {', '.join(missing)}")
        if alone or (not missing and min(rows.values()) >= self._rules.short_run):
            yield Piece({stream: _joined(parts) for stream, parts in tables.items()}, number, last)
            return
        reason = f"in a run of fewer than {self._rules.short_run} rows, between two steps of the clock"
        if missing:
            reason = f"in a run, where the clock begins again, without samples of {', '.join(missing)}"
        self._raw.lost.add(reason, sum(rows.values()), f"in run {number + 1}")

    def _odd_stamp(self, stream: str, row: int) -> None:
        self._raw.lost.add("the stamp is far from those of its neighbours", 1, f"near {self._at(stream, row)}")

    def _needed(self, block: RawSignals, joints: Mapping[str, list[int]]) -> Table | None:
        """Stamps and needed columns of a block's valid rows; None: it has other joints only."""
        raw, names = self._raw, self._columns.streams.get(block.stream)
        if names is None:
            return None
        first = self._rows[block.stream]
        rows = np.arange(first, first + len(block.columns)) if block.rows is None else block.rows
        self._rows[block.stream] = int(rows[-1]) + 1 if len(rows) else first
        index = {name: k for k, name in enumerate(block.names)}
        lacking = [name for name in names if name not in index]
        if len(lacking) == len(names):
            raw.counts[f"messages on {block.stream} of other joints left out"] += len(block.columns)
            return None
        if lacking:
            self._missing.update(dict.fromkeys(lacking, len(rows)))
            raw.lost.add(f"without {short_list(lacking, 4)}", len(rows), self._at(block.stream, rows[0]))
            return None
        values = block.columns[:, [index[name] for name in names]]
        t_ns, known = self._stamps(block, values, rows)
        bad = ~np.isfinite(values[:, joints[block.stream]])
        if bad.any():
            signals = [names[k] for k in joints[block.stream]]
            for k in np.flatnonzero(bad.any(axis=0)):
                self._missing[signals[k]] += int(bad[:, k].sum())
            worst = np.where(bad.any(axis=1), bad.argmax(axis=1), -1)
            for k in np.unique(worst[worst >= 0]):
                at, reason = worst == k, f"'{signals[k]}' is missing or no finite number"
                raw.lost.add(reason, int(at.sum()), self._at(block.stream, rows[np.argmax(at)]))
            known &= worst < 0
        if not known.all():
            t_ns, values = t_ns[known], values[known]
        return t_ns, values

    def _at(self, stream: str, row: int) -> str:
        return self._raw.position(int(row)) + (f" of {stream}" if stream else "")

    def _stamps(self, block: RawSignals, values: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Stamps of a block's rows by the clock in use, [ns], and which are known."""
        raw, arm = self._raw, self._arm
        known = np.ones(len(values), bool)
        if "time" in self._columns.signals and not self._by_rate:
            times = values[:, self._columns.signals["time"][1][0]]
            known = np.isfinite(times)
            if not known.all():
                first = self._at(block.stream, rows[np.argmin(known)])
                raw.lost.add(f"'{arm.time.column}', its time, is missing", int((~known).sum()), first)
            t_ns = np.zeros(len(times), np.int64)
            unit_ns = TIME_UNITS[arm.time.unit]
            t_ns[known] = np.round(times[known] * unit_ns).astype(np.int64)
            if self._stamped or not self._uses_rate(t_ns[known], f"'{arm.time.column}'"):
                if not self._stamped:
                    expect_no_counter(t_ns[known], unit_ns, arm.time.column)
                self._stamped = True
                return t_ns, known
        if arm.time.column and block.other_ns is not None and arm.time.column == raw.clocks[1]:
            self._stamped = True
            return block.other_ns, known
        if block.t_ns is not None and not self._by_rate:
            if block.other_ns is not None and not arm.time.column and not arm.time.rate_hz:
                self._clocks.add(block.t_ns, block.other_ns)
            if self._stamped or raw.clocks[1] or not self._uses_rate(block.t_ns, "the file"):
                self._stamped = True
                return block.t_ns, known
        if not arm.time.rate_hz:
            remedy = "name its column of times in arm.toml ([time] column), or the rate of its rows ([time] rate_hz)"
            raise RecordingError("; ".join([f"{raw.path}: it has no clock: {remedy}", *raw.hints()]))
        self._by_rate = True
        known = np.ones(len(values), bool)
        return np.round(rows * (1e9 / arm.time.rate_hz)).astype(np.int64), known

    def _uses_rate(self, t_ns: np.ndarray, whose: str) -> bool:
        """Whether the stated rate replaces the first block's stamps, since most rows share theirs with others."""
        rate_hz = self._arm.time.rate_hz
        if not rate_hz or len(t_ns) < 3 or np.mean(t_ns[1:] == t_ns[:-1]) <= SHARED_STAMPS:
            return False
        self._raw.notes.append(f"stamps of {whose} are no clock: rows at the stated {rate_hz:g} Hz")
        return True

    # --- What was left out.

    def expect_rates(self, t_ns: np.ndarray) -> None:
        """Compare the stamps of the first recording with the rates that the description and the file state."""
        if not self._stamped or self._by_rate:
            return
        stated_hz = self._arm.time.rate_hz
        if stated_hz:
            expect_same_rate("[time] rate_hz", stated_hz, t_ns, f"correct rate_hz, leave it out, or {self.remedy}")
            return
        for name, hz in self._raw.stated_hz.items():
            remedy = f"where the stamps are right, give their rate ([time] rate_hz); else {self.remedy}"
            expect_same_rate(f"the file's {name}", hz, t_ns, remedy)

    def with_losses(self, recording: Recording, counts: Counter[str]) -> Recording:
        """The recording with what was left out or sorted since the one before, in its provenance.

        Args:
            counts: changes of this recording, by ordered().
        """
        dropped = [text for text in (REPEATED, UNMEASURED) if counts[text]]
        sentences = self._raw.lost.sentences() + [f"{counts[text]} {text}" for text in dropped]
        left_out = self._raw.lost.count + sum(counts[text] for text in dropped)
        self._keep_lost()
        rows = recording.samples + left_out
        self._total.update(rows=recording.samples + counts[REPEATED], repeated=counts[REPEATED], sorted=counts[SORTED])
        if not left_out and not counts[SORTED]:
            return recording
        facts = {"dropped": sentences, "dropped_share": round(left_out / rows, 6)}
        facts["sorted_share"] = round(counts[SORTED] / rows, 6)
        done = [*sentences[: len(sentences) - len(dropped)], *recording.provenance["done"]]
        return replace(recording, provenance=recording.provenance | facts | {"done": done})

    def _keep_lost(self) -> None:
        for reason, (count, at) in self._raw.lost.reasons.items():
            self._lost.add(reason, count, at)
        self._raw.lost.reasons.clear()

    def expect_enough(self) -> None:
        """Refuse a file of which too many rows are left out or sorted, or whose two clocks disagree.

        Raises:
            RecordingError: names the reasons, the columns, the first row and the ways on.
        """
        self._clocks.expect_same()
        self._keep_lost()
        total, lost = self._total, self._lost.count + self._total["repeated"]
        rows = total["rows"] + self._lost.count
        most = max(self._rules.most_share * rows, self._rules.least_refused)
        if lost and (lost == rows or lost > most):
            reasons = self._lost.sentences() + [f"{total['repeated']} {REPEATED}"] * bool(total["repeated"])
            raise RecordingError(f"{lost} of {rows} rows are left out; {'; '.join(self._absent() or reasons)}")
        if total["sorted"] > most:
            raise RecordingError(
                f"{total['sorted']} of {rows} rows are out of order by their stamps; write the rows in the order in "
                f"which they were measured, or {self.remedy}"
            )

    def _absent(self) -> list[str]:
        """A sentence with the ways on for each signal that is missing throughout."""
        rows, found = sum(self._rows.values()), []
        for signal, (stream, indices) in self._columns.signals.items():
            names = [self._columns.streams[stream][k] for k in indices]
            absent = [k for k, name in enumerate(names) if self._missing[name] >= 0.9 * rows]
            if not absent:
                continue
            joints = [self._arm.robot.joints[k] for k in absent] if len(names) == len(self._arm.robot.joints) else []
            listed = ", ".join(f"'{names[k]}'" for k in absent)
            ways = WAYS_ON.get(signal, f"remove [signals.{signal}] from arm.toml, since it is optional")
            ways = ways.format(joints=short_list(joints))
            found.append(
                f"{signal} of {short_list(joints) or 'all'} ({listed}) has no number in nearly all rows: {ways}"
            )
        return found


def _joined(tables: list[Table]) -> Table:
    return np.concatenate([t for t, _ in tables]), np.concatenate([v for _, v in tables])


def _taken(tables: list[Table], end: int) -> Table:
    """Remove and return the rows before `end`."""
    t_ns, values = _joined(tables)
    early = t_ns < end
    tables[:] = [(t_ns[~early], values[~early])]
    return t_ns[early], values[early]
