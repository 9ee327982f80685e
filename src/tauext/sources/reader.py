"""What sources that read in a thread have in common: queue, ticks, disconnection."""

from __future__ import annotations

import importlib
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from tauext.errors import ConfigError
from tauext.monitor.source import Sample, SourceCounts, SourceSettings

# --- Between the thread that receives samples and the loop: bounded, the newest wins, what is pushed out is counted.


CAPACITY = 64
"""A loop that is this many samples behind has a gap at its hands anyway."""


class SampleQueue:
    """Samples in their order; any thread may put, one thread takes."""

    def __init__(self, counts: SourceCounts, capacity: int = CAPACITY):
        """counts: `received` counts every put, `overrun` what was pushed out."""
        self._counts, self._capacity = counts, capacity
        self._samples: deque[Sample] = deque()
        self._changed = threading.Condition()
        self._closed = False

    def put(self, sample: Sample) -> None:
        """Never waits: where the queue is full, the oldest goes."""
        with self._changed:
            self._counts.received += 1
            if len(self._samples) == self._capacity:
                self._samples.popleft()
                self._counts.overrun += 1
            self._samples.append(sample)
            self._changed.notify()

    def take(self, timeout_s: float) -> Sample | None:
        """The oldest one; None where none came for timeout_s or the queue is closed and empty."""
        until = time.monotonic() + timeout_s
        with self._changed:
            while not self._samples:
                left = until - time.monotonic()
                if self._closed or left <= 0 or not self._changed.wait(left):
                    break
            return self._samples.popleft() if self._samples else None

    def close(self) -> None:
        """No more will be put: who waits is let go, and what is there can still be taken."""
        with self._changed:
            self._closed = True
            self._changed.notify()

    @property
    def ended(self) -> bool:
        """Closed, and everything was taken."""
        return self._closed and not self._samples


# --- What sources have in common that read a robot in a thread of their own.


RETRY_S = 1.0
"""Between attempts to reach a robot that has gone."""


class Unreachable(Exception):
    """The robot is not there, or went; says why."""


def optional_library(module: str, who: str, package: str, extra: str) -> Any:
    """A module of a library that only one source needs.

    Raises:
        ConfigError: it is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ConfigError(f"{who} needs {package}: pip install 'tauext[{extra}]'") from error


class ReaderSource(ABC):
    """Connects, reads sample after sample into a queue, and connects anew where the robot goes.

    At open() the robot must be there: a wrong address is told at once.
    """

    robot_joints: int
    """That its samples have."""

    def __init__(self, name: str):
        self.name, self.counts = name, SourceCounts()
        self._notes: list[str] = []
        self._closed = threading.Event()
        self._thread: threading.Thread | None = None
        self._last_ns: int | None = None

    # Of the robot; the reader's thread, connect() at first the loop's.

    @abstractmethod
    def connect(self) -> None:
        """Raises Unreachable."""

    @abstractmethod
    def read(self) -> Sample | None:
        """Wait for the next sample, for a tenth of a second at most; None: there was none. Raises Unreachable."""

    @abstractmethod
    def disconnect(self) -> None:
        """May be called without a connection."""

    # Of a source.

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
            raise ConfigError(f"{self.name}: {error}") from error
        self._thread = threading.Thread(target=self._work, name=f"reader of {self.name}", daemon=True)
        self._thread.start()

    def next_sample(self, timeout_s: float) -> Sample | None:
        return self._queue.take(timeout_s)

    @property
    def ended(self) -> bool:
        return self._thread is not None and self._queue.ended

    def notes(self) -> list[str]:
        told, self._notes = self._notes, []
        return told

    def _note(self, text: str) -> None:
        """Keeps the text for the next notes()."""
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
                    self._note(f"{self.name} is gone: {error}; trying again")
                    self._reconnect()
                    continue
                if sample is not None:
                    self._count_lost(sample.t_ns)
                    self._queue.put(sample)
        except Exception as error:  # a library's own: the loop ends, and says so
            self._note(f"{self.name} cannot be read any more: {type(error).__name__}: {error}")
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
            self._note(f"{self.name} is there again")
            return

    def _count_lost(self, t_ns: int) -> None:
        if self._last_ns is not None:
            self.counts.lost += max(0, round((t_ns - self._last_ns) / self.settings.period_ns) - 1)
        self._last_ns = t_ns


def sample_of(
    t_s: float, q: list[float], dq: list[float], tau: np.ndarray, temperature: np.ndarray | None = None
) -> Sample:
    """A sample that has just come in, from what a robot's library gives."""
    signals = (np.array(q, dtype=float), np.array(dq, dtype=float), tau)
    return Sample(round(t_s * 1e9), *signals, time.monotonic_ns(), temperature)


# --- When to ask a bus next: once a period by the clock, whatever an answer took.


class Ticks:
    """Times a period apart, from the first wait() on; those that have passed meanwhile are skipped for good."""

    def __init__(
        self,
        period_s: float,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ):
        """clock and sleep count in seconds."""
        self._period_s, self._clock, self._sleep = period_s, clock, sleep
        self._due_s: float | None = None

    def wait(self, most_s: float) -> int | None:
        """Wait for the next one; how many were skipped before it. None: it is still off after most_s."""
        now_s = self._clock()
        due_s = now_s if self._due_s is None else self._due_s
        if (left_s := due_s - now_s) > 0:
            self._sleep(min(left_s, most_s))
            if left_s > most_s:
                return None
        skipped = max(0, int((self._clock() - due_s) // self._period_s))
        self._due_s = due_s + (1 + skipped) * self._period_s
        return skipped
