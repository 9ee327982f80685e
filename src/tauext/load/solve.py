"""A load from its sums: weighted least squares, with what the errors of tau_ext say of their own size and memory."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tauext.load.normal import BLOCK_ROWS, Normal
from tauext.load.rows import BASE_FORCE, COLUMNS, COULOMB, FRAME_FORCE, LOAD, OFFSET, TARGET

PASSES = 4
LEAST_SCALE = 0.5
"""Of an error beside the bundle's sigma: a few seconds may happen to be easy."""
LEAST_CORRELATION = 30.0
"""Rows: errors of friction go with the direction of a move, and last for a good part of one: 0.3 s at least. A fit
takes some of them up, so that what it leaves shows less."""
OWN = (OFFSET, COULOMB)


@dataclass(frozen=True)
class Noise:
    """What is known of the errors of tau_ext beside its sigma."""

    scale: np.ndarray  # (n,): times sigma
    correlation: float  # rows that say as much as one


@dataclass(frozen=True)
class Fit:
    """Coefficients of some columns that all joints share."""

    values: np.ndarray
    covariance: np.ndarray
    own: np.ndarray  # (n, 2): offset and Coulomb friction of each joint, [N m]
    noise: Noise
    misfit: float
    """What is left, in squared standard errors a row: 1 where nothing but the bundle's own error is left."""
    cost: float
    """What is left in independent squared errors, and what the priors hold against it: for comparison."""


def fit(
    normal: Normal,
    which: slice,
    sizes: np.ndarray,
    prior: np.ndarray | None = None,
    noise: Noise | None = None,
) -> Fit:
    """Least squares of tau_ext on some columns, with offset and friction of every joint beside them.

    Args:
        sizes: standard deviations of those, (n, 2).
        prior: information about the coefficients, about 0; None: none.
        noise: None: found in what the fit leaves.
    """
    fixed, noise = noise is not None, noise or Noise(np.ones(len(normal.gram)), float(BLOCK_ROWS))
    shared = list(range(COLUMNS)[which])
    prior = np.zeros((len(shared), len(shared))) if prior is None else prior
    for _ in range(1 if fixed else PASSES):
        found = solve(normal, shared, sizes, prior, noise)
        if not fixed:
            noise = noise_of(normal, shared, found.values, found.own)
    return found


def solve(normal: Normal, shared: list[int], sizes: np.ndarray, prior: np.ndarray, noise: Noise) -> Fit:
    """Normal equations: each joint's own two unknowns are eliminated before the joints are added up."""
    size = len(shared)
    information, moment = prior.copy(), np.zeros(size)
    eliminated = []
    order = [*shared, *OWN, TARGET]
    for j, whole in enumerate(normal.gram):
        gram = whole[np.ix_(order, order)] / (noise.scale[j] ** 2 * noise.correlation)
        own = gram[size : size + 2, size : size + 2] + np.diag(sizes[j] ** -2.0)
        across, beside = gram[:size, size : size + 2], gram[size : size + 2, -1]
        gain = np.linalg.solve(own, np.column_stack([across.T, beside]))
        information += gram[:size, :size] - across @ gain[:, :size]
        moment += gram[:size, -1] - across @ gain[:, -1]
        eliminated.append(gain)
    covariance = np.linalg.pinv(information, hermitian=True)
    values = covariance @ moment
    own_values = np.array([gain[:, -1] - gain[:, :size] @ values for gain in eliminated])
    left = left_over(normal.gram, shared, values, own_values)
    cost = float(np.sum(left / noise.scale**2) / noise.correlation)
    cost += float(np.sum((own_values / sizes) ** 2) + values @ prior @ values)
    misfit = float(left.sum() / max(normal.worth.sum(), 1e-9))
    return Fit(values, covariance, own_values, noise, misfit, cost)


def left_over(grams: np.ndarray, shared: list[int], values: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Sum of squares that the coefficients leave of each joint, (n,)."""
    left = np.empty(len(grams))
    for j, gram in enumerate(grams):
        theta = np.zeros(COLUMNS)
        theta[shared], theta[list(OWN)], theta[TARGET] = -values, -own[j], 1.0
        left[j] = theta @ gram @ theta
    return np.maximum(left, 0.0)


def noise_of(normal: Normal, shared: list[int], values: np.ndarray, own: np.ndarray) -> Noise:
    """Size and correlation of the errors that a fit leaves: sums over blocks grow with how long errors last."""
    single = left_over(normal.gram, shared, values, own)
    blocks = left_over(normal.blocks, shared, values, own)
    scale = np.sqrt(np.maximum(single / np.maximum(normal.worth, 1e-9), LEAST_SCALE**2))
    correlation = np.sum(blocks / scale**2) / max(np.sum(single / scale**2), 1e-300)
    return Noise(scale, float(np.clip(correlation, LEAST_CORRELATION, BLOCK_ROWS)))


def models(normal: Normal, sizes: np.ndarray, prior: np.ndarray, noise: Noise) -> dict[str, Fit]:
    """The same sums by each of what may have acted: a load, a force along the base's axes, one along the frame's."""
    return {
        "load": fit(normal, LOAD, sizes, prior, noise),
        "base": fit(normal, BASE_FORCE, sizes, noise=noise),
        "frame": fit(normal, FRAME_FORCE, sizes, noise=noise),
        "nothing": fit(normal, slice(0, 0), sizes, noise=noise),
    }
