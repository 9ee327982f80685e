"""Limits of an arm that has shown a minute of itself: those that errors of other arms in its place ask for.

Each arm of the fleet was given a minute of its own and the prior of the others, and judged on the rest of its motion.
What that says of errors, of limits and of how they grow with the motion holds for one more arm of the type, but for
its size: a joint's errors on its own minute, left out of the fit in turn, by what the fleet's scale says of that.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tauext import _core
from tauext.config import AlarmConfig, DriftConfig
from tauext.data.first_seconds import total_s
from tauext.data.recording import Recording
from tauext.fit.fleet_prior import FleetErrors
from tauext.train.calibrate_limits import LevelLimits, set_limits
from tauext.train.error_scale import FEATURES, Rows, collect_rows, freeze_floor_nm
from tauext.train.judged import Judged
from tauext.train.preparation import Job

ENOUGH_S = 540.0
"""From so much motion on an arm's own errors say more of it than other arms' do: from there on short recordings ask for
no reserve of friction either (train/limits.py)."""
LEAST_SIZE, LARGEST_SIZE = 0.5, 2.0
"""A minute's errors do not show that an arm is twice as quiet as the fleet; one that is twice as loud is told."""


def fleet_errors(job: Job, bundle: _core.Bundle) -> FleetErrors | None:
    """What the fleet says of this arm's errors; None: it says nothing, or the arm's own say more."""
    like = job.like
    if like is None or like.errors is None or bundle.has_network:
        return None
    same = like.gain_per_s == bundle.observer.gain_per_s
    return like.errors if same and total_s(job.motion.uncut) < ENOUGH_S else None


def sizes(rows: Rows, scale: _core.ErrorScaleSettings) -> np.ndarray:
    """How large each joint's errors are beside those that a scale announces in the same motion, (n,)."""
    used = [FEATURES.index(kind) for kind in scale.features]
    F, n = rows.features[:, :, used], rows.error_nm.shape[1]
    sliding, near = (
        np.einsum("rjf,jf->rj", F, np.array(w).reshape(n, -1)) for w in (scale.sigma_weights, scale.sigma_near_weights)
    )
    sigma = np.where(rows.near_stiction, near, sliding)
    return np.sqrt(np.mean(rows.error_nm**2, axis=0) / np.maximum(np.mean(sigma**2, axis=0), 1e-300))


def scale_settings(errors: FleetErrors, size: np.ndarray) -> _core.ErrorScaleSettings:
    """The fleet's error scale for an arm whose errors are so large beside the fleet's, (n,)."""
    scale = _core.ErrorScaleSettings()
    scale.features = [getattr(_core.MotionFeature, name) for name in errors.features]
    by_joint = size[:, None]
    scale.limit_weights = (by_joint * errors.limit_weights).ravel().tolist()
    scale.sigma_weights = (by_joint * errors.sigma_weights).ravel().tolist()
    scale.sigma_near_weights = (by_joint * errors.sigma_near_weights).ravel().tolist()
    scale.largest = (size * errors.largest).tolist()
    scale.largest_sigma = (size * errors.largest_sigma).tolist()
    return scale


def put_fleet_scale(
    job: Job, bundle: _core.Bundle, judged: Sequence[Recording | Judged], errors: FleetErrors, drift: DriftConfig
) -> None:
    """Put the fleet's error scale into the bundle, as large as this arm's own errors are."""
    rows = collect_rows(bundle, judged, job.threads, job.config.margins)
    found = sizes(rows, scale_settings(errors, np.ones(bundle.joints)))
    size = np.clip(found, LEAST_SIZE, None)
    bundle.error_scale = scale_settings(errors, size)
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
            f"errors are larger than the fleet's by {', '.join(loud)}: this arm is not like the others there, and its "
            "limits are raised by as much"
        )


def put_fleet_limits(bundle: _core.Bundle, errors: FleetErrors, alarm: AlarmConfig) -> tuple[str, dict]:
    """Put the fleet's limits into the bundle; what they rest on, in words, and the facts."""
    set_limits(bundle, LevelLimits(errors.sliding_limit_nm, errors.near_stiction_limit_nm), alarm)
    bundle.contact_sliding_limit_nm = errors.contact_sliding_limit_nm.tolist()
    bundle.contact_near_stiction_limit_nm = errors.contact_near_stiction_limit_nm.tolist()
    bundle.hold_s, bundle.contact_hold_s = errors.hold_s, errors.contact_hold_s
    words = (
        f"limits are those of {errors.arms} arms of this type that had {errors.minutes:g} min of their own and the "
        f"prior of the others, on {60 * errors.hours:.0f} min of the rest of their motion, and as large as this arm's "
        f"own errors beside theirs. {errors.facts['sentence']} They are {errors.facts['arms_factor']:.2f} times that, "
        "so that none of these arms was over limits that the others ask for."
    )
    return words, dict(errors.facts) | {"sentence": words, "like": True}
