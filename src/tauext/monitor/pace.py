"""Lets the time of a recording pass as time on the wall does."""

from __future__ import annotations

import time
from collections.abc import Callable


class Pace:
    """A sample is there once its time has come: the recording runs `speed` times as fast as it was recorded.

    A replay that fell behind does not wait until it has caught up. Times that go backwards are not waited for.
    """

    def __init__(
        self,
        speed: float | None,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ):
        """speed: None for as fast as it can. clock and sleep count in seconds."""
        self.speed = speed
        self._clock, self._sleep = clock, sleep
        self._began: tuple[float, int] | None = None

    def wait_until(self, t_ns: int) -> None:
        """Return when the sample of this stamp has been recorded; the first call starts the time and waits for none."""
        left_s = self.left_s(t_ns)
        if left_s > 0:
            self._sleep(left_s)

    def left_s(self, t_ns: int) -> float:
        """Until then, on the wall, [s]; 0 or negative where its time has come. The first call starts the time, too."""
        if self.speed is None:
            return 0.0
        if self._began is None:
            self._began = (self._clock(), t_ns)
        clock_s, first_ns = self._began
        return clock_s + (t_ns - first_ns) * 1e-9 / self.speed - self._clock()
