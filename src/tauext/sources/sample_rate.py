"""From the publisher's rate to the bundle's: every n-th sample, by time stamps."""

from __future__ import annotations

import statistics

LEARNT_FROM = 21
"""Samples that the rate is learnt from; none of them is given on, as the monitor would see a wrong rate."""
TOLERANCE = 0.05
"""What the monitor calls another rate."""
CHANGED = 0.2
"""A rate that differs by so much from the one learnt is another one; less is jitter."""


class SampleRate:
    """Learns a publisher's period from stamps, then says of each sample whether the bundle's rate wants it.

    A publisher at n times the bundle's rate has every n-th sample taken, in slots of the bundle's period counted from
    the first; a lost sample is replaced by its neighbour. One at any other rate is given on whole, for the monitor to
    name the wrong rate.
    """

    def __init__(self, period_ns: int):
        """period_ns: of the bundle."""
        self._wanted_ns = period_ns
        self.forget()

    def forget(self) -> None:
        """Learn anew: another publisher."""
        self.period_ns: int | None = None
        """Of the publisher; None until it is learnt."""
        self.factor = 1
        self.lost = 0
        """By gaps of the stamps, since it was learnt."""
        self._steps: list[int] = []
        self._last_ns: int | None = None
        self._due_ns: int | None = None

    def wants(self, t_ns: int) -> bool:
        """Whether the sample at t_ns, later than the one before it, is to be given on."""
        last_ns, self._last_ns = self._last_ns, t_ns
        if last_ns is None:
            return False
        step_ns = t_ns - last_ns
        if self.period_ns is not None:
            self.lost += max(0, round(step_ns / self.period_ns) - 1)
        self._learn(step_ns)
        if self.period_ns is None:
            return False
        if self.factor == 1:
            return True
        if self._due_ns is None or t_ns - self._due_ns > self._wanted_ns:
            self._due_ns = t_ns
        if t_ns < self._due_ns - self.period_ns // 2:
            return False
        self._due_ns += self._wanted_ns
        return True

    @property
    def problem(self) -> str | None:
        """What is wrong with the publisher's rate, in words."""
        if self.period_ns is None:
            return None
        is_hz, wanted_hz = 1e9 / self.period_ns, 1e9 / self._wanted_ns
        if self.factor > 1 or abs(is_hz / wanted_hz - 1) <= TOLERANCE:
            return None
        rule = "no multiple of" if is_hz > wanted_hz else "less than"
        return (
            f"{is_hz:.4g} samples a second are {rule} the bundle's {wanted_hz:.4g}: "
            "publish at that rate, or train for this one"
        )

    def _learn(self, step_ns: int) -> None:
        """Again for every so many samples, as rates change.

        The mean step, of steps divided by how many medians they are long: neither lost samples nor jitter count.
        """
        self._steps.append(step_ns)
        if len(self._steps) < LEARNT_FROM - 1:
            return
        median_ns = statistics.median(self._steps)
        period_ns = round(sum(self._steps) / max(1, sum(round(step / median_ns) for step in self._steps)))
        self._steps.clear()
        if self.period_ns is not None and abs(period_ns / self.period_ns - 1) <= CHANGED:
            return
        self.period_ns, self._due_ns = period_ns, None
        ratio = self._wanted_ns / period_ns
        self.factor = max(1, round(ratio)) if abs(round(ratio) / ratio - 1) <= TOLERANCE else 1
