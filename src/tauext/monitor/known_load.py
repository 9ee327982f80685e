"""Torque constants from a known weight, and bundles scaled by them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tauext import _core
from tauext.bundle.units import own_shares
from tauext.errors import ConfigError
from tauext.files.provenance import VERSION
from tauext.monitor.weighing import NamedFrame, Seen, identify, load_sentences, sums_about, weighing_joints

# --- Error factor of the torque constants from a known weight.


LEAST_SPREAD = 1e-3
"""Least relative standard deviation of one joint's constant about the common factor."""
ANY = 0.5
"""Relative standard deviation of the common factor, which is unknown."""
COM_KNOWN_M = 0.005
"""Standard deviation of a given centre of mass, [m]."""
WELL = 0.03
"""Largest standard error of an accepted common factor: masses of robot files are no more accurate."""
OF_ITS_OWN = 0.7
"""Largest ratio of a constant's error to its prior error at which it counts as estimated."""
MOST_FACTOR = 5.0
"""Largest error factor of constants in N m: beyond it the error is a gear ratio or a unit."""
MOST_RATIO = 1e6
"""Largest error factor in any unit: a smaller estimated mass is no weight."""
STEPS = 6


@dataclass(frozen=True)
class Noise:
    """Properties of the errors of tau_ext beside its sigma."""

    scale: np.ndarray  # (n,): factor on sigma
    correlation: float  # number of rows with the information of one independent row


@dataclass(frozen=True)
class KnownWeight:
    """Correction factors of the bundle's torques, one a joint."""

    factors: np.ndarray  # (n,)
    errors: np.ndarray  # (n,): standard errors
    shows: np.ndarray  # (n,) bool: estimated from the joint itself; the others use the common factor
    skipped: np.ndarray  # (n,) bool: others in their own unit, whose constant stays unknown
    common: float
    common_error: float
    com_m: np.ndarray  # (3,)

    def constants(self, bundle: _core.Bundle) -> list[float]:
        """Corrected torque constants of this bundle, one a joint."""
        constants = np.array(bundle.observer.nm_per_unit or [1.0] * bundle.joints)
        return np.where(self.skipped, constants, constants * self.factors).tolist()

    def shares(self, own: np.ndarray) -> np.ndarray:
        """Relative standard errors of the constants beside the common factor, (n,), once all are scaled by it.

        Args:
            own: (n,) before; joints that the weight does not show keep them.
        """
        left = np.hypot(self.factors / self.common - 1, self.errors / self.factors)
        return np.where(self.shows, np.minimum(left, 1.0), own)

    @property
    def one_factor(self) -> bool:
        """Whether one factor fits all joints: no estimated one is off by more than two standard errors."""
        off = np.abs(self.factors - self.common)[self.shows]
        return bool((off <= 2 * self.errors[self.shows]).all())


def weigh_constants(
    bundle: _core.Bundle,
    frame: NamedFrame,
    parts: Sequence[Seen],
    mass_kg: float,
    com_m: Sequence[float] | None = None,
    reach_m: float = _core.LoadSums.USUAL_REACH_M,
) -> KnownWeight:
    """Estimate torque constants from a load of known mass: tau_ext_j = a_j X_j(m, h) + offset_j + Coulomb_j, factor 1 /
    a_j.

    Every a_j is regularised to the common one: a weight at the flange has little effect on the last joints.

    Raises:
        ConfigError: no load is detected, or the motion does not determine the factor to WELL.
    """
    first = identify(bundle, frame, parts, reach_m)
    if first.verdict != "load" or not first.mass_seen:
        reason = load_sentences(first, frame.name, "N m")[0]
        raise ConfigError(f"--known-kg {mass_kg:g} cannot set torque constants: {reason}")
    common = first.mass_kg / mass_kg
    if not common * MOST_RATIO > 1:
        raise ConfigError(
            f"--known-kg {mass_kg:g} cannot set torque constants: the estimated mass is {first.mass_kg:.2g} kg, "
            f"a factor of more than {MOST_RATIO:g} less; are these the recordings with the weight?"
        )
    a, h = np.full(bundle.joints, common), first.phi[1:4] / common
    phi = _core.load_parameters([mass_kg, *h], reach_m)
    covariance, sizes = np.zeros((3 + bundle.joints,) * 2), _core.weigh_sizes(bundle)
    spread = np.maximum(own_shares(bundle), LEAST_SPREAD)
    for _ in range(_core.LoadSums.ROUNDS):
        sums, target = sums_about(bundle, frame.frame, parts, phi), targets(a, phi)
        a, h, covariance = solve_known(sums, target, sizes, spread, mass_kg, com_m, reach_m, a, h)
        phi = _core.load_parameters([mass_kg, *h], reach_m)
    known = known_weight(a, h / mass_kg, covariance, spread, ~weighing_joints(bundle))
    if bundle.units.relative_to < 0 and not 1 / MOST_FACTOR < known.common < MOST_FACTOR:
        raise ConfigError(
            f"{mass_kg:g} kg would make every torque {known.common:.3g} times as large; torque constants are not off "
            "by so much: is the weight in kg, and the tau in the bundle's unit?"
        )
    return known


def targets(a: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """Targets of each joint as sums of the columns, (n, columns), without a_j times inertia and gear."""
    sums = _core.LoadSums
    target = np.zeros((len(a), sums.COLUMNS))
    target[:, sums.TAU_EXT], target[:, sums.GEAR] = 1.0, -a
    target[:, sums.LOAD + 4 : sums.LOAD + 10] = -a[:, None] * phi[4:]
    return target


def solve_known(
    sums: _core.LoadSums, target: np.ndarray, sizes: np.ndarray, spread: np.ndarray, mass_kg: float,
    com_m: Sequence[float] | None, reach_m: float, a: np.ndarray, h: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Gauss-Newton in h and every a_j; both and their covariance, (3 + n, 3 + n), h first."""
    n, whole, noise = len(a), sums.whole, Noise(np.ones(len(a)), float(sums.BLOCK_ROWS))
    start = float(a.mean())
    before = np.diag((spread * start) ** 2) + (ANY * start) ** 2 * np.ones((n, n))
    about_a, centre = np.linalg.inv(before), np.zeros(3)
    prior_h = np.eye(3) / (max(mass_kg, sums.LEAST_MASS_KG) * reach_m / 2) ** 2
    if com_m is not None:
        prior_h, centre = np.eye(3) / (mass_kg * COM_KNOWN_M) ** 2, mass_kg * np.array(com_m)
    for _ in range(STEPS):
        information = np.zeros((3 + n, 3 + n))
        information[:3, :3], information[3:, 3:] = prior_h, about_a
        moment = np.r_[prior_h @ centre, about_a @ np.full(n, start)]
        gains = []
        for j in range(n):
            gram = turned_gram(whole[j], target[j], a[j], mass_kg, h) / (noise.scale[j] ** 2 * noise.correlation)
            own = gram[4:6, 4:6] + np.diag(sizes[j] ** -2.0)
            gain = np.linalg.solve(own, np.column_stack([gram[:4, 4:6].T, gram[4:6, 6]]))
            at = [0, 1, 2, 3 + j]
            information[np.ix_(at, at)] += gram[:4, :4] - gram[:4, 4:6] @ gain[:, :4]
            moment[at] += gram[:4, 6] - gram[:4, 4:6] @ gain[:, 4]
            gains.append(gain)
        covariance = np.linalg.inv(information)
        found = covariance @ moment
        own_values = np.array([g[:, 4] - g[:, :4] @ found[[0, 1, 2, 3 + j]] for j, g in enumerate(gains)])
        h, a = found[:3], found[3:]
        noise = known_noise(sums, target, a, mass_kg, h, own_values)
    return a, h, covariance


def turned_gram(gram: np.ndarray, target: np.ndarray, a: float, mass_kg: float, h: np.ndarray) -> np.ndarray:
    """Sums of h (3), a, offset, Coulomb and target of one joint, linear about a and h: (7, 7)."""
    sums = _core.LoadSums
    to = np.zeros((7, sums.COLUMNS))
    to[:3, sums.LOAD + 1 : sums.LOAD + 4] = a * np.eye(3)
    to[3, sums.LOAD : sums.LOAD + 4] = np.r_[mass_kg, h]
    to[4, sums.OFFSET] = to[5, sums.COULOMB] = 1.0
    to[6] = target
    to[6, sums.LOAD + 1 : sums.LOAD + 4] += a * h
    turned: np.ndarray = to @ gram @ to.T
    return turned


def known_noise(
    sums: _core.LoadSums, target: np.ndarray, a: np.ndarray, mass_kg: float, h: np.ndarray, own: np.ndarray
) -> Noise:
    """Noise of the errors, as noise_left() of a load."""
    theta = target.copy()
    theta[:, sums.LOAD : sums.LOAD + 4] -= a[:, None] * np.r_[mass_kg, h]
    theta[:, sums.OFFSET], theta[:, sums.COULOMB] = -own[:, 0], -own[:, 1]
    single, blocks = (np.einsum("ja,jab,jb->j", theta, squares, theta) for squares in (sums.whole, sums.blocks))
    scale = np.sqrt(np.maximum(single / np.maximum(sums.worth, 1e-9), sums.LEAST_NOISE_SCALE**2))
    correlation = np.sum(blocks / scale**2) / max(np.sum(single / scale**2), 1e-300)
    return Noise(scale, float(np.clip(correlation, sums.LEAST_CORRELATION, sums.BLOCK_ROWS)))


def known_weight(
    a: np.ndarray, com_m: np.ndarray, covariance: np.ndarray, spread: np.ndarray, skipped: np.ndarray
) -> KnownWeight:
    """Factors 1 / a, each with its error; the common one is their weighted mean.

    Args:
        spread: (n,) relative standard deviations about the common factor before the weighing.
        skipped: (n,) bool: joints whose rows had no weight.

    Raises:
        ConfigError: the motion does not determine them.
    """
    of_a = covariance[3:, 3:]
    if (a <= 0).any():
        raise ConfigError("the known weight acts upwards at a joint: is the sign of its torque right (tauext check)?")
    weight = np.linalg.solve(of_a, np.ones(len(a)))
    mean, error = float(weight @ a / weight.sum()), float(weight.sum() ** -0.5)
    if error > WELL * mean:
        raise ConfigError(
            f"the motion does not determine the torque constants: their common factor only to {error / mean:.0%}, "
            f"where {WELL:.0%} is needed; move more, with the weight farther from the joints"
        )
    errors = np.sqrt(np.diag(of_a)) / a**2
    shows = np.sqrt(np.diag(of_a)) <= OF_ITS_OWN * np.hypot(spread * mean, error)
    shows &= ~skipped
    factors = np.where(shows, 1 / a, 1 / mean)
    return KnownWeight(factors, errors, shows, skipped, 1 / mean, error / mean**2, com_m)


# --- Bundles whose torque constants are multiplied by one factor.


RATIOS = (_core.TermKind.load, _core.TermKind.load_presliding)
"""Terms whose weight is a share of a torque, not a torque."""


def scaled_bundle(bundle: _core.Bundle, factor: float) -> _core.Bundle:
    """Rescale a bundle: all torques that it reads, estimates or compares with become `factor` times as large.

    Masses and inertias of the model scale too, since the arm's own weight was estimated from the same torques.
    Estimates scale exactly up to rounding, and limits keep their promise. Separate factors for joints are impossible:
    no arm has such masses.
    """
    new = _core.Bundle.from_bytes(bundle.to_bytes())
    new.observer = observer_with(bundle.observer, times(factor, bundle.observer.nm_per_unit or [1.0] * bundle.joints))
    new.units = _core.TorqueUnits(bundle.units.given, -1, bundle.units.unknown)  # a weight in kg defines the N m
    new.links = [scaled_link(link, factor) for link in bundle.links]
    prior, terms = new.prior, len(new.prior.terms)
    prior.most_load_nm = times(factor, prior.most_load_nm)
    prior.corrected_links = [scaled_link(link, factor) for link in prior.corrected_links]
    share = [term.kind in RATIOS for term in prior.terms]
    prior.weights = [weight if share[k % terms] else factor * weight for k, weight in enumerate(prior.weights)]
    for part, names in ((new, TORQUES), (new.drift, DRIFT), (new.error_scale, SIGMA)):
        for name in names:
            setattr(part, name, times(factor, getattr(part, name)))
    new.answer_reference()
    return new


def corrected_bundle(bundle: _core.Bundle, known: KnownWeight) -> _core.Bundle:
    """The bundle scaled by the common factor, which is then known to the error of the weighing."""
    new = scaled_bundle(bundle, known.common)
    settings = new.wrench_settings
    settings.common_share = known.common_error / known.common
    settings.torque_share = known.shares(np.array(own_shares(bundle))).tolist()
    new.wrench_settings = settings
    return new


TORQUES = (
    "sliding_limit_nm",
    "near_stiction_limit_nm",
    "contact_sliding_limit_nm",
    "contact_near_stiction_limit_nm",
    "output_scale_nm",
    "torque_limit_nm",
    "largest_torque_nm",
    "possible_torque_nm",
)
"""Fields of a bundle in N m, one value a joint."""
DRIFT = ("size_nm", "freeze_floor_nm")
SIGMA = ("sigma_weights", "sigma_near_weights", "largest_sigma")


def times(factor: float, values: Sequence[float]) -> list[float]:
    return [factor * value for value in values]


def observer_with(observer: _core.ObserverSettings, nm_per_unit: list[float]) -> _core.ObserverSettings:
    """Return the settings with these constants."""
    kept = ("gain_per_s", "timing", "sample_period_ns", "network_stride", "method", "high_pass_per_s", "low_pass_per_s")
    return _core.ObserverSettings(**{name: getattr(observer, name) for name in kept}, nm_per_unit=nm_per_unit)


def scaled_link(link: _core.Link, factor: float) -> _core.Link:
    """The link with masses and inertias times the factor."""
    scaled = _core.Link()
    for name in ("joint_name", "parent", "type", "rotation", "translation", "com"):
        setattr(scaled, name, getattr(link, name))
    scaled.mass, scaled.rotor_inertia = factor * link.mass, factor * link.rotor_inertia
    scaled.inertia = [factor * value for value in link.inertia]
    return scaled


def with_provenance(bundle: _core.Bundle, known: KnownWeight, mass_kg: float, recordings: list[str]) -> dict:
    """Store the source of the constants in the bundle and return it as facts."""
    facts = json.loads(bundle.provenance or "{}")
    facts["known_weight"] = {
        "mass_kg": mass_kg,
        "factor": known.common,
        "standard_error": known.common_error,
        "recordings": recordings,
        "version": VERSION,
    }
    bundle.provenance = json.dumps(facts, sort_keys=True)
    return facts
