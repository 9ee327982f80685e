"""A fleet prior from many arms: terms, equations, mean and covariance, what a minute is worth and what it leaves."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tauext import _core
from tauext.config import TrainConfig
from tauext.errors import ConfigError, TauextError
from tauext.files.place import Place
from tauext.files.provenance import provenance
from tauext.files.room import expect_new_file
from tauext.fit.coverage import fit_coverage, seen_too
from tauext.fit.fleet_prior import FleetPrior, block_columns
from tauext.fit.fleet_prior_file import expect_name, write_fleet_prior
from tauext.fit.hierarchy import Hierarchy, learn_hierarchy
from tauext.fleet.arms import LEAST_ARMS, FleetArm, OwnTerms, job_of, own_terms_of, settings_of
from tauext.fleet.days import fleet_days
from tauext.fleet.errors import NewArm, errors_of, new_arm
from tauext.fleet.evidence import ArmEvidence, choose_trust, evidence_of, priors_without, weight_prior
from tauext.fleet.summary import ODD, arms_facts, spread_facts
from tauext.fleet.terms import common_gain, common_terms, common_widths
from tauext.progress import SILENT, Reporter
from tauext.recipes import FULL_PRIOR
from tauext.train.fitting import observe

LEAST_JUDGED = 3
"""Arms whose rest is judged: fewer say nothing of the next one's errors."""


def make_fleet_prior(
    arms: Sequence[FleetArm],
    out: Place,
    config: TrainConfig = TrainConfig(recipe="prior"),  # noqa: B008
    accept: Sequence[str] = (),
    report: Reporter = SILENT,
) -> FleetPrior:
    """What arms of one type have in common, written to a file that `train --like` takes.

    An arm that `train` would refuse is left out and told; the others must still be three.

    Args:
        out: NAME.prior.json.
        config: of the trainings whose terms are taken over.
        accept: codes of the doctor that are no fault on your word, CODE or CODE:joint.

    Raises:
        ConfigError: too few arms, arms of several types, or a file that cannot be written.
    """
    expect_name(out)
    expect_new_file(out)
    if config.row.fit != FULL_PRIOR["fit"]:
        raise ConfigError(f"recipe = {config.recipe} must be tauext or prior, whose weights a fleet prior holds")
    config = replace(config, recipe="prior")
    own, left_out = own_terms(arms, config, accept, report)
    gain, widths = common_gain(own), common_widths(own)
    setup = observe(job_of(own[0].arm, settings_of(own[0], config, gain)))
    terms = common_terms(setup, config.prior, own)
    evidence = every_evidence(own, config, gain, widths, terms, report)
    found = learn_hierarchy([one.evidence() for one in evidence], block_columns(terms))
    with report.progress("fleet prior: arms left out") as show:
        without = priors_without(evidence, terms, show)
    trust, rest_nm = choose_trust(evidence, without)
    joints = own[0].type.joints
    facts = {
        **provenance("tauext fleet prior", settings(own, config), config.seed),
        "arms": arms_facts([one.name for one in evidence], [one.minutes for one in evidence], joints, terms, found),
        "spread": spread_facts(joints, terms, found),
        "left_out": left_out,
        "after_a_minute": after_a_minute(evidence, rest_nm, joints),
    }
    prior = FleetPrior(own[0].type, gain, widths, terms, weight_prior(evidence, found, trust), facts=facts)
    likes = [replace(prior, weights=replace(one, trust=trust)) for one in without]
    new = new_arms(own, evidence, found, config, likes, report)
    threads = config.threads or os.cpu_count() or 1
    errors = errors_of(new, config, threads) if len(new) >= LEAST_JUDGED else None
    if errors is None:
        report.say(
            f"{len(new)} arms have more motion than a minute; without {LEAST_JUDGED} nothing is known of a new arm's "
            "errors, and its limits will follow from its own minute"
        )
    days = fleet_days([one.factors for one in evidence])
    prior = replace(prior, errors=errors, coverage=common_coverage(own, config, gain), days=days)
    write_fleet_prior(prior, out)
    return prior


def own_terms(
    arms: Sequence[FleetArm], config: TrainConfig, accept: Sequence[str], report: Reporter
) -> tuple[list[OwnTerms], dict[str, str]]:
    """What each arm's own training keeps, and why arms were left out.

    Raises:
        ConfigError: too few are left, or arms of several types.
    """
    own: list[OwnTerms] = []
    left_out: dict[str, str] = {}
    with report.progress("fleet prior: terms of each arm") as show:
        for done, arm in enumerate(arms):
            try:
                found = own_terms_of(arm, config, accept, report)
            except TauextError as error:
                left_out[arm.name] = " ".join(str(error).split())
                report.say(f"{arm.name} is left out: {left_out[arm.name]}")
                continue
            if own:
                own[0].type.expect(found.type, own[0].arm.name, arm.name)
            own.append(found)
            show(done + 1, len(arms), arm.name)
    if left_out and len(own) < LEAST_ARMS:
        why = "; ".join(f"{name}: {reason}" for name, reason in left_out.items())
        raise ConfigError(f"{len(own)} of {len(arms)} arms can be used, and {LEAST_ARMS} are needed ({why})")
    return own, left_out


def every_evidence(
    own: Sequence[OwnTerms],
    config: TrainConfig,
    gain_per_s: float,
    widths_rad: Sequence[float],
    terms: Sequence[Sequence[_core.Term]],
    report: Reporter,
) -> list[ArmEvidence]:
    """Each arm's motion on the common terms."""
    evidence = []
    with report.progress("fleet prior: equations of each arm") as show:
        for done, one in enumerate(own):
            evidence.append(evidence_of(one, config, gain_per_s, widths_rad, terms))
            show(done + 1, len(own), one.arm.name)
    return evidence


def new_arms(
    own: Sequence[OwnTerms],
    evidence: Sequence[ArmEvidence],
    found: Hierarchy,
    config: TrainConfig,
    likes: Sequence[FleetPrior],
    report: Reporter,
) -> list[NewArm]:
    """Every arm that is like the others, as if it were new; without those too short to judge, or odd in some joint."""
    chosen = [k for k, one in enumerate(evidence) if one.judges and found.trust[k].min() >= ODD]
    arms = []
    with report.progress("fleet prior: each arm as a new one") as show:
        for done, k in enumerate(chosen):
            arms.append(new_arm(own[k], config, likes[k]))
            show(done + 1, len(chosen), own[k].arm.name)
    return arms


def common_coverage(own: Sequence[OwnTerms], config: TrainConfig, gain_per_s: float) -> _core.CoverageSettings:
    """Motion that any of the arms showed, told as finely as the longest of them can tell it."""
    fits = []
    for one in own:
        job = job_of(one.arm, settings_of(one, config, gain_per_s))
        setup = observe(job)
        fits.append((sum(r.duration_s for r in job.motion.uncut), one, fit_coverage(setup, job.motion.uncut)))
    _, _, widest = max(fits, key=lambda fit: fit[0])
    for _, one, _ in fits:
        job = job_of(one.arm, settings_of(one, config, gain_per_s))
        widest = seen_too(widest, widest.settings, observe(job), job.motion.uncut)
    return widest.settings


def settings(own: Sequence[OwnTerms], config: TrainConfig) -> dict:
    """For provenance."""
    plain = {"recipe": config.recipe, "prior": config.prior}
    return {
        "data": {one.arm.name: str(one.arm.data) for one in own},
        "bundles": {one.arm.name: one.arm.bundle.name for one in own if one.arm.bundle is not None},
        "config": {name: str(value) for name, value in plain.items()},
    }


def after_a_minute(evidence: Sequence[ArmEvidence], rest_nm: Sequence[np.ndarray], joints: Sequence[str]) -> dict:
    """Median over the arms of the error with a minute and the others' prior, by that with all of its own motion."""
    ratios = [rest / one.error_nm for one, rest in zip(evidence, rest_nm, strict=True) if len(rest)]
    if not ratios:
        return {}
    return dict(zip(joints, np.median(ratios, axis=0).round(3).tolist(), strict=True))
