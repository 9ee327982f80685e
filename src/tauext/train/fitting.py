"""Observer and fits of a recipe."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pkgutil import resolve_name
from typing import Protocol

from tauext._core import Bundle
from tauext.config import PriorConfig
from tauext.data.recording import Recording
from tauext.fit.bundle_writing import build_setup, rate_tolerance, set_drift
from tauext.fit.coverage import coverage_facts, fit_coverage
from tauext.fit.find_kinematics import Kinematics
from tauext.fit.prior_facts import held_sentence, prior_facts
from tauext.fit.prior_terms import PriorFit, region_width
from tauext.fit.torque_constants import with_constants
from tauext.fit.training_set import Setup, with_presliding
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
    return replace(setup, observer=with_constants(setup.observer, run.constants.used))


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
