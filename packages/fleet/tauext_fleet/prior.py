"""A fleet prior from many arms: terms, equations, mean and covariance, and its summary."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from tauext import _core
from tauext.config import PriorConfig, TrainConfig
from tauext.errors import ConfigError, TauextError
from tauext.files.preflight import expect_new_file
from tauext.files.provenance import provenance
from tauext.fit.coverage import fit_coverage
from tauext.fit.prior_terms import ESTIMATED, own_terms
from tauext.fit.training_set import Setup, with_presliding
from tauext.progress import SILENT, Reporter
from tauext.recipes import FULL_PRIOR
from tauext.train.fitting import observe
from tauext_fleet.fleet_prior import FleetPrior, block_columns, expect_name, write_fleet_prior
from tauext_fleet.hierarchy import Hierarchy, learn_hierarchy
from tauext_fleet.like import Like, seen_too
from tauext_fleet.prior_arms import LEAST_ARMS, FleetArm, OwnTerms, own_terms_of, run_of, settings_of
from tauext_fleet.prior_content import ODD
from tauext_fleet.prior_evidence import (
    ArmEvidence,
    NewArm,
    choose_trust,
    errors_of,
    evidence_of,
    fleet_days,
    new_arm,
    priors_without,
    weight_prior,
)

# --- The fleet in a table that a person reads: each arm's friction by the fleet's, and which arm is the odd one.


SPEED_RAD_S = 0.5
"""Friction is reported at this speed: most joints slide at it, and few slow moves are faster."""
Kind = _core.TermKind
AT_SPEED: dict[_core.TermKind, Callable[[_core.Term], float]] = {
    Kind.coulomb: lambda term: float(np.tanh(SPEED_RAD_S / term.speed)),
    Kind.presliding: lambda term: 1.0,
    Kind.viscous: lambda term: SPEED_RAD_S,
}
"""Friction of a term of weight 1 at SPEED_RAD_S."""


def friction_columns(terms: Sequence[Sequence[_core.Term]], joint: int) -> np.ndarray:
    """What each of all columns adds to the joint's friction at the speed of AT_SPEED, (columns,)."""
    blocks = block_columns(terms)
    out = np.zeros(int(blocks[-1][-1]) + 1)
    out[blocks[joint]] = [AT_SPEED[t.kind](t) if t.kind in AT_SPEED else 0.0 for t in terms[joint]]
    return out


def arms_facts(
    names: Sequence[str], minutes: Sequence[float], joints: Sequence[str], terms: Sequence, found: Hierarchy
) -> list[dict]:
    """List minutes of each arm, and for each joint its friction by the fleet's with its error, and its trust."""
    lines = [friction_columns(terms, j) for j in range(len(joints))]
    mean = [float(line @ found.mean) for line in lines]
    facts = []
    for a, name in enumerate(names):
        factor = [share(float(line @ found.weights[a]), of) for line, of in zip(lines, mean, strict=True)]
        error = [share(float(np.sqrt(line @ found.errors[a] @ line)), of) for line, of in zip(lines, mean, strict=True)]
        friction = [[f, None if e is None else abs(e)] for f, e in zip(factor, error, strict=True)]
        trust = [round(float(u), 3) for u in found.trust[a]]
        facts.append(
            {
                "name": name,
                "minutes": round(minutes[a], 3),
                "friction": dict(zip(joints, friction, strict=True)),
                "trust": dict(zip((*joints, "links"), trust, strict=True)),
            }
        )
    return facts


def spread_facts(joints: Sequence[str], terms: Sequence, found: Hierarchy) -> dict:
    """List for each joint the fleet's friction at the speed of AT_SPEED, [N m], and the share by which arms differ."""
    out = {}
    for j, name in enumerate(joints):
        line = friction_columns(terms, j)
        mean = float(line @ found.mean)
        spread = share(float(np.sqrt(line @ found.covariance @ line)), abs(mean))
        out[name] = {"friction_nm": round(abs(mean), 4), "spread": spread}
    return out


def share(value: float, whole: float) -> float | None:
    """None: of a joint that no arm moved, the fleet has no friction to compare with."""
    return round(value / whole, 4) if whole else None


# --- Terms that all arms of a type get: those that enough of them keep.


ENOUGH = 0.5
"""A width, a ripple or a load term stays that this share of the arms keeps."""


def common_gain(arms: Sequence[OwnTerms]) -> float:
    """The observer gain that most arms choose, the slower one of two, [1/s]."""
    counts = Counter(one.gain_per_s for one in arms)
    return min(counts, key=lambda gain: (-counts[gain], gain))


def common_widths(arms: Sequence[OwnTerms]) -> tuple[float, ...]:
    """Presliding widths that enough arms keep, rising, [rad]."""
    every = sorted({width for one in arms for width in one.widths_rad})
    return tuple(width for width in every if enough([width in one.widths_rad for one in arms]))


def common_terms(setup: Setup, config: PriorConfig, arms: Sequence[OwnTerms]) -> tuple[tuple[_core.Term, ...], ...]:
    """Terms of each joint; Coulomb terms level off at the speeds that half of the arms reach.

    Args:
        setup: of any of the arms.
    """
    bent = with_presliding(setup, common_widths(arms))
    terms = []
    for j in range(setup.tree.size):
        cycles = sorted({number for one in arms for number in one.ripples[j]})
        kept = [number for number in cycles if enough([number in one.ripples[j] for one in arms])]
        load = ESTIMATED if enough([one.loaded[j] for one in arms]) else None
        top = float(np.median([one.tops_rad_s[j] for one in arms]))
        terms.append(tuple(own_terms(bent, config, j, kept, load, top)))
    return tuple(terms)


def enough(kept: Sequence[bool]) -> bool:
    return sum(kept) >= ENOUGH * len(kept)


# --- A fleet prior from many arms: terms, equations, mean and covariance, what a minute is worth and what it leaves.


LEAST_JUDGED = 3
"""Least number of arms with motion beyond a minute; fewer do not predict a new arm's errors."""


def make_fleet_prior(
    arms: Sequence[FleetArm],
    out: Path,
    config: TrainConfig = TrainConfig(recipe="prior"),  # noqa: B008
    accept: Sequence[str] = (),
    report: Reporter = SILENT,
) -> FleetPrior:
    """What arms of one type have in common, written to a file that `train --like` takes.

    An arm that `train` would refuse is left out and reported; at least three must remain.

    Args:
        out: NAME.prior.json.
        config: of the trainings whose terms are taken over.
        accept: codes of faults to accept, CODE or CODE:joint.

    Raises:
        ConfigError: too few arms, arms of several types, or a file that cannot be written.
    """
    expect_name(out)
    expect_new_file(out)
    if config.row.fit != FULL_PRIOR["fit"]:
        raise ConfigError(f"recipe = {config.recipe} must be tauext or prior, whose weights a fleet prior holds")
    config = replace(config, recipe="prior")
    own, left_out = terms_of_all(arms, config, accept, report)
    gain, widths = common_gain(own), common_widths(own)
    setup = observe(run_of(own[0].arm, settings_of(own[0], config, gain)))
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
    likes = [Like(replace(prior, weights=replace(one, trust=trust))) for one in without]
    new = new_arms(own, evidence, found, config, likes, report)
    threads = config.threads or os.cpu_count() or 1
    errors = errors_of(new, config, threads) if len(new) >= LEAST_JUDGED else None
    if errors is None:
        report.say(
            f"{len(new)} arms have more motion than a minute; with fewer than {LEAST_JUDGED} a new arm's errors are "
            "unknown, and its thresholds will follow from its own minute"
        )
    days = fleet_days([one.factors for one in evidence])
    prior = replace(prior, errors=errors, coverage=common_coverage(own, config, gain), days=days)
    write_fleet_prior(prior, out)
    return prior


def terms_of_all(
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
    likes: Sequence[Like],
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
    """Motion that any of the arms covered, as finely resolved as the longest recording allows."""
    fits = []
    for one in own:
        run = run_of(one.arm, settings_of(one, config, gain_per_s))
        setup = observe(run)
        fits.append((sum(r.duration_s for r in run.motion.uncut), one, fit_coverage(setup, run.motion.uncut)))
    _, _, widest = max(fits, key=lambda fit: fit[0])
    for _, one, _ in fits:
        run = run_of(one.arm, settings_of(one, config, gain_per_s))
        widest = seen_too(widest, widest.settings, observe(run), run.motion.uncut)
    return widest.settings


def settings(own: Sequence[OwnTerms], config: TrainConfig) -> dict:
    """Return facts for provenance."""
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
