"""What a calibration may promise: false alarms in so many hours, and the hours of data that it takes to say so.

False alarms in free motion are taken as a Poisson process: rare, and those less than 0.5 s apart counted as one.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Literal

import numpy as np
from scipy.special import gammaincinv

from tauext.errors import ConfigError


@dataclass(frozen=True)
class FalseAlarmBudget:
    """At most `alarms` false alarms of the whole arm in `hours` hours of operation, in the long run.

    Raises:
        ConfigError: a number that is not finite and > 0.
    """

    alarms: float
    hours: float

    def __post_init__(self) -> None:
        for name in ("alarms", "hours"):
            _require_positive(f"false alarm budget: {name}", getattr(self, name))

    @property
    def rate_per_hour(self) -> float:
        """False alarms an hour, [1/h]."""
        return self.alarms / self.hours

    def __str__(self) -> str:
        """In words: `1 in 8 h`."""
        return f"{self.alarms:g} in {duration(self.hours)}"


def split(budget: FalseAlarmBudget, joints: int, regions: int) -> np.ndarray:
    """Equal shares of the budget, (joints, regions), [1/h], that sum to its rate.

    An alarm of the arm is an alarm of some joint in some region, so the arm's rate is at most the sum of theirs; it is
    less where one episode crosses several limits.

    Raises:
        ConfigError: no joint or no region.
    """
    for name, count in (("joints", joints), ("regions", regions)):
        if count < 1:
            raise ConfigError(f"false alarm budget: {name} = {count} must be >= 1")
    return np.full((joints, regions), budget.rate_per_hour / (joints * regions))


def rate_interval(events: int, hours: float, confidence: float = 0.95) -> tuple[float, float]:
    r"""Two-sided confidence interval of a Poisson rate, [1/h]: it covers at least `confidence` [Garwood1936].

    .. math:: \left(\frac{\chi^2_{\alpha/2}(2k)}{2T},\ \frac{\chi^2_{1-\alpha/2}(2k+2)}{2T}\right), \quad \alpha = 1 - c

    The lower end is 0 where there was no event. (chi-squared quantiles through the inverse incomplete gamma function.)

    Raises:
        ConfigError: events < 0, hours not > 0, or a confidence outside 0 to 1.
    """
    _check(events, hours, confidence)
    return _lower(events, hours, (1 - confidence) / 2), _upper(events, hours, (1 - confidence) / 2)


def upper_rate(events: int, hours: float, confidence: float = 0.95) -> float:
    """One-sided upper bound of a Poisson rate, [1/h] [Garwood1936]: -ln(1 - confidence)/hours without any event.

    Raises:
        ConfigError: as rate_interval.
    """
    _check(events, hours, confidence)
    return _upper(events, hours, 1 - confidence)


def is_consistent(events: int, hours: float, promised_rate: float, confidence: float = 0.95) -> bool:
    """Whether the promised rate, [1/h], lies in the confidence interval of what a test showed.

    False also where the test showed far fewer alarms than promised: then the promise holds, see `is_kept`.

    Raises:
        ConfigError: as rate_interval.
    """
    low, high = rate_interval(events, hours, confidence)
    return low <= promised_rate <= high


def is_kept(events: int, hours: float, promised_rate: float, confidence: float = 0.95) -> bool:
    """Whether a test leaves the promise standing: so many alarms or more are no surprise at the promised rate, [1/h].

    False where P(events or more | promised rate) < 1 - confidence.

    Raises:
        ConfigError: as rate_interval.
    """
    _check(events, hours, confidence)
    return _lower(events, hours, 1 - confidence) <= promised_rate


def hours_to_support(budget: FalseAlarmBudget, confidence: float = 0.95) -> float:
    """Hours that bound the rate by the budget's when not one false alarm fell in them: -ln(1 - confidence)/rate, [h].

    24.0 h for 1 in 8 h: the "rule of three" [Hanley1983].

    Raises:
        ConfigError: a confidence outside 0 to 1.
    """
    _check(0, budget.hours, confidence)
    return -math.log1p(-confidence) / budget.rate_per_hour


@dataclass(frozen=True)
class Promise:
    """What was asked of a calibration, and what its recordings can support.

    Supported means: at the rate asked for, the recordings would have held a false alarm with probability `confidence`
    or more. Shorter ones cannot tell the wanted limits from worse ones, whatever a fit says. It is a necessary
    condition and no proof: the limits come from these very recordings, and beyond them rest on the fitted tail; what
    the limits do is shown by other recordings (`is_kept`).

    Raises:
        ConfigError: hours not > 0, streams < 1, or a confidence outside 0 to 1.
    """

    asked: FalseAlarmBudget
    hours: float
    """Healthy hours of calibration recordings."""
    streams: int = 1
    """Limits that share the budget: joints times regions."""
    confidence: float = 0.95

    def __post_init__(self) -> None:
        _check(0, self.hours, self.confidence)
        if self.streams < 1:
            raise ConfigError(f"promise: streams = {self.streams} must be >= 1")

    @property
    def needed_hours(self) -> float:
        """Hours of calibration that the budget takes, [h]."""
        return hours_to_support(self.asked, self.confidence)

    @property
    def missing_hours(self) -> float:
        """Hours still to be recorded for the budget, [h]; 0 where it is supported."""
        return max(0.0, self.needed_hours - self.hours)

    @property
    def is_supported(self) -> bool:
        """Whether the recordings are long enough for the budget."""
        # The hours that the sentence names must do, whatever the last bits of their sum.
        return self.hours >= self.needed_hours * (1 - 1e-9)

    @property
    def supported(self) -> FalseAlarmBudget:
        """The smallest budget that the recordings support: 1 in 6.7 minutes for 20 minutes of them."""
        return FalseAlarmBudget(1, self.hours / -math.log1p(-self.confidence))

    @property
    def extrapolation(self) -> float:
        """Hours an alarm of each limit's equal share, over the hours recorded: how far the tails are stretched."""
        return self.streams / self.asked.rate_per_hour / self.hours

    def sentence(self) -> str:
        """In words, for people: what is promised, or why nothing is and how much more to record."""
        asked = (
            f"At most {self.asked.alarms:g} false alarm{'s' * (self.asked.alarms != 1)} in {duration(self.asked.hours)}"
        )
        have = f"{duration(self.hours, 'down')} of calibration"
        if not self.is_supported:
            return (
                f"{asked} cannot be promised: {have} support 1 in {duration(self.supported.hours, 'down')} at best (at "
                f"{100 * self.confidence:g} % confidence); record {duration(self.missing_hours, 'up')} more of free "
                f"motion, {duration(self.needed_hours, 'up')} in all."
            )
        said = f"{asked}: supported by {have} (at {100 * self.confidence:g} % confidence)."
        if self.streams > 1:
            share = duration(self.streams / self.asked.rate_per_hour)
            far = f"{self.extrapolation:.1f} times" if self.extrapolation > 1 else "within"
            said += f" Each of {self.streams} limits has an equal share, 1 in {share}, {far} the recorded time."
        return said

    def summary(self) -> dict:
        """All of it for JSON."""
        return {
            "asked": asdict(self.asked) | {"rate_per_hour": self.asked.rate_per_hour, "text": str(self.asked)},
            "confidence": self.confidence,
            "calibration_hours": self.hours,
            "needed_hours": self.needed_hours,
            "missing_hours": self.missing_hours,
            "supported": self.is_supported,
            "supported_budget": asdict(self.supported)
            | {"rate_per_hour": self.supported.rate_per_hour, "text": str(self.supported)},
            "streams": self.streams,
            "extrapolation": self.extrapolation,
            "sentence": self.sentence(),
        }


UNITS = (("h", 1.0), ("minutes", 60.0), ("s", 3600.0))
ROUNDINGS: dict[str, Callable[[float], int]] = {
    "nearest": round,
    "up": lambda x: math.ceil(x - 1e-9),
    "down": lambda x: math.floor(x + 1e-9),
}


def duration(hours: float, rounding: Literal["nearest", "up", "down"] = "nearest") -> str:
    """A time in words, to about three digits: `8 h`, `6.67 minutes`, `24 s`."""
    unit, factor = next(((u, f) for u, f in UNITS if hours * f >= 1), UNITS[-1])
    value = hours * factor
    digits = min(1, 2 - math.floor(math.log10(value))) if value >= 10 else 2 - math.floor(math.log10(value))
    return f"{ROUNDINGS[rounding](value * 10**digits) / 10**digits:.6g} {unit}"


def _lower(events: int, hours: float, tail: float) -> float:
    return float(gammaincinv(events, tail)) / hours if events else 0.0


def _upper(events: int, hours: float, tail: float) -> float:
    return float(gammaincinv(events + 1, 1 - tail)) / hours


def _check(events: int, hours: float, confidence: float) -> None:
    if events < 0 or events != int(events):
        raise ConfigError(f"events = {events} must be a whole number >= 0")
    _require_positive("hours", hours)
    if not 0 < confidence < 1:
        raise ConfigError(f"confidence = {confidence} must lie between 0 and 1")


def _require_positive(name: str, value: float) -> None:
    if not (math.isfinite(value) and value > 0):
        raise ConfigError(f"{name} = {value} must be > 0")
