r"""Mean and covariance of the weights of many arms of one type: empirical Bayes by EM, robust to a bad arm.

.. math:: w_{ab} \sim N(\mu_b, \Sigma_b / u_{ab}), \qquad y_a = X_a w_a + e_a

a: an arm, b: a block of weights that vary together (friction of a joint, the inertial corrections of all links). u_ab
is 1 for an arm like the others and falls with how far the arm's block is from those of the others, so steeply that a
worn joint neither moves nor widens the estimate for all. Arms are few and weights many: Sigma_b is drawn
towards its own diagonal, as if MORE_ARMS more had been seen whose weights vary independently.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tauext.fit.regression import inverse

ROUNDS = 60
SETTLED = 1e-3
"""Largest relative change of a block's total variance in the last round."""
MORE_ARMS = 4.0
CLOSE = 2.5
"""Standard deviations up to which an arm is like the others: one healthy arm in 160 is farther away ..."""
STEEP = 6
"""... from where its trust falls with this power of the distance: with the fourth of Mahalanobis', so that what a block
adds to the mean and to the covariance falls, too."""
LEAST_ARMS = 5
"""Among fewer arms, no outlier can be identified."""
USUAL = 1.4826
"""Standard deviation per median distance from the median."""
COMMON, SINGLE = 0.3, 0.1
"""The first guess: all of a block moves by this share, and each weight by what shows as this share of the block."""
WEAK = 1e-2
"""Ridge of the mean that the first guess is about, by the rows."""


@dataclass(frozen=True)
class Evidence:
    """One arm's normal equations, each joint's rows counted by how sure they are: -2 log p = w G w - 2 w b + ..."""

    gram: np.ndarray  # (columns, columns)
    moment: np.ndarray  # (columns,)
    rows: float
    """Independent ones."""


@dataclass(frozen=True)
class Hierarchy:
    """Distribution of an arm type's weights, and each arm's own weights."""

    mean: np.ndarray  # (columns,)
    covariance: np.ndarray  # (columns, columns), block by block: of one more arm
    trust: np.ndarray  # (arms, blocks), u: 1 for an arm like the others
    weights: np.ndarray  # (arms, columns): each arm's own
    errors: np.ndarray  # (arms, columns, columns): their covariance


def learn_hierarchy(evidence: Sequence[Evidence], blocks: Sequence[np.ndarray]) -> Hierarchy:
    """Mean, covariance and trust at the maximum of the likelihood, by EM.

    Args:
        evidence: of at least two arms.
        blocks: columns of each, together all that any arm excites; other columns stay 0.
    """
    width = len(evidence[0].moment)
    scale = scale_of(evidence)
    excited = scale > 0
    inside = [at[excited[at]] for at in blocks]
    scaled = [Evidence(one.gram / outer(scale), one.moment / floor(scale), one.rows) for one in evidence]
    mean, covariance = first_guess(scaled, inside)
    trust = np.ones((len(evidence), len(blocks)))
    distance = np.zeros_like(trust)
    for _ in range(ROUNDS):
        w, V = expected(scaled, mean, covariance, trust, inside)
        alone = expected(scaled, mean, covariance, np.ones_like(trust), inside)
        distance = distances(*alone, moments_without(w, V, trust, inside), inside)
        trust = trust_of(distance)
        before = covariance
        mean, covariance = moments(w, V, trust, inside)
        if settled(before, covariance, inside):
            break
    w, V = expected(scaled, mean, covariance, trust, inside)
    predictive = np.zeros((width, width))
    for b, at in enumerate(inside):
        predictive[np.ix_(at, at)] = covariance[np.ix_(at, at)] * (1 + 1 / trust[:, b].sum())
    back = 1 / floor(scale)
    return Hierarchy(mean * back, predictive * np.outer(back, back), trust, w * back, V * np.outer(back, back))


def scale_of(evidence: Sequence[Evidence]) -> np.ndarray:
    """RMS of each column over the fleet, in standard errors of a row, (columns,); 0: no arm excites it."""
    mean = np.mean([np.diag(one.gram) / max(one.rows, 1.0) for one in evidence], axis=0)
    largest = float(mean.max(initial=0.0))
    return np.sqrt(np.where(mean > 1e-14 * largest, mean, 0.0))


def floor(scale: np.ndarray) -> np.ndarray:
    """The scale, 1 where it is 0."""
    return np.where(scale > 0, scale, 1.0)


def outer(scale: np.ndarray) -> np.ndarray:
    return np.outer(floor(scale), floor(scale))


def first_guess(evidence: Sequence[Evidence], blocks: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """First guess: the mean of all arms as if they were one, and a covariance about it."""
    gram = np.sum([one.gram for one in evidence], axis=0)
    moment = np.sum([one.moment for one in evidence], axis=0)
    rows = sum(one.rows for one in evidence)
    mean, covariance = np.zeros(len(moment)), np.zeros_like(gram)
    used = np.concatenate(blocks)
    ridge = WEAK * rows * np.eye(len(used))
    mean[used] = np.linalg.solve(gram[np.ix_(used, used)] + ridge, moment[used])
    for at in blocks:
        own, block = mean[at], gram[np.ix_(at, at)] / rows
        size = max(float(np.sqrt(max(own @ block @ own, 0.0))), 1.0)
        covariance[np.ix_(at, at)] = COMMON**2 * np.outer(own, own) + (SINGLE * size) ** 2 * np.eye(len(at))
    return mean, covariance


def expected(
    evidence: Sequence[Evidence],
    mean: np.ndarray,
    covariance: np.ndarray,
    trust: np.ndarray,
    blocks: Sequence[np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:
    """Each arm's weights (arms, columns) by its data and the fleet, and their covariance (arms, columns, columns)."""
    used = np.concatenate(blocks)
    w, V = np.tile(mean, (len(evidence), 1)), np.zeros((len(evidence), *covariance.shape))
    precision = [inverse(covariance[np.ix_(at, at)]) for at in blocks]
    for a, one in enumerate(evidence):
        information, right = one.gram.copy(), one.moment.copy()
        for b, at in enumerate(blocks):
            own = trust[a, b] * precision[b]
            information[np.ix_(at, at)] += own
            right[at] += own @ mean[at]
        V[a][np.ix_(used, used)] = inverse(information[np.ix_(used, used)])
        w[a, used] = V[a][np.ix_(used, used)] @ right[used]
    return w, V


def moments(
    w: np.ndarray, V: np.ndarray, trust: np.ndarray, blocks: Sequence[np.ndarray], without: int | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of the arms' weights, all or without one."""
    arms = np.array([a for a in range(len(w)) if a != without])
    mean, covariance = np.zeros(w.shape[1]), np.zeros(V.shape[1:])
    for b, at in enumerate(blocks):
        u, own = trust[arms, b], w[np.ix_(arms, at)]
        mean[at] = u @ own / u.sum()
        apart = own - mean[at]
        spread = (u[:, None] * apart).T @ apart + np.einsum("a,aij->ij", u, V[np.ix_(arms, at, at)])
        share = len(arms) / (len(arms) + MORE_ARMS)
        spread = spread / len(arms)
        covariance[np.ix_(at, at)] = share * spread + (1 - share) * np.diag(np.diag(spread))
    return mean, covariance


Moments = tuple[np.ndarray, np.ndarray]


def moments_without(w: np.ndarray, V: np.ndarray, trust: np.ndarray, blocks: Sequence[np.ndarray]) -> list[Moments]:
    """Mean and covariance of the other arms, for each arm; none with fewer than LEAST_ARMS."""
    return [moments(w, V, trust, blocks, without=a) for a in range(len(w))] if len(w) >= LEAST_ARMS else []


def distances(w: np.ndarray, V: np.ndarray, others: Sequence[Moments], blocks: Sequence[np.ndarray]) -> np.ndarray:
    r"""Distance of each arm's blocks from those of the other arms, (arms, blocks), in standard deviations.

    The squared distance of Mahalanobis is expected over what an arm's own data leave open; its cube root is normal, of
    mean 1 and variance 2 / (9 p) where p weights are as the others' [WilsonHilferty1931]_. Held against the median over
    the arms, since few arms make the covariance too small for one more of them.

    Args:
        w, V: of each arm as if it were trusted; an untrusted arm's wide errors would distort the distance.
        others: mean and covariance of the others, for each arm; none: all distances are 0.
    """
    squares = np.zeros((len(w), len(blocks)))
    if not others:
        return squares
    for a, (mean, covariance) in enumerate(others):
        for b, at in enumerate(blocks):
            precision = inverse(covariance[np.ix_(at, at)])
            apart = w[a, at] - mean[at]
            squares[a, b] = apart @ precision @ apart + float(np.sum(precision * V[a][np.ix_(at, at)]))
    middle = np.maximum(np.median(squares, axis=0), 1e-300)
    root = np.cbrt(squares / middle)
    usual = USUAL * np.median(np.abs(root - 1), axis=0)
    of_chance = np.sqrt(2 / (9 * np.array([max(len(at), 1) for at in blocks])))
    return (root - 1) / np.maximum(usual, of_chance)


def trust_of(distance: np.ndarray) -> np.ndarray:
    """1 up to CLOSE, falling beyond."""
    return (CLOSE / np.maximum(distance, CLOSE)) ** STEEP


def settled(before: np.ndarray, after: np.ndarray, blocks: Sequence[np.ndarray]) -> bool:
    """Whether no block's total variance changed by more than SETTLED."""
    pairs = [(np.diag(before)[at].sum(), np.diag(after)[at].sum()) for at in blocks]
    return all(abs(a - b) <= SETTLED * max(b, 1e-300) for a, b in pairs)
