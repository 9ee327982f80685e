"""What was detected of forces that an evaluation added to free motion, as results.json has it, and in words."""

from __future__ import annotations

from dataclasses import dataclass

ASSUMED = (
    "The forces were added to the recorded motor torque of free motion: the position controller is assumed to hold its "
    "path. Hands and compliance reduce a real force, and a controller that gives way shows less of it, and later."
)


@dataclass(frozen=True)
class PeakBin:
    """Events whose peaks lie between two, in the entry's unit."""

    peak_from: float
    peak_to: float
    events: int
    latched: int
    delay_median_s: float | None

    @property
    def middle(self) -> float:
        return (self.peak_from * self.peak_to) ** 0.5


@dataclass(frozen=True)
class InjectedCurve:
    """Of one place and shape."""

    place: str
    shape: str
    events: int
    latched: int
    nine_of_ten: float | None
    """Peak from which on 9 of 10 are detected; None where there is none."""
    delay_median_s: float | None
    """From there on."""
    delay_p95_s: float | None
    bins: tuple[PeakBin, ...]


@dataclass(frozen=True)
class Injected:
    """Of one bundle."""

    unit: str
    events: int
    unhealthy: int
    curves: tuple[InjectedCurve, ...]
    without_forces: str | None = None
    """Why there are torques on single joints instead of forces."""
    left_out: tuple[str, ...] = ()
    blind: tuple[str, ...] = ()
    """Places where usually no joint notices any force."""

    @property
    def place(self) -> str:
        """Where most events were: the end of the arm."""
        return max(self.curves, key=lambda one: (sum(c.events for c in self.at(one.place)), one.place)).place

    def at(self, place: str) -> tuple[InjectedCurve, ...]:
        return tuple(one for one in self.curves if one.place == place)

    def words(self) -> str:
        """`30 N (hit of 20 ms, after 35 ms), ...`: the peaks from which on 9 of 10 are detected, at `place`."""
        return ", ".join(
            f"{number(one.nine_of_ten)} {self.unit} ({one.shape}, after {milliseconds(one.delay_median_s)} ms)"
            if one.nine_of_ten is not None
            else f"no peak that was tried ({one.shape})"
            for one in self.at(self.place)
        )


def number(peak: float | None) -> str:
    return "none" if peak is None else f"{peak:.2g}" if peak < 10 else f"{peak:.0f}"


def milliseconds(delay_s: float | None) -> str:
    return "–" if delay_s is None else f"{1e3 * delay_s:.0f}"
