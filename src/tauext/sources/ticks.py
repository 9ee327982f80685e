"""When to ask a bus next: once a period by the clock, whatever an answer took."""

from __future__ import annotations

import time
from collections.abc import Callable


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
