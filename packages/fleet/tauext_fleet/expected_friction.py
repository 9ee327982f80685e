r"""Refit with a fleet prior: joints that hardly moved follow those that did.

.. math:: \log f \sim N(0, D), \qquad \log \hat f_m = \log f_m + e_m

D is the covariance of log friction between recordings of one arm (prior_evidence.py); m are the joints that moved. A
joint that did not move is expected at the mean of log f under both. A joint whose own minute determines its friction
better keeps that. A joint that the others contradict is ignored: its change is wear, not temperature.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tauext import _core
from tauext.train.refit import LEAST_MOVED_S
from tauext_fleet.hierarchy import CLOSE

LEAST_AGREEING = 2
"""Fewest joints that moved; the change of a single one may be wear."""


def expectations(
    factor: np.ndarray, error: np.ndarray, moved_s: np.ndarray, days: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Expected ratio of each joint's friction to the old one, from the other joints: mean and standard deviation, (n,)
    each, and which joints follow it, (n,) bool; None: no joint does.

    Args:
        factor, error: ratio and standard error of each joint from its own minute, (n,).
        days: covariance of their logarithms from one recording to the next, (n, n).
    """
    telling = agreeing(np.flatnonzero(moved_s >= LEAST_MOVED_S), np.log(factor), error / factor, days)
    if len(telling) < LEAST_AGREEING:
        return None
    mean, spread = np.ones(len(factor)), np.zeros(len(factor))
    for j in range(len(factor)):
        others = telling[telling != j]
        log_mean, spread[j] = predicted(j, others, np.log(factor), error / factor, days)
        mean[j] = np.exp(log_mean)
    follows = (moved_s < LEAST_MOVED_S) & (mean * spread < error)
    return (mean, mean * spread, follows) if follows.any() else None


def predicted(
    joint: int, others: np.ndarray, log_factor: np.ndarray, error: np.ndarray, days: np.ndarray
) -> tuple[float, float]:
    """Mean and standard deviation of a joint's logarithm, predicted from the others'."""
    gain = days[joint, others] @ np.linalg.inv(days[np.ix_(others, others)] + np.diag(error[others] ** 2))
    left = days[joint, joint] - gain @ days[others, joint]
    return float(gain @ log_factor[others]), float(np.sqrt(max(left, 0.0)))


def agreeing(joints: np.ndarray, log_factor: np.ndarray, error: np.ndarray, days: np.ndarray) -> np.ndarray:
    """Joints that agree with the others: the farthest is left out until all are CLOSE."""
    while len(joints) >= LEAST_AGREEING:
        far = [distance(j, joints[joints != j], log_factor, error, days) for j in joints]
        worst = int(np.argmax(far))
        if far[worst] <= CLOSE:
            break
        joints = np.delete(joints, worst) if len(joints) > LEAST_AGREEING else joints[:0]
    return joints


def distance(joint: int, others: np.ndarray, log_factor: np.ndarray, error: np.ndarray, days: np.ndarray) -> float:
    """Distance between the joint's value and the others' expectation, in standard deviations."""
    mean, spread = predicted(joint, others, log_factor, error, days)
    return abs(float(log_factor[joint]) - mean) / float(np.hypot(spread, error[joint]))


Numbers = Sequence[float] | np.ndarray


def settings_with(mean: Numbers, error: Numbers, follows: Sequence[bool] | np.ndarray) -> _core.RefitSettings:
    """Settings of a refit with expectations for the joints that follow; the others as without a fleet."""
    settings = _core.RefitSettings()
    pairs = zip(mean, error, follows, strict=True)
    expected = [(float(m), float(e)) if on else (1.0, settings.common) for m, e, on in pairs]
    settings.expected, settings.expected_error = [m for m, _ in expected], [e for _, e in expected]
    return settings
