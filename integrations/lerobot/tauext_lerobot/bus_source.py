"""Common parts of sources that read several motors of a bus: ticks, and motors that stop answering."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import TypeVar

from tauext.errors import AwayError, ConfigError
from tauext.files.places import Place
from tauext.monitor.source import SourceSettings
from tauext.sources.reader import ReaderSource, Unreachable

REPORTED_AFTER = 5
"""Consecutive readings without a motor after which it is reported."""
Motor = TypeVar("Motor")


class DropOuts:
    """Counts readings without a servo; reports when a servo stops answering and when it answers again."""

    def __init__(self, names: dict[int, str], note: Callable[[str], None]):
        """names: names of the servos by id."""
        self._names, self._note = names, note
        self._in_a_row = dict.fromkeys(names, 0)
        self.missed = dict.fromkeys(names, 0)
        """Readings without the servo, by id."""
        self.corrupt = self.refused = 0
        """Unusable packets; readings in which a servo was missing."""

    def whole(self, came: Collection[int], corrupt: int) -> bool:
        """Whether all servos answered; counts those that did not."""
        self.corrupt += corrupt
        for id_, name in self._names.items():
            if id_ not in came:
                self.missed[id_] += 1
                self._in_a_row[id_] += 1
                if self._in_a_row[id_] == REPORTED_AFTER:
                    self._note(f"{name} does not answer: no sample until it does")
            else:
                if self._in_a_row[id_] >= REPORTED_AFTER:
                    self._note(f"{name} answers again, after {self._in_a_row[id_]} readings without it")
                self._in_a_row[id_] = 0
        missing = len(came) < len(self._names)
        self.refused += missing
        return not missing

    def summary(self) -> str:
        """One line about missing servos; empty: none was missing."""
        if not self.refused:
            return ""
        by_name = ", ".join(f"{self._names[id_]} in {count}" for id_, count in self.missed.items() if count)
        packets = f"; {self.corrupt} unusable packets" if self.corrupt else ""
        return f"a servo was missing in {self.refused} readings: {by_name}{packets}"

    def forget(self) -> None:
        """Restart the count."""
        self.refused = self.corrupt = 0
        self.missed = dict.fromkeys(self._names, 0)


class BusSource(ReaderSource):
    """A source that reads several motors of a bus."""

    _drop_outs: DropOuts | None = None

    def motors_of(self, settings: SourceSettings, path: Place, motors: Mapping[str, Motor]) -> list[Motor]:
        """Select the motors of the bundle's joints; missing answers of these are counted.

        Args:
            path: the file that lists the motors.

        Raises:
            ConfigError: the file lacks a joint.
        """
        for name in settings.joints:
            if name not in motors:
                raise ConfigError(f"{path}: joint '{name}' of the bundle is missing; the file has {', '.join(motors)}")
        found = [motors[name] for name in settings.joints]
        self.robot_joints = len(found)
        self._drop_outs = DropOuts({one.id: str(one) for one in found}, self._note)  # type: ignore[attr-defined]
        return found

    def _all_came(self, ids: Collection[int], corrupt: int = 0) -> bool:
        """Whether all motors answered; counts the reading as refused where one did not."""
        assert self._drop_outs is not None  # since open()
        whole = self._drop_outs.whole(ids, corrupt)
        self.counts.refused += not whole
        return whole

    def close(self) -> None:
        super().close()
        if self._drop_outs is not None and (summary := self._drop_outs.summary()):
            self._note(f"{self.name}: {summary}")
            self._drop_outs.forget()


def expect_answers(readings: int, notes: list[str]) -> None:
    """Raise Unreachable, with the notes of the bus, if no reading was whole."""
    if not readings:
        raise Unreachable("; ".join(notes) or "no reading in which every motor answered")


def shortest_period_ns(reading_ns: float, periods_ns: Sequence[int], arm: str) -> int:
    """The shortest of the periods in which a reading, [ns], fits twice.

    Raises:
        AwayError: there is none.
    """
    for period_ns in periods_ns:
        if 2 * reading_ns <= period_ns:
            return period_ns
    raise AwayError(
        f"{arm}: a reading takes {reading_ns * 1e-6:.3g} ms, more than half of the longest period, "
        f"{periods_ns[-1] * 1e-6:g} ms: set a higher baud rate, or put fewer motors on the bus"
    )


# --- Time of the next request on a bus: one per period, independent of the answers' delays.


class Ticks:
    """Ticks one period apart, starting at the first wait(); missed ticks are skipped."""

    def __init__(
        self,
        period_s: float,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ):
        """clock and sleep are in seconds."""
        self._period_s, self._clock, self._sleep = period_s, clock, sleep
        self._due_s: float | None = None

    def wait(self, most_s: float) -> int | None:
        """Wait for the next tick; returns how many were skipped before it. None: it is not due within most_s."""
        now_s = self._clock()
        due_s = now_s if self._due_s is None else self._due_s
        if (left_s := due_s - now_s) > 0:
            self._sleep(min(left_s, most_s))
            if left_s > most_s:
                return None
        skipped = max(0, int((self._clock() - due_s) // self._period_s))
        self._due_s = due_s + (1 + skipped) * self._period_s
        return skipped
