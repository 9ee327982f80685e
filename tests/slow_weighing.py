"""A load found the slow way, in NumPy: the twin of the core's sums, solver and verdict."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from tauext import _core
from tauext.monitor.weighing import NamedFrame, Seen

ROW_S = 0.01
OFFSET_SHARE, COULOMB_SHARE = 0.07, 0.2
"""Standard deviations of what is co-estimated of each joint, an offset and friction of another size than in training,
as shares of the most that its drift may be (0.3 of its friction): 2 % and 6 % of it. Warming up is 10 to 15 %."""

LOAD, OFFSET, COULOMB, BASE_FORCE, FRAME_FORCE, TARGET = slice(0, 4), 4, 5, slice(6, 9), slice(9, 12), 12
COLUMNS = 13
"""Of a row: m and h, the joint's own offset and friction, forces along the base's and the frame's axes, tau_ext."""


BLOCK_ROWS = 100
"""A second: sums over so much show how long errors of tau_ext go on in one direction."""


@dataclass
class Normal:
    """Per joint: sum of z z^T / sigma^2, and the same of its sums over blocks, which tell the errors' correlation."""

    gram: np.ndarray  # (n, COLUMNS, COLUMNS)
    blocks: np.ndarray  # (n, COLUMNS, COLUMNS)
    worth: np.ndarray  # (n,): rows, each by what it is worth

    @classmethod
    def empty(cls, joints: int) -> Normal:
        return cls(np.zeros((joints, COLUMNS, COLUMNS)), np.zeros((joints, COLUMNS, COLUMNS)), np.zeros(joints))

    def add(self, z: np.ndarray, sigma: np.ndarray, worth: np.ndarray) -> None:
        """Rows that follow one another: z (rows, n, COLUMNS); sigma and worth (rows, n)."""
        for first in range(0, len(z), BLOCK_ROWS):
            rows = slice(first, first + BLOCK_ROWS)
            scaled = z[rows] / sigma[rows, :, None]
            self.gram += np.einsum("kja,kj,kjb->jab", scaled, worth[rows], scaled)
            block = np.einsum("kja,kj->ja", scaled, worth[rows])
            self.blocks += np.einsum("ja,jb->jab", block, block)
            self.worth += worth[rows].sum(axis=0)

    def __add__(self, other: Normal) -> Normal:
        return Normal(self.gram + other.gram, self.blocks + other.blocks, self.worth + other.worth)


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


ROUNDS = 3
"""In which inertia and the loaded side of each gear follow from the load found so far."""
USUAL_KG = 2.0
"""Where nothing is known: see the core."""
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
    """As tauext.monitor.weighing, with every round over the rows again."""
    if sum(part.rows for part in parts) < LEAST_ROWS:
        raise ValueError(
            f"{parts[0].recording.name if parts else 'nothing'}: too few healthy samples to weigh a load; it takes "
            f"{LEAST_ROWS * ROW_S:g} s behind the observer's warm-up"
        )
    phi = np.zeros(10) if phi is None else phi
    sizes, found, prior = friction_sizes(bundle), None, np.zeros((4, 4))
    for _ in range(ROUNDS):
        normal = Normal.empty(bundle.joints)
        for part in parts:
            normal.add(columns(bundle, frame.frame, part, phi), part.sigma, part.worth)
        found = fit(normal, LOAD, sizes, reach_prior(phi[0] or USUAL_KG, reach_m))
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
    information[0, 0] = 1000.0**-2  # of a mass before any motion
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


def columns(bundle: _core.Bundle, frame: _core.LoadFrame, seen: Seen, phi: np.ndarray) -> np.ndarray:
    """All columns of the rows, (rows, n, COLUMNS), about a load phi (10,) as known so far.

    It says which side the gears are loaded on; and its inertia, which follows from mass and first moment, is taken off.
    """
    r = seen.recording
    told = _core.load_rows(bundle, frame, phi.tolist(), r.t_ns, r.q, r.dq, seen.samples)
    z = np.empty((*seen.tau_ext.shape, COLUMNS))
    z[..., LOAD] = told["load"][..., :4]
    z[..., OFFSET], z[..., COULOMB] = 1.0, told["coulomb"]
    z[..., BASE_FORCE], z[..., FRAME_FORCE] = told["base_forces"], told["frame_forces"]
    z[..., TARGET] = seen.tau_ext - told["offset"] - told["load"][..., 4:] @ phi[4:]
    return z


def friction_sizes(bundle: _core.Bundle) -> np.ndarray:
    """Standard deviations of offset and Coulomb friction that are co-estimated, (n, 2), [N m]."""
    size = np.array(bundle.drift.size_nm if bundle.drift.time_constant_s else 0.3 * np.array(bundle.sliding_limit_nm))
    return np.column_stack([OFFSET_SHARE * size, COULOMB_SHARE * size])
