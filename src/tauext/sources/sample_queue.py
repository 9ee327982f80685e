"""Between the thread that receives samples and the loop: bounded, the newest wins, what is pushed out is counted."""

from __future__ import annotations

import threading
import time
from collections import deque

from tauext.monitor.source import Sample, SourceCounts

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
