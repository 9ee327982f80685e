"""Tail of errors in free motion, and the number of false alarms that a calibration can promise."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Literal

import numpy as np
from scipy.special import gammainc, gammaincinv

from tauext.config import require
from tauext.errors import ConfigError, TrainingError

# --- Tail of a joint's error in free motion: rate of peaks of |tau_ext| above levels that few or no peaks reached.
#
# Peaks over a threshold u come as a Poisson process of rate lambda_u, and their excess over u follows a generalised
# Pareto distribution [Coles2001]_ (4.2):
#
# .. math:: P(X > u + y \mid X > u) = (1 + \xi y / \sigma)^{-1/\xi}, \quad
#           x_\rho = u + \frac{\sigma}{\xi}\left[\left(\frac{\lambda_u}{\rho}\right)^{\xi} - 1\right]
#
# with x_rho the level that peaks exceed rho times an hour. xi = 0 is the exponential distribution; with xi < 0 the tail
# ends at u - sigma/xi. It is SciPy's `genpareto`, whose own fit has no bounds of the shape and evaluates one
# pair of parameters at a time. Here, with c = xi/sigma, the log-likelihood [Grimshaw1993]_
#
# .. math:: \ell(c, \sigma) = -n \ln\sigma - S(c) - \frac{S(c)}{c\,\sigma}, \quad S(c) = \sum_i \ln(1 + c\,y_i)
#
# needs one sum for each c, for all sigma: a grid costs little and needs no convergence.


SHAPES = (-0.9, 1.0)
"""Bounds of the shape. Below -1 the likelihood has no maximum [Grimshaw1993]_. From 1 on the mean excess is infinite,
which is impossible for torque errors."""


@dataclass(frozen=True)
class TailConfig:
    """How a tail is fitted to peaks."""

    exceedances: tuple[int, ...] = (200, 140, 100, 70, 50)
    """Thresholds to try, by the number of peaks above, falling: more peaks lower the variance and raise the bias."""
    share: float = 0.05
    """Largest share of the peaks that counts as a tail; the last of `exceedances` is always tried."""
    fewest: int = 30
    """Fewest exceedances for fitting a tail."""
    least_p: float = 0.1
    """A threshold is skipped if a fit as bad as its own is less probable than this ..."""
    widest_step: float = 2.58
    """... or if a higher threshold's shape differs by more standard errors than this (99 %)."""
    misfit_p: float = 0.01
    """Probability of so bad a fit over the highest threshold, below which the peaks have no tail of this kind."""
    usual_shape: float = 0.1
    """Prior of the shape: flat up to this, beyond it a normal distribution's upper half. A few dozen peaks do not tell
    a tail of 0.1 from one of 0.5, whose limits are several times as high, and one large peak moves the fit from one to
    the other. Hydrology bounds the shape for the same reason ([Martins2000]_, within 0.5)."""
    shape_spread: float = 0.3
    """Standard deviation of that normal distribution; a larger one raises the limits of heavy tails."""
    draws: int = 256
    """Draws of a tail's rates, even in probability."""


GOODNESS_P = np.array([0.5, 0.25, 0.1, 0.05, 0.025, 0.01, 0.001])
GOODNESS_SHAPES = np.array([-0.9, -0.8, -0.6, -0.4, -0.2, 0.0, 0.25, 0.5, 1.0])
GOODNESS_A2 = np.array(
    [
        [0.691, 1.124, 1.779, 2.344, 2.961, 3.767, 5.964],
        [0.538, 0.806, 1.179, 1.484, 1.818, 2.292, 3.501],
        [0.473, 0.697, 1.003, 1.246, 1.509, 1.862, 2.855],
        [0.442, 0.642, 0.915, 1.134, 1.367, 1.693, 2.513],
        [0.415, 0.598, 0.842, 1.032, 1.226, 1.502, 2.181],
        [0.394, 0.562, 0.786, 0.966, 1.146, 1.400, 1.991],
        [0.371, 0.527, 0.728, 0.894, 1.060, 1.295, 1.864],
        [0.356, 0.501, 0.687, 0.835, 0.981, 1.187, 1.771],
        [0.383, 0.544, 0.759, 0.940, 1.122, 1.376, 2.066],
    ]
)
"""Anderson and Darling's A² (a row a shape, a column a p), exceeded with probability p by samples of a generalised
Pareto distribution. Shape and scale are fitted to them within SHAPES. The table is the parametric bootstrap of
[Choulakian2001]_ with 60,000 samples of 100. For 50 or 200 it is within 3 %, near the lower bound 10 %."""


class TooFewPeaks(TrainingError):
    """Too few peaks to fit a tail."""

    def __init__(self, peaks: int, fewest: int) -> None:
        super().__init__(
            f"{peaks} peaks are too few to fit a tail: at least {fewest} are needed; record more free motion"
        )


@dataclass(frozen=True, eq=False)
class Tail:
    """Peaks of |tau_ext| in free motion above a threshold, and the distribution fitted to them."""

    threshold_nm: float
    shape: float
    scale_nm: float
    exceedances: int
    """Fitted peaks, above the threshold."""
    hours: float
    """Hours of observation."""
    goodness_p: float
    """Probability of so bad a fit for a tail of this kind, by Anderson and Darling's test; clipped to 0.001 to 0.5."""
    peaks_nm: np.ndarray = field(repr=False)
    """All peaks, descending, [N m]."""
    config: TailConfig = TailConfig()

    @property
    def rate_per_hour(self) -> float:
        """Rate of peaks over the threshold, lambda_u, [1/h]."""
        return self.exceedances / self.hours

    @property
    def fits(self) -> bool:
        """Whether the distribution describes the data, so that levels beyond the data are credible."""
        return self.goodness_p >= self.config.misfit_p

    def seen(self, rate_per_hour: float, confidence: float) -> float:
        """Largest peak that so low a rate does not explain, [N m]; the largest one at least.

        k peaks or more exceed the level of this rate with probability gammainc(k, rate hours) [Garwood1936]_.
        """
        counts = np.arange(1, len(self.peaks_nm) + 1)
        allowed = int((gammainc(counts, rate_per_hour * self.hours) >= confidence).sum())
        return float(self.peaks_nm[max(allowed, 1) - 1])

    def rates(self, levels_nm: np.ndarray, order: np.random.Generator) -> np.ndarray:
        r"""Rates of peaks over each level, drawn from their posterior distribution, (draws, levels), [1/h].

        .. math:: \lambda(x) = \lambda_u \left(1 + \xi \frac{x - u}{\sigma}\right)^{-1/\xi}, \quad
                  p(\xi, \sigma) \propto L(\xi, \sigma)\,\sigma^{-1}\,e^{-\max(\xi - \xi_0, 0)^2 / 2 s^2}, \quad
                  \lambda_u \sim \Gamma(n + 1/2, T)

        xi_0 and s are usual_shape and shape_spread. At and below the threshold the peaks themselves take the place of
        the distribution: k of them above a level count as k of the n above the threshold.

        Draws are even in probability instead of random, so that few suffice; `order` pairs those of one tail
        independently with those of another.

        Args:
            levels_nm: (levels,), [N m].
        """
        n, levels = self.exceedances, np.asarray(levels_nm, dtype=float)
        shape, scale, weight = _posterior(self.peaks_nm[:n] - self.threshold_nm, self.config)
        even = (np.arange(self.config.draws) + 0.5) / self.config.draws
        drawn = order.permutation(np.searchsorted(np.cumsum(weight) / weight.sum(), even))
        above = order.permutation(gammaincinv(n + 0.5, even)) / self.hours
        y, xi = np.maximum(levels - self.threshold_nm, 0) / scale[drawn, None], shape[drawn, None]
        exponential = np.abs(xi) < 1e-9
        bounded = np.log1p(np.maximum(xi * y, np.nextafter(-1, 0))) / np.where(exponential, 1, xi)
        below = np.searchsorted(-self.peaks_nm, -levels, side="left") / n
        rates: np.ndarray = above[:, None] * np.exp(-np.where(exponential, y, bounded)) * np.maximum(below, 1)
        return rates

    def summary(self) -> dict:
        """All values for JSON; of the peaks only the largest."""
        return {
            "threshold_nm": self.threshold_nm,
            "shape": self.shape,
            "scale_nm": self.scale_nm,
            "exceedances": self.exceedances,
            "hours": self.hours,
            "rate_per_hour": self.rate_per_hour,
            "goodness_p": self.goodness_p,
            "fits": self.fits,
            "largest_nm": float(self.peaks_nm[0]),
        }


def fit_tail(peaks_nm: np.ndarray, hours: float, config: TailConfig = TailConfig()) -> Tail:
    """Fit the tail of declustered peaks, above the lowest suitable threshold.

    A low threshold has many peaks above it, hence little variance; too low a threshold has bias ([Coles2001]_ 4.3.1).
    Thresholds have 200, 140, ... 50 peaks above, but no more than a twentieth of all unless 50; with no more than 50
    peaks, all but one. The first threshold is chosen that Anderson and Darling's test does not reject ([Bader2018]_)
    and whose shape agrees with all higher ones ([Coles2001]_ 4.3.4). The difference of two shapes has the variance (1 +
    xi)² (1/n_higher - 1/n_lower), as one sample contains the other. If no threshold passes, the highest is used.

    Args:
        peaks_nm: separate peaks, (peaks,), [N m], in any order: all of them, or the largest (held_peaks).
        hours: hours of operation observed; rates refer to the same hours.

    Raises:
        TooFewPeaks: fewer than 31 peaks, or fewer than 30 over every threshold because of equal ones.
        TrainingError: a peak is not finite or negative.
        ConfigError: hours not > 0.
    """
    require(0 < hours < math.inf, "hours", hours, "> 0")
    peaks = np.sort(np.asarray(peaks_nm, dtype=float).ravel())[::-1]  # NaN comes first
    if len(peaks) and not (math.isfinite(peaks[0]) and peaks[-1] >= 0):
        wrong = peaks[-1] if peaks[-1] < 0 else peaks[0]
        raise TrainingError(f"a peak of |tau_ext| = {wrong} Nm must be finite and >= 0")
    if len(peaks) <= config.fewest:
        raise TooFewPeaks(len(peaks), config.fewest + 1)
    tried = []
    most = max(config.exceedances[-1], config.share * len(peaks))
    for count in [n for n in config.exceedances if n <= most and n < len(peaks)] or [len(peaks) - 1]:
        threshold = float(peaks[count])
        above = int((peaks > threshold).sum())  # fewer than `count` where peaks are equal
        if above >= config.fewest:
            tried.append((threshold, *fit_excess(peaks[:above] - threshold), above))
    if not tried:
        raise TooFewPeaks(above, config.fewest + 1)  # the others are equal
    for number, (threshold, shape, scale, above) in enumerate(tried):
        p = goodness(peaks[:above] - threshold, shape, scale)
        steady = all(
            abs(other - shape) <= config.widest_step * (1 + shape) * math.sqrt(1 / fewer - 1 / above)
            for _, other, _, fewer in tried[number + 1 :]
        )
        if p >= config.least_p and steady:
            break
    return Tail(threshold, shape, scale, above, hours, p, peaks, config)


def fit_excess(excess: np.ndarray) -> tuple[float, float]:
    """Maximum-likelihood shape (within SHAPES) and scale of excesses > 0 over a threshold, (n,)."""
    low, high = GRID
    for _ in range(6):
        grid = np.linspace(low, high, 65)
        c, mean, scale = _best_scales(excess, grid)
        best = int(np.argmax(_likelihood(len(excess), c, mean, scale)))
        low, high = grid[best] - (grid[1] - grid[0]), grid[best] + (grid[1] - grid[0])
    return float(c[best] * scale[best]), float(scale[best])


def goodness(excess: np.ndarray, shape: float, scale: float) -> float:
    """Probability of a fit as bad or worse, by Anderson and Darling's A² and GOODNESS_A2; clipped to 0.001 to 0.5."""
    y = np.sort(excess) / scale
    n = len(y)
    log_survival = -y if abs(shape) < 1e-9 else -np.log1p(shape * y) / shape
    odd = 2 * np.arange(1, n + 1) - 1
    a2 = -n - np.mean(odd * (np.log(-np.expm1(log_survival)) + log_survival[::-1]))
    critical = [np.interp(shape, GOODNESS_SHAPES, column) for column in GOODNESS_A2.T]
    return float(np.exp(np.interp(a2, critical, np.log(GOODNESS_P))))


GRID = (-12.0, 25.0)
"""Grid of ln(1 + c largest excess): from tails that end at the largest excess to one of 1e10 of the scale."""


def _best_scales(excess: np.ndarray, grid: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """c = (e^grid - 1)/largest excess; S(c)/(c n), which is the mean excess at c = 0; and the likeliest scale for each
    c: that mean, as long as the shape c sigma stays within SHAPES, else at its bound."""
    largest = excess.max()
    c = np.expm1(grid) / largest
    logs = np.log1p(c[:, None] * excess).mean(axis=1)
    tiny = np.abs(grid) < 1e-8
    mean = np.where(tiny, excess.mean(), logs / np.where(tiny, 1, c))
    bound = np.where(tiny, np.inf, np.where(c < 0, *SHAPES) / np.where(tiny, 1, c))
    return c, mean, np.minimum(mean, bound)


def _likelihood(n: int, c: np.ndarray, mean: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """l(c, sigma) of the module's docstring, with mean = S(c)/(c n)."""
    return -n * (np.log(scale) + c * mean + mean / scale)


def _posterior(excess: np.ndarray, config: TailConfig) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Shapes and scales of the excesses over a threshold, with their posterior weights, see `Tail.rates`."""
    n = len(excess)
    grid = np.linspace(*GRID, 371)
    profile = _likelihood(n, *_best_scales(excess, grid))
    likely = grid[profile > profile.max() - 12]  # down to e^-12 of the largest; the rest is negligible
    grid = np.linspace(likely[0] - 0.1, likely[-1] + 0.1, 96)
    c, mean, best = (column[:, None] for column in _best_scales(excess, grid))
    scale = best * np.exp(np.linspace(-5.5, 6.5, 40) / math.sqrt(n))
    shape = c * scale
    # Prior 1/sigma; d shape d sigma = sigma dc d sigma, dc ~ e^grid d grid, d sigma = sigma d ln sigma.
    weight = _likelihood(n, c, mean, scale) + np.log(scale) + grid[:, None]
    weight -= (np.maximum(shape - config.usual_shape, 0) / config.shape_spread) ** 2 / 2
    weight = np.where((shape > SHAPES[0]) & (shape < SHAPES[1]), np.exp(weight - weight.max()), 0)
    kept = weight > 1e-8 * weight.max()
    return shape[kept], scale[kept], weight[kept]


# --- Promises of a calibration: false alarms in a number of hours, and the hours of data that support them. False
# alarms in free motion are modelled as a Poisson process: rare, and those less than 0.5 s apart count as one.


@dataclass(frozen=True)
class FalseAlarmBudget:
    """At most `alarms` false alarms of the whole arm in `hours` hours of operation, in the long run.

    Raises:
        ConfigError: a number is not finite and > 0.
    """

    alarms: float
    hours: float

    def __post_init__(self) -> None:
        for name in ("alarms", "hours"):
            value = getattr(self, name)
            require(0 < value < math.inf, f"target false alarm rate: {name}", value, "> 0")

    @property
    def rate_per_hour(self) -> float:
        """Rate of false alarms, [1/h]."""
        return self.alarms / self.hours

    def __str__(self) -> str:
        """Return text such as `1 in 8 h`."""
        return f"{self.alarms:g} in {duration(self.hours)}"

    def summary(self) -> dict:
        """All values for JSON."""
        return asdict(self) | {"rate_per_hour": self.rate_per_hour, "text": str(self)}


def rate_interval(events: int, hours: float, confidence: float = 0.95) -> tuple[float, float]:
    r"""Two-sided confidence interval of a Poisson rate, [1/h]: it covers at least `confidence` [Garwood1936].

    .. math:: \left(\frac{\chi^2_{\alpha/2}(2k)}{2T},\ \frac{\chi^2_{1-\alpha/2}(2k+2)}{2T}\right), \quad \alpha = 1 - c

    The lower end is 0 without events. Chi-squared quantiles come from the inverse incomplete gamma function.

    Raises:
        ConfigError: events < 0, hours not > 0, or confidence outside 0 to 1.
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


def is_kept(events: int, hours: float, promised_rate: float, confidence: float = 0.95) -> bool:
    """Whether a test is compatible with the promised rate, [1/h]: not if P(events or more | promised rate) < 1 -
    confidence.

    Raises:
        ConfigError: as rate_interval.
    """
    _check(events, hours, confidence)
    return _lower(events, hours, 1 - confidence) <= promised_rate


@dataclass(frozen=True)
class Promise:
    """The requested budget of a calibration, and the budget that its recordings support.

    Supported means: at the requested rate, the recordings would contain a false alarm with probability `confidence` or
    more. Shorter ones cannot distinguish the wanted limits from worse ones. The condition is necessary, not sufficient:
    the limits come from these recordings and, beyond them, from the fitted tail. Other recordings test the limits
    (`is_kept`).

    Raises:
        ConfigError: hours not > 0, or a confidence outside 0 to 1.
    """

    asked: FalseAlarmBudget
    hours: float
    """Healthy hours of calibration recordings."""
    confidence: float = 0.95

    def __post_init__(self) -> None:
        _check(0, self.hours, self.confidence)

    @property
    def needed_hours(self) -> float:
        """Hours without false alarm that bound the rate by the budget's, [h]: 24 h for 1 in 8 h [Hanley1983]."""
        return -math.log1p(-self.confidence) / self.asked.rate_per_hour

    @property
    def missing_hours(self) -> float:
        """Hours missing for the budget, [h]; 0 where it is supported."""
        return max(0.0, self.needed_hours - self.hours)

    @property
    def is_supported(self) -> bool:
        """Whether the recordings are long enough for the budget."""
        # Tolerates rounding: the hours named in the sentence must suffice.
        return self.hours >= self.needed_hours * (1 - 1e-9)

    @property
    def supported(self) -> FalseAlarmBudget:
        """Smallest budget that the recordings support: 1 in 6.7 minutes for 20 minutes of recordings."""
        return FalseAlarmBudget(1, self.hours / -math.log1p(-self.confidence))

    def sentence(self) -> str:
        """Text on the promise, or on the reason for none and how much more to record."""
        asked = (
            f"At most {self.asked.alarms:g} false alarm{'s' * (self.asked.alarms != 1)} in {duration(self.asked.hours)}"
        )
        have = f"{duration(self.hours, 'down')} of calibration"
        if not self.is_supported:
            return (
                f"{asked} cannot be proved: {have} support 1 in {duration(self.supported.hours, 'down')} at best (at "
                f"{100 * self.confidence:g} % confidence); record {duration(self.missing_hours, 'up')} more of free "
                f"motion, {duration(self.needed_hours, 'up')} in all."
            )
        return f"{asked}: supported by {have} (at {100 * self.confidence:g} % confidence)."

    def summary(self) -> dict:
        """All values for JSON."""
        return {
            "asked": self.asked.summary(),
            "confidence": self.confidence,
            "calibration_hours": self.hours,
            "needed_hours": self.needed_hours,
            "missing_hours": self.missing_hours,
            "supported": self.is_supported,
            "supported_budget": self.supported.summary(),
            "sentence": self.sentence(),
        }


def promised_per_hour(limits: Mapping) -> float | None:
    """False alarms an hour that a bundle's limits are set for, [1/h]; None: they have no budget.

    The requested budget; of limits that are not extrapolated, the smallest that is proved if the requested one is not.

    Args:
        limits: facts of the limits, with the promise's `summary()`.
    """
    if "extrapolated" in limits:
        return float(limits["extrapolated"]["per_hour"])
    return proved_per_hour(limits)


def proved_per_hour(limits: Mapping) -> float | None:
    """False alarms an hour that the data behind a bundle's limits prove, [1/h]; None: they prove nothing.

    Args:
        limits: see promised_per_hour.
    """
    promise = limits.get("promise")
    if not isinstance(promise, dict):
        return None
    return float(promise["asked" if promise["supported"] else "supported_budget"]["rate_per_hour"])


def at_most_per_hour(limits: Mapping) -> float | None:
    """Largest rate of false alarms that agrees with what a bundle's limits state, [1/h]; None: they have no budget.

    Extrapolated limits state an interval, of which this is the upper end; others state a single rate. A test
    contradicts the statement if even this rate makes so many false alarms implausible (`is_kept`).

    Args:
        limits: see promised_per_hour().
    """
    rate = promised_per_hour(limits)
    if rate is None or "extrapolated" not in limits:
        return rate
    return max(rate, float(limits["extrapolated"]["between_per_hour"][1]))


def duration(hours: float, rounding: Literal["nearest", "up", "down"] = "nearest") -> str:
    """Format a time to about three digits: `8 h`, `6.67 minutes`, `24 s`."""
    unit, value = next(
        ((unit, hours * factor) for unit, factor in (("h", 1), ("minutes", 60)) if hours * factor >= 1),
        ("s", hours * 3600),
    )
    if not value > 1e-9:
        return f"0 {unit}"
    digits = min(1, 2 - math.floor(math.log10(value))) if value >= 10 else 2 - math.floor(math.log10(value))
    scaled = value * 10**digits
    whole = {"nearest": round(scaled), "up": math.ceil(scaled - 1e-9), "down": math.floor(scaled + 1e-9)}[rounding]
    number = f"{whole / 10**digits:.6g}"
    return f"{number} {'minute' if (number, unit) == ('1', 'minutes') else unit}"


def _lower(events: int, hours: float, tail: float) -> float:
    return float(gammaincinv(events, tail)) / hours if events else 0.0


def _upper(events: int, hours: float, tail: float) -> float:
    return float(gammaincinv(events + 1, 1 - tail)) / hours


def _check(events: int, hours: float, confidence: float) -> None:
    require(events >= 0 and events == int(events), "events", events, "a whole number >= 0")
    require(0 < hours < math.inf, "hours", hours, "> 0")
    if not 0 < confidence < 1:
        raise ConfigError(f"confidence = {confidence} must lie between 0 and 1")
