"""A load from recordings: mass and centre of mass, how sure they are, and whether it is a load at all."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from tauext import _core
from tauext.errors import RecordingError
from tauext.load.frame import NamedFrame
from tauext.load.normal import Normal
from tauext.load.rows import LOAD, ROW_S, Seen, columns, friction_sizes
from tauext.load.solve import Fit, Noise, fit, models

ROUNDS = 3
"""In which inertia and the loaded side of each gear follow from the load found so far."""
DENSITY_KG_M3 = 2700.0
"""Aluminium: a load's inertia about its own centre is taken to be that of a ball of it, little beside m c^2."""
LEAST_ROWS = 30
"""Three tenths of a second: less is no measurement."""
SHOWS = 3.0
"""Standard errors between a mass and 0."""
BETTER = 9.0
"""By which another explanation must be cheaper: odds of 90 to 1 and more, in a comparison of independent errors."""
BY_HOW_MUCH = 1.3
"""And by a share: errors of the model are not independent, and cost each explanation something else."""
DOWN = 0.95
"""Cosine of the angle to gravity, 18 degrees, within which a force cannot be told from a weight."""
POOR = 4.0
"""Squared standard errors a row that a load may leave: twice the usual error. Some arms are off by that; a wrench that
moves about on the arm leaves more."""
EXPLAINS = 0.5
"""Share of what shows that a load must explain where more than POOR is left."""
UNSEEN_SHARE = 0.5
"""Of the reach: a direction of the centre of mass is not seen where its standard error is more than half of what was
assumed before any motion."""
MASS_UNSEEN = 0.25
"""A mass is not told where its standard error is a quarter of it."""


@dataclass(frozen=True)
class LoadEstimate:
    """What was found; lengths and axes of the load frame."""

    mass_kg: float
    mass_error_kg: float
    com_m: np.ndarray  # (3,)
    com_error_m: np.ndarray  # (3,)
    phi: np.ndarray  # (10,): m, h, I about the frame's origin
    covariance: np.ndarray  # (4, 4) of m and h
    com_covariance: np.ndarray  # (3, 3)
    seconds: float
    verdict: str
    """`load`, `nothing`, `contact` (a force fits better), `lifts` (what shows pulls up) or `unclear`."""
    reach_m: float
    fits: dict[str, Fit] = field(repr=False)

    @property
    def misfit(self) -> float:
        """Squared standard errors a row that the load leaves."""
        return self.fits["load"].misfit

    @property
    def at_bound(self) -> bool:
        """The centre of mass is as far away as was said to be possible."""
        return bool(np.linalg.norm(self.com_m) >= self.reach_m * (1 - 1e-9))

    @property
    def mass_seen(self) -> bool:
        return self.mass_error_kg <= max(MASS_UNSEEN * self.mass_kg, 0.05)

    @property
    def unseen(self) -> list[np.ndarray]:
        """Directions of the centre of mass that the motion did not tell."""
        sizes, axes = np.linalg.eigh(self.com_covariance)
        return [axis for size, axis in zip(sizes, axes.T, strict=True) if size > (UNSEEN_SHARE * self.reach_m / 2) ** 2]


def identify(
    bundle: _core.Bundle, frame: NamedFrame, parts: Sequence[Seen], reach_m: float = 0.3, phi: np.ndarray | None = None
) -> LoadEstimate:
    """The load that these rows show, by weighted least squares on tau_ext.

        tau_ext_j = X_j(m, h) + offset_j + Coulomb_j tanh(dq_j / v) + error,   weights worth / (scale_j sigma_j)^2

    X holds gravity, inertia and the friction that the load adds, through the observer's filter. The centre of mass is
    within the reach: h is drawn to 0 with a standard deviation of m reach / 2.

    Args:
        phi: a load to begin with, (10,).

    Raises:
        RecordingError: fewer than LEAST_ROWS rows.
    """
    if sum(part.rows for part in parts) < LEAST_ROWS:
        raise RecordingError(
            f"{parts[0].recording.name if parts else 'nothing'}: too few healthy samples to weigh a load; it takes "
            f"{LEAST_ROWS * ROW_S:g} s behind the observer's warm-up"
        )
    phi = np.zeros(10) if phi is None else phi
    sizes, found, prior = friction_sizes(bundle), None, np.zeros((4, 4))
    for _ in range(ROUNDS):
        normal = Normal.empty(bundle.joints)
        for part in parts:
            normal.add(columns(bundle, frame.frame, part, phi), part.sigma, part.worth)
        found = fit(normal, LOAD, sizes, reach_prior(phi[0], reach_m))
        prior = reach_prior(found.values[0], reach_m)
        found = fit(normal, LOAD, sizes, prior)
        phi = with_inertia(found.values, reach_m)
    assert found is not None
    fits = models(normal, sizes, prior, noise_for_comparison(found))
    return estimate_of(found, phi, fits, reach_m, sum(part.rows for part in parts) * ROW_S, np.array(bundle.gravity))


def noise_for_comparison(found: Fit) -> Noise:
    """Errors as the bundle knows them, where the load leaves more: else a contact would be taken for a large error."""
    return Noise(np.minimum(found.noise.scale, 1.5), found.noise.correlation)


def reach_prior(mass_kg: float, reach_m: float) -> np.ndarray:
    """Information about (m, h) before any motion: nothing of m, each of h within m reach / 2 of 0."""
    information = np.zeros((4, 4))
    information[1:, 1:] = np.eye(3) / (max(mass_kg, 0.1) * reach_m / 2) ** 2
    return information


def with_inertia(values: np.ndarray, reach_m: float) -> np.ndarray:
    """phi (10,) of mass and first moment: a mass is at least 0, its centre within the reach, its inertia a ball's."""
    mass = max(float(values[0]), 0.0)
    if mass == 0:
        return np.zeros(10)
    com = values[1:4] / mass
    com = com * min(1.0, reach_m / max(float(np.linalg.norm(com)), 1e-12))
    radius = (3 * mass / (4 * math.pi * DENSITY_KG_M3)) ** (1 / 3)
    inertia = 0.4 * mass * radius**2 * np.eye(3) + mass * (com @ com * np.eye(3) - np.outer(com, com))
    return np.r_[mass, mass * com, np.diag(inertia), inertia[0, 1], inertia[0, 2], inertia[1, 2]]


def estimate_of(
    found: Fit, phi: np.ndarray, fits: dict[str, Fit], reach_m: float, seconds: float, gravity: np.ndarray
) -> LoadEstimate:
    """Mass and centre of mass with their errors, and the verdict."""
    mass = float(phi[0])
    divisor = max(mass, 1e-6)
    com = phi[1:4] / divisor
    slope = np.column_stack([-com / divisor, np.eye(3) / divisor])
    covariance = found.covariance
    com_covariance = slope @ covariance @ slope.T
    error = math.sqrt(max(covariance[0, 0], 0.0))
    return LoadEstimate(
        mass, error, com, np.sqrt(np.maximum(np.diag(com_covariance), 0.0)), phi, covariance, com_covariance, seconds,
        verdict(float(found.values[0]), error, fits, gravity), reach_m, fits,
    )  # fmt: skip


def along(force: Fit, gravity: np.ndarray) -> bool:
    """Whether a force along the base's axes is one that pulls down: where nothing speeds up, that is a load."""
    size = float(np.linalg.norm(force.values) * np.linalg.norm(gravity))
    return float(force.values @ gravity) > DOWN * size


def verdict(mass_kg: float, error_kg: float, fits: dict[str, Fit], gravity: np.ndarray) -> str:
    """What the comparison says; see LoadEstimate."""
    load, nothing = fits["load"], fits["nothing"]
    other = fits["frame"].cost
    if not along(fits["base"], gravity):
        other = min(other, fits["base"].cost)
    if nothing.cost - min(load.cost, other) < BETTER:
        return "nothing"
    if BY_HOW_MUCH * other + BETTER < load.cost:
        return "contact"
    if mass_kg < -SHOWS * error_kg:
        return "lifts"
    if load.misfit > POOR and nothing.cost - load.cost < EXPLAINS * nothing.cost:
        return "unclear"
    return "load" if mass_kg > SHOWS * error_kg or nothing.cost - load.cost >= BETTER else "nothing"
