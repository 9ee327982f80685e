"""Limits of a training: by a promise, from minutes of data, from a fleet, or as in the paper."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace

import numpy as np

from tauext import _core
from tauext._core import Bundle
from tauext.check.before_training import expect_accepted
from tauext.check.finding import Finding, Severity
from tauext.check.sensors import torque_step_nm
from tauext.config import DriftConfig, TrainConfig
from tauext.data.free_motion import total_s
from tauext.data.recording import Recording
from tauext.errors import ConfigError
from tauext.files.kind import is_simulated
from tauext.files.places import Place
from tauext.fit.bundle_writing import freeze_drift, make_bundle
from tauext.fit.fleet_prior import FleetErrors
from tauext.fit.network_weights import LIMIT, NetworkWeights
from tauext.fit.prior_terms import PriorFit
from tauext.fit.tail import duration, promised_per_hour
from tauext.fit.training_set import Setup
from tauext.train.error_scale import (
    FEATURES,
    ErrorRows,
    Judged,
    blind_sigma,
    collect_rows,
    fit_error_scale,
    freeze_floor_nm,
    put_constant_error,
    with_outputs,
)
from tauext.train.paper_limits import LimitMotion, ignore_standing, put_paper, set_limits
from tauext.train.preparation import Job
from tauext.train.promised_limits import put_promised
from tauext.train.supported_limits import SupportedConfig, put_supported
from tauext.train.wrench import fit_wrench

# --- Limits of an arm with a minute of its own motion, from the errors of a fleet's arms.
#
# Each arm of the fleet was fitted to a minute of its own with the prior of the others and evaluated on the rest of its
# motion. Errors, limits and their growth with the motion apply to another arm of the type up to a factor, its size: a
# joint's held-out errors on its own minute, divided by the prediction of the fleet's scale.


ENOUGH_S = 540.0
"""Time of motion from which an arm's own errors determine limits better than the fleet's, [s]. From this time on, short
recordings need no friction reserve either."""
LEAST_SIZE, LARGEST_SIZE = 0.5, 2.0
"""Bounds of an arm's errors relative to the fleet's: a minute cannot prove smaller ones; larger ones are reported."""


def fleet_errors(job: Job, bundle: Bundle) -> FleetErrors | None:
    """The fleet's errors for this arm; None: none, or the arm's own errors determine more."""
    like = job.like
    if like is None or like.errors is None or bundle.has_network:
        return None
    same = like.gain_per_s == bundle.observer.gain_per_s
    return like.errors if same and total_s(job.motion.uncut) < ENOUGH_S else None


def sizes(rows: ErrorRows, scale: _core.ErrorScaleSettings) -> np.ndarray:
    """Ratio of each joint's errors to the scale's prediction for the same motion, (n,)."""
    used = [FEATURES.index(kind) for kind in scale.features]
    F, n = rows.features[:, :, used], rows.error_nm.shape[1]
    sliding, near = (
        np.einsum("rjf,jf->rj", F, np.array(w).reshape(n, -1)) for w in (scale.sigma_weights, scale.sigma_near_weights)
    )
    sigma = np.where(rows.near_stiction, near, sliding)
    return np.sqrt(np.mean(rows.error_nm**2, axis=0) / np.maximum(np.mean(sigma**2, axis=0), 1e-300))


def scale_settings(errors: FleetErrors, size: np.ndarray) -> _core.ErrorScaleSettings:
    """The fleet's error scale for an arm with this size of errors relative to the fleet's, (n,)."""
    scale = _core.ErrorScaleSettings()
    scale.features = [getattr(_core.MotionFeature, name) for name in errors.features]
    by_joint = size[:, None]
    scale.limit_weights = (by_joint * errors.limit_weights).ravel().tolist()
    scale.sigma_weights = (by_joint * errors.sigma_weights).ravel().tolist()
    scale.sigma_near_weights = (by_joint * errors.sigma_near_weights).ravel().tolist()
    scale.largest = (size * errors.largest).tolist()
    scale.largest_sigma = (size * errors.largest_sigma).tolist()
    return scale


def put_fleet_scale(job: Job, bundle: Bundle, rows: ErrorRows, errors: FleetErrors, drift: DriftConfig) -> None:
    """Set the fleet's error scale, adjusted to the size of this arm's errors."""
    found = sizes(rows, scale_settings(errors, np.ones(bundle.joints)))
    size = np.clip(found, LEAST_SIZE, None)
    bundle.error_scale = scale_settings(errors, size)
    blind_sigma(bundle)
    if bundle.drift.time_constant_s > 0:
        seen = freeze_floor_nm(rows.error_nm, drift, rows.period_s)
        bundle.drift.freeze_floor_nm = np.maximum(
            drift.freeze_floor_share * np.array(bundle.drift.size_nm), seen
        ).tolist()
    by_joint = dict(zip(job.joints, found.round(4).tolist(), strict=True))
    job.facts["error_scale"] = {"hours": rows.hours, "like": by_joint}
    loud = [f"{name} {value:.1f}" for name, value in by_joint.items() if value > LARGEST_SIZE]
    if loud:
        job.notes.append(
            f"errors are larger than the fleet's by {', '.join(loud)}: this arm differs from the others there, and its "
            "limits are raised as much"
        )


def put_fleet(bundle: Bundle, motion: LimitMotion) -> dict:
    """The fleet's limits."""
    errors, alarm = motion.fleet, motion.alarm
    assert errors is not None
    limits = np.array([errors.sliding_limit_nm, errors.near_stiction_limit_nm])
    contact = np.array([errors.contact_sliding_limit_nm, errors.contact_near_stiction_limit_nm])
    set_limits(bundle, limits, alarm, contact, (errors.hold_s, errors.contact_hold_s))
    words = (
        f"limits are those of {errors.arms} arms of this type that had {errors.minutes:g} min of their own and the "
        f"prior of the others, on {60 * errors.hours:.0f} min of the rest of their motion, and as large as this arm's "
        f"own errors beside theirs. {errors.facts['sentence']} They are {errors.facts['arms_factor']:.2f} times that, "
        "so that none of these arms was over limits that the others ask for."
    )
    motion.note(words)
    return dict(errors.facts) | {"sentence": words, "like": True}


# --- Kinds of limits, and those of a training.


def put_given(bundle: Bundle, motion: LimitMotion) -> dict:
    """The limits of a network that was trained elsewhere."""
    network = motion.network
    assert network is not None and network.limit_nm is not None
    set_limits(bundle, np.tile(network.limit_nm, (2, 1)), motion.alarm)
    words = f"limits are {LIMIT} of {network.file}, and promise nothing"
    motion.note(words)
    return {"sentence": words}


LIMITS: dict[str, Callable[[Bundle, LimitMotion], dict]] = {
    "promised": put_promised,
    "supported": put_supported,
    "paper": put_paper,
    "fleet": put_fleet,
    "given": put_given,
}
"""For each kind, a function that sets a bundle's limits and returns facts of them, none for the paper's."""


def put_limits(job: Job, bundle: Bundle, setup: Setup, fit: PriorFit | None) -> None:
    """Set error scale, limits, hold times and the freeze of the drift tracker.

    Raises:
        ConfigError: promised limits without calibration recordings.
        TrainingError: too little free motion.
    """
    config, kind = job.config, limits_kind(job.config, job.calibration, job.network)
    follows = config.resolved().error_scale == "on"
    if follows and kind == "supported" and bundle.region_width >= 0:
        bundle.near_memory_s = SupportedConfig.near_memory / bundle.observer.gain_per_s
    if words := ignore_standing(bundle, [*job.training, *job.validation]):
        job.notes.append(words)
    unseen, left_out = unseen_motion(job, bundle, setup, fit)
    if config.row.presliding:
        bundle.after_contact_factor = config.alarm.after_contact_factor
    motion = LimitMotion(
        job.name,
        config.alarm,
        job.threads,
        config.margins,
        job.report,
        job.notes.append,
        calibration=job.calibration,
        out=job.out,
        suspects=len(job.suspects),
        unseen=unseen,
        left_out=left_out,
        fit=fit,
        fleet=fleet_errors(job, bundle) if follows else None,
        network=job.network,
    )
    motion = put_error_scale(job, bundle, motion, follows)
    facts = LIMITS["fleet" if kind == "supported" and motion.fleet is not None else kind](bundle, motion)
    if kind == "promised":
        job.notes.append(facts["sentence"])
    if fit is not None:
        freeze_drift(bundle, config.drift)
    if facts:  # those of the paper's recipes are as they are
        job.facts["limits"], job.facts["torque_step_nm"] = facts, torque_steps_nm(bundle, job.training)
        job.notes.extend(put_limit_findings(bundle, job.facts))


def put_error_scale(job: Job, bundle: Bundle, motion: LimitMotion, follows: bool) -> LimitMotion:
    """Set the error scale and the errors of forces; returns the motion with its errors and poses.

    Args:
        follows: whether limits follow the error that the motion announces; else the scale is constant.
    """
    judged = motion.judged if follows else motion.unseen or motion.judged
    rows = collect_rows(bundle, judged, job.threads, job.config.margins)
    if motion.fleet is not None:
        put_fleet_scale(job, bundle, rows, motion.fleet, job.config.drift)
    elif follows:
        job.facts["error_scale"] = fit_error_scale(bundle, rows, job.config.drift)
    else:
        put_constant_error(bundle, rows)
    if follows:
        for one in motion.left_out:
            assert one.bundle is not None
            one.bundle.error_scale = bundle.error_scale
    job.facts["wrench"] = job.facts.get("wrench", {}) | fit_wrench(bundle, judged, job.threads, job.config.margins)
    return replace(motion, rows=rows, poses=job.facts["wrench"].get("poses", []))


def limits_kind(
    config: TrainConfig,
    calibration: Sequence[object],
    network: NetworkWeights | None = None,
    folder: Place | None = None,
) -> str:
    """Return the kind of limits: promised, supported, paper, or given with a network that was trained elsewhere.

    Args:
        folder: of the dataset, for the message; None: its recordings are in memory.

    Raises:
        ConfigError: promised limits without calibration recordings.
    """
    if config.limits == "promised" and not calibration:
        raise ConfigError(f"limits = promised {no_calibration(folder)}")
    if config.limits != "auto":
        return config.limits
    if network is not None and network.limit_nm is not None:
        return "given"
    if config.row.largest_error_limits:
        return "paper"
    return "promised" if calibration else "supported"


def no_calibration(folder: Place | None) -> str:
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


def unseen_motion(job: Job, bundle: Bundle, setup: Setup, fit: PriorFit | None) -> tuple[list[Judged], list[Judged]]:
    """Free motion not used in training the bundle or its cross-validation priors."""
    by_fit = fit is not None and not bundle.has_network
    # Without a network, the prior was finally fitted to the validation motion too.
    recordings = [] if by_fit and not job.validation else job.motion.for_limits
    unseen = [with_outputs(bundle, recording, job.threads) for recording in recordings]
    left_out = left_out_of_fit(bundle, fit, setup, job.reference(setup)) if by_fit and fit is not None else []
    return unseen, left_out


def left_out_of_fit(bundle: Bundle, fit: PriorFit, setup: Setup, reference: Recording) -> list[Judged]:
    """Each fifth of the training motion, evaluated with a prior fitted to the other four.

    All motion then has errors of an independent fit; a tenth set apart would have few. These priors use less data than
    the bundle, so on average their errors are larger.
    """
    judged = []
    for fold in fit.left_out:
        other = make_bundle(bundle.name, replace(setup, prior=fold.settings), bundle.near_stiction_rad_s, reference)
        other.region_width, other.drift = bundle.region_width, bundle.drift
        other.near_memory_s = bundle.near_memory_s
        other.largest_torque_nm, other.torque_limit_nm = bundle.largest_torque_nm, bundle.torque_limit_nm
        other.possible_torque_nm, other.possible_speed_rad_s = bundle.possible_torque_nm, bundle.possible_speed_rad_s
        other.rate_tolerance = bundle.rate_tolerance
        judged += [Judged(recording, span, other) for recording, span in fold.spans]
    return judged


# --- Limits that are of little use.


def limit_findings(
    bundle: Bundle, step_nm: Mapping[str, float], wide: float = 1 / 3, too_wide: float = 1 / 2
) -> list[Finding]:
    """Findings of limits that are far too wide, or finer than the torque is known.

    Args:
        step_nm: step of which each torque is a whole multiple, by joint; those without one are left out.
        wide: share of a joint's largest torque in training above which its limit is a finding. Good recordings of ten
            minutes give 0.02 to 0.2, and up to 1 at single joints that turn about the vertical or are light.
        too_wide: share that makes it a fault if the limits of half of the joints or more are above.
    """
    found, watched = [], np.array(bundle.monitored)
    limits = np.maximum(bundle.sliding_limit_nm, bundle.near_stiction_limit_nm)
    shares = (limits / bundle.largest_torque_nm)[watched]
    severity: Severity = "fault" if 2 * (shares > too_wide).sum() >= len(shares) else "warning"
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
    """Set `limit_findings` in a bundle's provenance by its `torque_step_nm`; returns a line each for the user.

    Args:
        promise: findings of the promise (worse_promise), stored beside those of the limits.
    """
    found = [*limit_findings(bundle, facts.get("torque_step_nm", {})), *promise]
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
    expect_accepted(found, accept, where, "its limits", how)


def worse_promise(before: Mapping, after: Mapping, name: str) -> tuple[str, list[Finding]]:
    """The promise that limits replace beside theirs, in a sentence, and a fault if it is worse and not asked for.

    A budget that the recordings support was asked for; the smallest that they support, in place of it, was not.

    Args:
        before, after: facts of the limits; without a promise before, there is nothing to compare.
        name: of the bundle that is replaced.
    """
    old, new = promised_per_hour(before), promised_per_hour(after)
    if old is None or new is None:
        return "", []
    promise, old_hours = after["promise"], before["promise"]["calibration_hours"]
    then = f"1 in {duration(1 / old)} from {duration(old_hours, 'down')} of calibration"
    now = f"1 in {duration(1 / new, 'down')} from {duration(promise['calibration_hours'], 'down')}"
    words = f"promise of false alarms: {now}, in place of {then} in {name}"
    if promise["supported"] or new <= old * (1 + 1e-9):
        return words, []
    advice = (
        f"keep the bundle, record {duration(promise['missing_hours'], 'up')} more of free motion, or ask for a budget "
        "that these recordings support (--false-alarms, --in-hours)"
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
