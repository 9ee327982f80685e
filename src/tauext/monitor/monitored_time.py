"""Share of the time in which a live arm was monitored: a valid estimate came, and in time."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

from tauext._core import cause_names

MINUTE_S, HOUR_S = 60.0, 3600.0
PARTLY, BLIND = 0.99, 0.9
"""Shares of the last minute below which the arm was not fully monitored, and hardly monitored."""
LATE_S = 0.1
"""Longest wait between two estimates, and greatest age of a sample at its estimate, that count as monitored, [s]."""
LEAST_S = 10.0
"""Counted time before a share is stated, [s]."""
CAME_LATE = "samples came late or not at all"


@dataclass(frozen=True)
class Monitored:
    """Monitored time of a loop, counted from its first valid estimate on."""

    minute: float = math.nan
    """Share of the last minute, 0 to 1; NaN until LEAST_S are counted."""
    hour: float = math.nan
    """Share of the last hour; NaN as above."""
    seconds: float = 0.0
    """Monitored time since the start of the loop, [s]."""
    of_seconds: float = 0.0
    """Counted time since then, [s]."""
    why: str = ""
    """Why some of the last minute was not monitored; empty: all was."""

    @property
    def level(self) -> int:
        """0: monitored, or not stated yet; 1: below PARTLY; 2: below BLIND."""
        return (self.minute < PARTLY) + (self.minute < BLIND)


class _Window:
    """Sums over the newest seconds."""

    def __init__(self, span_s: float):
        self._span_ns, self._rows = span_s * 1e9, deque[tuple[int, int, int]]()
        self.good_ns = self.total_ns = 0

    def add(self, good_ns: int, total_ns: int, causes: int) -> None:
        self._rows.append((good_ns, total_ns, causes))
        self.good_ns, self.total_ns = self.good_ns + good_ns, self.total_ns + total_ns
        while len(self._rows) > 1 and self.total_ns - self._rows[0][1] >= self._span_ns:
            good, total, _ = self._rows.popleft()
            self.good_ns, self.total_ns = self.good_ns - good, self.total_ns - total

    @property
    def share(self) -> float:
        return self.good_ns / self.total_ns if self.total_ns >= LEAST_S * 1e9 else math.nan

    @property
    def causes(self) -> int:
        found = 0
        for good, total, causes in self._rows:
            found |= causes if good < total else 0
        return found


class MonitoredTime:
    """Counts in the loop's thread: a few integers a block of samples, a row a second.

    A sample that is judged at most LATE_S after it came, and after the estimate before, counts as monitored, although
    it was missing for a while.
    """

    def __init__(self, missing_after_s: float):
        """missing_after_s: time after which the loop counts a sample as missing."""
        self._longest_ns = round(max(LATE_S, missing_after_s) * 1e9)
        self._last_ns: int | None = None
        self._is_silent = False
        self._good_ns = self._total_ns = self._causes = 0
        self._minute, self._hour = _Window(MINUTE_S), _Window(HOUR_S)
        self._all_good_ns = self._all_ns = 0

    def add(self, now_ns: int, valid: float, causes: int = 0) -> None:
        """Count the time since the last estimate.

        Args:
            now_ns: when the estimates were there, by time.monotonic_ns().
            valid: share of them whose health is ok and that came in time; the count begins with a whole one.
            causes: bits of the causes of a bad health.
        """
        self._is_silent = False
        self._count(now_ns, valid, causes)

    def miss(self, now_ns: int, causes: int) -> None:
        """Count a silence once it is longer than a late sample may take; before that, the next estimate decides."""
        if self._last_ns is not None and (self._is_silent or now_ns - self._last_ns > self._longest_ns):
            self._is_silent = True
            self._count(now_ns, 0.0, causes)

    def _count(self, now_ns: int, valid: float, causes: int) -> None:
        last_ns = self._last_ns
        if last_ns is None:
            self._last_ns = now_ns if valid == 1 else None
            return
        self._last_ns, wait_ns = now_ns, now_ns - last_ns
        self._total_ns += wait_ns
        if wait_ns <= self._longest_ns:
            self._good_ns += round(valid * wait_ns)
        if valid < 1 or wait_ns > self._longest_ns:
            self._causes |= causes

    def second(self) -> Monitored:
        """Close a second; the shares up to now."""
        if self._total_ns:
            for window in (self._minute, self._hour):
                window.add(self._good_ns, self._total_ns, self._causes)
            self._all_good_ns, self._all_ns = self._all_good_ns + self._good_ns, self._all_ns + self._total_ns
            self._good_ns = self._total_ns = self._causes = 0
        minute, why = self._minute, ""
        if minute.good_ns < minute.total_ns:
            names = cause_names(minute.causes)
            # A busy computer or a bad connection produces the other ones.
            other = [name for name in names if name not in ("missing sample", "gap", "late sample", "wrong rate")]
            why = ", ".join(other) if other else CAME_LATE
        return Monitored(minute.share, self._hour.share, self._all_good_ns * 1e-9, self._all_ns * 1e-9, why)


def percent(share: float) -> str:
    """`97.2 %`; rounded down, so that only a whole is 100 %."""
    return f"{math.floor(1000 * share + 1e-9) / 10:.1f} %".replace("100.0 %", "100 %")


class MonitoredNews:
    """Lines about the monitored share when its level changes: at most three in ten minutes, however it flickers."""

    def __init__(self, remedy: str, quiet_s: float = 600.0, again_s: float = 60.0):
        """
        Args:
            remedy: what a person can do if samples come late or not at all.
            quiet_s: least time between two lines about the share, [s], unless it has become worse.
            again_s: time without loss after which a line reports that all is monitored again, [s].
        """
        self._quiet_s, self._again_s = quiet_s, again_s
        self._remedy = remedy
        self._reported = self._worst = 0
        self._line_s, self._bad_s = -math.inf, -math.inf

    def line(self, now_s: float, monitored: Monitored) -> str:
        """A line to print; empty: none. now_s: monotonic time, [s]."""
        level = monitored.level
        if now_s >= self._line_s + self._quiet_s:
            self._worst = 0
        if level:
            self._bad_s = now_s
            if level <= max(self._reported, self._worst):
                return ""
            self._reported = self._worst = level
            self._line_s = now_s
            return blind_words(monitored, self._remedy)
        if self._reported and now_s >= self._bad_s + self._again_s:
            self._reported = 0
            return f"monitored {percent(monitored.minute)} of the last minute again"
        return ""


def blind_words(monitored: Monitored, remedy: str) -> str:
    """`ONLY 62.0 % OF THE LAST MINUTE WAS MONITORED: samples came late or not at all; close other programs`."""
    words = f"only {percent(monitored.minute)} of the last minute was monitored"
    words = words.upper() if monitored.level == 2 else words
    return f"{words}: {monitored.why}" + (f"; {remedy}" if monitored.why == CAME_LATE and remedy else "")
