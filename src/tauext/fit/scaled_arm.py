"""A model's inertia and its torque constants, corrected together: most likely by what free motion shows."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize

from tauext import _core
from tauext.fit.kinematic_sample import ROW_S, KinematicSample
from tauext.robot.inertial import PARAMETERS, inertial_parameters

ROTOR = len(PARAMETERS) - 1
MASS_OFF = 0.1
"""Share by which a link's mass is off, at a place within the link; only how the links compare matters, see doubt."""
TOOL = 0.1
"""Mass of what may hang at the last link beside it, as a share of the arm's; at so large a share of its reach."""
INDEPENDENT_S = 1.0
"""What friction leaves unexplained stays for about as long, so that many samples say no more than one."""
KNOWN = 0.5
"""Standard error, as a share, from which on a constant of the model as it is says nothing, not even its sign."""
SIGN_TIE = 1.0
"""By so much in the logarithm of the evidence an inverted sign must be more likely: a factor of e says nothing, and few
drives report their current with the sign inverted."""
LEAST_NOISE = 1e-6
ROUNDS = 8
DELTA = 1e-4


@dataclass(frozen=True)
class ScaledArm:
    """Torque constants and how well they are known."""

    nm_per_unit: np.ndarray  # (n,)
    log_errors: np.ndarray
    """(n,) standard errors of their logarithms."""
    doubt: float
    """How wrong the model turned out to be: 1 where masses are off by MASS_OFF."""


def fit_scaled_arm(
    sample: KinematicSample, tree: _core.Tree, log_spread: float, start: np.ndarray | None = None
) -> ScaledArm:
    r"""Constants k at the maximum of the evidence, over all inertial parameters that the arm may have.

    .. math:: r_j = s_j Z_j \theta + F_j w_j + \epsilon_j, \quad s_j = e^{-x_j} / k_{0,j}, \quad
              \theta \sim N(\theta_0, \tau^2 D^2), \quad x_j \sim N(0, \sigma_x^2), \quad \ln\tau \sim N(0, 1)

    r is the observer's without a model, in the recordings' unit, Z what a unit of each inertial parameter adds to it,
    in N m, F a joint's friction and rotor. theta_0 are the model's parameters, D is how far those of an arm may be from
    them; tau is found along with x, so that a good model counts for more than a bad one. theta is integrated over: at
    its best value alone, constants would shrink to nothing where the model fits badly. The noise of a joint is what its
    fit leaves; INDEPENDENT_S of it counts as one sample.

    Args:
        sample: without a model.
        log_spread: sigma_x.
        start: (n,) k_0, with sign; None: from the model as it is, but with the sign that is more likely where it is < 0
            there: what hangs at a wrist may weigh more than the wrist.
    """
    n = sample.joints
    model, spread = np.array([inertial_parameters(link)[:ROTOR] for link in tree.links]).ravel(), spreads(tree)
    Z = sample.regressors(tree, range(n), range(len(PARAMETERS))).reshape(sample.rows, n, n, len(PARAMETERS))
    parts = []
    for j in range(n):
        beside = np.column_stack([sample.own[j], Z[:, j, j, ROTOR]])
        left = unexplained(np.column_stack([Z[:, j, :, :ROTOR].reshape(sample.rows, -1), sample.target[:, j]]), beside)
        parts.append(left.T @ left)
    count = max(1.0, sample.rows * ROW_S / INDEPENDENT_S)
    grams, begun = np.array(parts), start is None
    # A joint whose torque friction explains to the last bit, as one of 0 throughout, says nothing of its constant.
    grams[grams[:, -1, -1] <= LEAST_NOISE**2 * sample.rows] = 0.0
    start = as_it_is(grams, model, count) if start is None else start
    evidence = Evidence(grams, model, spread, start, log_spread)
    at, weights, cost = most_likely(evidence, sample.rows, count)
    for k in np.flatnonzero(start < 0) if begun else ():
        turned = replace(evidence, start=np.where(np.arange(n) == k, -evidence.start, evidence.start))
        other = most_likely(turned, sample.rows, count)
        if other[2] < cost + SIGN_TIE:
            evidence, (at, weights, cost) = turned, other
    steps = DELTA * np.eye(n + 1)
    slopes = [evidence.cost(at + h, weights)[1] - evidence.cost(at - h, weights)[1] for h in steps]
    curvature = np.array(slopes) / (2 * DELTA)
    variances = np.diag(np.linalg.pinv((curvature + curvature.T) / 2))[:n]
    return ScaledArm(evidence.constants(at), np.sqrt(np.maximum(variances, 0.0)), float(np.exp(at[-1])))


def most_likely(evidence: Evidence, rows: int, count: float) -> tuple[np.ndarray, np.ndarray, float]:
    """The unknowns, each joint's weight and the cost there, with the noise that is found along with them.

    Args:
        count: independent samples.
    """
    at, least = np.zeros(len(evidence.start) + 1), LEAST_NOISE**2 * rows
    weights = count / np.maximum(evidence.grams[:, -1, -1] / 10, least)  # most of r is explained in the end
    for _ in range(ROUNDS):
        at = minimize(lambda x, w=weights: evidence.cost(x, w)[:2], at, jac=True, method="BFGS").x
        weights = count / np.maximum(evidence.squares(at, weights), least)
    return at, weights, evidence.cost(at, weights)[0] - count / 2 * float(np.log(weights).sum())


def as_it_is(grams: np.ndarray, model: np.ndarray, count: float) -> np.ndarray:
    """Constants that the model has if nothing of it is off, (n,); a joint where that says nothing gets the mean.

    Args:
        count: independent samples.
    """
    of_model, together = model @ grams[:, :-1, :-1] @ model, grams[:, :-1, -1] @ model
    with np.errstate(divide="ignore", invalid="ignore"):
        constants = of_model / together
        explained = together**2 / (of_model * grams[:, -1, -1])
        known = np.isfinite(constants) & ((1 - explained) < KNOWN**2 * count * explained)
    usual = np.exp(np.mean(np.log(np.abs(constants[known])))) if known.any() else 1.0
    return np.where(known, constants, usual)


def unexplained(columns: np.ndarray, beside: np.ndarray) -> np.ndarray:
    """What a fit of columns by those beside them leaves."""
    return columns - beside @ np.linalg.lstsq(beside, columns, rcond=None)[0]


def spreads(tree: _core.Tree) -> np.ndarray:
    """D: how far parameters may be off, (10 n,), from a mass that is missing or too much somewhere on its link."""
    reach = sum(float(np.linalg.norm(link.translation)) for link in tree.links[1:])
    whole = sum(link.mass for link in tree.links)
    rows = []
    for k, link in enumerate(tree.links):
        p = inertial_parameters(link)
        mass, size = MASS_OFF * link.mass, np.sqrt(max(p[4:7].sum(), 0.0) / (2 * max(link.mass, 1e-9)))
        if k == tree.size - 1:
            mass, size = np.hypot(mass, TOOL * whole), max(size, TOOL * reach)
        rows.append(np.r_[mass, np.full(3, mass * size), np.full(6, mass * size**2)])
    return np.concatenate(rows)


@dataclass(frozen=True)
class Evidence:
    """Of constants and doubt, for columns of which friction and rotors were taken out."""

    grams: np.ndarray
    """(n, 10 n + 1, 10 n + 1) of each joint's Z and r."""
    model: np.ndarray
    spread: np.ndarray
    start: np.ndarray
    log_spread: float

    def constants(self, at: np.ndarray) -> np.ndarray:
        """(n,) of the unknowns (x, ln tau)."""
        return self.start * np.exp(at[:-1])

    def cost(self, at: np.ndarray, weights: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """-ln of the evidence but for a constant, its gradient, and the most likely parameters.

        Args:
            weights: (n,) of each joint's squares: 1 / variance of a row.
        """
        n = len(self.start)
        scales, spread = 1 / self.constants(at), np.exp(at[-1]) * self.spread
        Q, q = self.grams[:, :-1, :-1], self.grams[:, :-1, -1]
        gram, moment = np.tensordot(weights * scales**2, Q, 1), (weights * scales) @ q
        A = np.eye(len(self.model)) + spread[:, None] * gram * spread
        inverse = np.linalg.inv(A)
        u = inverse @ (spread * (moment - gram @ self.model))
        theta = self.model + spread * u
        squares = theta @ gram @ theta - 2 * moment @ theta + weights @ self.grams[:, -1, -1]
        prior = np.sum((at[:n] / self.log_spread) ** 2) + at[n] ** 2
        cost = (u @ u + squares + np.linalg.slogdet(A)[1] + prior) / 2
        second = np.outer(theta, theta) + spread[:, None] * inverse * spread
        of_scales = weights * (scales * np.tensordot(Q, second, 2) - q @ theta)
        of_doubt = len(u) - np.trace(inverse) - u @ u
        return cost, np.r_[-scales * of_scales, of_doubt] + at / np.r_[np.full(n, self.log_spread**2), 1.0], theta

    def squares(self, at: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """What the most likely parameters leave of each joint's r, sum of squares, (n,)."""
        theta, scales = self.cost(at, weights)[2], 1 / self.constants(at)
        sides = np.column_stack([-scales[:, None] * theta, np.ones(len(scales))])
        return np.einsum("ji,jik,jk->j", sides, self.grams, sides)
