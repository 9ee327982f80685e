"""Errors of new arms: each arm gets a minute of its own and the prior of the others, and the rest of it judges."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tauext import _core
from tauext.config import AlarmConfig, TrainConfig
from tauext.data.recording import Recording
from tauext.fit.fleet_prior import FleetErrors, FleetPrior
from tauext.fleet.arms import OwnTerms, job_of, settings_of
from tauext.fleet.evidence import MINUTES
from tauext.train.error_scale import Rows, collect_rows, scale_of
from tauext.train.fitting import fit_prior, observe, put_prior, with_fit
from tauext.train.fleet_limits import LEAST_SIZE, scale_settings, sizes
from tauext.train.held_peaks import Peaks, collect_peaks
from tauext.train.judged import Judged
from tauext.train.limits import EVEN_ODDS, FORGOTTEN, unseen_motion
from tauext.train.network import assemble
from tauext.train.promised_limits import PromisedLimits, promised_limits

MOST_REST_S = 3600.0
"""Of each arm: more says little more of how arms differ."""
ROUNDS = 2
"""Of the common scale and each arm's size beside it."""


@dataclass(frozen=True)
class NewArm:
    """One arm as if it were new: its bundle after a minute, and what that is wrong by."""

    own: OwnTerms
    bundle: _core.Bundle
    minute: Rows
    """Its first minute, left out of the fit in turn."""
    rest: Rows


def new_arm(own: OwnTerms, config: TrainConfig, like: FleetPrior) -> NewArm:
    """A training of the arm on its first minute, and the errors of that.

    Args:
        config: without torque constants, which the minute has to tell.
        like: what the other arms know.
    """
    job = job_of(own.arm, config, minutes=MINUTES, like=like)
    setup = observe(job)
    fit = fit_prior(job, setup, job.motion.uncut)
    assert fit is not None
    bundle = assemble(job, with_fit(setup, fit))
    put_prior(job, bundle, fit)
    bundle.near_memory_s = FORGOTTEN / bundle.observer.gain_per_s if bundle.region_width >= 0 else bundle.near_memory_s
    bundle.after_contact_factor = job.config.alarm.after_contact_factor
    _, left_out = unseen_motion(job, bundle, setup, fit)
    margins = job.config.margins
    minute = collect_rows(bundle, left_out, job.threads, margins)
    rest = collect_rows(bundle, judged_rest(own, config, bundle, like.gain_per_s), job.threads, margins)
    return NewArm(own, bundle, minute, rest)


def judged_rest(own: OwnTerms, config: TrainConfig, bundle: _core.Bundle, gain_per_s: float) -> Iterator[Judged]:
    """The arm's motion behind its first minute, judged by this bundle."""
    job = job_of(own.arm, settings_of(own, config, gain_per_s))
    before_s = 0.0
    for recording in job.motion.uncut:
        first_s = max(60 * MINUTES - before_s, 0.0)
        last_s = 60 * MINUTES + MOST_REST_S - before_s
        before_s += recording.duration_s
        span = span_of(recording, first_s, last_s)
        if span.start < span.stop:
            yield Judged(recording, span, bundle)


def span_of(recording: Recording, from_s: float, to_s: float) -> slice:
    """Samples in this time after the first."""
    first, last = np.searchsorted(recording.time_s, [from_s, to_s])
    return slice(int(first), int(last))


def errors_of(arms: Sequence[NewArm], config: TrainConfig, threads: int) -> FleetErrors:
    """The scale that fits all arms' errors but for the size of each, and the limits that all of them support together.

    Raises:
        TrainingError: too few peaks to say anything.
    """
    n = arms[0].bundle.joints
    own = np.array([np.sqrt(np.mean(one.minute.error_nm**2, axis=0)) for one in arms])
    size = own / np.median(own, axis=0)
    for _ in range(ROUNDS):
        scale = scale_of(pooled([one.rest for one in arms], size))
        size = np.array([np.clip(sizes(one.minute, scale), LEAST_SIZE, None) for one in arms])
    scale = scale_of(pooled([one.rest for one in arms], size))
    weights = {
        name: np.array(getattr(scale, name)).reshape(n, -1)
        for name in ("limit_weights", "sigma_weights", "sigma_near_weights")
    }
    nothing = np.zeros(n)
    errors = FleetErrors(
        MINUTES, sum(one.rest.hours for one in arms), len(arms), tuple(kind.name for kind in scale.features),
        **weights, largest=np.array(scale.largest), largest_sigma=np.array(scale.largest_sigma),
        sliding_limit_nm=nothing, near_stiction_limit_nm=nothing,
        contact_sliding_limit_nm=nothing, contact_near_stiction_limit_nm=nothing,
        hold_s=0.0, contact_hold_s=0.0, facts={},
    )  # fmt: skip
    for one, own_size in zip(arms, size, strict=True):
        one.bundle.error_scale = scale_settings(errors, own_size)

    def rest(some: Sequence[NewArm]) -> Iterator[Judged]:
        for one in some:
            yield from judged_rest(one.own, config, one.bundle, one.bundle.observer.gain_per_s)

    margins = config.margins
    found = promised_limits(arms[0].bundle, lambda: rest(arms), AlarmConfig(), threads, margins, EVEN_ODDS, True)
    held = [collect_peaks(one.bundle, rest([one]), [found.hold_s], threads, margins=margins)[0] for one in arms]
    return with_limits(errors, found, factor_of(np.array([largest(peaks) for peaks in held])))


def largest(peaks: Peaks) -> np.ndarray:
    """Largest held error of each joint by the common scale, sliding and in either region, (joints, regions), [N m]."""
    top = np.array([[of_region[0] if len(of_region) else 0.0 for of_region in of_joint] for of_joint in peaks.nm])
    return np.maximum.accumulate(top, axis=1)


def factor_of(top_nm: np.ndarray) -> float:
    """What limits at the largest errors of the other arms must be multiplied by for none of the arms to be over them.

    One arm's errors are alike, and unlike another's: what hours of all arms say of a rate holds for hours of the same
    arms. Each of A arms beside the limits of the others says what one more arm may do: it is over the largest of A by
    chance once in A + 1.

    Args:
        top_nm: largest held error of each arm, (arms, joints, regions).
    """
    factors = [np.max(top_nm[a] / np.delete(top_nm, a, axis=0).max(axis=0)) for a in range(len(top_nm))]
    return max(1.0, float(np.max(factors)))


def with_limits(errors: FleetErrors, found: PromisedLimits, factor: float) -> FleetErrors:
    """The errors with what they ask of limits, times the factor between arms."""
    facts = {key: value for key, value in found.facts().items() if key != "one_moment"} | {"arms_factor": factor}
    return replace(
        errors,
        sliding_limit_nm=factor * found.collision.sliding_nm,
        near_stiction_limit_nm=factor * found.collision.near_stiction_nm,
        contact_sliding_limit_nm=factor * found.contact.sliding_nm,
        contact_near_stiction_limit_nm=factor * found.contact.near_stiction_nm,
        hold_s=found.hold_s,
        contact_hold_s=found.contact_hold_s,
        facts=facts,
    )


def pooled(rows: Sequence[Rows], size: np.ndarray) -> Rows:
    """Rows of all arms, each arm's errors by its size, (arms, n)."""
    before = np.cumsum([0, *(len(one.recordings) for one in rows[:-1])])
    return Rows(
        np.concatenate([one.error_nm / own for one, own in zip(rows, size, strict=True)]),
        np.concatenate([one.near_stiction for one in rows]),
        np.concatenate([one.features for one in rows]),
        rows[0].period_s,
        np.concatenate([one.t_ns for one in rows]),
        np.concatenate([one.recording + first for one, first in zip(rows, before, strict=True)]),
        tuple(name for one in rows for name in one.recordings),
    )
