r"""What a fleet of its type tells a refit: joints that hardly moved follow those that did.

.. math:: \log f \sim N(0, D), \qquad \log \hat f_m = \log f_m + e_m

D: how friction differs from one recording of an arm to the next (tauext.fleet.days); m: joints that moved. A
joint that did not is expected at the mean of log f under both. One whose own minute says more than that is left to it,
and one that the others contradict tells them nothing: it wears, and was not warmed.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tauext import _core
from tauext.errors import ConfigError
from tauext.fit.fleet_prior import FleetPrior
from tauext.fit.hierarchy import CLOSE

LEAST_MOVED_S = 10.0
"""A joint that moved for less showed too little of its friction."""
LEAST_AGREEING = 2
"""Joints: what one alone shows may be its own wear."""


def expect_days(like: FleetPrior, bundle: _core.Bundle) -> np.ndarray:
    """The fleet's covariance between recordings of one arm, (n, n), in the bundle's order of joints.

    Raises:
        ConfigError: it is of other joints, or none of its arms had several recordings.
    """
    joints = tuple(link.joint_name for link in bundle.links)
    if like.type.joints != joints:
        told, own = ", ".join(like.type.joints), ", ".join(joints)
        raise ConfigError(f"like: joints = ({told}) of the fleet prior must be ({own}) as of the bundle")
    if like.days is None:
        raise ConfigError(
            "like: this fleet prior knows how arms differ and not how days do, which is another thing; make it of arms "
            "with two recordings or more each, from different times of the day"
        )
    return like.days.covariance


def expectations(
    factor: np.ndarray, error: np.ndarray, moved_s: np.ndarray, days: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Of a joint's friction by the old one what the other joints say: mean and standard deviation, (n,) each, and which
    joints are to follow, (n,) bool; None: none is.

    Args:
        factor, error: of each joint by its own minute, (n,).
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
    """Mean and standard deviation of a joint's logarithm by those of others."""
    gain = days[joint, others] @ np.linalg.inv(days[np.ix_(others, others)] + np.diag(error[others] ** 2))
    left = days[joint, joint] - gain @ days[others, joint]
    return float(gain @ log_factor[others]), float(np.sqrt(max(left, 0.0)))


def agreeing(joints: np.ndarray, log_factor: np.ndarray, error: np.ndarray, days: np.ndarray) -> np.ndarray:
    """Those of the joints that none of the others contradicts: the farthest is left out until all are CLOSE."""
    while len(joints) >= LEAST_AGREEING:
        far = [distance(j, joints[joints != j], log_factor, error, days) for j in joints]
        worst = int(np.argmax(far))
        if far[worst] <= CLOSE:
            break
        joints = np.delete(joints, worst) if len(joints) > LEAST_AGREEING else joints[:0]
    return joints


def distance(joint: int, others: np.ndarray, log_factor: np.ndarray, error: np.ndarray, days: np.ndarray) -> float:
    """Standard deviations between what the joint showed and what the others let expect."""
    mean, spread = predicted(joint, others, log_factor, error, days)
    return abs(float(log_factor[joint]) - mean) / float(np.hypot(spread, error[joint]))


Numbers = Sequence[float] | np.ndarray


def settings_with(mean: Numbers, error: Numbers, follows: Sequence[bool] | np.ndarray) -> _core.RefitSettings:
    """A refit's settings in which these joints are expected there, and the others as without a fleet."""
    settings = _core.RefitSettings()
    pairs = zip(mean, error, follows, strict=True)
    told = [(float(m), float(e)) if on else (1.0, settings.common) for m, e, on in pairs]
    settings.expected, settings.expected_error = [m for m, _ in told], [e for _, e in told]
    return settings
