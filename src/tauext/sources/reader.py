"""Common parts of sources that read in a thread: queue, ticks, disconnection."""

from __future__ import annotations

import importlib
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from tauext.errors import AwayError, ConfigError
from tauext.files.places import Place
from tauext.monitor.source import Sample, SourceCounts, SourceFacts, SourceSettings

# --- Bounded queue between the receiving thread and the loop. The newest samples win; dropped ones are counted.


CAPACITY = 64
"""Samples; a loop this far behind has a gap in any case."""


class SampleQueue:
    """Samples in order; any thread may put, one thread takes."""

    def __init__(self, counts: SourceCounts, capacity: int = CAPACITY):
        """counts: `received` counts every put, `overrun` every dropped sample."""
        self._counts, self._capacity = counts, capacity
        self._samples: deque[Sample] = deque()
        self._changed = threading.Condition()
        self._closed = False

    def put(self, sample: Sample) -> None:
        """Add a sample without waiting; a full queue drops its oldest sample."""
        with self._changed:
            self._counts.received += 1
            if len(self._samples) == self._capacity:
                self._samples.popleft()
                self._counts.overrun += 1
            self._samples.append(sample)
            self._changed.notify()

    def take(self, timeout_s: float) -> Sample | None:
        """Remove the oldest sample; None if none arrived within timeout_s or the queue is closed and empty."""
        until = time.monotonic() + timeout_s
        with self._changed:
            while not self._samples:
                left = until - time.monotonic()
                if self._closed or left <= 0 or not self._changed.wait(left):
                    break
            return self._samples.popleft() if self._samples else None

    def close(self) -> None:
        """End the queue: wakes a waiting take(); remaining samples can still be taken."""
        with self._changed:
            self._closed = True
            self._changed.notify()

    @property
    def ended(self) -> bool:
        """Whether the queue is closed and empty."""
        return self._closed and not self._samples


# --- Common base of sources that read a robot in their own thread.


RETRY_S = 1.0
"""Time between attempts to reconnect, [s]."""


class Unreachable(Exception):
    """The robot cannot be reached or the connection is lost; the text is the reason."""


class Misfit(Unreachable):
    """The robot answers, but does not fit a file or an option: a later attempt fails, too."""


def refusal(name: str, error: Unreachable) -> ConfigError:
    """The error of a source of this name that cannot be described or opened."""
    kind = ConfigError if isinstance(error, Misfit) else AwayError
    return kind(f"{name}: {error}")


def optional_library(module: str, who: str, package: str, extra: str) -> Any:
    """Import a module of a library that only one source needs.

    Raises:
        ConfigError: the library is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ConfigError(f"{who} needs {package}: pip install 'tauext[{extra}]'") from error


class ReaderSource(ABC):
    """Connects, reads samples into a queue, and reconnects when the connection is lost.

    The robot must be reachable at open(), so that a wrong address is reported at once.
    """

    robot_joints: int
    """Number of joints in a sample."""

    def __init__(self, name: str):
        self.name, self.counts = name, SourceCounts()
        self._notes: list[str] = []
        self._closed = threading.Event()
        self._thread: threading.Thread | None = None
        self._last_ns: int | None = None

    # For subclasses. The reader's thread calls these; the first connect() is called by the loop's thread.

    @abstractmethod
    def connect(self) -> None:
        """Connect to the robot. Raises Unreachable."""

    @abstractmethod
    def read(self) -> Sample | None:
        """Wait for the next sample, at most 0.1 s; None: none arrived. Raises Unreachable."""

    @abstractmethod
    def disconnect(self) -> None:
        """Close the connection; also called without one."""

    @abstractmethod
    def find_out(self, wait_s: float, robot: Path | None) -> SourceFacts:
        """Connect, and describe the arm, see Describes; describe() disconnects. Raises Unreachable."""

    # The interface of a source.

    def describe(self, wait_s: float, robot: Path | None = None) -> SourceFacts:
        try:
            return self.find_out(wait_s, robot)
        except Unreachable as error:
            raise refusal(self.name, error) from error
        finally:
            self.disconnect()

    def open(self, settings: SourceSettings) -> None:
        if len(settings.joints) != self.robot_joints:
            raise ConfigError(
                f"{self.name} has {self.robot_joints} joints, the bundle {len(settings.joints)}: "
                f"{', '.join(settings.joints)}"
            )
        self.settings, self._queue = settings, SampleQueue(self.counts)
        try:
            self.connect()
        except Unreachable as error:
            raise refusal(self.name, error) from error
        self._thread = threading.Thread(target=self._work, name=f"reader of {self.name}", daemon=True)
        self._thread.start()

    def next_sample(self, timeout_s: float) -> Sample | None:
        return self._queue.take(timeout_s)

    @property
    def ended(self) -> bool:
        return self._thread is not None and self._queue.ended

    def notes(self) -> list[str]:
        notes, self._notes = self._notes, []
        return notes

    def _note(self, text: str) -> None:
        """Keep a text for the next notes()."""
        self._notes.append(text)

    def close(self) -> None:
        self._closed.set()
        if self._thread is not None:
            self._thread.join(2.0)
        self.disconnect()

    def _work(self) -> None:
        try:
            while not self._closed.is_set():
                try:
                    sample = self.read()
                except Unreachable as error:
                    self._note(f"{self.name} is disconnected: {error}; reconnecting")
                    self._reconnect()
                    continue
                if sample is not None:
                    self._count_lost(sample.t_ns)
                    self._queue.put(sample)
        except Exception as error:  # a library's own error: the loop ends, with a note
            self._note(f"{self.name} cannot be read: {type(error).__name__}: {error}")
        finally:
            self._queue.close()

    def _reconnect(self) -> None:
        self._last_ns = None
        while not self._closed.wait(RETRY_S):
            try:
                self.disconnect()
                self.connect()
            except Unreachable:
                continue
            self._note(f"{self.name} is reconnected")
            return

    def _count_lost(self, t_ns: int) -> None:
        if self._last_ns is not None:
            self.counts.lost += max(0, round((t_ns - self._last_ns) / self.settings.period_ns) - 1)
        self._last_ns = t_ns


# --- Several motors on a bus, some of which may stop answering.


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


def sample_of(
    t_s: float, q: list[float], dq: list[float], tau: np.ndarray, temperature: np.ndarray | None = None
) -> Sample:
    """A sample received now, from the values of a robot's library."""
    signals = (np.array(q, dtype=float), np.array(dq, dtype=float), tau)
    return Sample(round(t_s * 1e9), *signals, time.monotonic_ns(), temperature)


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
