"""Clocks of raw recordings: where a new run begins, and what is wrong with stamps that cannot be used."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from tauext.data.recording import fitted_period_ns
from tauext.errors import RecordingError

Table = tuple[np.ndarray, np.ndarray]
"""Stamps (samples,), [ns], and values (samples, columns)."""


@dataclass(frozen=True)
class RowRules:
    """When rows of a raw recording begin a new recording, are left out, or refuse the file."""

    steps_back: float = 3.0
    """A stamp further behind the newest is late, or begins a new run, [sample periods]; UDP exchanges neighbours."""
    late_s: float = 1.0
    """Largest delay of a packet after its stamp at which it is still sorted in, [s]."""
    pause_s: float = 600.0
    """A longer step ahead begins a new run, [s]: a clock that was set, or a log that was continued."""
    short_run: int = 10
    """A run of fewer rows beside others is left out: no signal can be judged on it."""
    piece_s: float = 600.0
    """A longer raw recording becomes several recordings of about this length, [s] ..."""
    piece_rows: int = 150_000
    """... or about so many samples, whichever is less: memory stays bounded."""
    most_waiting: int = 3_000_000
    """Rows that are kept until the stamps go on: no arm is sampled as often within late_s."""
    most_share: float = 0.2
    """Share of rows left out or sorted above which the file is refused: it is not what the description states ..."""
    least_refused: int = 10
    """... and the least number: fewer refuse no file, whatever its length."""


class Runs:
    """Splits the rows of one stream, block by block, where its clock begins again.

    A row behind the newest stamp begins a new run if the next row stays behind too and the time that it names was
    already recorded: a clock that starts again or is set back repeats times, late packets fill a hole. A single row far
    from its neighbours' stamps is left out.

    Args:
        left_out: called with the index of a row that is left out, counted from the stream's first.
    """

    def __init__(self, left_out: Callable[[int], object], rules: RowRules = RowRules()):
        self.number = 0
        """Number of the present run, from 0."""
        self._left_out, self._rules = left_out, rules
        self._held: Table | None = None
        self._before, self._period = 0, 0.0
        self._begin()

    def _begin(self) -> None:
        self._first: int | None = None
        self._newest, self._recent = 0, np.zeros(0, np.int64)

    def split(self, table: Table | None) -> Iterator[tuple[int, Table]]:
        """Yield the rows with the number of their run; the last row waits for the next block, or for None."""
        parts = [one for one in (self._held, table) if one is not None]
        if not parts:
            return
        t_ns = np.concatenate([one[0] for one in parts])
        end = len(t_ns) - (table is not None)
        if not self._period and len(t_ns) > 2:
            steps = np.abs(np.diff(t_ns))  # rows may come in falling order
            self._period = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
        keep, begin = np.ones(len(t_ns), bool), 0
        while begin < end:
            stop = self._run_end(t_ns, begin, end, keep)
            yield from self._kept(parts, begin, stop, keep)
            if stop < end:
                self.number += 1
                self._begin()
            begin = stop
        self._before += end
        self._held = None if table is None else (table[0][-1:], table[1][-1:])

    def _kept(self, parts: list[Table], begin: int, stop: int, keep: np.ndarray) -> Iterator[tuple[int, Table]]:
        """Rows begin to stop of the parts together, without those left out; nothing is copied where all stay."""
        before = 0
        for t_ns, values in parts:
            rows = slice(max(begin - before, 0), max(stop - before, 0))
            kept = keep[before : before + len(t_ns)][rows]
            before += len(t_ns)
            if kept.any():
                part = t_ns[rows], values[rows]
                yield self.number, (part if kept.all() else (part[0][kept], part[1][kept]))

    def _run_end(self, t_ns: np.ndarray, begin: int, end: int, keep: np.ndarray) -> int:
        """Index of the row that begins the next run, or `end`; clears `keep` of rows that are left out."""
        if self._first is None:
            self._first = self._newest = int(t_ns[begin])
        newest = np.maximum.accumulate(np.r_[self._newest, t_ns[begin:end]])
        back = self._rules.steps_back * self._period
        late_ns, pause_ns = self._rules.late_s * 1e9, self._rules.pause_s * 1e9
        odd = (t_ns[begin:end] < newest[:-1] - back) | (t_ns[begin:end] > newest[:-1] + pause_ns)
        for k in np.flatnonzero(odd) + begin:
            front, now = int(newest[k - begin]), int(t_ns[k])
            following = int(t_ns[k + 1]) if k + 1 < len(t_ns) else now
            if now > front:
                if following > front + pause_ns:
                    return int(k)
            elif following < now:
                continue  # rows in falling order
            elif following <= front:
                seen = np.r_[self._recent, t_ns[begin:k]]
                repeats = now <= self._first or now < front - late_ns
                if repeats or np.abs(seen - now).min() < 0.5 * self._period:
                    return int(k)
                continue  # a late burst fills a hole
            elif now > self._first and now >= front - late_ns:
                continue  # a late packet
            keep[k] = False
            self._left_out(self._before + int(k))
            if now > front:  # what follows is behind a wrong stamp
                newest = np.r_[newest[: k - begin + 1], np.maximum.accumulate(np.r_[front, t_ns[k + 1 : end]])]
        kept = t_ns[begin:end][keep[begin:end]]
        self._newest = max(self._newest, int(kept.max(initial=self._newest)))
        recent = np.r_[self._recent, kept]
        self._recent = recent[recent >= self._newest - late_ns]
        return end


# --- Stamps that cannot be used, and rates that contradict each other.


SHARED_STAMPS = 0.2
"""Share of rows with the stamp of the row before, and other values, from which the stamps are no clock."""
DISAGREE = 0.02
"""Two rates that differ by a larger share contradict each other."""
ARM_HZ = (5.0, 20_000.0)
"""Least and largest rate of arms' logs; a clock that counts rows gives another one."""


def expect_clock(t_ns: np.ndarray, repeated: int, remedy: str) -> None:
    """Refuse stamps of which too many are shared by several rows.

    Args:
        t_ns: (samples,), one a row, [ns].
        repeated: rows whose stamp repeats that of the row before while the values differ.
        remedy: what to do instead, a clause.
    """
    if repeated <= SHARED_STAMPS * len(t_ns) or repeated < 2:
        return
    different = np.unique(t_ns)
    if len(different) == 1:
        raise RecordingError(f"all {len(t_ns)} stamps are equal, so they are no clock; {remedy}")
    step_s = float(np.median(np.diff(different))) * 1e-9
    a_stamp, rate_hz = len(t_ns) / len(different), len(t_ns) / ((different[-1] - different[0]) * 1e-9)
    raise RecordingError(
        f"{a_stamp:.3g} rows share each stamp on average: the stamps resolve {step_s:.4g} s, and about {rate_hz:.4g} "
        f"rows come in a second; {remedy}"
    )


def expect_no_counter(t_ns: np.ndarray, unit_ns: float, column: str) -> None:
    """Refuse a column of times that counts rows: every step is one, at a rate that no log has."""
    steps = np.diff(t_ns)
    if len(steps) and (steps == unit_ns).all() and not ARM_HZ[0] <= 1e9 / unit_ns <= ARM_HZ[1]:
        raise RecordingError(
            f"column '{column}' grows by exactly 1 a row: it counts rows and is no clock; give the rate of the rows "
            'instead ([time] column = "" and rate_hz), or the column\'s unit ([time] unit)'
        )


def expect_same_rate(name: str, rate_hz: float, t_ns: np.ndarray, remedy: str) -> None:
    """Refuse a stated rate that differs from that of the stamps.

    Args:
        name: the entry that states the rate, as the message names it.
        remedy: what to do, a clause.
    """
    if len(t_ns) < 3:
        return
    measured_hz = 1e9 / fitted_period_ns(t_ns)
    if abs(measured_hz / rate_hz - 1) > DISAGREE:
        raise RecordingError(f"{name} = {rate_hz:.5g} Hz, but the stamps come at {measured_hz:.5g} Hz; {remedy}")


@dataclass
class TwoClocks:
    """Time that two clocks of the same rows count, compared over a whole recording."""

    names: tuple[str, str]
    counted_ns: list[float] = field(default_factory=lambda: [0.0, 0.0])

    def add(self, first: np.ndarray, second: np.ndarray) -> None:
        """Add the steps of a block's rows by both clocks, [ns]; those at which one is set are passed over."""
        steps = np.diff(first), np.diff(second)
        counts = (steps[0] >= 0) & (steps[1] >= 0) & (np.abs(steps[0] - steps[1]) < 1e9)
        for k in (0, 1):
            self.counted_ns[k] += float(steps[k][counts].sum())

    def expect_same(self) -> None:
        """Raise RecordingError where the clocks differ; the message names both and how to choose one."""
        a, b = self.counted_ns
        if abs(a - b) > max(DISAGREE * min(a, b), 2e8):  # messages are logged in bursts, which differ at the ends
            one, other = self.names
            raise RecordingError(
                f"its two clocks disagree: {one} counts {a * 1e-9:.5g} s, {other} {b * 1e-9:.5g} s for the same rows, "
                f"so that speeds would differ by a factor of {max(a, b) / max(min(a, b), 1):.3g}; choose one: "
                f'[time] column = "{one}" or "{other}"'
            )
