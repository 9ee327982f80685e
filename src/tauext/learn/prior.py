"""The prior: what friction and model error show in r, fitted by ridge regression on filtered regressors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from tauext import _core
from tauext.config import PriorConfig
from tauext.data import Recording
from tauext.errors import TrainingError
from tauext.learn.find_kinematics import can_be_found, find_kinematics
from tauext.learn.inertial_regressors import inertial_regressors
from tauext.learn.kinematic_sample import LEAST_ROWS, KinematicSample
from tauext.learn.kinematics import Kinematics
from tauext.learn.possible_links import ROTOR, fix_impossible, solve_possible
from tauext.learn.prior_terms import CORRECTED, ESTIMATED, has_model, own_terms, shared_terms
from tauext.learn.regression import FOLDS, NormalEquations, Regression
from tauext.learn.ripple import find_ripple
from tauext.learn.training_set import Chain
from tauext.learn.widths import idle_widths
from tauext.robot.inertial import PARAMETERS, inertial_parameters, with_inertial_parameters

RIPPLE_HELPS = 0.01
"""A ripple stays that lowers the error on left-out motion by this share: in minutes, noise may look like one."""
FOUND_ARM_COSTS = 0.1


LEAST_CYCLES = 5  # a turn: what comes back more seldom is gravity that is not quite right, and no gear


@dataclass(frozen=True)
class Inertia:
    """What the prior says of gravity and inertia, beside the estimated model: the default is sines and cosines."""

    tree: _core.Tree | None = None
    """Its inertial parameters are corrected; None: none are."""
    load: int | None = None
    """See own_terms."""
    loads: tuple[_core.Link, ...] = ()
    kinematics: Kinematics | None = None


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
    kinematics: Kinematics | None = None  # found from the motion, where there is no model and this explains it
    dropped_widths: dict[float, str] = field(default_factory=dict)  # [rad]: and why


def fit_prior(
    chain: Chain,
    recordings: Sequence[Recording],
    config: PriorConfig,
    tell: Callable[[str], None] | None = None,
    known: Kinematics | None = None,
) -> PriorFit:
    """The prior of a chain whose prior holds nothing but presliding widths yet.

    Without a model the arm itself is looked for first. Ripple is searched for in what a first fit leaves; then
    presliding widths that do not help are left out.

    Args:
        tell: takes a line about what was found.
        known: an arm that was found already, to be looked at first where there is no model.

    Raises:
        TrainingError: no recording is longer than the observer's warm-up.
    """
    inertia = Inertia(chain.tree if config.correct_model else None, ESTIMATED)
    fit = None
    if not has_model(chain):
        inertia, fit = find_inertia(chain, recordings, config, tell or (lambda line: None), known)
    ripple: list[list[int]] = [[] for _ in range(chain.tree.size)]
    fit = fit or fit_terms(chain, recordings, config, ripple, inertia)
    for _ in range(config.most_ripples):
        found = find_ripple(chain, recordings, fit, ripple, LEAST_CYCLES if inertia.tree or has_model(chain) else 1)
        if not any(found):
            break
        tried = [known + new for known, new in zip(ripple, found, strict=True)]
        more = fit_terms(chain, recordings, config, tried, inertia)
        helps = more.error_nm < (1 - RIPPLE_HELPS) * fit.error_nm  # on motion left out of the fit
        kept = [a if better else b for a, b, better in zip(tried, ripple, helps, strict=True)]
        if kept == ripple:
            break
        fit = more if kept == tried else fit_terms(chain, recordings, config, kept, inertia)
        ripple = kept
    dropped = idle_widths(chain, recordings, config, fit) if config.drop_widths else {}
    if dropped:
        prior = _core.PriorSettings()
        prior.widths_rad = [width for width in chain.widths_rad if width not in dropped]
        without = fit_terms(replace(chain, prior=prior), recordings, config, ripple, inertia)
        fit = replace(without, dropped_widths=dropped)
    return replace(fit, kinematics=inertia.kinematics)


def find_inertia(
    chain: Chain,
    recordings: Sequence[Recording],
    config: PriorConfig,
    tell: Callable[[str], None],
    known: Kinematics | None,
) -> tuple[Inertia, PriorFit]:
    """What stands for gravity and inertia where there is no model, and a first fit with it.

    An arm found from its motion says what happens at poses that training never saw, which sines and cosines of
    the angles cannot; those stay where they explain left-out motion better by FOUND_ARM_COSTS.
    """
    nothing: list[list[int]] = [[] for _ in range(chain.tree.size)]
    basis = fit_terms(chain, recordings, config, nothing, Inertia())
    if not (config.find_kinematics and can_be_found(chain)):
        return Inertia(), basis
    own = [own_terms(chain, config, joint) for joint in range(chain.tree.size)]
    sample = KinematicSample(chain.tree, chain.observer, recordings, own, chain.widths_rad)
    if sample.rows < LEAST_ROWS:
        return Inertia(), basis
    joints = tuple(link.joint_name for link in chain.tree.links)
    kinematics = find_kinematics(sample, joints, tell, start=known).kinematics
    inertia = Inertia(kinematics.tree(joints, chain.tree.gravity), kinematics=kinematics)
    fit = fit_terms(chain, recordings, config, nothing, inertia)
    inertia = replace(inertia, load=CORRECTED, loads=tuple(fit.settings.corrected_links))
    fit = fit_terms(chain, recordings, config, nothing, inertia)
    rms = np.sqrt(fit.regression.whole.energy / fit.regression.whole.rows)
    with_arm, without = (float(np.sqrt(np.mean((one.error_nm / rms) ** 2))) for one in (fit, basis))
    tell(f"error on left-out motion: {with_arm:.1%} of r with the arm found, {without:.1%} with sines and cosines")
    return (Inertia(), basis) if (1 - FOUND_ARM_COSTS) * with_arm > without else (inertia, fit)


def fit_terms(
    chain: Chain,
    recordings: Sequence[Recording],
    config: PriorConfig,
    ripple: Sequence[Sequence[int]],
    inertia: Inertia,
) -> PriorFit:
    """All terms of the prior, with these ripples of each joint: see fit_ridge."""
    tops = np.max([np.abs(recording.dq).max(axis=0) for recording in recordings], axis=0)
    own = [own_terms(chain, config, j, ripple[j], inertia.load, top) for j, top in enumerate(tops.tolist())]
    shared = [] if has_model(chain) or inertia.tree else shared_terms(chain)
    return fit_ridge(chain, recordings, own, shared, inertia.tree, inertia.loads)


def fit_ridge(
    chain: Chain,
    recordings: Sequence[Recording],
    own: Sequence[Sequence[_core.Term]],
    shared: Sequence[_core.Term],
    corrected: _core.Tree | None = None,
    loads: Sequence[_core.Link] = (),
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
        corrected: the arm whose inertial parameters are corrected too; None: none is.
        loads: links whose beta the load terms of form CORRECTED see; they are fitted anew here, with little difference.

    Raises:
        TrainingError: no recording is longer than the observer's warm-up.
    """
    terms = [term for group in own for term in group] + list(shared)
    usable = [recording for recording in recordings if recording.duration_s > chain.warm_up_s + 1]
    pieces = FOLDS if len(usable) < FOLDS else 1  # of each recording, so that there is something to leave out
    found = [
        (problem, (recording, span))
        for recording in usable or recordings
        for problem, span in _problems(chain, recording, own, shared, terms, corrected, loads, pieces)
    ]
    if not found:
        raise TrainingError(f"no training recording is longer than the observer's warm-up of {chain.warm_up_s:g} s")
    regression = Regression([problem for problem, _ in found])
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
        left_out.append(LeftOut(_settings(chain, own, shared, terms, corrected, one), where))
    settings = _settings(chain, own, shared, terms, corrected, solution)
    weights, errors, shares = (_by_joint(chain, own, shared, values) for values in (solution, spread, determined))
    corrections = [np.zeros((chain.tree.size, 0))] * 3
    if corrected:
        corrections = [one[-len(PARAMETERS) * chain.tree.size :] for one in (solution, spread, determined)]
        corrections = [one.reshape(chain.tree.size, len(PARAMETERS)) for one in corrections]
    return PriorFit(settings, ridge, error, weights, errors, shares, *corrections, regression, left_out)


def _problems(chain, recording, own, shared, terms, corrected, loads, pieces) -> list[tuple[NormalEquations, slice]]:
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
    settings.corrected_links = list(loads)
    values = _core.prior_regressors(chain.tree, chain.observer, settings, *signals, rows)
    ends = np.cumsum([len(group) for group in own])
    mine = [np.arange(end - len(group), end) for group, end in zip(own, ends, strict=True)]
    terms_of = [np.r_[at, ends[-1] : len(terms)] for at in mine]  # its own and the shared ones
    model = np.zeros((len(rows), n, 0))
    if corrected is not None:
        model = inertial_regressors(corrected, chain.observer, recording, rows)
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
        by_link = solution[-len(PARAMETERS) * corrected.size :].reshape(-1, len(PARAMETERS))
        parameters = [inertial_parameters(link) + by for link, by in zip(corrected.links, by_link, strict=True)]
        for p in parameters:
            if p[0] <= 0 and np.any(p[1:ROTOR] != 0):
                p[0] = 1.0  # it shows nowhere, and a first moment needs some
        settings.corrected_links = [
            with_inertial_parameters(link, p) for link, p in zip(corrected.links, parameters, strict=True)
        ]
    return settings
