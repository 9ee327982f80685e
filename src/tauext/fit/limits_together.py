r"""Limits chosen together: the rates of all tails sum to the arm's, which a budget bounds.

Limits x_s of the joints' regions s are those by which the arm detects most, at a sum of rates within the budget B:

.. math:: \min_x \sum_h \ln F_h, \quad F_h = \min_j \frac{x_j}{|\tau_{hj}|}, \quad
          P\Big(\sum_s \lambda_s(x_s) \le B\Big) \ge c

tau_h is a hit's torque of unit size and F_h the size from which a limit is exceeded: sizes are spread evenly over
their logarithm. Each tail is allowed a mean rate. At the best of them, a little more rate lowers ln F equally
wherever it is spent, so a tail's rate is proportional to the share of hits that it decides, times d ln x / d ln rate.
Confidence is asked of the sum: what one tail has too much of, others have too little of.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from tauext.fit.tail import FalseAlarmBudget, Tail


@dataclass(frozen=True)
class ShareConfig:
    """How a budget is shared by the tails."""

    sharpness: float = 12.0
    """How sharply the joint with the smallest size of a hit decides, in its logarithm: within 8 % joints share."""
    equal: float = 0.2
    """Share of the budget that is split equally: which joints decide is known from hits at the ends of links alone, and
    a larger share raises the forces noticed there."""


class TailCurve:
    """Level of a tail by its mean rate, and draws of the rate over each level."""

    def __init__(self, tail: Tail, number: int):
        """Number: of the tail among those of an arm, so that draws of two tails are independent.

        Rates are known at up to 24 levels below the threshold and 72 beyond it, up to 60 times the largest excess.
        """
        spread = tail.peaks_nm[0] - tail.threshold_nm
        below = np.unique(tail.peaks_nm[tail.exceedances :])
        below = below[np.unique(np.linspace(0, len(below) - 1, 24).round().astype(int))]
        self._levels = np.r_[below, tail.threshold_nm + spread * np.geomspace(0.01, 60.0, 72)]
        with np.errstate(divide="ignore"):
            rates = np.maximum(tail.rates(self._levels, np.random.default_rng(number)), 1e-30)
        self._logs = np.log(rates)
        self._mean = np.log(rates.mean(axis=0))

    def level(self, rate: float) -> float:
        """Level with this mean rate, [N m]; the largest that is looked at if the tail reaches further."""
        return float(np.interp(-math.log(rate), -self._mean, self._levels))

    def slope(self, rate: float) -> float:
        """- d ln level / d ln rate, 1e-3 at least."""
        near = [math.log(max(self.level(rate * factor), 1e-300)) for factor in (1.5, 1 / 1.5)]
        return max((near[1] - near[0]) / (2 * math.log(1.5)), 1e-3)

    def draws(self, level: float) -> np.ndarray:
        """Rates over the level, (draws,), [1/h]."""
        k = int(np.clip(np.searchsorted(self._levels, level) - 1, 0, len(self._levels) - 2))
        share = np.clip((level - self._levels[k]) / (self._levels[k + 1] - self._levels[k]), 0, 1)
        drawn: np.ndarray = np.exp((1 - share) * self._logs[:, k] + share * self._logs[:, k + 1])
        return drawn


def rates_together(
    tails: Sequence[Sequence[Tail]],
    budget: FalseAlarmBudget,
    confidence: float,
    hits_nm: np.ndarray,
    region_hours: np.ndarray,
    config: ShareConfig = ShareConfig(),
) -> np.ndarray:
    """Mean rate that each tail is allowed, (joints, regions), [1/h], for the limits that detect most together.

    Args:
        tails: of each joint's regions.
        confidence: that all of them together stay within the budget.
        hits_nm: torques of hits of unit size, (hits, joints), of any sign; equally many for equal weights. A hit that
            loads no joint, such as one on a link before the first monitored joint, counts nothing; if all are of that
            kind, one that loads every joint alike takes their place.
        region_hours: hours of each joint in each region, (joints, regions): a hit finds it there as often.
    """
    shape = len(tails), len(tails[0])
    curves = [TailCurve(tail, number) for number, tail in enumerate(tail for of_joint in tails for tail in of_joint)]
    often = region_hours / np.maximum(region_hours.sum(axis=1, keepdims=True), 1e-300)
    felt = (hits_nm != 0).any(axis=1)
    hits_nm = hits_nm[felt] if felt.any() else np.ones((1, shape[0]))
    hits_nm = np.tile(hits_nm, (-(-500 // len(hits_nm)), 1))  # each meets its joints in all regions
    order = np.random.default_rng(0).random(hits_nm.shape)
    region = np.minimum((order[:, :, None] > often.cumsum(axis=1)).sum(axis=2), shape[1] - 1)
    # Of every hit and joint: number of the tail that it meets.
    met = np.arange(shape[0]) * shape[1] + region
    with np.errstate(divide="ignore"):
        lever = np.log(np.abs(hits_nm))
    share = np.full(len(curves), 1 / len(curves))
    for _ in range(40):
        levels = np.log(
            [max(curve.level(budget.rate_per_hour * one), 1e-300) for curve, one in zip(curves, share, strict=True)]
        )
        force = levels[met] - lever
        decides = np.exp(-config.sharpness * (force - force.min(axis=1, keepdims=True)))
        decides /= decides.sum(axis=1, keepdims=True)
        worth = np.bincount(met.ravel(), decides.ravel(), len(curves))
        worth *= np.array([curve.slope(budget.rate_per_hour * one) for curve, one in zip(curves, share, strict=True)])
        share = np.sqrt(share * ((1 - config.equal) * worth / worth.sum() + config.equal / len(curves)))
        share /= share.sum()

    def over(log_factor: float) -> float:
        rates = math.exp(log_factor) * budget.rate_per_hour * share
        levels = [curve.level(rate) for curve, rate in zip(curves, rates, strict=True)]
        drawn = np.sum([curve.draws(level) for curve, level in zip(curves, levels, strict=True)], axis=0)
        return math.log(float(np.quantile(drawn, confidence)) / budget.rate_per_hour)

    low, high = -7.0, 7.0  # of the logarithm of what the confidence costs in rate
    factor = low if over(low) > 0 else high if over(high) < 0 else brentq(over, low, high, xtol=1e-3)
    allowed: np.ndarray = (math.exp(factor) * budget.rate_per_hour * share).reshape(shape)
    return allowed
