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
from tauext.train.preparation import Job

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


def observe(job: Job, gain_per_s: float | None = None) -> Setup:
    """Build the setup up to r: estimated model, torque constants, and the recipe's observer and filters.

    Args:
        gain_per_s: observer gain; None: that of the settings, or the paper's while it is still to be chosen.

    Raises:
        TrainingError: the recordings' joints differ from the model's, or their rates differ.
    """
    config = job.config.observer if gain_per_s is None else replace(job.config.observer, gain_per_s=gain_per_s)
    setup = build_setup(job.tree, job.training[0], config, job.config.recipe, job.config.filters)
    setup = replace(setup, threads=job.threads)
    rate_tolerance(job.training, setup.observer)  # fails early
    if job.constants is None:
        return setup
    return replace(setup, observer=with_constants(setup.observer, job.constants.used))


def fit_prior(job: Job, setup: Setup, recordings: Sequence[Recording]) -> PriorFit | None:
    """Fit the recipe's prior to this motion, by its function or by the start; None: the recipe has none.

    Raises:
        TrainingError: too little motion.
    """
    recipe, config = job.config.row, job.config.prior
    if recipe.fit is None:
        return None
    if (started := job.start.fit(setup, recordings, config)) is not None:
        return started
    fit: Fit = resolve_name(recipe.fit)
    bent = with_presliding(setup, config.widths_rad) if recipe.presliding else setup
    known = job.constants.kinematics if job.constants else None
    return fit(bent, recordings, config=config, report=job.say, known=known)


def with_fit(setup: Setup, fit: PriorFit | None) -> Setup:
    """Return the setup with the fitted prior, if any."""
    return setup if fit is None else replace(setup, prior=fit.settings)


def put_prior(job: Job, bundle: Bundle, fit: PriorFit | None) -> None:
    """Set the prior's facts, the limits' region and the bounds of the drift tracker.

    Called after the gate, which compares residuals without drift tracking.
    """
    if fit is None:
        return
    job.facts["prior"] = prior_facts(fit, job.joints)
    if held := held_sentence(job.facts["prior"]):
        job.notes.append(held)
    put_region(job, bundle, fit)
    if job.config.row.drift:
        set_drift(bundle, fit, job.config.drift)


def put_coverage(job: Job, bundle: Bundle, setup: Setup) -> None:
    """Add the coverage of training motion and its facts, if the recipe has it."""
    if not job.config.row.coverage:
        return
    fit = job.start.covered(fit_coverage(setup, job.motion.uncut), setup, job.motion.uncut)
    bundle.coverage = fit.settings
    job.facts["coverage"] = coverage_facts(fit, job.joints)


def put_region(job: Job, bundle: Bundle, fit: PriorFit) -> None:
    """Set the presliding width that decides which region's limits apply."""
    if fit.settings.widths_rad:
        bundle.region_width = region_width(fit.settings.widths_rad, job.config.prior)
