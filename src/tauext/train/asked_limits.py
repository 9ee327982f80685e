r"""Limits of the budget that was asked for, from whatever motion there is.

The limits of the budget that the motion proves give the shape: how joints and regions compare. One factor on all of
them then meets the budget asked for. With x the worst ratio of a joint's held error to its limit, its peaks over a
threshold follow a generalised Pareto distribution, as those of a joint do in fit/tail.py. Its shape and scale have
priors, since a few peaks do not determine them. Friction of other hours and days multiplies the errors by g, a
lognormal factor. Of the draws of both, the factor f is the level for which

.. math:: \operatorname{median}\ \lambda(f / g) = B

and at least the largest peak that the budget B does not allow. The other draws give the interval of the rate.

Two errors that a short time hardly shows raise single limits afterwards: a joint at rest hides up to its friction, and
rare errors of slow motion are larger than the error scale there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaincinv, ndtri

from tauext._core import Bundle, MotionFeature
from tauext.errors import TrainingError
from tauext.fit.tail import FalseAlarmBudget, duration
from tauext.train.error_scale import FEATURES, rest_sigma_nm
from tauext.train.held_peaks import REGIONS, Moment, Peaks, collect_peaks
from tauext.train.hits import noticed_pushes_n
from tauext.train.paper_limits import LimitMotion
from tauext.train.promised_limits import PromisedLimits, calibrated, note_moments
from tauext.train.supported_limits import Raised, SupportedConfig, put_other_motion, raised


@dataclass(frozen=True)
class AskedConfig:
    """How limits are extrapolated to a budget that the motion does not prove."""

    share: float = 0.15
    """Share of the peaks that is the tail ..."""
    exceedances: tuple[int, int] = (5, 200)
    """... but at least and at most so many."""
    shape: tuple[float, float] = (0.05, 0.08)
    """Mean and standard deviation of the prior of the tail's shape."""
    scale: tuple[float, float] = (0.1, 0.4)
    """Median of the prior of its scale, as a share of the threshold, and the standard deviation of the logarithm."""
    growth: float = 0.22
    """Median of ln g, the growth of errors by friction that the motion does not show, and ..."""
    growth_spread: float = 0.2
    """... its standard deviation; both fall as ..."""
    growth_hours: float = 0.5
    """... 1 / sqrt(1 + hours / this): hours contain warm-up, programs and pauses of their own."""
    reserve_hours: float = SupportedConfig.decay_s / 3600
    """The reserve of friction in the limits of the first minutes fades with this time, and the growth replaces it."""
    rest_share: float = 0.75
    """Least limit of a joint at rest as a share of its friction, ..."""
    rest_errors: float = 7.0
    """... or this many standard errors at rest, whichever is lower: in 80 minutes of rests, the largest errors of each
    joint were 3 to 7 times their root mean square, and 0.2 to 0.75 of its friction. It falls as ..."""
    rest_hours: float = 2.0
    """... 1 / sqrt(1 + hours / this)."""
    slow_share: float = 0.3
    """Least limit as a share of that of usual motion. It falls as ..."""
    slow_hours: float = 0.5
    """... 1 / sqrt(1 + hours / this)."""
    draws: int = 256
    interval: float = 0.9
    """Probability of the stated interval."""
    times_as_many: tuple[float, ...] = (8.0, 48.0)
    """Budgets stated beside the one asked for, in false alarms of it."""


def faded(hours: float, by_hours: float) -> float:
    """Share that remains of a term which minutes need after so many hours: 1 / sqrt(1 + hours / by_hours)."""
    return 1 / math.sqrt(1 + hours / by_hours)


@dataclass(frozen=True)
class WorstErrors:
    """Rates at which the arm's worst ratio of error to limit exceeds levels, in draws of what is unknown."""

    peaks: np.ndarray
    """Descending, (peaks,)."""
    hours: float
    levels: np.ndarray
    """Rising, (levels,)."""
    rates: np.ndarray
    """(draws, levels), [1/h]."""

    @classmethod
    def of(cls, peaks: np.ndarray, hours: float, config: AskedConfig) -> WorstErrors:
        """Fit the tail of these peaks, descending, (peaks,), which were seen in so many hours.

        Raises:
            TrainingError: there is none above 0.
        """
        peaks = peaks[peaks > 0]
        if not len(peaks):
            raise TrainingError("thresholds need errors of free motion, and tau_ext is zero throughout")
        fewest, most = config.exceedances
        count = min(max(fewest, math.ceil(config.share * len(peaks))), most, len(peaks))
        threshold = float(peaks[count]) if count < len(peaks) else float(peaks[-1])
        shape, scale = posterior(peaks[:count] - threshold, threshold, config)
        even = (np.arange(config.draws) + 0.5) / config.draws
        paired = np.random.default_rng(0)
        above = paired.permutation(gammaincinv(count + 0.5, even)) / hours
        unseen = faded(hours, config.growth_hours)
        growth = -config.growth * math.expm1(-hours / config.reserve_hours)
        grown = np.exp(unseen * (growth + config.growth_spread * ndtri(paired.permutation(even))))
        levels = np.r_[np.unique(peaks[:200]), peaks[0] * np.geomspace(1.001, 50, 300)]
        at = levels / grown[:, None]
        beyond = np.maximum(1 + shape[:, None] * np.maximum(at - threshold, 0) / scale[:, None], 1e-12)
        exact = np.where(np.abs(shape) < 1e-9, 1e-9, shape)[:, None]
        below = np.maximum(np.searchsorted(-peaks, -at, side="left") / count, 1.0)
        return cls(peaks, hours, levels, above[:, None] * beyond ** (-1 / exact) * below)

    def level(self, rate_per_hour: float) -> float:
        """Level that is exceeded at this rate in the median of the draws; no less than `seen`."""
        middle = np.log(np.maximum(np.median(self.rates, axis=0), 1e-30))
        level = float(np.interp(-math.log(rate_per_hour), -middle, self.levels))
        return max(level, self.seen(rate_per_hour))

    def seen(self, rate_per_hour: float) -> float:
        """Largest peak that this rate does not allow: more than rate times hours are above no smaller one."""
        return float(self.peaks[min(int(rate_per_hour * self.hours), len(self.peaks) - 1)])

    def between(self, level: float, probability: float) -> tuple[float, float]:
        """Interval of the rate over a level that holds with this probability, [1/h]."""
        logs = np.log(np.maximum(self.rates, 1e-30))
        rates = np.array([np.interp(level, self.levels, one) for one in logs])
        low, high = np.exp(np.quantile(rates, [(1 - probability) / 2, (1 + probability) / 2])).tolist()
        return low, high


def posterior(excess: np.ndarray, threshold: float, config: AskedConfig) -> tuple[np.ndarray, np.ndarray]:
    r"""Draws of shape and scale of a generalised Pareto distribution of excesses over a threshold, (draws,) each.

    .. math:: p(\xi, \sigma) \propto N(\xi; \text{shape})\, N(\ln \sigma/u; \text{scale}) \prod_i
              \frac{1}{\sigma} (1 + \xi y_i / \sigma)^{-1/\xi - 1}

    They are even in probability instead of random, so that few suffice.
    """
    middle, spread = config.shape
    share, factor = config.scale
    xi = (middle + spread * np.linspace(-4, 4, 33))[:, None]
    xi[np.abs(xi) < 1e-6] = 1e-6
    logs = (math.log(share) + factor * np.linspace(-4, 4, 65))[None]
    inside = 1 + xi[:, :, None] * excess / (threshold * np.exp(logs))[:, :, None]
    log_density = -(1 / xi + 1) * np.log(np.maximum(inside, 1e-300)).sum(axis=2) - len(excess) * logs
    log_density -= ((xi - middle) / spread) ** 2 / 2 + ((logs - math.log(share)) / factor) ** 2 / 2
    log_density[(inside <= 0).any(axis=2)] = -np.inf
    weight = np.exp(log_density - log_density.max()).ravel()
    even = (np.arange(config.draws) + 0.5) / config.draws
    drawn = np.minimum(np.searchsorted(np.cumsum(weight) / weight.sum(), even), weight.size - 1)
    row, column = np.divmod(drawn, logs.size)
    return xi[row, 0], threshold * np.exp(logs[0, column])


def put_asked(bundle: Bundle, motion: LimitMotion, config: AskedConfig = AskedConfig()) -> dict:
    """Set limits for the budget asked for; returns facts. Calibration recordings that prove it set them alone.

    Raises:
        TrainingError: see calibrated() and raised().
    """
    asked = FalseAlarmBudget(motion.alarm.false_alarms, motion.alarm.in_hours)
    found, worst = proved(bundle, motion, config)
    promised, facts = found.promised, found.facts
    factor, floors = 1.0, None
    if promised is None or not promised.promise.is_supported or not motion.by_calibration:
        factor = worst.level(asked.rate_per_hour)
        put_factors(bundle, factor, worst.level(max(motion.alarm.contacts_an_hour, asked.rate_per_hour)))
        rest_nm = rest_sigma_nm(bundle) if motion.rest_sigma_nm is None else motion.rest_sigma_nm
        floors = put_floors(bundle, worst.hours, config, rest_nm)
        for moment in facts.get("one_moment", []):
            moment["limit_nm"] *= factor
            moment["without_nm"] *= factor
        low, high = worst.between(factor, config.interval)
        if promised is not None and factor * facts.get("minutes_factor", 1.0) >= 1:
            # The limits are no lower than those that are proved.
            high = max(min(high, promised.promise.supported.rate_per_hour), asked.rate_per_hour)
        facts["extrapolated"] = {
            "per_hour": asked.rate_per_hour,
            "between_per_hour": [low, high],
            "probability": config.interval,
            "hours": worst.hours,
            "factor": factor,
            "largest_seen": float(worst.peaks[0] / factor),
            "floors_nm": [] if floors is None else floors[:, np.array(bundle.monitored)].tolist(),
        }
        facts |= {
            "sentence": asked_sentence(asked, facts["extrapolated"], promised),
            "set_for": str(asked),
            "hold_s": bundle.hold_s,
        }
    facts["budgets"] = budgets(bundle, motion, worst, factor, asked, config)
    motion.note(facts["sentence"])
    motion.note(budgets_sentence(facts["budgets"]))
    if not motion.by_calibration:
        put_other_motion(bundle, motion, found, factor, asked.rate_per_hour, floors)
    note_moments(bundle, [Moment(**one) for one in facts.get("one_moment", [])], motion.note)
    return facts


def proved(bundle: Bundle, motion: LimitMotion, config: AskedConfig) -> tuple[Raised, WorstErrors]:
    """Set the limits of the budget that the motion proves; returns them and the errors beside them."""
    if motion.by_calibration:
        promised, facts = calibrated(bundle, motion)
        assert promised.peaks is not None
        return Raised(promised, facts, facts["sentence"]), worst_of(bundle, promised.peaks, config)
    found = raised(bundle, motion)
    hold_s = min(bundle.hold_s, bundle.contact_hold_s)  # that of contacts, where the limits are the largest errors
    (peaks,) = collect_peaks(bundle, motion.held_out, (hold_s,), motion.threads, motion.margins)
    return found, worst_of(bundle, peaks.of_joints(np.flatnonzero(bundle.monitored)), config)


def worst_of(bundle: Bundle, peaks: Peaks, config: AskedConfig) -> WorstErrors:
    """The errors of the monitored joints beside the bundle's limits."""
    limits = np.array([bundle.sliding_limit_nm, bundle.near_stiction_limit_nm])[:, np.array(bundle.monitored)]
    return WorstErrors.of(peaks.worst(limits), peaks.hours, config)


def put_factors(bundle: Bundle, collision: float, contact: float) -> None:
    """Multiply a bundle's limits: those of a contact follow from those of a collision, and are no higher."""
    for region in REGIONS:
        limit_nm = np.array(getattr(bundle, f"{region}_limit_nm"))
        setattr(bundle, f"contact_{region}_limit_nm", (min(contact, collision) * limit_nm).tolist())
        setattr(bundle, f"{region}_limit_nm", (collision * limit_nm).tolist())


def put_floors(bundle: Bundle, hours: float, config: AskedConfig, sigma_nm: np.ndarray) -> np.ndarray | None:
    """Raise limits that follow the error where they are lowest; returns the least ones sliding and at rest,
    (2, joints), [N m], or None if limits are constant.

    At rest it follows from the joint's friction, as far as the bundle has a prior of it, and its standard error there.

    Args:
        sigma_nm: standard errors at rest in the recorded motion, (joints,); the scale contains those of other programs.
    """
    scale = bundle.error_scale
    if not scale.follows:
        return None
    constant, standstill = FEATURES.index(MotionFeature.constant), FEATURES.index(MotionFeature.standstill)
    friction_nm = np.array([bundle.prior.friction_at_rest_nm(j) for j in range(bundle.joints)])
    least, fades = config.slow_share * faded(hours, config.slow_hours), faded(hours, config.rest_hours)
    rest_nm = fades * np.minimum(config.rest_share * friction_nm, config.rest_errors * sigma_nm)
    at_rest = rest_nm / np.array(bundle.near_stiction_limit_nm)
    weights = np.array(scale.limit_weights).reshape(bundle.joints, -1)
    weights[:, constant] = np.maximum(weights[:, constant], least)
    weights[:, standstill] = np.maximum(weights[:, standstill], at_rest - weights[:, constant])
    scale.limit_weights = weights.ravel().tolist()
    scale.largest = np.maximum(scale.largest, np.maximum(least, at_rest)).tolist()
    bundle.error_scale = scale
    return np.array([least * np.array(bundle.sliding_limit_nm), rest_nm])


def budgets(
    bundle: Bundle,
    motion: LimitMotion,
    worst: WorstErrors,
    factor: float,
    asked: FalseAlarmBudget,
    config: AskedConfig,
) -> list[dict]:
    """The budget asked for and some that allow more false alarms, with their share of the limits and the pushes that
    they notice.

    Args:
        factor: on the limits to which `worst` refers.
    """
    pushes, found = noticed_pushes_n(bundle, motion.poses), []
    for times in (1.0, *config.times_as_many):
        budget = FalseAlarmBudget(asked.alarms, asked.hours / times)
        share = 1.0 if times == 1 else min(worst.level(budget.rate_per_hour) / factor, 1.0)
        found.append(
            {
                "text": str(budget),
                "per_hour": budget.rate_per_hour,
                "between_per_hour": list(worst.between(share * factor, config.interval)),
                "share_of_limits": share,
                "push_n": {place: share * push for place, push in pushes.items()},
            }
        )
    return found


def asked_sentence(asked: FalseAlarmBudget, found: dict, promised: PromisedLimits | None) -> str:
    """What the limits are set for, and what the data alone prove."""
    low, high = found["between_per_hour"]
    words = (
        f"Thresholds are set for {asked}, extrapolated from {duration(found['hours'], 'down')} "
        f"({found['probability']:.0%}: 1 in {duration(1 / high)} {rarest(low)})."
    )
    if promised is None:
        return f"{words} So short a time proves nothing: record more free motion."
    promise = promised.promise
    words += f" The data alone prove 1 in {duration(promise.supported.hours, 'down')} (at {promise.confidence:.0%})"
    if not promise.is_supported:
        words += f"; {duration(promise.missing_hours, 'up')} more of free motion would prove {asked}"
    if promised.suspects:
        left_out, they = ("s are", "they were") if promised.suspects > 1 else (" is", "it was")
        words += (
            f". {promised.suspects} unlabelled contact{left_out} left out; if {they} none, the data prove 1 in "
            f"{duration(1 / promised.bound_per_hour, 'down')}"
        )
    return f"{words}."


RAREST_PER_HOUR = 1e-3
"""A smaller lower end of an interval is stated as `or rarer`."""


def rarest(per_hour: float) -> str:
    """End of an interval of rates."""
    return "or rarer" if per_hour < RAREST_PER_HOUR else f"to 1 in {duration(1 / per_hour)}"


def budgets_sentence(found: Sequence[dict]) -> str:
    """The budgets with the pushes that they notice."""
    entries = []
    for one in found:
        pushes = ", ".join(f"{push:.3g} N at the {place}" for place, push in one["push_n"].items())
        entries.append(f"{one['text']}: {pushes or format(one['share_of_limits'], '.0%') + ' of these thresholds'}")
    return f"detected pushes by target false alarm rate: {'; '.join(entries)}"
