"""Weights of a prior by ridge regression."""

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
from tauext.fit.regression import FOLDS, NormalEquations, Regression
from tauext.fit.training_set import Setup
from tauext.robot.inertial import PARAMETERS, inertial_parameters, with_inertial_parameters

# --- Ridge regression of r on terms of a prior that went through the observer's filter.


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
    with ThreadPoolExecutor(min(setup.threads, 4)) as pool:
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
    observation, rows = setup.observe(recording)
    if len(rows) < 10:
        return []
    settings = _core.PriorSettings()
    settings.widths_rad, settings.branches = setup.widths_rad, setup.prior.branches
    settings.terms = terms = regressors.terms
    settings.weights = [0.0] * (n * len(terms))
    settings.corrected_links = list(regressors.loads)
    values = _core.prior_regressors(setup.tree, setup.observer, settings, *recording.signals, rows)
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
