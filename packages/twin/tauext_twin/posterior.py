"""Friction, rotor inertia, masses and centres of mass of an arm as a simulator has them, with a joint posterior."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.stats import chi2

from tauext import _core
from tauext.check.joint_fit import delayed
from tauext.fit.regression import NormalEquations, solve_within
from tauext.fit.ridge import Regressors, gather
from tauext.fit.training_set import with_presliding
from tauext.robot.inertial import PARAMETERS, point_inertia, six_of
from tauext_twin.arm import Arm

Kind = _core.TermKind
FRICTION = tuple(
    getattr(Kind, name)
    for name in ("viscous", "coulomb", "presliding", "load", "load_presliding", "local_memory", "backlash")
)
"""Terms that a simulator's damping and frictionloss stand for."""
OF_LINK = ("mass", "x", "y", "z", "inertia", "armature")
"""Unknowns of a link: mass added at its centre of mass [kg], mass times the shift of that centre [kg m], share by which
its inertia about that centre is larger, and the rotor inertia of its joint [kg m^2]; each beside the robot file."""
VALUES = ("damping", "frictionloss", "armature", "mass", "com_x", "com_y", "com_z", "inertia_factor")
"""What a simulator has of a joint and its link: [N m s/rad], [N m], [kg m^2], [kg], [m]; a factor on the file's
inertia about the centre of mass."""


@dataclass(frozen=True)
class Expected:
    """Standard deviations of what a robot file leaves open, before any motion is seen."""

    mass_share: float = 0.2
    com_m: float = 0.03
    inertia_share: float = 0.3
    """Of a link's inertia about its centre of mass."""
    rotor_share: float = 0.5
    """Of the arm's largest inertia about a joint."""
    tool_share: float = 0.1
    """A tool that the file lacks: of the arm's mass, at the last link ..."""
    tool_m: float = 0.1
    """... and how far from that link's centre of mass, [m]."""
    constant_share: float = 0.05
    """Of a joint's torque: an offset that does not turn with the motion, beside which gravity is found."""
    piece_s: float = 6.0
    """Length of pieces whose errors are taken as independent, [s]."""
    most_pieces: int = 120
    least_mass: float = 0.3
    """Share of its mass in the file that a link keeps at least, and likewise of its inertia."""
    most_shift: float = 0.15
    """Of a centre of mass, as a share of the arm's length."""
    lag_s: float = 0.01
    """By which torques are read earlier and later, to find by how much they lag behind the motion ..."""
    most_lag_s: float = 0.03
    """... and the most that is found."""


@dataclass(frozen=True)
class Posterior:
    r"""Unknowns x of a linear model of r, and what a simulator's joint is of them.

    .. math:: x = (w, \theta),\quad A = \sum_j G_j / (\kappa_j s_j^2) + \Lambda,\quad \hat x = A^{-1} b,\quad
        C = A^{-1} \Big(\sum_p g_p g_p^T + \Lambda\Big) A^{-1}

    w: weights of the friction terms; theta: OF_LINK of each link. G: Gram matrix, s^2: mean squared error of joint j,
    kappa: by how much the sums of its errors over pieces p exceed those of independent ones; g_p: score of a piece, so
    that errors may persist within it. Lambda: inverse variances of Expected.
    """

    equations: NormalEquations
    """Of all pieces, in the columns of x."""
    A: np.ndarray
    b: np.ndarray
    middle: np.ndarray
    """What A^-1 encloses in C."""
    arm: Arm
    lag_s: np.ndarray
    """By which each joint's torque lags behind its motion, where its error is least, (n,), [s], ..."""
    hidden_by_lag: np.ndarray
    """... and by how much its rotor inertia seems smaller for that, (n,), [kg m^2]."""

    @property
    def tree(self) -> _core.Tree:
        """Of the robot file."""
        return self.arm.setup.tree

    @cached_property
    def mean(self) -> np.ndarray:
        return self.solved(np.ones(len(self.b), dtype=bool))

    @property
    def errors(self) -> np.ndarray:
        """Mean squared error of each joint, (n,), [N m squared]."""
        return self.equations.squares(self.mean) / self.equations.rows

    @cached_property
    def hidden(self) -> np.ndarray:
        """Standard error of rotor inertias beside `covariance`, (n,), [kg m^2]: what a lag of the torque hides, and as
        no rotor inertia is below 0, by how much it would be."""
        return np.hypot(self.hidden_by_lag, np.minimum(self.free_rotors, 0.0))

    @property
    def free_rotors(self) -> np.ndarray:
        """Rotor inertia of each joint without bounds, (n,), [kg m^2]."""
        return self.rotors(np.linalg.solve(self.A, self.b))

    @cached_property
    def covariance(self) -> np.ndarray:
        inverse = np.linalg.inv(self.A)
        return np.asarray(inverse @ self.middle @ inverse)

    def solved(self, free: np.ndarray) -> np.ndarray:
        """The unknowns where those that are not free are 0.

        No rotor inertia is below 0, and no mass and inertia of a link below least_mass.
        """
        n, x, expected = self.tree.size, np.zeros(len(self.b)), Expected()
        low = np.full(len(x), -np.inf)
        own = low[-len(OF_LINK) * n :].reshape(n, -1)
        masses = np.array([link.mass for link in self.tree.links])
        own[:, 0], own[:, 4] = (expected.least_mass - 1) * masses, expected.least_mass - 1
        own[:, 5] = [-link.rotor_inertia for link in self.tree.links]
        infinite = np.full(int(free.sum()), np.inf)
        x[free] = solve_within(self.A[np.ix_(free, free)], self.b[free], low[free], infinite)
        return x

    @cached_property
    def most_shift_m(self) -> float:
        """Of a centre of mass, beside the file's, [m]."""
        return Expected().most_shift * max(
            sum(float(np.linalg.norm(link.translation)) for link in self.tree.links), 0.1
        )

    def off_the_file(self, doubt: float = 0.05) -> np.ndarray:
        """The unknowns with every link as in the file whose correction the motion does not show, (columns,).

        The link with the least evidence is put back to the file's values, the rest is solved again, and so on until
        each that is left differs by more than its errors explain. So the shoulder's mass does not take what the tool's
        explains as well.

        Args:
            doubt: probability of a link being changed that is as in the file.
        """
        n, free = self.tree.size, np.ones(len(self.b), dtype=bool)
        links = np.arange(len(self.b))[-len(OF_LINK) * n :].reshape(n, -1)
        groups = [group for one in links for group in (one[:-1], one[-1:])]
        while True:
            x, inverse = self.solved(free), np.linalg.inv(self.A[np.ix_(free, free)])
            covariance = np.zeros_like(self.A)
            covariance[np.ix_(free, free)] = inverse @ self.middle[np.ix_(free, free)] @ inverse
            chances = {
                k: chi2.sf(x[at] @ np.linalg.pinv(covariance[np.ix_(at, at)], hermitian=True) @ x[at], len(at))
                for k, at in enumerate(groups)
                if free[at].any()
            }
            least = max(chances, key=lambda k: chances[k], default=-1)
            if least < 0 or chances[least] <= doubt:
                return x
            free[groups[least]] = False

    @cached_property
    def sliding(self) -> list[tuple[int, int]]:
        """Columns of each joint's viscous term, and of its Coulomb term with the narrowest smoothing."""
        found, first = [], 0
        for terms in self.arm.terms:
            coulomb = [k for k, term in enumerate(terms) if term.kind == Kind.coulomb]
            viscous = next(k for k, term in enumerate(terms) if term.kind == Kind.viscous)
            found.append((first + viscous, first + min(coulomb, key=lambda k: terms[k].speed)))
            first += len(terms)
        return found

    def friction(self, x: np.ndarray, kinds: Sequence[_core.TermKind] = FRICTION, bounded: bool = True) -> np.ndarray:
        """Damping [N m s/rad] and frictionloss [N m] of each joint that come closest to its friction, (n, 2).

        Least squares over the motion, behind the observer: G_SS^-1 G_SF w for the columns S of `sliding` and F of these
        kinds; r has friction with a minus.

        Args:
            bounded: neither is below 0.
        """
        out, first = np.zeros((self.tree.size, 2)), 0
        for j, terms in enumerate(self.arm.terms):
            at, gram = self.equations.columns[j], self.equations.gram[j]
            own = first + np.array([k for k, term in enumerate(terms) if term.kind in kinds], dtype=int)
            first += len(terms)
            S, F = np.searchsorted(at, self.sliding[j]), np.searchsorted(at, own)
            size = np.sqrt(np.maximum(np.diag(gram)[S], 1e-300))
            square = gram[np.ix_(S, S)] / np.outer(size, size) + 1e-9 * np.eye(2)
            right = -(gram[np.ix_(S, F)] @ x[own]) / size
            out[j] = solve_within(square, right, np.full(2, 0.0 if bounded else -np.inf), np.full(2, np.inf)) / size
        return out

    def theta(self, x: np.ndarray) -> np.ndarray:
        """OF_LINK of each link, (n, 6)."""
        return x[-len(OF_LINK) * self.tree.size :].reshape(self.tree.size, -1)

    def rotors(self, x: np.ndarray) -> np.ndarray:
        """Rotor inertia of each joint, (n,), [kg m^2]."""
        return np.array([link.rotor_inertia for link in self.tree.links]) + self.theta(x)[:, 5]

    def values(self, x: np.ndarray, bounded: bool = True) -> np.ndarray:
        """VALUES of each joint, (n, 8).

        Args:
            bounded: as a body can have them; False: for their spread.
        """
        out, theta = np.zeros((self.tree.size, len(VALUES))), self.theta(x)
        out[:, :2] = self.friction(x, bounded=bounded)
        links, least = self.tree.links, Expected().least_mass
        masses = np.array([link.mass for link in links])
        out[:, 2] = np.maximum(self.rotors(x), 0.0 if bounded else -np.inf)
        out[:, 3], out[:, 7] = np.maximum(masses + theta[:, 0], least * masses), np.maximum(1 + theta[:, 4], least)
        shift = theta[:, 1:4] / np.maximum(out[:, 3:4], 1e-9)
        far = np.linalg.norm(shift, axis=1, keepdims=True) / self.most_shift_m
        out[:, 4:7] = [link.com for link in links] + shift / np.maximum(far, 1.0)
        return out

    def draws(self, count: int, seed: int, bounded: bool = True) -> np.ndarray:
        """Joint draws of VALUES, (count, n, 8), of each joint's torque within the error of its constant, and of what
        is `hidden` of its rotor inertia."""
        rng = np.random.default_rng(seed)
        size = np.sqrt(np.maximum(np.diag(self.covariance), 1e-300))
        values, vectors = np.linalg.eigh(self.covariance / np.outer(size, size))
        root = size[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))

        def drawn() -> np.ndarray:
            values = self.values(self.mean + root @ rng.standard_normal(len(self.mean)), bounded)
            values[:, 2] += self.hidden * rng.standard_normal(self.tree.size)
            if bounded:
                values[:, 2] = np.maximum(values[:, 2], 0.0)
            factors = 1 + self.arm.torque_error * rng.standard_normal(self.tree.size)
            values[:, :3] *= np.maximum(factors, 0.5)[:, None]
            values[:, :4] *= max(1 + self.arm.torque_common * rng.standard_normal(), 0.5)
            return values

        return np.array([drawn() for _ in range(count)]).reshape(count, self.tree.size, len(VALUES))

    def standard_errors(self, seed: int, count: int = 2000) -> np.ndarray:
        """Of VALUES, (n, 8): the spread of draws without bounds, at which it would be 0."""
        return np.asarray(self.draws(count, seed, bounded=False).std(axis=0))


def find_posterior(arm: Arm, expected: Expected = Expected()) -> Posterior:
    """The posterior of an arm's parameters from its training motion.

    Raises:
        TrainingError: no recording is longer than the observer's warm-up.
    """
    found = _found(arm, 0.0, expected)
    early, late = (_found(arm, lag_s, expected) for lag_s in (-expected.lag_s, expected.lag_s))
    bend = early.errors - 2 * found.errors + late.errors  # of a parabola through all three
    lags = (early.errors - late.errors) / (2 * np.maximum(bend, 1e-9 * found.errors))
    lags = np.clip(lags, -expected.most_lag_s / expected.lag_s, expected.most_lag_s / expected.lag_s)
    hidden = lags * (late.free_rotors - early.free_rotors) / 2
    return replace(found, lag_s=lags * expected.lag_s, hidden_by_lag=hidden)


def _found(arm: Arm, lag_s: float, expected: Expected) -> Posterior:
    """The posterior with the torque read later than its stamps."""
    setup, terms = arm.setup, arm.terms
    recordings = [replace(one, tau=delayed(one.tau, lag_s, one.rate_hz)) for one in arm.training]
    total_s = sum(recording.duration_s for recording in recordings)
    count = int(np.clip(total_s / expected.piece_s, 20, expected.most_pieces))
    regressors = Regressors([list(of) for of in terms], corrected=setup.tree, loads=setup.prior.corrected_links)
    bent = with_presliding(setup, setup.widths_rad, setup.prior.branches)
    equations = gather(bent, recordings, regressors, max(1, round(count / max(len(recordings), 1))))
    basis, width = link_basis(setup.tree), sum(map(len, terms))
    pieces = [reduced(one, basis, width, arm.in_nm) for one, _ in equations]
    whole = sum(pieces[1:], start=pieces[0])
    return _weighted(arm, pieces, whole, _precision(arm, whole, expected))


def link_basis(tree: _core.Tree) -> np.ndarray:
    """Changes of all links' PARAMETERS by OF_LINK, to first order, (11 n, 6 n).

    Added mass, and a shift of the centre of mass, change first moment and inertia about the joint's origin alike. A
    link's inertia grows by one share, so that it stays one that a body can have.
    """
    h, inertia = slice(1, 4), slice(4, 10)
    out = np.zeros((len(PARAMETERS) * tree.size, len(OF_LINK) * tree.size))
    for k, link in enumerate(tree.links):
        own, c = np.zeros((len(PARAMETERS), len(OF_LINK))), np.array(link.com)
        own[0, 0], own[h, 0], own[inertia, 0] = 1.0, c, six_of(point_inertia(1.0, c))
        for axis, e in enumerate(np.eye(3)):
            own[h, 1 + axis] = e
            own[inertia, 1 + axis] = six_of(2 * (c @ e) * np.eye(3) - np.outer(c, e) - np.outer(e, c))
        own[inertia, 4], own[-1, 5] = link.inertia, 1.0
        out[len(PARAMETERS) * k :, len(OF_LINK) * k :][: len(PARAMETERS), : len(OF_LINK)] = own
    return out


def reduced(equations: NormalEquations, basis: np.ndarray, width: int, in_nm: np.ndarray) -> NormalEquations:
    """The same equations with OF_LINK in place of all inertial parameters; joints in other units show none of these.

    Args:
        width: number of friction terms.
        in_nm: joints whose torque is in N m, (n,) bool.
    """
    columns, grams, moments = [], [], []
    for at, gram, moment, counts in zip(equations.columns, equations.gram, equations.moment, in_nm, strict=True):
        own = int((at < width).sum())
        T = np.zeros((len(at), own + basis.shape[1]))
        T[:own, :own] = np.eye(own)
        T[own:, own:] = basis if counts else 0.0
        columns.append(np.r_[at[:own], width + np.arange(basis.shape[1])])
        grams.append(T.T @ gram @ T)
        moments.append(T.T @ moment)
    return NormalEquations(tuple(columns), grams, moments, equations.energy, equations.rows)


def _precision(arm: Arm, whole: NormalEquations, expected: Expected) -> np.ndarray:
    """Inverse variances of all unknowns before any motion, (columns,); a friction term may be as large as all of r."""
    tree, terms = arm.setup.tree, arm.terms
    width = sum(map(len, terms))
    variance = np.ones(width + len(OF_LINK) * tree.size)
    for at, gram, energy in zip(whole.columns, whole.gram, whole.energy, strict=True):
        own = at < width
        square = np.diag(gram)[own]
        variance[at[own]] = np.where(square > 0, energy / np.maximum(square, 1e-12 * whole.rows), 1.0)
    for first, of in zip(np.cumsum([0, *map(len, terms)]), terms, strict=False):
        constants = first + np.array([k for k, term in enumerate(of) if term.kind == Kind.constant], dtype=int)
        variance[constants] *= expected.constant_share**2
    masses = np.array([link.mass for link in tree.links])
    mass = expected.mass_share * masses + 0.01 * masses.mean()
    shift = expected.com_m * (masses + 0.05 * masses.mean())
    mass[-1] += expected.tool_share * masses.sum()
    shift[-1] += expected.tool_m * mass[-1]
    inertia, q = np.full(tree.size, expected.inertia_share), np.array([one.q[0] for one in arm.training])
    about = [tree.momentum(q, np.tile(one, (len(q), 1)))[0][:, j] for j, one in enumerate(np.eye(tree.size))]
    rotor = np.full(tree.size, expected.rotor_share * max(float(np.max(about)), 1e-3))
    variance[width:] = np.column_stack([mass, shift, shift, shift, inertia, rotor]).ravel() ** 2
    return 1 / np.maximum(variance, 1e-18)


def _weighted(
    arm: Arm, pieces: Sequence[NormalEquations], whole: NormalEquations, precision: np.ndarray, rounds: int = 3
) -> Posterior:
    """The posterior, with each joint weighed by its errors and by how long they persist."""
    size, weight = len(precision), whole.rows / np.maximum(whole.energy, 1e-12 * whole.rows)
    for k in range(rounds):
        A, b = np.diag(precision), np.zeros(size)
        for at, gram, moment, one in zip(whole.columns, whole.gram, whole.moment, weight, strict=True):
            A[np.ix_(at, at)] += one * gram
            b[at] += one * moment
        found = Posterior(whole, A, b, np.diag(precision), arm, *np.zeros((2, len(weight))))
        if k == rounds - 1:
            break
        errors = np.maximum(found.errors, 1e-12 * whole.energy / whole.rows)
        for j, at in enumerate(whole.columns):
            usual = errors[j] * np.diag(whole.gram[j])
            shown = usual > 1e-9 * usual.max()
            of_piece = np.array([piece.moment[j] - piece.gram[j] @ found.mean[at] for piece in pieces])[:, shown]
            weight[j] = 1 / (errors[j] * max(1.0, float(np.mean((of_piece**2).sum(axis=0) / usual[shown]))))
    scores = np.zeros((len(pieces), size))
    for j, at in enumerate(whole.columns):
        scores[:, at] += [weight[j] * (piece.moment[j] - piece.gram[j] @ found.mean[at]) for piece in pieces]
    few = len(pieces) / max(len(pieces) - 1, 1)
    return replace(found, middle=few * scores.T @ scores + np.diag(precision))
