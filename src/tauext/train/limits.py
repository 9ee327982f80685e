"""Limits of a training: for the budget asked for, by a promise, from minutes of data, or as in the paper.

A kind of limits is a function `put(bundle, motion) -> facts` in LIMITS: put_asked, put_promised, put_supported or
put_paper. All use the same motion (LimitMotion) and the peaks of its held error (held_peaks). Limits with a stated rate
follow from the peaks' tails (fit/tail.py), the rate that each tail is allowed (fit/limits_together.py), and the level
at this rate (promised_limits.limits_of).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from tauext._core import Bundle
from tauext.check.before_training import expect_accepted
from tauext.check.finding import Finding, Severity
from tauext.check.sensors import torque_step_nm
from tauext.config import TrainConfig
from tauext.data.recording import Recording
from tauext.errors import ConfigError
from tauext.files.kind import is_simulated
from tauext.fit.bundle_writing import freeze_drift, make_bundle
from tauext.fit.prior_terms import PriorFit
from tauext.fit.tail import duration, proved_per_hour
from tauext.fit.training_set import Setup
from tauext.train.asked_limits import put_asked
from tauext.train.error_scale import (
    HeldOut,
    collect_rows,
    fit_error_scale,
    limit_scale,
    put_constant_error,
    rest_sigma_nm,
    with_outputs,
)
from tauext.train.other_programs import widen_for_other_programs
from tauext.train.paper_limits import LimitMotion, ignore_standing, put_paper
from tauext.train.preparation import TrainingRun
from tauext.train.promised_limits import put_promised
from tauext.train.supported_limits import SupportedConfig, put_supported
from tauext.train.wrench import fit_wrench

# --- Kinds of limits, and those of a training.


LIMITS: dict[str, Callable[[Bundle, LimitMotion], dict]] = {
    "asked": put_asked,
    "promised": put_promised,
    "supported": put_supported,
    "paper": put_paper,
}
"""For each kind, a function that sets a bundle's limits and returns facts of them, none for the paper's."""


def put_limits(run: TrainingRun, bundle: Bundle, setup: Setup, fit: PriorFit | None) -> None:
    """Set error scale, limits, hold times and the freeze of the drift tracker.

    Raises:
        ConfigError: promised limits without calibration recordings.
        TrainingError: too little free motion.
    """
    config, kind = run.config, limits_kind(run.config, run.given.calibration)
    follows = config.resolved().error_scale == "on"
    if follows and kind in ("asked", "supported") and not run.given.calibration and bundle.region_width >= 0:
        bundle.near_memory_s = SupportedConfig.near_memory / bundle.observer.gain_per_s
    if words := ignore_standing(bundle, [*run.training, *run.validation]):
        run.notes.append(words)
    unseen, left_out = unseen_motion(run, bundle, setup, fit)
    if config.row.presliding:
        bundle.after_contact_factor = config.alarm.after_contact_factor
    motion = LimitMotion(
        run.name,
        config.alarm,
        run.threads,
        config.margins,
        run.report,
        run.notes.append,
        calibration=run.given.calibration,
        out=run.out,
        suspects=len(run.suspects),
        unseen=unseen,
        left_out=left_out,
        fit=fit,
    )
    motion = put_error_scale(run, bundle, setup, motion, follows)
    if (started := run.start.put_limits(run, bundle, kind)) is not None:
        words, facts = started
        run.notes.append(words)
    else:
        facts = LIMITS[kind](bundle, motion)
        if kind == "promised":
            run.notes.append(facts["sentence"])
    if fit is not None:
        freeze_drift(bundle, config.drift)
    if facts:  # those of the paper's recipes are as they are
        run.facts["limits"], run.facts["torque_step_nm"] = facts, torque_steps_nm(bundle, run.training)
        run.notes.extend(put_limit_findings(bundle, run.facts))


def put_error_scale(run: TrainingRun, bundle: Bundle, setup: Setup, motion: LimitMotion, follows: bool) -> LimitMotion:
    """Set the error scale and the errors of forces; returns the motion with its errors and poses.

    Args:
        follows: whether limits follow the error that the motion announces; else the scale is constant.
    """
    held_out = motion.held_out if follows else motion.unseen or motion.held_out
    rows = collect_rows(bundle, held_out, run.threads, run.config.margins)
    if not follows:
        put_constant_error(bundle, rows)
    else:
        started = run.start.put_scale(run, bundle, rows)
        if started is None:
            started = fit_error_scale(bundle, rows, run.config.drift)
            motion = replace(motion, rest_sigma_nm=rest_sigma_nm(bundle))
            if motion.fit is not None:
                programs, added = widen_for_other_programs(bundle, setup, motion.fit, run.training, rows)
                started, motion = started | {"other_programs": programs}, replace(motion, added_weights=added)
        run.facts["error_scale"] = started | {"of_limits": limit_scale(bundle)}
        for one in motion.left_out:
            assert one.bundle is not None
            one.bundle.error_scale = bundle.error_scale
    run.facts["wrench"] = run.facts.get("wrench", {}) | fit_wrench(bundle, held_out, run.threads, run.config.margins)
    return replace(motion, rows=rows, poses=run.facts["wrench"].get("poses", []))


def limits_kind(config: TrainConfig, calibration: Sequence[object], folder: Path | None = None) -> str:
    """Return the kind of limits: asked, promised, supported or paper.

    Args:
        folder: of the dataset, for the message; None: its recordings are in memory.

    Raises:
        ConfigError: promised limits without calibration recordings.
    """
    if config.limits == "promised" and not calibration:
        raise ConfigError(f"limits = promised {no_calibration(folder)}")
    if config.limits != "auto":
        return config.limits
    if config.row.largest_error_limits:
        return "paper"
    return "asked"


def no_calibration(folder: Path | None) -> str:
    """End of a message: a dataset without calibration recordings, and how to get some.

    Args:
        folder: of the dataset; None: its recordings are in memory.
    """
    more = (
        "`tauext simulate --calibration-hours 24` makes some"
        if folder is not None and is_simulated(folder)
        else "record more of the arm's motion without touches, list the recordings as calibration in [split] of the "
        "description, and import them"
    )
    return f"needs calibration recordings, which the dataset has none of; {more}"


def unseen_motion(
    run: TrainingRun, bundle: Bundle, setup: Setup, fit: PriorFit | None
) -> tuple[list[HeldOut], list[HeldOut]]:
    """Free motion not used in training the bundle or its cross-validation priors."""
    by_fit = fit is not None and not bundle.has_network
    # Without a network, the prior was finally fitted to the validation motion too.
    recordings = [] if by_fit and not run.validation else run.motion.for_limits
    unseen = [with_outputs(bundle, recording, run.threads) for recording in recordings]
    left_out = left_out_of_fit(bundle, fit, setup, run.reference(setup)) if by_fit and fit is not None else []
    return unseen, left_out


def left_out_of_fit(bundle: Bundle, fit: PriorFit, setup: Setup, reference: Recording) -> list[HeldOut]:
    """Each fifth of the training motion, evaluated with a prior fitted to the other four.

    All motion then has errors of an independent fit; a tenth set apart would have few. These priors use less data than
    the bundle, so on average their errors are larger.
    """
    held_out = []
    for fold in fit.left_out:
        other = make_bundle(bundle.name, replace(setup, prior=fold.settings), bundle.near_stiction_rad_s, reference)
        other.region_width, other.drift = bundle.region_width, bundle.drift
        other.near_memory_s = bundle.near_memory_s
        other.largest_torque_nm, other.torque_limit_nm = bundle.largest_torque_nm, bundle.torque_limit_nm
        other.possible_torque_nm, other.possible_speed_rad_s = bundle.possible_torque_nm, bundle.possible_speed_rad_s
        other.rate_tolerance = bundle.rate_tolerance
        held_out += [HeldOut(recording, span, other) for recording, span in fold.spans]
    return held_out


# --- Limits that are of little use.


def limit_findings(bundle: Bundle, facts: Mapping, wide: float = 1 / 3, too_wide: float = 1 / 2) -> list[Finding]:
    """Findings of limits that are far too wide, or finer than the torque is known.

    Args:
        facts: provenance with `torque_step_nm`, the step of which each torque is a whole multiple, by joint, and
            `limits`.
        wide: share of a joint's largest torque in training above which its limit is a finding. Good recordings of ten
            minutes give 0.02 to 0.2, and up to 1 at single joints that turn about the vertical or are light.
        too_wide: share that makes it a fault if the limits of half of the joints or more are above, even those that are
            proved.
    """
    found, watched, step_nm = [], np.array(bundle.monitored), facts.get("torque_step_nm", {})
    proved = 1 / max(facts.get("limits", {}).get("extrapolated", {}).get("factor", 1.0), 1.0)
    limits = np.maximum(bundle.sliding_limit_nm, bundle.near_stiction_limit_nm)
    shares = (limits / bundle.largest_torque_nm)[watched]
    severity: Severity = "fault" if 2 * (proved * shares > too_wide).sum() >= len(shares) else "warning"
    for j in np.flatnonzero(watched).tolist():
        limit, largest = float(limits[j]), bundle.largest_torque_nm[j]
        name, unit = bundle.links[j].joint_name, bundle.estimate_units[j]
        step = step_nm.get(name, 0.0)
        if limit > wide * largest:
            evidence = f"{limit:.3g} {unit}, {limit / largest:.0%} of the largest torque that it gave"
            advice = (
                "few touches are found there: remove touches and odd recordings from the training, check unit and "
                "robot file, or train on more motion, in which the joint moves faster and carries more"
            )
            found.append(Finding("limit-wide", severity, name, evidence, advice))
        if (finest := min(bundle.sliding_limit_nm[j], bundle.near_stiction_limit_nm[j])) < step:
            evidence = f"{finest:.3g} {unit}, where the torque has steps of {step:.3g} {unit}"
            advice = "one step of the torque raises an alarm: train on motion in which the joint moves as in its work"
            found.append(Finding("limit-fine", "fault", name, evidence, advice))
    return found


def put_limit_findings(bundle: Bundle, facts: dict, promise: Sequence[Finding] = ()) -> list[str]:
    """Set `limit_findings` in a bundle's provenance; returns a line each for the user.

    Args:
        promise: findings of the promise (worse_promise), stored beside those of the limits.
    """
    found = [*limit_findings(bundle, facts), *promise]
    facts["limit_findings"] = [asdict(one) for one in found]
    return [
        f"{one.severity}: {': '.join(filter(None, (one.code, one.joint)))}: {one.evidence}; {one.advice}"
        for one in found
    ]


def refuse_limits(facts: Mapping, where: str, accept: Sequence[str]) -> None:
    """Raise FaultyDataError if the limits have a fault, in `limit_findings`, that is not accepted.

    Args:
        where: name of the bundle to write, for the message.
    """
    found = [Finding(**one) for one in facts.get("limit_findings", [])]
    how = "No bundle is written. To write it all the same, accept the faults; the bundle records it:"
    expect_accepted(found, accept, where, "its thresholds", how)


def worse_promise(before: Mapping, after: Mapping, name: str) -> tuple[str, list[Finding]]:
    """The promise that limits replace beside theirs, in a sentence, and a fault if it is worse and not asked for.

    A budget that the recordings support was asked for; the smallest that they support, in place of it, was not.

    Args:
        before, after: facts of the limits; without a promise before, there is nothing to compare.
        name: of the bundle that is replaced.
    """
    old, new = proved_per_hour(before), proved_per_hour(after)
    if old is None or new is None:
        return "", []
    promise, old_hours = after["promise"], before["promise"]["calibration_hours"]
    then = f"1 in {duration(1 / old)} from {duration(old_hours, 'down')} of calibration"
    now = f"1 in {duration(1 / new, 'down')} from {duration(promise['calibration_hours'], 'down')}"
    words = f"false alarm rate that the data prove: {now}, in place of {then} in {name}"
    if promise["supported"] or new <= old * (1 + 1e-9):
        return words, []
    advice = (
        f"keep the bundle, record {duration(promise['missing_hours'], 'up')} more of free motion, or ask for a "
        "false alarm rate that these recordings support (--false-alarms, --in-hours)"
    )
    return words, [Finding("promise-worse", "fault", None, f"{now}, in place of {then} in {name}", advice)]


def torque_steps_nm(bundle: Bundle, recordings: Sequence[Recording]) -> dict[str, float]:
    """Step of which each torque is a whole multiple in the unit of the estimates, by joint, where there is one."""
    found = {}
    for j, (link, factor) in enumerate(
        zip(bundle.links, bundle.observer.nm_per_unit or [1.0] * bundle.joints, strict=True)
    ):
        if (step := torque_step_nm(recordings, j)) is not None:
            found[link.joint_name] = abs(factor) * step
    return found
