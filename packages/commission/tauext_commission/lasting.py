"""A source that lasts: where one is lost for good, a new object of its kind connects again."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import astuple, replace
from pathlib import Path

from tauext.errors import AwayError, ConfigError
from tauext.monitor.source import (
    Commanded,
    Describes,
    Sample,
    Source,
    SourceCounts,
    SourceFacts,
    SourceSettings,
    StopChecked,
    Stoppable,
)
from tauext.sources.describing import LEARNT_STEPS, learnt_period_ns, why_another

RETRY_S, LONGEST_RETRY_S = 1.0, 30.0
"""Time before the first attempt, which doubles, and the longest one, [s]."""
SILENT_S = 2.0
"""Time without a sample after which a source that is open counts as away, [s]."""
MOST_JUDGED = 10 * LEARNT_STEPS
"""Samples in which a usable clock shows its rate; without one the monitor reports the stamps."""
DESCRIBE_S = 10.0
"""Longest wait for an arm that describes itself again, [s]."""


class LastingSource:
    """Passes on the samples of one source after the other, and never ends.

    A source that ends or cannot be opened is closed and replaced, in a thread of its own. The new one must describe the
    same arm. A source that connects again by itself is not described again: after a silence its samples are held back
    until they have shown the arm's rate. Its joints are its own to check.
    """

    def __init__(
        self,
        first: Source,
        again: Callable[[], Source],
        facts: SourceFacts,
        robot: Path | None = None,
        is_described: bool = True,
    ):
        """
        Args:
            first: not open yet.
            again: makes a new one; may raise ConfigError.
            facts: description of the arm, which must stay the same.
            robot: robot file, as describe() got it.
            is_described: whether `first` has just described this arm; False: it was away.
        """
        self.name = first.name
        self._first, self._again, self._facts, self._robot = first, again, facts, robot
        self._source: Source | None = None
        self._next: Source | None = None
        self._before = SourceCounts()
        self._why, self._last_ns = "", 0
        self._judged: list[int] | None = None if is_described else []
        """Stamps since the last silence, while the rate is not confirmed; None: it is."""
        self._notes: list[str] = []
        self._closed, self._ready = threading.Event(), threading.Event()
        self._thread: threading.Thread | None = None

    def open(self, settings: SourceSettings) -> None:
        self._settings = settings
        try:
            self._first.open(settings)
        except ConfigError as error:
            self._replace(self._first, str(error))
        else:
            self._source = self._first

    def next_sample(self, timeout_s: float) -> Sample | None:
        if self._source is None:
            if not self._ready.wait(timeout_s):
                return None
            self._ready.clear()
            self._source, self._next, self._why = self._next, None, ""
            if self._source is None:  # closed meanwhile
                return None
            self._judged, self._last_ns = None, time.monotonic_ns()  # it has just been described
            self._notes.append(f"{self.name} is back")
        sample = self._source.next_sample(timeout_s)
        if sample is not None:
            if self._last_ns and sample.received_ns - self._last_ns > SILENT_S * 1e9:
                self._judged = []
            self._last_ns = sample.received_ns
            if self._judged is not None and not self._has_rate(self._judged, sample.t_ns):
                self._before.refused += 1
                return None
        elif self._source.ended:
            self._notes += self._source.notes()
            self._before = self.counts
            lost, self._source = self._source, None
            self._replace(lost, "it has ended")
        return sample

    def _has_rate(self, judged: list[int], t_ns: int) -> bool:
        """Whether the samples since a silence have the rate of the arm; False: not known yet, or it is another arm."""
        judged.append(t_ns)
        if len(judged) <= LEARNT_STEPS:
            return False
        known, other = self._facts, ""
        try:
            period_ns = learnt_period_ns(judged, self.name)
            other = why_another(known, replace(known, settings=replace(known.settings, period_ns=period_ns)))
        except AwayError:  # stamps that do not rise
            if len(judged) < MOST_JUDGED:
                return False
        if not other:
            if self._why:
                self._notes.append(f"{self.name} is back")
            self._judged, self._why = None, ""
            return True
        judged.clear()
        self._be_away(f"the source does not match this folder: {other}")
        return False

    def _be_away(self, why: str) -> None:
        """Report a new reason why no sample comes."""
        if why != self._why:
            self._why = why
            self._notes.append(f"{self.name} is away: {why}")

    @property
    def away(self) -> str:
        """Why no sample comes now; empty: samples come."""
        silent_s = (time.monotonic_ns() - self._last_ns) * 1e-9
        return self._why or (f"no sample for {silent_s:.0f} s" if self._last_ns and silent_s > SILENT_S else "")

    @property
    def counts(self) -> SourceCounts:
        """Counts of all sources so far."""
        now = SourceCounts() if self._source is None else self._source.counts
        return SourceCounts(*(a + b for a, b in zip(astuple(self._before), astuple(now), strict=True)))

    @property
    def ended(self) -> bool:
        return self._closed.is_set()

    def notes(self) -> list[str]:
        notes, self._notes = self._notes, []
        return notes + (self._source.notes() if self._source is not None else [])

    def command(self, text: str) -> None:
        source = self._source
        if not isinstance(source or self._first, Commanded):
            raise ConfigError(f"{text[:60]!r}: source {self.name} takes no commands; sim:ARM does")
        if source is None:
            raise ConfigError(f"{self.name} is away: {self._why}")
        source.command(text)  # type: ignore[attr-defined]

    def check_stop(self) -> None:
        if not isinstance(self._first, Stoppable):
            raise ConfigError(f"{self.name} cannot stop its robot: leave `stop = true` out")
        if isinstance(self._first, StopChecked):
            self._first.check_stop()

    def stop(self) -> None:
        if self._source is None:
            raise RuntimeError(f"{self.name} is away: {self._why}")
        self._source.stop()  # type: ignore[attr-defined]

    def close(self) -> None:
        self._closed.set()
        if self._thread is not None:
            self._thread.join(2.0)
        for source in (self._source, self._next):
            if source is not None:
                source.close()
                self._notes += source.notes()
        self._source = self._next = None

    def _replace(self, lost: Source, why: str) -> None:
        self._why = why
        self._notes.append(f"{self.name} is away: {why}; it is tried again")
        self._thread = threading.Thread(target=self._work, args=(lost,), name=f"retry of {self.name}", daemon=True)
        self._thread.start()

    def _work(self, lost: Source) -> None:
        with suppress(Exception):  # of a library, on a dead link
            lost.close()
        wait_s = RETRY_S
        while not self._closed.wait(wait_s):
            source: Source | None = None
            try:
                source = self._again()
                if isinstance(source, Describes):
                    found = source.describe(DESCRIBE_S, self._robot)
                    if other := why_another(self._facts, found):
                        raise ConfigError(f"the source does not match this folder: {other}")
                source.open(self._settings)
            except Exception as error:  # of a library too: an arm that is away for a night must be found in the morning
                if source is not None:
                    with suppress(Exception):
                        source.close()
                self._be_away(f"{error}" or type(error).__name__)
                wait_s = min(2 * wait_s, LONGEST_RETRY_S)
                continue
            if self._closed.is_set():
                source.close()
                return
            self._next = source
            self._ready.set()
            return
