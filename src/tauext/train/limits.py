"""Limits of a training: by a promise, from minutes of data, or as in the paper."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from tauext._core import Bundle
from tauext.config import TrainConfig
from tauext.data.free_motion import total_s
from tauext.data.recording import Recording
from tauext.errors import ConfigError, TrainingError
from tauext.fit.bundle_writing import freeze_drift, make_bundle
from tauext.fit.prior_facts import friction_nm
from tauext.fit.prior_terms import PriorFit
from tauext.fit.training_set import Setup
from tauext.train.calibrate import calibrate_bundle, no_calibration
from tauext.train.error_scale import (
    ErrorRows,
    Judged,
    add_friction,
    collect_rows,
    fit_error_scale,
    ignore_standing,
    paper_limits,
    put_constant_error,
    raise_limits,
    set_limits,
    usual_speed_rad_s,
    whole_recordings,
    with_outputs,
)
from tauext.train.held_peaks import Moment
from tauext.train.preparation import Job
from tauext.train.promised_limits import (
    NOT_MEASURED,
    apply_promised,
    other_motion,
    promised_limits,
    put_limit_findings,
    torque_steps_nm,
)
from tauext.train.wrench import fit_wrench

# --- Limits from a promise, from minutes of motion, or as in the paper.


SHORT_S = 240.0
"""Decay time of the friction reserve with the length T of the recordings, exp(-T / this), [s]. One minute contains one
state of the gears; ten contain the warm-up (5 to 7 minutes)."""
UNPROMISED_FACTOR = 1.6
"""Factor on the largest errors if the motion is too short for any budget, so that false alarms are unbounded."""
LEAST_RESERVE = 0.02
"""Least share of the friction used as a reserve; it is smaller from nine minutes on."""
FORGOTTEN = 2.0
"""Time near stiction after a joint began to slide, in 1/K0, for limits from minutes: r still contains the breakaway,
and minutes have few of them."""
EVEN_ODDS = 0.5
"""Confidence with which the limits keep the supported budget, which itself already has the promise's confidence."""


def put_limits(job: Job, bundle: Bundle, setup: Setup, fit: PriorFit | None) -> None:
    """Set limits, hold times and the freeze of the drift tracker.

    Raises:
        ConfigError: promised limits without calibration recordings.
        TrainingError: too little free motion.
    """
    config, kind = job.config, limits_kind(job.config, job.calibration)
    scaled = config.resolved().error_scale == "on"
    if scaled and kind == "supported" and bundle.region_width >= 0:
        bundle.near_memory_s = FORGOTTEN / bundle.observer.gain_per_s
    if words := ignore_standing(bundle, [*job.training, *job.validation]):
        job.notes.append(words)
    unseen, left_out = unseen_motion(job, bundle, setup, fit)
    judged = [*unseen, *left_out]
    if config.row.presliding:
        bundle.after_contact_factor = config.alarm.after_contact_factor
    rows = None
    if scaled:
        rows = collect_rows(bundle, judged, job.threads, config.margins)
        started = job.start.put_scale(job, bundle, rows)
        job.facts["error_scale"] = fit_error_scale(bundle, rows, config.drift) if started is None else started
        for one in left_out:
            assert one.bundle is not None
            one.bundle.error_scale = bundle.error_scale
        job.facts["wrench"] = job.facts.get("wrench", {}) | fit_wrench(bundle, judged, job.threads, config.margins)
    else:  # limits are constants
        motion = unseen or judged
        put_constant_error(bundle, collect_rows(bundle, motion, job.threads, config.margins))
        job.facts["wrench"] = job.facts.get("wrench", {}) | fit_wrench(bundle, motion, job.threads, config.margins)
    poses = job.facts.get("wrench", {}).get("poses", [])
    own = job.start.put_limits(job, bundle, kind)
    if own is not None:
        words, job.facts["limits"] = own
        job.notes.append(words)
    elif kind == "promised":
        promised, job.facts["limits"] = calibrate_bundle(
            bundle, job.name, job.calibration, config.alarm, job.threads, config.margins, job.report, job.out, poses
        )
        job.report.say(promised.sentence())
    elif kind == "supported":
        words, job.facts["limits"] = set_supported_limits(
            bundle, judged, config, job.threads, fit, rows, poses, len(job.suspects)
        )
        job.notes.append(words)
        if "other_motion" in job.facts["limits"]:
            job.notes.append(job.facts["limits"]["other_motion"]["sentence"])
        units = dict(zip(job.joints, bundle.estimate_units, strict=True))
        for moment in (Moment(**facts) for facts in job.facts["limits"].get("one_moment", [])):
            job.notes.append(moment.sentence(units[moment.joint]))
    else:
        set_limits(bundle, paper_limits(bundle, unseen or judged, job.threads, config.margins), config.alarm)
    if fit is not None:
        freeze_drift(bundle, config.drift)
    if "limits" in job.facts:  # those of the paper's recipes are as they are
        job.facts["torque_step_nm"] = torque_steps_nm(bundle, job.training)
        job.notes.extend(put_limit_findings(bundle, job.facts))


def limits_kind(config: TrainConfig, calibration: Sequence[object], folder: Path | None = None) -> str:
    """Return the kind of limits: promised, supported or paper.

    Args:
        folder: see no_calibration().

    Raises:
        ConfigError: promised limits without calibration recordings.
    """
    if config.limits == "promised" and not calibration:
        raise ConfigError(f"limits = promised {no_calibration(folder)}")
    if config.limits != "auto":
        return config.limits
    if config.row.largest_error_limits:
        return "paper"
    return "promised" if calibration else "supported"


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


def set_supported_limits(
    bundle: Bundle,
    judged: Sequence[Recording | Judged],
    config: TrainConfig,
    threads: int,
    fit: PriorFit | None,
    rows: ErrorRows | None = None,
    poses: Sequence[Sequence[float]] = (),
    suspects: int = 0,
) -> tuple[str, dict]:
    """Set limits for the smallest budget of false alarms that this motion supports.

    If the motion is too short for that, the largest error is used. Both are raised, since minutes do not contain all
    changes of friction with temperature and time: limits that follow the error by `factor_after` and a share of the
    friction, constant ones by a share of the friction at the 95 % quantile of a joint's speed. Returns the basis as
    text, and facts.

    Args:
        rows: errors of the error scale's fit, for testing the promise in other motion.
        poses: of the motion, in which links are hit.
        suspects: number of suspected touches that were left out of the motion.
    """
    seen_s = total_s(whole_recordings(judged))
    factor = round(factor_after(seen_s, config.alarm.minutes_factor), 3)
    promised = None
    try:
        # A few dozen peaks determine the tail poorly; the factor below accounts for that.
        at_most_seen = bundle.error_scale.follows
        promised = promised_limits(
            bundle, lambda: judged, config.alarm, threads, config.margins, EVEN_ODDS, at_most_seen, poses=poses
        )
    except TrainingError as error:
        set_limits(bundle, paper_limits(bundle, judged, threads, config.margins), config.alarm)
        words = f"limits are the largest errors seen, and promise nothing ({error})"
        factor = max(factor, UNPROMISED_FACTOR)
        facts: dict = {"sentence": words}
    else:
        apply_promised(bundle, promised, config.alarm)
        promised = replace(promised, suspects=suspects)
        facts = promised.facts()
        words = f"no calibration recordings. {promised.sentence()}"
    if bundle.error_scale.follows:
        raise_limits(bundle, factor)
        facts["minutes_factor"] = factor
        raise_moments(facts, {}, factor)
        words += f" They are {factor:.3g} times what these minutes show."
        share = config.alarm.friction_reserve * math.exp(-seen_s / SHORT_S)
        added = None
        if fit is not None and share > LEAST_RESERVE:
            at_rest, per_speed = friction_line(fit, usual_speed_rad_s(judged))
            add_friction(bundle, share, at_rest, per_speed)
            added = share * at_rest, share * per_speed
            facts["friction_reserve"] = share
            words += f" {share:.1%} of the friction is added: so short a time shows little of its changes."
        if rows is not None and promised is not None:
            watched = np.flatnonzero(bundle.monitored)
            names = [bundle.links[j].joint_name for j in watched]
            own = None if added is None else (added[0][watched], added[1][watched])
            other = other_motion(rows.of_joints(watched), names, promised, EVEN_ODDS, factor, own)
            facts["other_motion"] = other.facts() if other else {"sentence": NOT_MEASURED}
            if other and other.broken:
                facts["sentence"] += f" {other.broken}: expect {other.factor:.2g} times as many."
        return words, facts
    if fit is None or not config.alarm.friction_reserve:
        return words, facts
    reserve = config.alarm.friction_reserve * friction_nm(fit, usual_speed_rad_s(judged))
    raise_limits(bundle, 1.0, reserve)
    names = [link.joint_name for link in bundle.links]
    facts["friction_reserve_nm"] = dict(zip(names, reserve.tolist(), strict=True))
    raise_moments(facts, facts["friction_reserve_nm"])
    return f"{words} They are raised by {config.alarm.friction_reserve:.0%} of the friction.", facts


def factor_after(seen_s: float, most: float) -> float:
    """Factor on limits that follow the error, for T seconds of motion: 1 + (most - 1)(1 - exp(-T/SHORT_S)).

    It grows as the friction reserve decays; for a single minute the reserve suffices.
    """
    return 1 - (most - 1) * math.expm1(-seen_s / SHORT_S)


def raise_moments(facts: dict, by_nm: Mapping[str, float], factor: float = 1.0) -> None:
    """Add to the facts the limits with and without decisive moments, as the limits were raised.

    Args:
        facts: facts of the limits. by_nm: amount added by joint; missing: 0.
    """
    if "one_moment" in facts:
        moments = [Moment(**entry) for entry in facts["one_moment"]]
        facts["one_moment"] = [m.scaled(factor, by_nm.get(m.joint, 0.0)).facts() for m in moments]


def friction_line(fit: PriorFit, speed_rad_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Friction at rest and its growth with speed, (n,) [N m] and [N m s/rad], from a line through two points.

    Args:
        speed_rad_s: usual speed of each joint, (n,); the other point is at a tenth of it.
    """
    usual, slow = friction_nm(fit, speed_rad_s), friction_nm(fit, speed_rad_s / 10)
    slope = np.maximum((usual - slow) / np.maximum(0.9 * speed_rad_s, 1e-9), 0)
    return np.maximum(usual - slope * speed_rad_s, 0), slope
