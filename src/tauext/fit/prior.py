"""The prior: friction and model error in r, fitted by ridge regression on filtered regressors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np

from tauext import _core
from tauext.config import PriorConfig
from tauext.data.recording import Recording
from tauext.data.servo import derives_velocity
from tauext.fit.find_kinematics import ArmSearch, Kinematics, KinematicSample, can_be_found, find_kinematics
from tauext.fit.prior_terms import CORRECTED, ESTIMATED, Kind, PriorFit, has_model, idle_widths, own_terms, shared_terms
from tauext.fit.regression import LEAST_SQUARE
from tauext.fit.ridge import Regressors, fit_ridge
from tauext.fit.stable_choice import simplest
from tauext.fit.temperature import with_temperature
from tauext.fit.training_set import Setup, with_presliding


@dataclass(frozen=True)
class RippleConfig:
    """Which torque ripples of motor and gear are found; more motion shows weaker ones, and takes longer."""

    most_cycles: int = 400
    """Most cycles per turn that are tried."""
    least_gear_cycles: int = 5
    """Fewest cycles per turn where a model explains gravity: lower frequencies are errors of gravity, not a gear."""
    data_s: float = 300.0
    """This much motion is enough, [s], and the search is slow ..."""
    joints_s: float = 600.0
    """... for each joint, so this time is divided by their number, [s] ..."""
    enough_s: float = 120.0
    """... down to this, [s]."""
    least_s: float = 45.0
    """In less motion noise can pass for a ripple, [s]: none is searched for."""
    share: float = 0.03
    """Least share of the remainder's sum of squares that a ripple explains."""
    outstands: float = 5.0
    """Least ratio of what a ripple explains to what the median number of cycles explains."""
    alias_tie: float = 1e-6
    """An encoder of N counts a turn shows k and N - k cycles as the same, but for rounding of this share: the fewer are
    taken."""
    helps: float = 0.01
    """A ripple is kept if it lowers the error on left-out motion by this share; in minutes, noise can pass for one."""


# --- Textbook friction, the baseline of the prior.


def fit_friction(setup: Setup, recordings: Sequence[Recording], **settings: object) -> PriorFit:
    r"""Constant, viscous and Coulomb friction of every joint, fitted to r as the prior is.

    .. math:: \tau_f = c + v \dot q + k \tanh(\dot q / 0.03\,\mathrm{rad/s})

    each through the observer's filter. The sign of the speed is smoothed above the noise of a differentiated encoder,
    over a speed that is small against any motion. The model is used unchanged, so its errors stay in r. Without a
    model, r contains all of gravity and inertia, which three numbers per joint cannot represent.

    Args:
        settings: of the prior; unused here.

    Raises:
        TrainingError: no recording is longer than the observer's warm-up.
    """
    own = [
        [
            _core.Term(Kind.constant, joint),
            _core.Term(Kind.viscous, joint),
            _core.Term(Kind.coulomb, joint, speed=0.03),
        ]
        for joint in range(setup.tree.size)
    ]
    return fit_ridge(setup, recordings, Regressors(own))


# --- Torque ripple of motor and gear, found in the residual of a fit.


def find_ripple(
    setup: Setup,
    recordings: Sequence[Recording],
    fit: PriorFit,
    known: Sequence[Sequence[int]],
    least_cycles: int = 1,
    config: RippleConfig = RippleConfig(),
) -> list[list[int]]:
    """Return for each joint the cycles per turn with a distinct ripple of motor and gear in the residual of a fit.

    Every whole number of cycles is tried: the share of the remainder's sum of squares that its sine and cosine,
    filtered like the observer, explain by themselves. A number is a ripple if it explains `share` and `outstands`
    times as much as the median number.

    Args:
        known: cycles that the fit already contains.
        least_cycles: fewer a turn are no ripple.
    """
    n = setup.tree.size
    if sum(recording.duration_s for recording in recordings) < config.least_s:
        return [[] for _ in range(n)]
    energy = np.zeros(n)
    moments, squares = np.zeros((n, config.most_cycles, 2)), np.zeros((n, config.most_cycles, 2))
    looked_at_s, data_s = 0.0, min(config.data_s, max(config.joints_s / n, config.enough_s))
    for recording in recordings:
        if looked_at_s >= data_s:
            break
        looked_at_s += recording.duration_s
        observation, rows = setup.observe(recording, fit.settings)
        left = (observation.residual - observation.prior)[rows]
        energy += (left**2).sum(axis=0)
        with ThreadPoolExecutor(min(setup.threads, 2)) as pool:  # two joints at a time: each takes much memory
            of_joint = partial(_of_joint, setup, recording, rows, left, config.most_cycles)
            each = pool.map(of_joint, range(n))
            for joint, (moment, square) in enumerate(each):
                moments[joint] += moment
                squares[joint] += square
    explained = (moments**2 / np.maximum(squares, 1e-12)).sum(axis=2)
    explained[:, : least_cycles - 1] = 0
    found = []
    for joint in range(n):
        best = int(np.flatnonzero(explained[joint] >= (1 - config.alias_tie) * explained[joint].max())[0])
        stands_out = explained[joint, best] > config.outstands * np.median(explained[joint])
        matters = explained[joint, best] > config.share * energy[joint]
        found.append([best + 1] if stands_out and matters and best + 1 not in known[joint] else [])
    return found


def _of_joint(
    setup: Setup, recording: Recording, rows: np.ndarray, left: np.ndarray, most_cycles: int, joint: int
) -> tuple[np.ndarray, np.ndarray]:
    """Products of each number's sine and cosine with the joint's residual, and their squares, (most_cycles, 2)."""
    moment, square = np.zeros((2, most_cycles, 2))
    for first in range(0, most_cycles, 50):  # all of them at once take hundreds of MB
        some = range(first, min(first + 50, most_cycles))
        settings = _core.PriorSettings()
        settings.terms = [
            _core.Term(_core.TermKind.ripple, joint, b=cycles + 1, form=form) for cycles in some for form in (0, 1)
        ]
        settings.weights = [0.0] * (setup.tree.size * len(settings.terms))
        values = _core.prior_regressors(setup.tree, setup.observer, settings, *recording.signals, rows)
        moment[some] = (values.T @ left[:, joint]).reshape(-1, 2)
        square[some] = np.einsum("rm,rm->m", values, values).reshape(-1, 2)
    return moment, square


# --- Play between gear and load: the joints that have it, and the presliding width of its state.


Play = tuple[int | None, ...]
"""Index of each joint's width; None: no visible play."""


def find_play(
    fit: PriorFit, fitted: Callable[[Play], PriorFit], least: float = 0.01, tie: float = 0.002
) -> tuple[Play, PriorFit]:
    """The play of each joint and the fit with it: every width is tried at all joints at once; each joint keeps the
    best one.

    A gear carries nothing while it crosses its play: beta (1 - |state|) of the weight shows in r. The state is a stop
    operator's, of half the play [Nordin2002].

    Args:
        fit: without play.
        fitted: the same with this one.
        least: share by which play lowers a joint's error on left-out motion.
        tie: share of the error: among widths this similar the narrowest is taken, hence the smallest play.
    """
    joints, widths = len(fit.error_nm), range(len(fit.settings.widths_rad))
    none: Play = (None,) * joints
    fitted = cache(fitted)  # each takes seconds
    if not widths:
        return none, fit
    errors = np.array([fitted((width,) * joints).error_nm for width in widths])
    best = [simplest(widths, of_joint.__getitem__, tie) for of_joint in errors.T.tolist()]
    helps = errors.min(axis=0) < (1 - least) * fit.error_nm
    play: Play = tuple(int(width) if better else None for width, better in zip(best, helps, strict=True))
    for joint in [j for j, width in enumerate(play) if width is not None]:
        # Another joint's play may have been what made the ridge too strong for this one.
        without: Play = tuple(None if j == joint else width for j, width in enumerate(play))
        if fitted(without).error_nm[joint] * (1 - least) <= fitted(play).error_nm[joint]:
            play = without
    return play, fit if play == none else fitted(play)


def play_sentence(play: Play, widths_rad: Sequence[float], joints: Sequence[str]) -> str:
    """Describe the play of the joints; empty if none has any."""
    found = [f"{name} {2e3 * widths_rad[k]:g} mrad" for name, k in zip(joints, play, strict=True) if k is not None]
    return f"play that carries no weight: {', '.join(found)}" if found else ""


# --- The prior.


@dataclass(frozen=True)
class Inertia:
    """The prior's terms of gravity and inertia, beside the estimated model: the default is sines and cosines."""

    tree: _core.Tree | None = None
    """Its inertial parameters are corrected; None: none are."""
    load: int | None = None
    """See own_terms."""
    loads: tuple[_core.Link, ...] = ()
    kinematics: Kinematics | None = None
    play: Play = ()
    """Play index of each joint, see own_terms; empty: no joint has play."""
    local_memory_nm: tuple[float, ...] = ()
    """Most of each joint's presliding friction that may have local memory; 0: none has. Empty: of no joint."""


def fit_prior(
    setup: Setup,
    recordings: Sequence[Recording],
    config: PriorConfig,
    report: Callable[[str], None] | None = None,
    known: Kinematics | None = None,
) -> PriorFit:
    """The prior of a setup whose prior holds nothing but presliding widths yet.

    Without a model, the arm's kinematics are found first. Ripple is then searched for in the residual of a first fit,
    and presliding widths that do not help are left out.

    Args:
        report: receives a line about what was found.
        known: an arm found earlier; tried first if there is no model.

    Raises:
        TrainingError: no recording is longer than the observer's warm-up.
    """
    inertia = Inertia(setup.tree if config.correct_model else None, ESTIMATED)
    fit = None
    if not has_model(setup):
        inertia, fit = find_inertia(setup, recordings, config, report or (lambda line: None), known)
    ripple: list[list[int]] = [[] for _ in range(setup.tree.size)]
    fit = fit or fit_terms(setup, recordings, config, ripple, inertia)
    least_cycles = RippleConfig.least_gear_cycles if inertia.tree or has_model(setup) else 1
    for _ in range(config.most_ripples):
        found = find_ripple(setup, recordings, fit, ripple, least_cycles)
        if not any(found):
            break
        tried = [known + new for known, new in zip(ripple, found, strict=True)]
        more = fit_terms(setup, recordings, config, tried, inertia)
        helps = more.error_nm < (1 - RippleConfig.helps) * fit.error_nm  # on motion left out of the fit
        kept = [a if better else b for a, b, better in zip(tried, ripple, helps, strict=True)]
        if kept == ripple:
            break
        fit = more if kept == tried else fit_terms(setup, recordings, config, kept, inertia)
        ripple = kept
    dropped = idle_widths(setup, recordings, config, fit) if config.drop_widths else {}
    if dropped:
        kept_widths = [width for width in setup.widths_rad if width not in dropped]
        without = fit_terms(with_presliding(setup, kept_widths), recordings, config, ripple, inertia)
        fit = replace(without, dropped_widths=dropped)

    def fitted(to: Setup, inertia: Inertia) -> PriorFit:
        return fit_terms(to, recordings, config, ripple, inertia)

    if any(derives_velocity(recording) for recording in recordings) and inertia.load is not None:
        inertia, fit = with_play(setup, fit, fitted, inertia, report)
    inertia, fit = with_local_memory(setup, fit, fitted, inertia)
    return chosen(setup, fit, recordings, config, ripple, inertia)


def with_play(
    setup: Setup,
    fit: PriorFit,
    fitted: Callable[[Setup, Inertia], PriorFit],
    inertia: Inertia,
    report: Callable[[str], None] | None,
) -> tuple[Inertia, PriorFit]:
    """The play of servo gears, if visible: see find_play."""
    bent = with_presliding(setup, fit.settings.widths_rad)

    def fitted_with(play: Play) -> PriorFit:
        return replace(fitted(bent, replace(inertia, play=play)), dropped_widths=fit.dropped_widths)

    play, better = find_play(fit, fitted_with)
    words = play_sentence(play, bent.widths_rad, [link.joint_name for link in setup.tree.links])
    if words and report is not None:
        report(words)
    return replace(inertia, play=play), better


def with_local_memory(
    setup: Setup,
    fit: PriorFit,
    fitted: Callable[[Setup, Inertia], PriorFit],
    inertia: Inertia,
    least: float = 0.005,
) -> tuple[Inertia, PriorFit]:
    """The fit with the share of each joint's presliding friction that has local memory, where left-out motion shows it.

    The two kinds of memory differ if a joint reverses again before it slides. Friction of real gears
    mostly has nonlocal memory [AlBender2005]; simulators and many controllers model it with local memory.

    Args:
        least: share by which it lowers the error on left-out motion, in the mean over the joints. The gears of an arm
            are alike, so its joints are judged together; a joint whose error grows by as much has none.
    """
    branches = branches_of(fit.settings)
    if not any(branches):
        return inertia, fit
    bent = with_presliding(setup, fit.settings.widths_rad, branches)
    tried = presliding_friction_nm(fit.settings).sum(axis=1)
    more = fitted(bent, replace(inertia, local_memory_nm=tuple(tried.tolist())))
    growth = more.error_nm / np.maximum(fit.error_nm, 1e-300) - 1
    helps = (growth.mean() < -least) & (growth < least)
    has_some = np.zeros(len(tried), dtype=bool)
    for m, term in enumerate(more.settings.terms):
        if term.kind == _core.TermKind.local_memory:
            has_some[term.a] = more.weights[term.a, m] < 0
    kept = np.where(helps & has_some, tried, 0.0)
    if kept.any():
        inertia = replace(inertia, local_memory_nm=tuple(kept.tolist()))
    if (kept == tried).all():
        found = more
    elif kept.any():
        found = fitted(bent, inertia)
    else:
        found = fit
        for settings in (fit.settings, *(one.settings for one in fit.left_out)):
            settings.branches = branches
    return inertia, replace(found, dropped_widths=fit.dropped_widths)


def branches_of(settings: _core.PriorSettings) -> list[float]:
    """The branches of a prior's presliding friction, (joints, widths) in rows: its weights as shares of their sum.

    A joint without presliding friction has a row of zeros; the list is empty where there are no widths.
    """
    found = presliding_friction_nm(settings)
    sums = found.sum(axis=1, keepdims=True)
    shares: list[float] = (found / np.where(sums > 0, sums, 1.0)).ravel().tolist()
    return shares


def presliding_friction_nm(settings: _core.PriorSettings) -> np.ndarray:
    """Friction of each joint by width, (joints, widths), [N m]; weights that would drive the motion count as 0."""
    weights = np.array(settings.weights).reshape(-1, max(len(settings.terms), 1))
    found = np.zeros((len(weights), len(settings.widths_rad)))
    for m, term in enumerate(settings.terms):
        if term.kind == _core.TermKind.presliding:
            found[term.a, term.b] = max(-weights[term.a, m], 0.0)
    return found


def chosen(
    fitted_to: Setup,
    fit: PriorFit,
    recordings: Sequence[Recording],
    config: PriorConfig,
    ripple: Sequence[Sequence[int]],
    inertia: Inertia,
) -> PriorFit:
    """The fit with what was chosen on the way to it, so that the same terms can be fitted to another observer's r.

    Where temperatures were recorded, its friction follows them if that helps.
    """

    def refit(setup: Setup) -> PriorFit:
        bent = with_presliding(setup, fit.settings.widths_rad, fit.settings.branches)
        again = fit_terms(bent, recordings, config, ripple, inertia)
        return chosen(setup, replace(again, dropped_widths=fit.dropped_widths), recordings, config, ripple, inertia)

    bound_loads(fitted_to, recordings, fit)
    if config.follow_temperature:
        fit = with_temperature(fitted_to, recordings, fit)
    return replace(fit, kinematics=inertia.kinematics, refit=refit)


def weighs_on(setup: Setup, recordings: Sequence[Recording], inertia: Inertia) -> np.ndarray:
    """Joints (n,) bool that the arm loads enough to show load-dependent friction.

    A strain-wave gear adds 5 % of a load to its friction. That shows if it is 5 % of the joint's friction or more,
    which is the mean of the torque along the joint's speed.
    """
    n = setup.tree.size
    if inertia.load is None:
        return np.zeros(n, dtype=bool)
    tree = setup.tree if inertia.load == ESTIMATED else _core.Tree(list(inertia.loads), setup.tree.gravity)
    along, rows = np.zeros(n), np.zeros(n)
    for recording in recordings:
        moves = np.abs(recording.dq) > 0.05  # rad/s
        along += np.sum(np.where(moves, recording.tau * np.sign(recording.dq), 0.0), axis=0)
        rows += np.sum(moves, axis=0)
    friction_nm = np.abs(setup.observer.nm_per_unit or 1.0) * np.abs(along) / np.maximum(rows, 1)
    known = ~np.array(setup.observer.unknown_constant or [False] * n, dtype=bool)
    return known & (0.05 * largest_beta(tree, setup, recordings) >= 0.05 * friction_nm)


def largest_beta(tree: _core.Tree, setup: Setup, recordings: Sequence[Recording]) -> np.ndarray:
    """The most |beta| of each joint (n,) in this motion, [N m]."""
    stride, most = setup.observer.network_stride, np.zeros(tree.size)
    for recording in recordings:
        beta = tree.momentum(recording.q[::stride].copy(), recording.dq[::stride].copy())[1]
        most = np.maximum(most, np.abs(beta).max(axis=0))
    return most


def bound_loads(setup: Setup, recordings: Sequence[Recording], fit: PriorFit, beyond: float = 1.2) -> None:
    """Limit the fit's load terms to `beyond` times the arm's own weight in this motion.

    A carried load would take them beyond the range of the fit.
    """
    loaded = _core.TermKind.load, _core.TermKind.load_presliding
    forms = {term.form for term in fit.settings.terms if term.kind in loaded}
    if not forms:
        return
    trees = [setup.tree] if forms == {ESTIMATED} else [_core.Tree(fit.settings.corrected_links, setup.tree.gravity)]
    if len(forms) > 1:
        trees.append(setup.tree)
    most = np.max([largest_beta(tree, setup, recordings) for tree in trees], axis=0)
    for settings in (fit.settings, *(one.settings for one in fit.left_out)):
        settings.most_load_nm = (beyond * most).tolist()


RESTS_HELP = 0.01
"""An arm that was found in rests, too, is taken if it lowers the error on left-out motion by this share: friction holds
gravity at rest, but a servo with play shows there what its gear carries."""


def find_inertia(
    setup: Setup,
    recordings: Sequence[Recording],
    config: PriorConfig,
    report: Callable[[str], None],
    known: Kinematics | None,
    costs: float = 0.1,
) -> tuple[Inertia, PriorFit]:
    """Terms of gravity and inertia for an arm without a model, and a first fit with them.

    An arm found from its motion, or from that and its rests (RESTS_HELP), predicts poses that training never saw, which
    sines and cosines of the angles cannot; those are used if they explain left-out motion better by `costs`.
    """
    nothing: list[list[int]] = [[] for _ in range(setup.tree.size)]
    basis = fit_terms(setup, recordings, config, nothing, Inertia())
    if not (config.find_kinematics and can_be_found(setup)):
        return Inertia(), basis
    own = [own_terms(setup, config, joint) for joint in range(setup.tree.size)]
    joints = tuple(link.joint_name for link in setup.tree.links)
    rms = np.sqrt(np.maximum(basis.regression.whole.energy / basis.regression.whole.rows, LEAST_SQUARE))

    def error(fit: PriorFit) -> float:
        return float(np.sqrt(np.mean((fit.error_nm / rms) ** 2)))

    def with_arm_of(sample: KinematicSample) -> tuple[Inertia, PriorFit]:
        said = (lambda line: report(f"with rests, {line}")) if sample.config.rests else report
        kinematics = find_kinematics(sample, said, start=known).kinematics
        inertia = Inertia(kinematics.tree(joints, setup.tree.gravity), kinematics=kinematics)
        fit = fit_terms(setup, recordings, config, nothing, inertia)
        inertia = replace(inertia, load=CORRECTED, loads=tuple(fit.settings.corrected_links))
        return inertia, fit_terms(setup, recordings, config, nothing, inertia)

    moving, all_rows = (
        KinematicSample(setup.tree, setup.observer, recordings, own, setup.widths_rad, ArmSearch(rests=rests))
        for rests in (False, True)
    )
    samples = [one for one in (moving, all_rows) if one.rows >= ArmSearch.least_rows]
    if not samples:
        return Inertia(), basis
    if len(samples) > 1 and np.array_equal(moving.target, all_rows.target):
        samples.pop()
    inertia, fit = simplest([with_arm_of(one) for one in samples], lambda one: error(one[1]), RESTS_HELP)
    with_arm, without = error(fit), error(basis)
    report(f"error on left-out motion: {with_arm:.1%} of r with the arm found, {without:.1%} with sines and cosines")
    return (Inertia(), basis) if (1 - costs) * with_arm > without else (inertia, fit)


def fit_terms(
    setup: Setup,
    recordings: Sequence[Recording],
    config: PriorConfig,
    ripple: Sequence[Sequence[int]],
    inertia: Inertia,
) -> PriorFit:
    """All terms of the prior, with these ripples of each joint: see fit_ridge."""
    tops = np.max([np.abs(recording.dq).max(axis=0) for recording in recordings], axis=0)
    weighs = weighs_on(setup, recordings, inertia)
    loads = [inertia.load if load else None for load in weighs]
    play = inertia.play or (None,) * len(loads)
    memory_nm = inertia.local_memory_nm or (0.0,) * len(loads)
    own = [
        own_terms(setup, config, j, ripple[j], loads[j], top, play[j], memory_nm[j] > 0)
        for j, top in enumerate(tops.tolist())
    ]
    shared = [] if has_model(setup) or inertia.tree else shared_terms(setup)
    return fit_ridge(setup, recordings, Regressors(own, shared, inertia.tree, inertia.loads), memory_nm)
