"""Observer and fits of a recipe: prior, network, and the observer gain."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pkgutil import resolve_name
from typing import Protocol

import numpy as np

from tauext._core import Bundle, Tree
from tauext.config import PAPER_GAIN_PER_S, PriorConfig
from tauext.data.recording import Recording
from tauext.fit.bundle_writing import build_setup, make_bundle, rate_tolerance, set_drift, set_signal_ranges
from tauext.fit.coverage import coverage_facts, fit_coverage
from tauext.fit.find_kinematics import Kinematics
from tauext.fit.network_training import Progress, ScaledNetwork, train_network
from tauext.fit.prior_facts import held_sentence, prior_facts
from tauext.fit.prior_terms import PriorFit, region_width
from tauext.fit.stable_choice import simplest
from tauext.fit.torque_constants import with_constants
from tauext.fit.training_set import Setup, TooShort, build_windows, find_scaling, with_presliding
from tauext.train.error_scale import collect_rows, largest_standardised
from tauext.train.limits import unseen_motion
from tauext.train.preparation import TrainingRun

# --- The observer, and a recipe's prior, fitted to r by the function in the recipe's row.


class Fit(Protocol):
    """Signature of the `fit` in a recipe's row."""

    def __call__(
        self,
        setup: Setup,
        recordings: Sequence[Recording],
        *,
        config: PriorConfig,
        report: Callable[[str], None],
        known: Kinematics | None,
    ) -> PriorFit:
        """Fit a prior to free motion.

        Args:
            setup: without a prior; with presliding states if the row has them.
            report: receives a line about the result.
            known: an arm already found in the motion, without a model.

        Raises:
            TrainingError: too little motion.
        """


def observe(run: TrainingRun, gain_per_s: float | None = None) -> Setup:
    """Build the setup up to r: estimated model, torque constants, and the recipe's observer and filters.

    Args:
        gain_per_s: observer gain; None: that of the settings, or the paper's while it is still to be chosen.

    Raises:
        TrainingError: the recordings' joints differ from the model's, or their rates differ.
    """
    config = run.config.observer if gain_per_s is None else replace(run.config.observer, gain_per_s=gain_per_s)
    setup = build_setup(run.tree, run.training[0], config, run.config.recipe, run.config.filters)
    setup = replace(setup, threads=run.threads)
    rate_tolerance(run.training, setup.observer)  # fails early
    if run.constants is None:
        return setup
    return replace(setup, observer=with_constants(setup.observer, run.constants))


def fit_prior(run: TrainingRun, setup: Setup, recordings: Sequence[Recording]) -> PriorFit | None:
    """Fit the recipe's prior to this motion, by its function or by the start; None: the recipe has none.

    Raises:
        TrainingError: too little motion.
    """
    recipe, config = run.config.row, run.config.prior
    if recipe.fit is None:
        return None
    if (started := run.start.fit(setup, recordings, config)) is not None:
        return started
    fit: Fit = resolve_name(recipe.fit)
    bent = with_presliding(setup, config.widths_rad) if recipe.presliding else setup
    known = run.constants.kinematics if run.constants else None
    return fit(bent, recordings, config=config, report=run.say, known=known)


def with_fit(setup: Setup, fit: PriorFit | None) -> Setup:
    """Return the setup with the fitted prior, if any."""
    return setup if fit is None else replace(setup, prior=fit.settings)


def put_prior(run: TrainingRun, bundle: Bundle, fit: PriorFit | None) -> None:
    """Set the prior's facts, the limits' region and the bounds of the drift tracker.

    Called after the gate, which compares residuals without drift tracking.
    """
    if fit is None:
        return
    run.facts["prior"] = prior_facts(fit, run.joints)
    if held := held_sentence(run.facts["prior"]):
        run.notes.append(held)
    put_region(run, bundle, fit)
    if run.config.row.drift:
        set_drift(bundle, fit, run.config.drift)


def put_coverage(run: TrainingRun, bundle: Bundle, setup: Setup) -> None:
    """Add the coverage of training motion and its facts, if the recipe has it."""
    if not run.config.row.coverage:
        return
    fit = run.start.covered(fit_coverage(setup, run.motion.uncut), setup, run.motion.uncut)
    bundle.coverage = fit.settings
    run.facts["coverage"] = coverage_facts(fit, run.joints)


def put_region(run: TrainingRun, bundle: Bundle, fit: PriorFit) -> None:
    """Set the presliding width that decides which region's limits apply."""
    if fit.settings.widths_rad:
        bundle.region_width = region_width(fit.settings.widths_rad, run.config.prior)


# --- The network on the residual of observer and prior, and its bundle.


CHECKPOINT = ".checkpoint.npz"
"""Ending of a network's checkpoint, beside the bundle until that is written."""


def fit_network(run: TrainingRun, setup: Setup) -> ScaledNetwork | None:
    """Train the recipe's network, or return that of the start; None: the recipe has none, or the motion is too short
    and there is a prior.

    Raises:
        TrainingError: too little data, or a loss that diverges.
    """
    if (started := run.start.network()) is not None:
        return started
    if not run.motion.network:
        return None
    with run.times.phase("windows"):
        scaling = find_scaling(setup, run.motion.training)
    with run.report.progress(f"train {run.name}") as show:

        def report(p: Progress) -> None:
            show(p.step, p.steps, f"loss {p.loss:.3g} validation {p.validation_loss:.3g}")

        try:
            with run.times.phase("windows"):
                training = build_windows(setup, scaling, run.motion.training)
                validation = build_windows(setup, scaling, run.motion.validation)
            trained = train_network(
                setup,
                training,
                validation,
                run.config,
                checkpoint_path=run.out.with_suffix(CHECKPOINT),
                settings={key: run.provenance[key] for key in ("settings", "recordings")}
                | {"robot": model_digest(run.tree)},
                report=report,
            )
        except TooShort as error:
            if not run.config.row.gated:
                raise
            run.notes.append(f"prior only: {error}")
            return None
    run.times.seconds["train"] = trained.seconds
    return ScaledNetwork(scaling, trained)


def assemble(run: TrainingRun, setup: Setup, network: ScaledNetwork | None = None) -> Bundle:
    """Make the bundle of this setup, without limits.

    Raises:
        TrainingError: all recordings are shorter than a window.
    """
    learned = (network.scaling, network.trained) if network else ()
    bundle = make_bundle(run.name, setup, run.config.observer.near_stiction_rad_s, run.reference(setup), *learned)
    bundle.units = run.units
    # Set before gate and limits, which use the same signal watch as the control loop.
    set_signal_ranges(bundle, run.training, run.torque_limit_nm, run.bounds)
    return bundle


def model_digest(tree: Tree) -> str:
    """SHA-256 of the model's numbers, so that checkpoints of another model are not resumed."""
    fields = ("joint_name", "parent", "rotation", "translation", "mass", "com", "inertia", "rotor_inertia")
    numbers = [[getattr(link, field) for field in fields] for link in tree.links]
    return hashlib.sha256(json.dumps([numbers, tree.gravity]).encode()).hexdigest()


# --- Observer gain from data: a fast observer detects a hit sooner, a slow one suppresses more errors.


@dataclass(frozen=True)
class GainConfig:
    """How gains are compared, by a hit of a torque that is equal for all of them."""

    gains_per_s: tuple[float, ...] = (PAPER_GAIN_PER_S, 50.0, 100.0)
    """Gains that are tried, [1/s]; the first is the paper's."""
    most_a_step: float = 0.5
    """Largest K0 times sample period."""
    hit: float = 4.0
    """Torque of the hit, in limits of the first gain."""
    hit_s: float = 0.06
    """Duration of the hit, a half sine, [s]: between hits of a hard and a padded shell."""
    latest_s: float = 0.2
    """Delay of a hit that stays below the limit, [s]."""
    worth: float = 0.05
    """Share by which a faster observer must detect the hit sooner: it has more noise and detects slow pushes later."""


def choose_gain(
    run: TrainingRun, setup: Setup, fit: PriorFit, config: GainConfig = GainConfig()
) -> tuple[Setup, PriorFit]:
    """Choose the gain that detects a hit soonest; returns setup and prior, unchanged if that is the first gain.

    Gains are compared by the time until the response passes a limit, on the mean over joints and all held-out motion.
    Each gain has its own error scale and the limits that this motion does not exceed. The prior's terms are those
    chosen at the first gain, refitted for each.

    Args:
        setup: without the prior, at the first gain.
    """
    assert fit.refit is not None
    period_s = 1e-9 * setup.observer.sample_period_ns
    tried = {PAPER_GAIN_PER_S: (setup, fit)}
    for gain in config.gains_per_s[1:]:
        if gain * period_s <= config.most_a_step:
            other = observe(run, gain)
            tried[gain] = (other, fit.refit(other))
    if len(tried) == 1:
        run.facts["gain"] = {"chosen_per_s": PAPER_GAIN_PER_S, "reason": "samples are too far apart for a faster one"}
        return setup, fit
    limits = {gain: limits_of_gain(run, *one) for gain, one in tried.items()}
    hit_nm = config.hit * limits[PAPER_GAIN_PER_S][0]
    errs = hit_nm > 0  # others rest without noise, and show no gain
    if not errs.any():
        run.facts["gain"] = {"chosen_per_s": PAPER_GAIN_PER_S, "reason": "no joint has an error"}
        return setup, fit
    delay_s = {
        gain: mean_delay_s(gain, limit_nm[:, errs], hit_nm[errs], config) for gain, (_, limit_nm) in limits.items()
    }
    chosen = simplest(list(delay_s), delay_s.__getitem__, config.worth)
    delays = ", ".join(f"{1e3 * delay:.0f} ms at {gain:g} 1/s" for gain, delay in delay_s.items())
    run.facts["gain"] = {
        "chosen_per_s": chosen,
        "hit_nm": dict(zip(run.joints, hit_nm.tolist(), strict=True)),
        "mean_delay_s": {f"{gain:g}": delay for gain, delay in delay_s.items()},
        "reason": f"a hit of {config.hit:g} times the threshold at {PAPER_GAIN_PER_S:g} 1/s is found after {delays}",
    }
    return tried[chosen]


def limits_of_gain(run: TrainingRun, setup: Setup, fit: PriorFit) -> tuple[np.ndarray, np.ndarray]:
    """Limits of a bundle with this gain on motion not used in its fit (largest_standardised)."""
    bundle = assemble(run, with_fit(setup, fit))
    put_region(run, bundle, fit)
    unseen, left_out = unseen_motion(run, bundle, setup, fit)
    return largest_standardised(collect_rows(bundle, [*unseen, *left_out], run.threads, run.config.margins))


def mean_delay_s(
    gain_per_s: float, limit_nm: np.ndarray, hit_nm: np.ndarray, config: GainConfig = GainConfig()
) -> float:
    r"""Mean time until a hit of hit_nm, (joints,), exceeds limit_nm, (rows, joints), [s].

    The observer's response to a half sine S sin(w t), w = pi / T, is

    .. math:: S \frac{K_0}{K_0^2 + w^2}\left(K_0 \sin w t - w \cos w t + w\,e^{-K_0 t}\right), \quad t \le T.
    """
    t, w = np.linspace(0, config.hit_s, 601), np.pi / config.hit_s
    response = gain_per_s * np.sin(w * t) - w * np.cos(w * t) + w * np.exp(-gain_per_s * t)
    highest = np.maximum.accumulate(gain_per_s / (gain_per_s**2 + w**2) * response)
    passed = np.searchsorted(highest, limit_nm / hit_nm)
    return float(np.append(t, config.latest_s)[passed].mean())
