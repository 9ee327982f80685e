"""Common parts of sources that read in a thread: queue, disconnection."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from pathlib import Path

import numpy as np

from tauext.errors import AwayError, ConfigError
from tauext.monitor.source import Sample, SourceCounts, SourceFacts, SourceSettings

# --- Bounded queue between the receiving thread and the loop. The newest samples win; dropped ones are counted.


class SampleQueue:
    """Samples in order; any thread may put, one thread takes."""

    def __init__(self, counts: SourceCounts, capacity: int = 1000):
        """counts: `received` counts every put, `overrun` every dropped sample.

        capacity: a second at 1 kHz, from which a late loop catches up in a few milliseconds.
        """
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


# --- What robots' libraries return.


def sample_of(
    t_s: float, q: list[float], dq: list[float], tau: np.ndarray, temperature: np.ndarray | None = None
) -> Sample:
    """A sample received now, from the values of a robot's library."""
    signals = (np.array(q, dtype=float), np.array(dq, dtype=float), tau)
    return Sample(round(t_s * 1e9), *signals, time.monotonic_ns(), temperature)
