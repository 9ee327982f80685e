r"""Which numbers of a table of arms and joints are none that healthy arms have, and how probable that is.

.. math:: x_{aj} = c_j + A_a + e_{aj} + w_{aj}

x: a logarithm of friction or of a constant, or a mass. c_j is what all arms have in common (a winter, a type's
friction), A_a what all joints of an arm do (a cold hall), e_aj ~ N(0, s_aj^2 + sigma_J^2) what a healthy joint does by
itself, beside the standard error s_aj. With a small probability the joint is another one now, up or down: |w| is half
normal. How far healthy arms and joints differ (sigma_A, sigma_J), and how often one is another (pi), is learned from
the table itself: all of them are integrated over, A exactly so, arm by arm; c is at its most probable. So a number
counts by how it stands out among its own arm's joints and among all arms' same joint, and by nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import log_ndtr

ARM_STEPS, JOINT_STEPS = 2.0 ** np.arange(-1.6, 1.61, 0.8), 2.0 ** np.arange(-1.6, 1.61, 0.4)
"""Of the usual spreads, those that are tried; finer where it matters more."""
DOUBLE = np.log(2.0)
"""The prior of a spread has a standard deviation of a factor of two."""
SHARES = (0.005, 0.03)
"""Shares of joints that changed between two dates; both equally probable."""
ODD_ARM = 0.05
"""Share of arms all of whose joints differ from those of the others."""
POINTS = 161
"""Spread of an arm's A."""
ROUNDS = 3
"""Of the centre and of which joints it is the centre of."""
FAR = 5.0
"""Standard deviations beyond which a density is neglected."""
LEAST_WEIGHT = 1e-5
LIKELIEST = 12
NAMED = 0.5
"""Least probability of a named joint: more likely than not."""
FARTHEST, FARTHEST_JUMPS = np.log(6.0), 6.0
"""Upper end of the search for the smallest named value: a factor; in other units, usual jumps."""


@dataclass(frozen=True)
class Question:
    """The prior of a table; in its own unit, for logarithms as shares."""

    arm_spread: float
    """Usual sigma_A; 0: no common part of the columns."""
    joint_spread: float
    """Usual sigma_J."""
    jump: float
    """Scale of w."""
    common: float
    """Standard deviation of what all c_j have in common."""
    apart: float
    """Standard deviation of each c_j by itself."""
    odd_arm: float = 0.3
    """Standard deviation of A of an arm on a day that no other had."""


class Spreads(NamedTuple):
    """One guess of the unknown spreads."""

    arm: float
    joint: float


class Guess(NamedTuple):
    """One guess of all unknowns, and its probability."""

    spreads: Spreads
    share: float
    centre: np.ndarray
    doubt: np.ndarray  # (joints,): variance of the centre
    log_weight: float


@dataclass(frozen=True)
class Odds:
    """Probabilities of a table."""

    more: np.ndarray  # (arms, joints): probability of w > 0; NaN where there is no number
    less: np.ndarray  # (arms, joints): of w < 0
    centre: np.ndarray  # (joints,): c
    shift: np.ndarray  # (arms,): A, what all joints of the arm do
    arm_spread: float
    joint_spread: float
    named_from: float
    """The least x beside what is usual for which a joint of an arm like the others would be named; inf: none would."""


def learn_odds(values: np.ndarray, errors: np.ndarray, question: Question) -> Odds:
    """The probability, number by number, that it is none of a healthy arm.

    Args:
        values: (arms, joints), NaN where there is none.
        errors: (arms, joints), standard errors.
    """
    known = np.isfinite(values)
    x, s = np.where(known, values, 0.0), np.where(known, errors, 1.0)
    table = Table(x, s, known, question)
    arm_steps = ARM_STEPS if question.arm_spread > 0 else (0.0,)
    spreads = [Spreads(a * question.arm_spread, j * question.joint_spread) for a in arm_steps for j in JOINT_STEPS]
    guesses = [guess for one in spreads for guess in table.guesses(one, first_centre(values, question))]
    weights = np.exp([guess.log_weight - max(one.log_weight for one in guesses) for guess in guesses])
    weights /= weights.sum()
    more, less, centre, shift = np.zeros_like(x), np.zeros_like(x), np.zeros(x.shape[1]), np.zeros(len(x))
    for guess, weight in zip(guesses, weights, strict=True):
        centre += weight * guess.centre
        if weight > LEAST_WEIGHT:
            found = table.sums(guess.spreads, guess.centre, guess.doubt).posterior(guess.share)
            more, less = more + weight * found.more, less + weight * found.less
            shift += weight * found.shift
    nowhere = np.where(known, 0.0, np.nan)
    arm, joint = (float(weights @ [guess.spreads[k] for guess in guesses]) for k in (0, 1))
    from_x = named_from(guesses, weights, s[known], x.shape[1], question) if known.any() else np.inf
    return Odds(more + nowhere, less + nowhere, centre, shift, arm, joint, from_x)


def first_centre(values: np.ndarray, question: Question) -> np.ndarray:
    """Median of each joint; 0 where too few arms determine what is common."""
    joints = [column[np.isfinite(column)] for column in values.T]
    few = len(values) < 3 and question.apart < 1
    return np.array([0.0 if few or len(column) == 0 else float(np.median(column)) for column in joints])


@dataclass(frozen=True)
class Posterior:
    """What one guess makes of the arms, with one share of joints that are others."""

    more: np.ndarray  # (arms, joints)
    less: np.ndarray
    odd: np.ndarray  # (arms,): probability of a day that no other arm had
    shift: np.ndarray  # (arms,): mean of A


@dataclass(frozen=True)
class Sums:
    """Densities of the arms' numbers on the grid of A."""

    same: np.ndarray  # (arms, points, joints) log densities
    up: np.ndarray
    down: np.ndarray
    prior: np.ndarray  # (arms, points), log, of A with the width of a point
    odd: np.ndarray  # (arms, points): share of the odd arms in it
    points: np.ndarray  # (arms, points): A

    def log_any(self, share: float) -> np.ndarray:
        """Log density of each number under the mixture of usual and unusual joints, (arms, points, joints)."""
        other = np.logaddexp(self.up, self.down) + np.log(share / 2)
        return np.logaddexp(self.same + np.log1p(-share), other)

    def evidence(self, share: float) -> float:
        """Log likelihood of the whole table."""
        return float(np.sum(log_sum(self.log_any(share).sum(axis=2) + self.prior)))

    def posterior(self, share: float) -> Posterior:
        whole = self.log_any(share)
        joint = whole.sum(axis=2) + self.prior
        at = np.exp(joint - log_sum(joint)[:, None])
        half = np.log(share / 2)
        more = np.einsum("ap,apj->aj", at, np.exp(self.up + half - whole))
        less = np.einsum("ap,apj->aj", at, np.exp(self.down + half - whole))
        return Posterior(more, less, np.sum(at * self.odd, axis=1), np.sum(at * self.points, axis=1))


@dataclass(frozen=True)
class Table:
    """The numbers, and their prior."""

    x: np.ndarray
    s: np.ndarray
    known: np.ndarray
    question: Question

    def sums(self, spreads: Spreads, centre: np.ndarray, doubt: np.ndarray) -> Sums:
        """Of one guess.

        Args:
            doubt: variance of the centre, (joints,).
        """
        apart = np.where(self.known, self.x - centre, 0.0)
        variance = self.s**2 + spreads.joint**2 + doubt
        points, width = self.grid(spreads, apart, variance)
        d = apart[:, None, :] - points[:, :, None]
        var = np.broadcast_to(variance[:, None, :], d.shape)
        wide = var + self.question.jump**2
        lean = d * self.question.jump / np.sqrt(var * wide)
        far = np.log(2) + log_normal(d, wide)
        known = self.known[:, None, :]
        same, up, down = (
            np.where(known, one, 0.0) for one in (log_normal(d, var), far + log_ndtr(lean), far + log_ndtr(-lean))
        )
        usual = np.log1p(-ODD_ARM) + log_normal(points, max(spreads.arm, 1e-9) ** 2)
        odd = np.log(ODD_ARM) + log_normal(points, self.question.odd_arm**2 + spreads.arm**2)
        if self.question.arm_spread == 0:
            nothing = np.zeros_like(points)
            return Sums(same, up, down, nothing, nothing, points)
        prior = np.logaddexp(usual, odd)
        return Sums(same, up, down, prior + np.log(width)[:, None], np.exp(odd - prior), points)

    def grid(self, spreads: Spreads, apart: np.ndarray, variance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points of A for each arm, (arms, points), and how far apart: all that its joints and 0 leave open."""
        if self.question.arm_spread == 0:
            return np.zeros((len(apart), 1)), np.ones(len(apart))
        wide = FAR * np.sqrt(variance.max(axis=1))
        low = np.minimum(apart.min(axis=1), 0.0) - np.minimum(wide, FAR * spreads.arm + wide / FAR)
        high = np.maximum(apart.max(axis=1), 0.0) + np.minimum(wide, FAR * spreads.arm + wide / FAR)
        points = low[:, None] + (high - low)[:, None] * np.linspace(0, 1, POINTS)
        return points, (high - low) / (POINTS - 1)

    def guesses(self, spreads: Spreads, centre: np.ndarray) -> list[Guess]:
        """With the most probable centre of each share, and how probable all of that is (Laplace)."""
        known = -0.5 * (np.log(spreads.joint / self.question.joint_spread) / DOUBLE) ** 2
        if self.question.arm_spread > 0:
            known -= 0.5 * (np.log(spreads.arm / self.question.arm_spread) / DOUBLE) ** 2
        sure, found = np.zeros(len(centre)), []
        for share in SHARES:
            for _ in range(ROUNDS):
                centre, covariance = self.centre(spreads, self.sums(spreads, centre, sure).posterior(share))
            log = known + self.sums(spreads, centre, sure).evidence(share)
            log += log_normal_vector(centre, self.prior_of_centre()) + 0.5 * np.linalg.slogdet(covariance)[1]
            found.append(Guess(spreads, share, centre, np.diag(covariance).copy(), float(log)))
        return found

    def prior_of_centre(self) -> np.ndarray:
        """Its covariance, (joints, joints)."""
        joints = self.x.shape[1]
        return self.question.common**2 * np.ones((joints, joints)) + self.question.apart**2 * np.eye(joints)

    def centre(self, spreads: Spreads, found: Posterior) -> tuple[np.ndarray, np.ndarray]:
        """c and its covariance by the joints that are as before, each by how probable that is: least squares over arms
        whose joints have A in common."""
        joints = self.x.shape[1]
        information, right = np.linalg.inv(self.prior_of_centre()), np.zeros(joints)
        healthy = np.where(self.known, np.clip(1 - found.more - found.less, 1e-9, 1.0), 1e-9)
        own = healthy / (self.s**2 + spreads.joint**2)
        for a, of_joint in enumerate(own):
            of_arm = 0.0
            if self.question.arm_spread > 0:
                usual, odd = spreads.arm**2, self.question.odd_arm**2 + spreads.arm**2
                of_arm = 1 / ((1 - found.odd[a]) / usual + found.odd[a] / odd)
            whole = np.diag(of_joint) - np.outer(of_joint, of_joint) * of_arm / (1 + of_arm * of_joint.sum())
            information = information + whole
            right = right + whole @ self.x[a]
        covariance = np.linalg.inv(information)
        return covariance @ right, covariance


def named_from(guesses: list[Guess], weights: np.ndarray, errors: np.ndarray, joints: int, question: Question) -> float:
    """By how much one joint of an arm like the others must be more than usual, to be named."""
    tried = np.linspace(0.01, 1.0, 100) * (FARTHEST if question.arm_spread > 0 else FARTHEST_JUMPS * question.jump)
    x = np.zeros((len(tried), joints))
    x[:, 0] = tried
    table = Table(x, np.full_like(x, np.median(errors)), np.ones_like(x, dtype=bool), question)
    keep = np.argsort(-weights)[:LIKELIEST]
    more = np.zeros(len(tried))
    for k in keep:
        sums = table.sums(guesses[k].spreads, np.zeros(joints), guesses[k].doubt)
        more += weights[k] / weights[keep].sum() * sums.posterior(guesses[k].share).more[:, 0]
    over = np.flatnonzero(more >= NAMED)
    return float(tried[over[0]]) if len(over) else np.inf


def log_normal(d: np.ndarray, variance: np.ndarray | float) -> np.ndarray:
    return -0.5 * (d**2 / variance + np.log(2 * np.pi * np.asarray(variance)))


def log_normal_vector(x: np.ndarray, covariance: np.ndarray) -> float:
    """Log density without the constant of 2 pi, which cancels in Laplace's integral."""
    return -0.5 * float(x @ np.linalg.solve(covariance, x) + np.linalg.slogdet(covariance)[1])


def log_sum(logs: np.ndarray) -> np.ndarray:
    """Log of the sum of the exponentials along the last axis."""
    top = logs.max(axis=-1)
    return top + np.log(np.exp(logs - top[..., None]).sum(axis=-1))
