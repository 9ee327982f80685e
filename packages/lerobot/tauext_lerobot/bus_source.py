"""Common parts of sources that ask several motors of a bus: ticks, motors that stop answering, what motors report."""

from __future__ import annotations

import time
from abc import abstractmethod
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Protocol, TypeVar

import numpy as np

from tauext.errors import AwayError, ConfigError
from tauext.monitor.source import Sample
from tauext.sources.describing import LEARNT_STEPS
from tauext.sources.reader import ReaderSource, Unreachable

WAIT_S = 0.1
"""Longest wait for a tick or an answer, [s]."""
TRIES = 3
"""Attempts at a one-time request, since packets may be lost."""
REPORTED_AFTER = 5
"""Consecutive readings without a motor after which it is reported."""


class Motor(Protocol):
    """A motor of a bus; its text names it in messages."""

    @property
    def id(self) -> int: ...


AnyMotor = TypeVar("AnyMotor", bound=Motor)


class BusSource(ReaderSource):
    """A source that asks every motor of a bus once per period.

    A reading without a motor is refused and counted. A motor that stops answering is reported, and when it answers
    again.
    """

    def __init__(self, name: str):
        super().__init__(name)
        self._due_s: float | None = None
        """Time of the next request; None: now. connect() sets it to None."""
        self._names: dict[int, str] = {}
        self._in_a_row: dict[int, int] = {}
        self._missed: dict[int, int] = {}
        self._reports: dict[int, str] = {}
        self._corrupt = 0

    # For subclasses.

    @abstractmethod
    def ask(self) -> Sample | None:
        """Ask every motor once; None: one did not answer. Raises Unreachable."""

    def motors_of(self, joints: Sequence[str], path: Path, motors: Mapping[str, AnyMotor]) -> list[AnyMotor]:
        """Select the motors of the joints; missing answers of these are counted from now on.

        Args:
            path: the file that lists the motors.

        Raises:
            ConfigError: the file lacks a joint.
        """
        for name in joints:
            if name not in motors:
                raise ConfigError(f"{path}: joint '{name}' of the bundle is missing; the file has {', '.join(motors)}")
        found = [motors[name] for name in joints]
        self.robot_joints = len(found)
        self._names = {one.id: str(one) for one in found}
        self._in_a_row, self._missed = dict.fromkeys(self._names, 0), dict.fromkeys(self._names, 0)
        self._reports, self._corrupt = dict.fromkeys(self._names, ""), 0
        return found

    def whole(self, came: Collection[int], corrupt: int = 0) -> bool:
        """Whether all motors answered; counts those that did not, and unusable packets."""
        self._corrupt += corrupt
        for id_, name in self._names.items():
            row, self._in_a_row[id_] = self._in_a_row[id_], 0
            if id_ not in came:
                self._missed[id_] += 1
                self._in_a_row[id_] = row + 1
                if row + 1 == REPORTED_AFTER:
                    self._note(f"{name} does not answer: no sample until it does")
            elif row >= REPORTED_AFTER:
                self._note(f"{name} answers again, after {row} readings without it")
        whole = len(came) == len(self._names)
        self.counts.refused += not whole
        return whole

    def reports(self, id_: int, text: str) -> None:
        """Note what a motor reports, such as a fault, where it has changed; empty: no error."""
        if text != self._reports[id_]:
            self._reports[id_] = text
            self._note(f"{self._names[id_]} reports: {text}" if text else f"{self._names[id_]} reports no error")

    def several(self, wait_s: float) -> list[Sample]:
        """As many samples as a rate is learnt from, fewer after wait_s. Raises Unreachable: none."""
        samples, until = list[Sample](), time.monotonic() + wait_s
        while len(samples) <= LEARNT_STEPS and time.monotonic() < until:
            if (sample := self.ask()) is not None:
                samples.append(sample)
        if not samples:
            raise Unreachable("; ".join(self.notes()) or "no reading in which every motor answered")
        return samples

    # The interface of a source, and of a reader.

    def read(self) -> Sample | None:
        """Ask at the next tick, one period after the last whatever the answers' delays; skipped ticks are lost."""
        now_s, period_s = time.monotonic(), self.settings.period_ns * 1e-9
        due_s = now_s if self._due_s is None else self._due_s
        if (left_s := due_s - now_s) > 0:
            time.sleep(min(left_s, WAIT_S))
            if left_s > WAIT_S:
                return None
        skipped = max(0, int((time.monotonic() - due_s) // period_s))
        self.counts.lost += skipped
        self._due_s = due_s + (1 + skipped) * period_s
        return self.ask()

    def _count_lost(self, t_ns: int) -> None:
        """Do nothing: stamps are times of requests, and skipped requests are counted in read()."""

    def close(self) -> None:
        super().close()
        if any(self._missed.values()):
            by_name = ", ".join(f"{self._names[id_]} in {count}" for id_, count in self._missed.items() if count)
            packets = f"; {self._corrupt} unusable packets" if self._corrupt else ""
            self._note(f"{self.name}: a servo was missing in {self.counts.refused} readings: {by_name}{packets}")
            self._missed = {}


def shortest_period_ns(samples: Sequence[Sample], periods_ms: Sequence[float], arm: str, least_ns: float = 0.0) -> int:
    """The shortest of the periods [ms] in which a reading fits twice.

    Args:
        samples: readings, whose median time from request to sample counts.
        least_ns: shortest time of a reading by its bytes, [ns].

    Raises:
        AwayError: there is none.
    """
    reading_ns = max(least_ns, float(np.median([one.received_ns - one.t_ns for one in samples])))
    for period_ns in (round(ms * 1e6) for ms in periods_ms):
        if 2 * reading_ns <= period_ns:
            return period_ns
    raise AwayError(
        f"{arm}: a reading takes {reading_ns * 1e-6:.3g} ms, more than half of the longest period, "
        f"{periods_ms[-1]:g} ms: set a higher baud rate, or put fewer motors on the bus"
    )
