"""What sources have in common that read a robot in a thread of their own."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod

import numpy as np

from tauext.errors import ConfigError
from tauext.monitor.source import Sample, SourceCounts, SourceSettings
from tauext.sources.sample_queue import SampleQueue

RETRY_S = 1.0
"""Between attempts to reach a robot that has gone."""


class Unreachable(Exception):
    """The robot is not there, or went; says why."""


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
