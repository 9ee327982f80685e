"""Torque constants of arms that report motor currents: one factor a joint."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize

from tauext import _core
from tauext.config import ObserverConfig, PriorConfig
from tauext.data.recording import Recording
from tauext.errors import ConfigError, TrainingError
from tauext.fit.bundle_writing import build_setup
from tauext.fit.find_kinematics import (
    ArmSearch,
    Fitted,
    Kinematics,
    KinematicSample,
    can_be_found,
    find_kinematics,
)
from tauext.fit.links import ROTOR
from tauext.fit.prior_terms import has_model, own_terms
from tauext.fit.stable_choice import simplest
from tauext.fit.training_set import Setup, with_presliding
from tauext.robot.inertial import PARAMETERS, inertial_parameters
from tauext.robot.model_case import empty


@dataclass(frozen=True)
class ConstantsConfig:
    """What is assumed of models and drives where torque constants are found, as standard errors or shares."""

    mass_off: float = 0.1
    """Share by which a link's mass is off, at a place within the link; only how the links compare matters, see
    `ScaledArm.doubt`."""
    tool: float = 0.1
    """Mass of what may hang at the last link beside it, as a share of the arm's; at so large a share of its reach."""
    independent_s: float = 1.0
    """Correlation time of the residual of friction, [s]: samples within it count as one."""
    least_sliding_s: float = 10.0
    """A joint that moves faster than ArmSearch.moves_rad_s for less than this has its rests counted, too."""
    known: float = 0.5
    """Above this relative standard error, a constant by the unchanged model has no information, not even its sign."""
    sign_tie: float = 1.0
    """Least gain in log evidence for an inverted sign: a factor of e is insignificant, and few drives report their
    current with the sign inverted."""
    least_noise: float = 1e-6
    """Least noise of a torque, in its recorded unit."""
    file_mass: float = 0.12
    """Standard errors of a robot file of which nothing is known, as shares: mass of a link (0.12: within 20 %) ..."""
    file_centre: float = 0.03
    """... its centre of mass ..."""
    file_inertia: float = 0.05
    """... and its inertia about it, of its size ..."""
    file_common: float = 0.04
    """... and a factor common to all masses: covers and cables are left out."""
    least_own: float = 0.02
    """Least standard error of a joint's constant: magnets and gears change with temperature and load."""
    pieces: int = 10
    """Pieces of the motion that are left out in turn for standard errors."""
    well_determined: float = 0.15
    """A constant counts as known up to this relative standard error beside the common factor."""
    guess: float = 0.5
    """One that is known to this share only is a guess: of no use for reading N m, but nearer to the model's torque,
    which it must meet, than amperes are."""
    least_share: float = 0.05
    """Least share of what friction leaves of a current that gravity and inertia explain; below, its constant is
    unknown."""
    unknown_to: float = 1.0
    """Standard deviation of the logarithm of an unknown constant about its value by the unchanged model."""
    given_to: float = 0.06
    """Standard deviation of the logarithm of a given constant: makers' numbers and gear losses are right within
    10 %."""
    kept: float = 0.75
    """A given constant is kept if the motion leaves this share of its uncertainty or more."""
    unit_tie: float = 0.01
    """Among joints known this similarly, the first one's unit is used for all."""
    arm_off: float = 0.03
    """Share by which the torques of an arm found in the motion are off, beside their scatter."""


# --- A model's inertia and its torque constants, corrected together: most likely by what free motion shows.


@dataclass(frozen=True)
class ScaledArm:
    """Torque constants and how well they are known."""

    nm_per_unit: np.ndarray  # (n,)
    covariance: np.ndarray
    """(n, n) of their logarithms."""
    doubt: float
    """Estimated model error: 1 if masses are off by ConstantsConfig.mass_off."""


def fit_scaled_arm(sample: KinematicSample, tree: _core.Tree, start: np.ndarray | None = None) -> ScaledArm:
    r"""Constants k at the maximum of the evidence, over all inertial parameters that the arm may have.

    .. math:: r_j = s_j Z_j \theta + F_j w_j + \epsilon_j, \quad s_j = e^{-x_j} / k_{0,j}, \quad
              \theta \sim N(\theta_0, \tau^2 D^2), \quad x_j \sim N(0, \sigma_x^2), \quad \ln\tau \sim N(0, 1)

    r is the observer's without a model, in the recordings' unit, Z what a unit of each inertial parameter adds to it,
    in N m, F a joint's friction and rotor. theta_0 are the model's parameters, D is how far those of an arm may be from
    them; tau is found along with x, so that a good model counts for more than a bad one. theta is integrated over: at
    its best value alone, constants would shrink to nothing where the model fits badly. The noise of a joint is what its
    fit leaves; ConstantsConfig.independent_s of it counts as one sample.

    The curvature of the evidence would understate the errors: motion confirms how the masses compare, so tau is small,
    but not their common scale, which goes into every constant. See Evidence.errors().

    Args:
        sample: without a model.
        start: (n,) k_0, with sign; None: from the model as it is, but with the sign that is more likely where it is < 0
            there: what hangs at a wrist may weigh more than the wrist.
    """
    n = sample.joints
    model, spread = np.array([inertial_parameters(link)[:ROTOR] for link in tree.links]).ravel(), spreads(tree)
    Z = sample.regressors(tree, range(n), range(len(PARAMETERS))).reshape(sample.rows, n, n, len(PARAMETERS))
    parts, counted = [], sliding_rows(sample)
    for j, rows in enumerate(counted.T):
        beside = np.column_stack([sample.own[j], Z[:, j, j, ROTOR]])
        columns = np.column_stack([Z[:, j, :, :ROTOR].reshape(sample.rows, -1), sample.target[:, j]])
        left = unexplained(columns[rows], beside[rows])
        parts.append(left.T @ left)
    count = np.maximum(1.0, counted.sum(axis=0) * ArmSearch.row_s / ConstantsConfig.independent_s)
    grams, begun = np.array(parts), start is None
    # A joint whose torque friction explains to the last bit, as one of 0 throughout, does not determine its constant.
    grams[grams[:, -1, -1] <= ConstantsConfig.least_noise**2 * counted.sum(axis=0)] = 0.0
    start = as_it_is(grams, model, count) if start is None else start
    evidence = Evidence(grams, model, spread, start, ConstantsConfig.unknown_to)
    at, weights, cost = most_likely(evidence, counted.sum(axis=0), count)
    for k in np.flatnonzero(start < 0) if begun else ():
        turned = replace(evidence, start=np.where(np.arange(n) == k, -evidence.start, evidence.start))
        other = most_likely(turned, counted.sum(axis=0), count)
        if other[2] < cost + ConstantsConfig.sign_tie:
            evidence, (at, weights, cost) = turned, other
    covariance = evidence.errors(at, weights, file_covariance(tree)) + ConstantsConfig.least_own**2 * np.eye(n)
    energy = np.maximum(grams[:, -1, -1], ConstantsConfig.least_noise**2 * counted.sum(axis=0))
    unseen = evidence.squares(at, weights) > (1 - ConstantsConfig.least_share) * energy
    covariance[unseen, :] = covariance[:, unseen] = 0.0
    covariance[unseen, unseen] = ConstantsConfig.unknown_to**2
    return ScaledArm(evidence.constants(at), covariance, float(np.exp(at[-1])))


def most_likely(evidence: Evidence, rows: np.ndarray, count: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """The unknowns, each joint's weight and the cost there, with the noise that is found along with them.

    Args:
        rows: (n,) that count for each joint.
        count: (n,) independent samples among them.
    """
    at, least = np.zeros(len(evidence.start) + 1), ConstantsConfig.least_noise**2 * rows
    weights = count / np.maximum(evidence.grams[:, -1, -1] / 10, least)  # most of r is explained in the end
    for _ in range(8):
        at = minimize(lambda x, w=weights: evidence.cost(x, w)[:2], at, jac=True, method="BFGS").x
        weights = count / np.maximum(evidence.squares(at, weights), least)
    return at, weights, evidence.cost(at, weights)[0] - float(count @ np.log(weights)) / 2


def sliding_rows(sample: KinematicSample) -> np.ndarray:
    """(rows, n) bool: rows that count for a joint's constant, since it moves; see ArmSearch.moves_rad_s."""
    slides = sample.speed_rad_s > ArmSearch.moves_rad_s
    return slides | (slides.sum(axis=0) * ArmSearch.row_s < ConstantsConfig.least_sliding_s)


def as_it_is(grams: np.ndarray, model: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Constants by the unchanged model, (n,); an undetermined joint gets the mean.

    Args:
        count: (n,) independent samples.
    """
    of_model, together = model @ grams[:, :-1, :-1] @ model, grams[:, :-1, -1] @ model
    with np.errstate(divide="ignore", invalid="ignore"):
        constants = of_model / together
        explained = together**2 / (of_model * grams[:, -1, -1])
        known = np.isfinite(constants) & ((1 - explained) < ConstantsConfig.known**2 * count * explained)
    usual = np.exp(np.mean(np.log(np.abs(constants[known])))) if known.any() else 1.0
    return np.where(known, constants, usual)


def unexplained(columns: np.ndarray, beside: np.ndarray) -> np.ndarray:
    """Residual of a fit of columns by other columns."""
    return columns - beside @ np.linalg.lstsq(beside, columns, rcond=None)[0]


def spreads(tree: _core.Tree) -> np.ndarray:
    """D: spread of the parameters, (10 n,), from a missing or surplus mass somewhere on the link."""
    reach = sum(float(np.linalg.norm(link.translation)) for link in tree.links[1:])
    whole = sum(link.mass for link in tree.links)
    rows = []
    for k, link in enumerate(tree.links):
        p = inertial_parameters(link)
        mass, size = ConstantsConfig.mass_off * link.mass, np.sqrt(max(p[4:7].sum(), 0.0) / (2 * max(link.mass, 1e-9)))
        if k == tree.size - 1:
            mass, size = np.hypot(mass, ConstantsConfig.tool * whole), max(size, ConstantsConfig.tool * reach)
        rows.append(np.r_[mass, np.full(3, mass * size), np.full(6, mass * size**2)])
    return np.concatenate(rows)


def file_covariance(tree: _core.Tree) -> np.ndarray:
    """Covariance of the parameters, (10 n, 10 n), of a robot file of which nothing is known."""
    n, columns = tree.size, []
    for k, link in enumerate(tree.links):
        p, centre = inertial_parameters(link)[:ROTOR], np.array(link.com)
        size = np.sqrt(max(p[4:7].sum(), 0.0) / (2 * max(link.mass, 1e-9)))
        off = [ConstantsConfig.file_mass * p]
        for step in ConstantsConfig.file_centre * size * np.eye(3):
            link.com = (centre + step).tolist()
            off.append(inertial_parameters(link)[:ROTOR] - p)
        off += list(ConstantsConfig.file_inertia * link.mass * size**2 * np.eye(ROTOR)[4:])
        columns += [np.kron(np.eye(n)[k], one) for one in off]
    columns.append(
        ConstantsConfig.file_common * np.concatenate([inertial_parameters(link)[:ROTOR] for link in tree.links])
    )
    return np.asarray(np.transpose(columns) @ columns)


def common_and_own(covariance: np.ndarray) -> tuple[float, np.ndarray]:
    """Standard errors of a common factor and of each joint beside it, (n,), of constants whose logs vary like this.

    Joints whose constants are no better than a guess have no part in the common factor.
    """
    variances = np.diag(covariance)
    known = np.flatnonzero(variances <= ConstantsConfig.guess**2)
    alike = covariance[np.ix_(known, known)][~np.eye(len(known), dtype=bool)]
    common = max(float(np.median(alike)), 0.0) if len(alike) else 0.0
    return float(np.sqrt(common)), np.sqrt(np.maximum(variances - common, ConstantsConfig.least_own**2))


@dataclass(frozen=True)
class Evidence:
    """Evidence of constants and doubt, for columns of which friction and rotors were taken out."""

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
        """Residual sum of squares of each joint's r with the most likely parameters, (n,)."""
        theta, scales = self.cost(at, weights)[2], 1 / self.constants(at)
        sides = np.column_stack([-scales[:, None] * theta, np.ones(len(scales))])
        return np.einsum("ji,jik,jk->j", sides, self.grams, sides)

    def errors(self, at: np.ndarray, weights: np.ndarray, of_file: np.ndarray) -> np.ndarray:
        """Covariance of the x found, (n, n): errors of noise, of the model and of the prior, to first order.

        The gradient is linear in each joint's Z^T r. Noise and the true arm's parameters move that, and the most likely
        x follows by the inverse curvature. No variance is below that of the evidence itself.

        Args:
            of_file: covariance of the true parameters about the model's, (10 n, 10 n).
        """
        n = len(self.start)
        scales, spread = 1 / self.constants(at), np.exp(at[-1]) * self.spread
        Q, q = self.grams[:, :-1, :-1], self.grams[:, :-1, -1]
        gram, moment = np.tensordot(weights * scales**2, Q, 1), (weights * scales) @ q
        inverse = np.linalg.inv(np.eye(len(spread)) + spread[:, None] * gram * spread)
        u = inverse @ (spread * (moment - gram @ self.model))
        theta = self.model + spread * u
        of_theta = -(weights * scales)[:, None] * (2 * scales[:, None] * (Q @ theta) - q)
        of_moment = np.vstack([of_theta @ (spread[:, None] * inverse * spread), -2 * (u @ inverse) * spread])
        moved, of_parameters = np.diag(np.r_[np.full(n, self.log_spread**-2.0), 0.0]), np.zeros_like(of_moment)
        for j, (weight, scale) in enumerate(zip(weights, scales, strict=True)):
            of_joint = weight * scale * (of_moment + np.outer(np.arange(n + 1) == j, theta))
            moved += of_joint @ Q[j] @ of_joint.T / weight
            of_parameters += scale * of_joint @ Q[j]
        moved += of_parameters @ of_file @ of_parameters.T
        slopes = [self.cost(at + h, weights)[1] - self.cost(at - h, weights)[1] for h in 1e-4 * np.eye(n + 1)]
        curvature = np.array(slopes) / 2e-4
        follows = np.linalg.pinv((curvature + curvature.T) / 2)
        covariance = (follows @ moved @ follows.T)[:n, :n]
        more = np.diag(follows)[:n] - np.diag(covariance)  # where the prior on x limits what is found
        return np.asarray(covariance + np.diag(np.maximum(more, 0.0)))


# --- Torque constants of arms that report motor currents: one factor a joint.


@dataclass(frozen=True)
class TorqueConstants:
    """One constant a joint, in N m a unit of the recordings' tau; negative: the sign is inverted."""

    nm_per_unit: np.ndarray  # (n,)
    standard_errors: np.ndarray
    """(n,) beside the common factor."""
    determined: np.ndarray  # (n,) bool
    relative_to: int | None = None
    """Joint in whose recorded unit all torques are then, where no model defines the N m; None: they are in N m."""
    given: bool = False
    """They correct constants that the recordings were multiplied by; one that is not determined is kept."""
    kinematics: Kinematics | None = None
    """The arm found in the motion, where there is no model."""
    common_share: float = 0.0
    """Relative standard error of a factor common to all joints: motion does not show the scale of the masses."""

    @property
    def shares(self) -> np.ndarray:
        """(n,) relative standard errors beside the common factor; NaN where there is no constant."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.abs(self.standard_errors / self.nm_per_unit)

    @property
    def guessed(self) -> np.ndarray:
        """(n,) bool: not determined, but used."""
        with np.errstate(invalid="ignore"):
            near = (self.nm_per_unit > 0) & (self.standard_errors <= ConstantsConfig.guess * self.nm_per_unit)
        return near & ~self.determined & (not self.given)

    @property
    def used(self) -> list[float]:
        """Factors for the recordings: 1 for a joint without information, whose torque is unchanged."""
        return np.where(self.determined | self.guessed, self.nm_per_unit, 1.0).tolist()

    @property
    def unknown(self) -> np.ndarray:
        """(n,) bool: neither determined nor guessed; torque and estimate stay in the recordings' own unit."""
        return ~(self.determined | self.guessed) & (not self.given)

    def units(self, given: _core.TorqueUnit) -> _core.TorqueUnits:
        """Units of a bundle with these constants, in and out; given: the unit of the recordings' tau."""
        return _core.TorqueUnits(given, -1 if self.relative_to is None else self.relative_to)

    def facts(self, joints: Sequence[str]) -> dict:
        """Facts for provenance: the constants used, in the order of the joints, and each joint's result."""
        facts: dict = {} if self.relative_to is None else {"relative_to": joints[self.relative_to]}
        facts |= {"given": True} if self.given else {}
        facts |= {"common_share": self.common_share} if self.common_share else {}
        return facts | {
            "used": self.used,
            "found": {
                name: {
                    "nm_per_unit": float(self.nm_per_unit[j]) if np.isfinite(self.nm_per_unit[j]) else None,
                    "standard_error": float(self.standard_errors[j]) if np.isfinite(self.standard_errors[j]) else None,
                    "determined": bool(self.determined[j]),
                }
                for j, name in enumerate(joints)
            },
        }

    def sentences(self, joints: Sequence[str]) -> list[str]:
        """The result as text."""
        words = [
            f"{name} {k:.3g} ± {error:.1g}"
            for name, k, error in zip(joints, self.nm_per_unit, self.standard_errors, strict=True)
        ]

        def listed(which: np.ndarray, texts: Sequence[str]) -> str:
            return ", ".join(text for text, here in zip(texts, which, strict=True) if here)

        together = (
            f"; all together ± {self.common_share:.0%}, beside each one's own error: a known payload shows that "
            "factor (tauext load --known-kg)"
            if self.common_share
            else ""
        )
        if self.given:
            kept = f"; kept for {listed(~self.determined, joints)}, whose motion does not improve them"
            if not self.determined.any():
                return ["torque constants of the import are kept: the motion does not improve them"]
            return [
                f"torque constants of the import, corrected by a factor: {listed(self.determined, words)}"
                f"{kept if not self.determined.all() else ''}{together}. The bundle applies them, a loop gives what "
                "it recorded"
            ]
        unit, sentences, unknown = "Nm", [], ~(self.determined | self.guessed)
        if self.relative_to is not None:
            unit = f"units of {joints[self.relative_to]}"
            sentences.append(f"without a model the Nm is undefined: torques, estimates and thresholds are in {unit}")
        if self.determined.any():
            sentences.append(f"torque constants, {unit} a unit of tau: {listed(self.determined, words)}{together}")
        if self.guessed.any():
            sentences.append(
                f"torque constants of {listed(self.guessed, words)} are guesses, gravity and inertia there are too "
                f"small beside friction: their torques, estimates and thresholds are no {unit} to rely on"
            )
        if unknown.any():
            sentences.append(
                f"torque constants of {listed(unknown, joints)} are undetermined, gravity and inertia there are too "
                "small beside friction: their torques, estimates and thresholds stay in the recordings' own unit"
            )
        return sentences


def fit_torque_constants(
    tree: _core.Tree, recordings: Sequence[Recording], config: ObserverConfig, given: bool = False
) -> TorqueConstants:
    """Constants from free motion, where the current exerts friction and the model's torque.

    The model's masses, centres of mass and inertia are corrected along with them, see fit_scaled_arm: a tool that it
    lacks does not go into the constants. Friction is the prior's, and a joint's rotor is its own.

    Without a model they are compared with the arm that is found in the motion; then only their ratios show.

    Args:
        given: the recordings' currents were multiplied by given constants; the result corrects them.

    Raises:
        ConfigError: no model, and no arm can be found: a joint slides, or too little motion.
        TrainingError: no recording is longer than the observer's warm-up.
    """
    friction = PriorConfig()
    setup = with_presliding(build_setup(tree, recordings[0], config), friction.widths_rad)
    tops = np.max([np.abs(recording.dq).max(axis=0) for recording in recordings], axis=0)
    own = [own_terms(setup, friction, j, top_speed_rad_s=top) for j, top in enumerate(tops.tolist())]
    if not has_model(setup):
        return _relative_constants(setup, recordings, own, given)
    sample = KinematicSample(empty(tree), setup.observer, recordings, own, setup.widths_rad)
    if not sample.rows:
        raise TrainingError(f"no training recording is longer than the observer's warm-up of {setup.warm_up_s:g} s")
    if given:
        return between_given(fit_scaled_arm(sample, tree, np.ones(tree.size)))
    arm = fit_scaled_arm(sample, tree)
    common, shares = common_and_own(arm.covariance)
    errors = shares * np.abs(arm.nm_per_unit)
    return TorqueConstants(arm.nm_per_unit, errors, shares <= ConstantsConfig.well_determined, common_share=common)


def with_constants(observer: _core.ObserverSettings, constants: TorqueConstants) -> _core.ObserverSettings:
    """Settings of the observer with these torque constants, by which it multiplies tau."""
    kept = ("gain_per_s", "timing", "sample_period_ns", "network_stride", "method", "high_pass_per_s", "low_pass_per_s")
    settings = {name: getattr(observer, name) for name in kept}
    unknown = constants.unknown.astype(int).tolist() if constants.unknown.any() else []
    return _core.ObserverSettings(**settings, nm_per_unit=constants.used, unknown_constant=unknown)


def between_given(arm: ScaledArm) -> TorqueConstants:
    """Corrections of given constants: the most likely ones between those found and 1, each by its error."""
    known = np.linalg.inv(arm.covariance)
    covariance = np.linalg.inv(known + np.eye(len(known)) / ConstantsConfig.given_to**2)
    common, own = common_and_own(covariance)
    return given_constants(np.exp(covariance @ known @ np.log(arm.nm_per_unit)), own, common)


def given_constants(factors: np.ndarray, log_errors: np.ndarray, common_share: float = 0.0) -> TorqueConstants:
    """Corrections of given constants; 1 if the data add little information.

    Args:
        log_errors: (n,) beside the common factor.
    """
    determined = (log_errors <= ConstantsConfig.kept * ConstantsConfig.given_to) & (factors > 0)
    factors, errors = np.where(determined, factors, 1.0), np.where(determined, log_errors, ConstantsConfig.given_to)
    common_share = common_share if determined.any() else 0.0
    return TorqueConstants(factors, errors * factors, determined, given=True, common_share=common_share)


def _relative_constants(
    setup: Setup, recordings: Sequence[Recording], own: Sequence[Sequence[_core.Term]], given: bool
) -> TorqueConstants:
    """Constants as multiples of that of the joint in which the arm found in the motion shows best.

    Given ones keep their mean and are drawn towards 1 as far as the motion leaves it open.
    """
    joints = tuple(link.joint_name for link in setup.tree.links)
    sample = (
        KinematicSample(setup.tree, setup.observer, recordings, own, setup.widths_rad) if can_be_found(setup) else None
    )
    if sample is None or sample.rows < ArmSearch.least_rows:
        if given:
            return given_constants(np.ones(len(joints)), np.full(len(joints), np.inf))
        raise ConfigError(
            "torque constants are found by comparing with a model, and there is none (case 'none'); nor can an arm be "
            "found in the motion, which takes turning joints, gravity and "
            f"{ArmSearch.least_rows * ArmSearch.row_s:g} s of it "
            "(--fit-torque-constants False trains in the recordings' own unit)"
        )
    candidate = find_kinematics(sample, one_unit=False)
    fitted = Fitted.of(sample, candidate.kinematics, candidate.scales)
    modelled = fitted.columns @ fitted.parameters.ravel()
    found = [
        _fit(modelled[rows, j], sample.target[rows, j], sample.own[j][rows])
        for j, rows in enumerate(sliding_rows(sample).T)
    ]
    constants, errors, determined = (np.array([one[k] for one in found]) for k in range(3))
    if given:
        return replace(drawn_to_given(constants, errors), kinematics=candidate.kinematics)
    known_to = np.where((constants > 0) & np.isfinite(errors), errors / np.abs(constants), np.inf)
    best = simplest(range(len(joints)), known_to.__getitem__, ConstantsConfig.unit_tie)
    ratios = constants / constants[best], errors / constants[best], determined
    return TorqueConstants(*ratios, relative_to=best, kinematics=candidate.kinematics)


def drawn_to_given(constants: np.ndarray, errors: np.ndarray) -> TorqueConstants:
    """Corrections whose ratios follow from the motion; their mean stays as given.

    Each correction is drawn to 1, the more the less the motion determines it.
    """
    known = (constants > 0) & np.isfinite(errors)
    logs, shares = np.zeros(len(constants)), np.full(len(constants), np.inf)
    logs[known], shares[known] = (
        np.log(constants[known]),
        np.hypot(errors[known] / constants[known], ConstantsConfig.arm_off),
    )
    trust = 1 / (shares**2 + ConstantsConfig.given_to**2)
    logs -= trust @ logs / max(trust.sum(), 1e-300)
    drawn = ConstantsConfig.given_to**2 * trust
    return given_constants(np.exp(drawn * logs), ConstantsConfig.given_to * np.sqrt(1 - drawn))


def _fit(model: np.ndarray, current: np.ndarray, beside: np.ndarray) -> tuple[float, float, bool]:
    """Constant, standard error, and whether that is known, of one joint; `beside` is friction and rotor."""
    columns = np.column_stack([model, beside])
    pieces = [
        (columns[at].T @ columns[at], columns[at].T @ current[at])
        for at in np.array_split(range(len(model)), ConstantsConfig.pieces)
    ]
    gram, moment = (sum(piece[k] for piece in pieces) for k in range(2))
    share = np.linalg.lstsq(gram, moment, rcond=None)[0]
    leave_one = np.array([np.linalg.lstsq(gram - g, moment - m, rcond=None)[0][0] for g, m in pieces])
    error = np.sqrt((ConstantsConfig.pieces - 1) / ConstantsConfig.pieces * ((leave_one - leave_one.mean()) ** 2).sum())
    left = current - beside @ np.linalg.lstsq(beside, current, rcond=None)[0]
    explained = 1 - np.sum((current - columns @ share) ** 2) / max(float(left @ left), 1e-300)
    if not abs(share[0]) > 0:
        return np.nan, np.nan, False
    determined = error <= ConstantsConfig.well_determined * abs(share[0]) and explained >= ConstantsConfig.least_share
    return 1 / share[0], error / share[0] ** 2, bool(determined)
