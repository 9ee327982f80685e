"""Weights of a prior: by ridge regression, or by MAP with a fleet prior."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from tauext import _core
from tauext.data.recording import Recording
from tauext.errors import TrainingError
from tauext.fit.links import bound_links, fix_impossible, solve_possible
from tauext.fit.prior_terms import LeftOut, PriorFit
from tauext.fit.regression import FOLDS, NormalEquations, Regression, inverse, solve_within
from tauext.fit.training_set import Setup
from tauext.robot.inertial import PARAMETERS, inertial_parameters, with_inertial_parameters

# --- Ridge regression of r on terms of a prior that went through the observer's filter.


AT_A_TIME = 4
"""Recordings whose regressors are held at a time, at most."""
BLOCK = 2048
"""Rows of the links' regressors held at a time: those of a whole recording take hundreds of MB."""


@dataclass(frozen=True)
class Regressors:
    """Regressors of r.

    Args:
        own: terms of each joint alone.
        shared: terms with a weight for every joint.
        corrected: the arm whose inertial parameters are corrected too; None: none is.
        loads: links whose beta the load terms of form CORRECTED see; they are refitted here, with little difference.
    """

    own: Sequence[Sequence[_core.Term]]
    shared: Sequence[_core.Term] = ()
    corrected: _core.Tree | None = None
    loads: Sequence[_core.Link] = ()

    @property
    def terms(self) -> list[_core.Term]:
        return [term for group in self.own for term in group] + list(self.shared)


def fit_ridge(
    setup: Setup, recordings: Sequence[Recording], regressors: Regressors, local_memory_nm: Sequence[float] = ()
) -> PriorFit:
    """Ridge regression of r on regressors that went through the observer's filter.

        minimise  sum_i |r_i - X_i w_i - Z_i theta|^2 / s_i^2 + lambda rows |(w, theta) scaled|^2

    w_i: weights of joint i's own friction terms; theta: corrections of the model, common to all joints (without a
    model: gravity and inertia terms, one set of weights a joint). Columns are scaled to unit RMS, s_i is the RMS of
    r_i. lambda is chosen by cross-validation over recordings. A coefficient's standard error comes from leaving
    out one part of the recordings after the other (jackknife).

    Args:
        local_memory_nm: the presliding friction of each joint, (n,), which bounds the part of it that has local memory.

    Raises:
        TrainingError: no recording is longer than the observer's warm-up.
    """
    found = gather(setup, recordings, regressors)
    regression = Regression([problem for problem, _ in found])
    for m, term in enumerate(term for group in regressors.own for term in group):
        if term.kind == _core.TermKind.local_memory:  # r shows minus the friction
            regression.bound(np.array([m]), np.array([-local_memory_nm[term.a]]), np.array([0.0]))
    return solved(setup, regression, found, regressors)


Found = tuple[NormalEquations, tuple[Recording, slice]]
"""The equations of a piece of a recording, and where it lies."""


def gather(
    setup: Setup, recordings: Sequence[Recording], regressors: Regressors, pieces: int | None = None
) -> list[Found]:
    """The equations of all recordings that are longer than the warm-up; see fit_ridge.

    Args:
        pieces: of each recording; None: enough to leave parts out.

    Raises:
        TrainingError: no recording is longer than the observer's warm-up.
    """
    usable = [recording for recording in recordings if recording.duration_s > setup.warm_up_s + 1]
    count = pieces or (FOLDS if len(usable) < FOLDS else 1)
    chosen = usable or recordings
    with ThreadPoolExecutor(min(setup.threads, AT_A_TIME)) as pool:
        each = pool.map(lambda one: _problems(setup, one, regressors, count), chosen)
        found = [
            (problem, (recording, span))
            for recording, problems in zip(chosen, each, strict=True)
            for problem, span in problems
        ]
    if not found:
        raise TrainingError(f"no training recording is longer than the observer's warm-up of {setup.warm_up_s:g} s")
    return found


def solved(setup: Setup, regression: Regression, found: Sequence[Found], regressors: Regressors) -> PriorFit:
    """The fit by regression of these equations, within the bounds of physical links."""
    corrected, excited = regressors.corrected, regression.used.copy()
    if corrected:
        bound_links(regression, corrected)
    while True:
        ridge, error = regression.choose_ridge()
        solution = regression.solve(regression.whole, ridge)
        if not fix_impossible(regression, corrected, solution):
            break
    spread, determined = regression.standard_errors(regression.leave_one(ridge)), regression.determined(ridge)
    left_out = []
    for k in range(len(regression.folds) if len(regression.folds) > 1 else 0):
        one = solve_possible(regression.copy(), regression.without(k), ridge, corrected)
        where = [where for _, where in found[k::FOLDS]]
        left_out.append(LeftOut(_settings(setup, regressors, one), where))
    settings = _settings(setup, regressors, solution)
    weights, errors, shares = (_by_joint(setup, regressors, values) for values in (solution, spread, determined))
    moved, moved_errors, moved_shares = [np.zeros((setup.tree.size, 0))] * 3
    held = np.zeros((setup.tree.size, 0), dtype=bool)
    if corrected:
        shape, last = (setup.tree.size, len(PARAMETERS)), slice(-len(PARAMETERS) * setup.tree.size, None)
        moved, moved_errors, moved_shares = (one[last].reshape(shape) for one in (solution, spread, determined))
        held = (excited & ~regression.used)[last].reshape(shape)
    of_corrections = (moved, moved_errors, moved_shares, held)
    return PriorFit(settings, ridge, error, weights, errors, shares, *of_corrections, regression, left_out)


def _problems(
    setup: Setup, recording: Recording, regressors: Regressors, pieces: int
) -> list[tuple[NormalEquations, slice]]:
    """The equations of each piece of a recording, and its samples."""
    n, own, shared, corrected = setup.tree.size, regressors.own, regressors.shared, regressors.corrected
    signals = (recording.t_ns, recording.q, recording.dq, recording.tau)
    observation = _core.observe(setup.tree, setup.observer, *signals)
    stride = setup.observer.network_stride
    rows = np.flatnonzero(observation.warm.astype(bool))[::stride].astype(np.int64)
    if len(rows) < 10:
        return []
    settings = _core.PriorSettings()
    settings.widths_rad, settings.branches = setup.widths_rad, setup.prior.branches
    settings.terms = terms = regressors.terms
    settings.weights = [0.0] * (n * len(terms))
    settings.corrected_links = list(regressors.loads)
    values = _core.prior_regressors(setup.tree, setup.observer, settings, *signals, rows)
    ends = np.cumsum([len(group) for group in own])
    mine = [np.arange(end - len(group), end) for group, end in zip(own, ends, strict=True)]
    terms_of = [np.r_[at, ends[-1] : len(terms)] for at in mine]  # its own and the shared ones
    links = range(n if corrected else 0)
    model = _core.LinkRegressors(corrected or setup.tree, setup.observer, list(links), list(range(len(PARAMETERS))))
    corrections = len(links) * len(PARAMETERS)
    width = ends[-1] + n * len(shared) + corrections
    columns = tuple(
        np.r_[at, ends[-1] + i * len(shared) + np.arange(len(shared)), width - corrections : width]
        for i, at in enumerate(mine)
    )
    target = observation.residual[rows]
    problems, done = [], 0
    for piece in np.array_split(np.arange(len(rows)), pieces):
        of_piece = slice(piece[0], piece[-1] + 1)
        X, y = values[of_piece], target[of_piece]
        squares, moments = X.T @ X, X.T @ y  # of all terms at once: most of them are common to all joints
        gram = [np.zeros((len(at) + corrections,) * 2) for at in terms_of]
        moment = [np.r_[moments[at, i], np.zeros(corrections)] for i, at in enumerate(terms_of)]
        for first in range(0, len(piece) if corrections else 0, BLOCK):
            block = slice(first, first + BLOCK)
            at = rows[of_piece][block]
            part, done = slice(done, int(at[-1]) + 1), int(at[-1]) + 1
            Z = model.rows(recording.t_ns[part], recording.q[part], recording.dq[part], at - part.start)
            for i, own_at in enumerate(terms_of):
                moment[i][len(own_at) :] += Z[:, i].T @ y[block, i]
                gram[i][: len(own_at), len(own_at) :] += X[block, own_at].T @ Z[:, i]
                gram[i][len(own_at) :, len(own_at) :] += Z[:, i].T @ Z[:, i]
        for of_joint, at in zip(gram, terms_of, strict=True):
            of_joint[: len(at), : len(at)] = squares[np.ix_(at, at)]
            of_joint[len(at) :, : len(at)] = of_joint[: len(at), len(at) :].T
        span = slice(int(rows[piece[0]]), int(rows[piece[-1]]) + 1)
        problems.append((NormalEquations(columns, gram, moment, (y**2).sum(axis=0), len(piece)), span))
    return problems


def _by_joint(setup: Setup, regressors: Regressors, solution: np.ndarray) -> np.ndarray:
    """Values of all columns as one row of terms a joint, (n, terms); 0 for the terms of other joints."""
    own, shared = regressors.own, regressors.shared
    ends = np.cumsum([len(group) for group in own])
    values = np.zeros((setup.tree.size, ends[-1] + len(shared)))
    for i, (end, group) in enumerate(zip(ends, own, strict=True)):
        values[i, end - len(group) : end] = solution[end - len(group) : end]
        at = ends[-1] + i * len(shared)
        values[i, ends[-1] :] = solution[at : at + len(shared)]
    return values


def _settings(setup: Setup, regressors: Regressors, solution: np.ndarray) -> _core.PriorSettings:
    """The prior with these coefficients."""
    corrected, settings = regressors.corrected, _core.PriorSettings()
    settings.widths_rad, settings.branches = setup.widths_rad, setup.prior.branches
    settings.terms = regressors.terms
    settings.weights = _by_joint(setup, regressors, solution).ravel().tolist()
    if corrected:
        by_link = solution[-len(PARAMETERS) * corrected.size :].reshape(-1, len(PARAMETERS))
        parameters = [inertial_parameters(link) + by for link, by in zip(corrected.links, by_link, strict=True)]
        settings.corrected_links = [
            with_inertial_parameters(link, p) for link, p in zip(corrected.links, parameters, strict=True)
        ]
    return settings


# --- Weights that are most likely given a fleet's prior distribution: MAP instead of the ridge.
#
# .. math:: \min_w \sum_j \frac{\gamma\,\eta_j}{s_j^2} |y_j - X_j w|^2 + (w - \mu)^T \Sigma^{-1} (w - \mu)
#
# eta_j is the share of the rows that are independent of each other, since errors stay what they are for a while, and
# gamma how much a row of the arm's own counts beside the fleet. s_j, the size of a joint's error, is found in what is
# left.


ROUNDS = 8
LEAST_ERROR = 0.5
"""Smallest error as a share of the fleet's: no minute is twice as quiet as the fleet."""


@dataclass(frozen=True)
class WeightPrior:
    """Distribution of all columns before the arm moves."""

    mean: np.ndarray  # (columns,)
    covariance: np.ndarray  # (columns, columns); 0 on the diagonal: no arm excites the column, and it stays
    error_nm: np.ndarray  # (n,) usual size of each joint's error
    memory_s: np.ndarray  # (n,) its correlation time
    trust: float = 1.0
    """Weight of the arm's own rows, gamma."""

    @property
    def known(self) -> np.ndarray:
        """Columns that may move, (columns,) bool."""
        return np.diag(self.covariance) > 0

    def precision(self) -> np.ndarray:
        """Inverse of the covariance of the columns that may move, 0 elsewhere."""
        known = self.known
        out = np.zeros_like(self.covariance)
        size = np.sqrt(np.diag(self.covariance)[known])
        correlation = self.covariance[np.ix_(known, known)] / np.outer(size, size)
        out[np.ix_(known, known)] = inverse(correlation) / np.outer(size, size)
        return (out + out.T) / 2


class MapRegression(Regression):
    """A regression whose ridge is a fleet's prior distribution; the `ridge` of its methods has no effect.

    Args:
        equations: of each stretch, at least one.
        prior: of the same columns.
        period_s: between two rows.
    """

    def __init__(self, equations: Sequence[NormalEquations], prior: WeightPrior, period_s: float) -> None:
        super().__init__(equations)
        self._prior, self._precision = prior, prior.precision()
        self.used = prior.known.copy()
        self._fixed = np.where(self.used, 0.0, prior.mean)
        self._independent = prior.trust * np.minimum(1.0, period_s / prior.memory_s)
        self.error_nm = prior.error_nm.copy()
        self._find_errors()

    def solve(self, equations: NormalEquations, ridge: float = 0.0) -> np.ndarray:
        """The most likely coefficients of all columns, (columns,)."""
        information, moment = self._normal(equations)
        used, solution = self.used, self._fixed.copy()
        right = moment[used] - information[np.ix_(used, ~used)] @ solution[~used]
        # Fixed columns are fixed in the fleet's mean too; another mean would pull the other columns along.
        size = 1 / np.sqrt(np.diag(information)[used])
        scaled = information[np.ix_(used, used)] * np.outer(size, size)
        low, high = self.low[used], self.high[used]
        found = size * solve_within(scaled, size * right, low / size, high / size)
        solution[used] = np.clip(found, low, high)  # scaling back may round beyond
        return solution

    def choose_ridge(self) -> tuple[float, np.ndarray]:
        """0, and the RMSE on what was left out, (n,)."""
        return 0.0, np.sqrt(self._left_out(0.0))

    def determined(self, ridge: float = 0.0) -> np.ndarray:
        """1 where the arm's own motion alone determines a coefficient, 0 where the fleet alone does, (columns,)."""
        information, _ = self._normal(self.whole)
        used, shares = self.used, np.zeros(len(self._fixed))
        before = 1 / np.diag(inverse(self._scaled_block(self._precision)))
        after = 1 / np.diag(inverse(self._scaled_block(information)))
        shares[used] = 1 - before / after
        return shares

    def covariance(self) -> np.ndarray:
        """Covariance of the coefficients, with all of the motion, (columns, columns)."""
        information, _ = self._normal(self.whole)
        size = self._sizes()
        out = np.zeros_like(information)
        out[np.ix_(self.used, self.used)] = inverse(self._scaled_block(information)) * np.outer(size, size)
        return out

    def _find_errors(self) -> None:
        """Size of each joint's error, (n,), from the residual over this number of independent rows."""
        least = LEAST_ERROR * self._prior.error_nm
        for _ in range(ROUNDS):
            solution, covariance = self.solve(self.whole), self.covariance()
            left = np.maximum(self.whole.squares(solution), 0.0)
            rows = self.whole.rows
            spent = np.array(
                [
                    c * float(np.sum(covariance[np.ix_(at, at)] * gram))
                    for c, at, gram in zip(self._counts(), self.whole.columns, self.whole.gram, strict=True)
                ]
            )
            share = np.clip(1 - spent / np.maximum(self._independent * rows, 1.0), 0.1, 1.0)
            self.error_nm = np.maximum(np.sqrt(left / (rows * share)), least)

    def _counts(self) -> np.ndarray:
        return self._independent / self.error_nm**2

    def _normal(self, equations: NormalEquations) -> tuple[np.ndarray, np.ndarray]:
        """Information matrix of all columns, and its right-hand side."""
        information, moment = self._precision.copy(), self._precision @ self._prior.mean
        for c, at, gram, own in zip(self._counts(), equations.columns, equations.gram, equations.moment, strict=True):
            information[np.ix_(at, at)] += c * gram
            moment[at] += c * own
        return information, moment

    def _sizes(self) -> np.ndarray:
        """Standard deviations in the fleet of the columns that are used."""
        return np.sqrt(np.diag(self._prior.covariance)[self.used])

    def _scaled_block(self, matrix: np.ndarray) -> np.ndarray:
        """Of the used columns, in units of what they vary by in the fleet."""
        size = self._sizes()
        return matrix[np.ix_(self.used, self.used)] * np.outer(size, size)
