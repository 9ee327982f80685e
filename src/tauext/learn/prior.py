"""The prior: what friction and model error show in r, fitted by ridge regression on filtered regressors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, combinations_with_replacement

import numpy as np

from tauext import _core
from tauext.config import PriorConfig
from tauext.data import Recording
from tauext.errors import TrainingError
from tauext.learn.regression import FOLDS, NormalEquations, Regression
from tauext.learn.ripple import find_ripple
from tauext.learn.training_set import Chain
from tauext.learn.widths import idle_widths
from tauext.robot.inertial import PARAMETERS, inertial_parameters, with_inertial_parameters

Kind = _core.TermKind
ROTOR = PARAMETERS.index("rotor")
RIPPLE_HELPS = 0.01
"""A ripple stays that lowers the error on left-out motion by this share: in minutes, noise may look like one."""


@dataclass(frozen=True)
class LeftOut:
    """The same prior fitted without a fifth of the recordings, and where that lies: (recording, samples) each."""

    settings: _core.PriorSettings
    parts: list[tuple[Recording, slice]]


@dataclass(frozen=True)
class PriorFit:
    """A fitted prior and how well the data determine it."""

    settings: _core.PriorSettings
    ridge: float
    error_nm: np.ndarray  # (n,) RMSE on recordings left out of the fit
    weights: np.ndarray  # (n, terms)
    standard_errors: np.ndarray  # (n, terms), over recordings
    determined: np.ndarray  # (n, terms): 1: by the data alone, 0: by the ridge alone
    corrections: np.ndarray  # (n, 11) of PARAMETERS; empty without a model
    correction_errors: np.ndarray
    corrections_determined: np.ndarray
    regression: Regression
    left_out: list[LeftOut]  # one for each fold that leaves a possible model
    dropped_widths: dict[float, str] = field(default_factory=dict)  # [rad]: and why


def own_terms(chain: Chain, config: PriorConfig, joint: int, ripple: Sequence[int]) -> list[_core.Term]:
    """Friction and ripple of one joint: what it does alone."""
    terms = [_core.Term(Kind.constant, joint), _core.Term(Kind.viscous, joint)]
    terms += [_core.Term(Kind.coulomb, joint, speed=speed) for speed in config.coulomb_speeds_rad_s]
    terms += [_core.Term(Kind.presliding, joint, b=width) for width in range(len(chain.widths_rad))]
    if has_model(chain):
        terms.append(_core.Term(Kind.load, joint, speed=config.coulomb_speeds_rad_s[0]))
        if chain.widths_rad:
            terms.append(_core.Term(Kind.load_presliding, joint, b=len(chain.widths_rad) // 2))
    return terms + [_core.Term(Kind.ripple, joint, b=cycles, form=form) for cycles in ripple for form in (0, 1)]


def shared_terms(chain: Chain) -> list[_core.Term]:
    """Without a model: gravity and inertia from sines and cosines of single joints and pairs, for every joint."""
    if has_model(chain):
        return []
    joints = range(chain.tree.size)
    terms = [_core.Term(Kind.gravity, j, j, form=form) for j in joints for form in (0, 1)]
    terms += [_core.Term(Kind.gravity, a, b, form=form) for a, b in combinations(joints, 2) for form in (2, 3, 4, 5)]
    # Three neighbours: gravity of parallel axes is that of the sum of their angles, and of a wrist behind them.
    terms += [_core.Term(Kind.gravity, j - 2, j - 1, j, form=form) for j in joints[2:] for form in range(6, 14)]
    terms += [_core.Term(Kind.momentum, j, j, form=0) for j in joints]
    terms += [_core.Term(Kind.momentum, a, b, form=form) for a in joints for b in near(a, joints) for form in (1, 2)]
    terms += [
        _core.Term(Kind.quadratic, a, b, c, form)
        for a, b in combinations_with_replacement(joints, 2)
        if b - a <= 1
        for c in near(a, joints)
        for form in (0, 1)
    ]
    return terms


def near(joint: int, joints: range) -> list[int]:
    """A joint and its neighbours, whose angles its inertia depends on most; all of them in a short arm."""
    return [other for other in joints if len(joints) <= 3 or abs(other - joint) <= 1]


def has_model(chain: Chain) -> bool:
    return any(link.mass > 0 or link.rotor_inertia > 0 for link in chain.tree.links)


def fit_prior(chain: Chain, recordings: Sequence[Recording], config: PriorConfig) -> PriorFit:
    """The prior of a chain whose prior holds nothing but presliding widths yet.

    Ripple is searched for in what a first fit leaves; then presliding widths that do not help are left out.

    Raises:
        TrainingError: no recording is longer than the observer's warm-up.
    """
    ripple: list[list[int]] = [[] for _ in range(chain.tree.size)]
    fit = fit_terms(chain, recordings, config, ripple)
    for _ in range(config.most_ripples):
        found = find_ripple(chain, recordings, fit, ripple)
        if not any(found):
            break
        tried = [known + new for known, new in zip(ripple, found, strict=True)]
        more = fit_terms(chain, recordings, config, tried)
        helps = more.error_nm < (1 - RIPPLE_HELPS) * fit.error_nm  # on motion left out of the fit
        kept = [a if better else b for a, b, better in zip(tried, ripple, helps, strict=True)]
        if kept == ripple:
            break
        fit = more if kept == tried else fit_terms(chain, recordings, config, kept)
        ripple = kept
    dropped = idle_widths(chain, recordings, config, fit) if config.drop_widths else {}
    if dropped:
        prior = _core.PriorSettings()
        prior.widths_rad = [width for width in chain.widths_rad if width not in dropped]
        fit = replace(fit_terms(replace(chain, prior=prior), recordings, config, ripple), dropped_widths=dropped)
    return fit


def fit_terms(
    chain: Chain, recordings: Sequence[Recording], config: PriorConfig, ripple: Sequence[Sequence[int]]
) -> PriorFit:
    """All terms of the prior, with these ripples of each joint: see fit_ridge."""
    own = [own_terms(chain, config, joint, ripple[joint]) for joint in range(chain.tree.size)]
    return fit_ridge(chain, recordings, own, shared_terms(chain), has_model(chain) and config.correct_model)


def fit_ridge(
    chain: Chain,
    recordings: Sequence[Recording],
    own: Sequence[Sequence[_core.Term]],
    shared: Sequence[_core.Term],
    corrected: bool,
) -> PriorFit:
    """Ridge regression of r on regressors that went through the observer's filter.

        minimise  sum_i |r_i - X_i w_i - Z_i theta|^2 / s_i^2 + lambda rows |(w, theta) scaled|^2

    w_i: weights of joint i's own friction terms; theta: corrections of the model, common to all joints (without a
    model: gravity and inertia terms, one set of weights a joint). Columns are scaled to unit RMS, s_i is the RMS of
    r_i. lambda is chosen by cross-validation over recordings. A coefficient's standard error comes from leaving
    out one part of the recordings after the other (jackknife).

    Args:
        own: terms of each joint alone.
        shared: terms with a weight for every joint.
        corrected: whether the model is corrected too; there must be one.

    Raises:
        TrainingError: no recording is longer than the observer's warm-up.
    """
    terms = [term for group in own for term in group] + list(shared)
    usable = [recording for recording in recordings if recording.duration_s > chain.warm_up_s + 1]
    pieces = FOLDS if len(usable) < FOLDS else 1  # of each recording, so that there is something to leave out
    found = [
        (problem, (recording, span))
        for recording in usable or recordings
        for problem, span in _problems(chain, recording, own, shared, terms, corrected, pieces)
    ]
    if not found:
        raise TrainingError(f"no training recording is longer than the observer's warm-up of {chain.warm_up_s:g} s")
    regression = Regression([problem for problem, _ in found])
    while True:
        ridge, error = regression.choose_ridge()
        solution = regression.solve(regression.whole, ridge)
        impossible = _impossible(chain, solution, regression.used) if corrected else []
        if not impossible:
            break
        for column in impossible:
            regression.fix(column, nearest_possible(chain, column, len(solution)))
    spread, determined = regression.standard_errors(regression.leave_one(ridge)), regression.determined(ridge)
    left_out = []
    for k in range(len(regression.folds) if len(regression.folds) > 1 else 0):
        one = solve_possible(regression.copy(), regression.without(k), ridge, chain, corrected)
        where = [where for _, where in found[k::FOLDS]]
        left_out.append(LeftOut(_settings(chain, own, shared, terms, corrected, one), where))
    settings = _settings(chain, own, shared, terms, corrected, solution)
    weights, errors, shares = (_by_joint(chain, own, shared, values) for values in (solution, spread, determined))
    corrections = [np.zeros((chain.tree.size, 0))] * 3
    if corrected:
        corrections = [one[-len(PARAMETERS) * chain.tree.size :] for one in (solution, spread, determined)]
        corrections = [one.reshape(chain.tree.size, len(PARAMETERS)) for one in corrections]
    return PriorFit(settings, ridge, error, weights, errors, shares, *corrections, regression, left_out)


def solve_possible(
    regression: Regression, equations: NormalEquations, ridge: float, chain: Chain, corrected: bool
) -> np.ndarray:
    """Coefficients that make no impossible link; columns that would are fixed in the regression."""
    while True:
        solution = regression.solve(equations, ridge)
        impossible = _impossible(chain, solution, regression.used) if corrected else []
        if not impossible:
            return solution
        for column in impossible:
            regression.fix(column, nearest_possible(chain, column, len(solution)))


def _impossible(chain: Chain, solution: np.ndarray, used: np.ndarray) -> list[int]:
    """Columns of corrections that would make a link that no link can be: they have to go, and the rest to be solved
    anew. A mass that falls to zero or below keeps what the file says, or is 1 kg where the file says nothing: what it
    adds shows in other parameters too, and they make up for it. A rotor inertia below zero is none."""
    first, columns = len(solution) - len(PARAMETERS) * chain.tree.size, []
    for k, link in enumerate(chain.tree.links):
        at = first + len(PARAMETERS) * k
        by = solution[at : at + len(PARAMETERS)]
        if link.mass + by[0] <= 0 and used[at]:  # one that shows nowhere may be any
            columns.append(at)
        if link.rotor_inertia + by[ROTOR] < 0 and used[at + ROTOR]:
            columns.append(at + ROTOR)
    return columns


def nearest_possible(chain: Chain, column: int, columns: int) -> float:
    """The correction that an impossible one is replaced by; see _impossible."""
    link, parameter = divmod(column - (columns - len(PARAMETERS) * chain.tree.size), len(PARAMETERS))
    if parameter == ROTOR:
        return -chain.tree.links[link].rotor_inertia
    return 0.0 if chain.tree.links[link].mass > 0 else 1.0


def _problems(chain, recording, own, shared, terms, corrected, pieces) -> list[tuple[NormalEquations, slice]]:
    """The equations of each piece of a recording, and its samples."""
    n = chain.tree.size
    signals = (recording.t_ns, recording.q, recording.dq, recording.tau)
    observation = _core.observe(chain.tree, chain.observer, *signals)
    stride = chain.observer.network_stride
    rows = np.flatnonzero(observation.warm.astype(bool))[::stride].astype(np.int64)
    if len(rows) < 10:
        return []
    settings = _core.PriorSettings()
    settings.widths_rad = chain.widths_rad
    settings.terms = terms
    settings.weights = [0.0] * (n * len(terms))
    values = _core.prior_regressors(chain.tree, chain.observer, settings, *signals, rows)
    ends = np.cumsum([len(group) for group in own])
    mine = [np.arange(end - len(group), end) for group, end in zip(own, ends, strict=True)]
    terms_of = [np.r_[at, ends[-1] : len(terms)] for at in mine]  # its own and the shared ones
    model = _model_regressors(chain, recording, rows) if corrected else np.zeros((len(rows), n, 0))
    width = ends[-1] + n * len(shared) + model.shape[2]
    columns = tuple(
        np.r_[at, ends[-1] + i * len(shared) + np.arange(len(shared)), width - model.shape[2] : width]
        for i, at in enumerate(mine)
    )
    target = observation.residual[rows]
    problems = []
    for piece in np.array_split(np.arange(len(rows)), pieces):
        of_piece = slice(piece[0], piece[-1] + 1)
        X, y, Z = values[of_piece], target[of_piece], model[of_piece]
        squares, moments = X.T @ X, X.T @ y  # of all terms at once: most of them are common to all joints
        gram, moment = [], []
        for i, at in enumerate(terms_of):
            mixed = X[:, at].T @ Z[:, i]
            gram.append(np.block([[squares[np.ix_(at, at)], mixed], [mixed.T, Z[:, i].T @ Z[:, i]]]))
            moment.append(np.r_[moments[at, i], Z[:, i].T @ y[:, i]])
        span = slice(int(rows[piece[0]]), int(rows[piece[-1]]) + 1)
        problems.append((NormalEquations(columns, gram, moment, (y**2).sum(axis=0), len(piece)), span))
    return problems


def _model_regressors(chain: Chain, recording: Recording, rows: np.ndarray) -> np.ndarray:
    """What a unit more of each link's inertial parameters in the *robot* takes from r: (rows, n, 11 n)."""
    still = np.zeros_like(recording.tau)

    def observed(tree: _core.Tree) -> np.ndarray:
        said = _core.observe(tree, chain.observer, recording.t_ns, recording.q, recording.dq, still)
        return said.residual[rows]

    # r is linear in the parameters, so where the units are added does not matter; a first moment needs some mass.
    links = chain.tree.links
    starts = [inertial_parameters(link) for link in links]
    for start in starts:
        start[0] = start[0] or 1.0
    started = [with_inertial_parameters(link, start) for link, start in zip(links, starts, strict=True)]
    base = observed(_core.Tree(started, chain.tree.gravity))
    values = np.empty((len(rows), len(links), len(PARAMETERS) * len(links)))
    for k, link in enumerate(links):
        for m, unit in enumerate(np.eye(len(PARAMETERS))):
            changed = list(started)
            changed[k] = with_inertial_parameters(link, starts[k] + unit)
            values[:, :, len(PARAMETERS) * k + m] = base - observed(_core.Tree(changed, chain.tree.gravity))
    return values


def _by_joint(chain: Chain, own: Sequence, shared: Sequence, solution: np.ndarray) -> np.ndarray:
    """Values of all columns as one row of terms a joint, (n, terms); 0 for the terms of other joints."""
    ends = np.cumsum([len(group) for group in own])
    values = np.zeros((chain.tree.size, ends[-1] + len(shared)))
    for i, (end, group) in enumerate(zip(ends, own, strict=True)):
        values[i, end - len(group) : end] = solution[end - len(group) : end]
        at = ends[-1] + i * len(shared)
        values[i, ends[-1] :] = solution[at : at + len(shared)]
    return values


def _settings(chain, own, shared, terms, corrected, solution) -> _core.PriorSettings:
    """The prior that these coefficients make."""
    settings = _core.PriorSettings()
    settings.widths_rad = chain.widths_rad
    settings.terms = terms
    settings.weights = _by_joint(chain, own, shared, solution).ravel().tolist()
    if corrected:
        by_link = solution[-len(PARAMETERS) * chain.tree.size :].reshape(-1, len(PARAMETERS))
        parameters = [inertial_parameters(link) + by for link, by in zip(chain.tree.links, by_link, strict=True)]
        for p in parameters:
            if p[0] <= 0 and np.any(p[1:ROTOR] != 0):
                p[0] = 1.0  # it shows nowhere, and a first moment needs some
        settings.corrected_links = [
            with_inertial_parameters(link, p) for link, p in zip(chain.tree.links, parameters, strict=True)
        ]
    return settings
