"""The paper's limits: what free motion that the network was not trained on reached at most."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tauext import _core
from tauext.config import AlarmConfig, FreeMotionConfig
from tauext.data.recording import Recording
from tauext.data.standing import standing_joints
from tauext.errors import TrainingError
from tauext.train.judged import Judged, errors, no_free_motion, whole_recordings


@dataclass(frozen=True)
class LevelLimits:
    """Limits of one level of the alarm: what |tau_ext| of a joint must exceed, [N m]."""

    sliding_nm: np.ndarray  # (n,)
    near_stiction_nm: np.ndarray  # (n,), for |dq| below the bundle's near_stiction_rad_s
    at_rest: tuple[str, ...] = ()
    """Joints that stood still in every recording."""


def paper_limits(
    bundle: _core.Bundle,
    recordings: Sequence[Recording | Judged],
    threads: int,
    margins: FreeMotionConfig = FreeMotionConfig(),  # noqa: B008
) -> LevelLimits:
    """Largest |tau_ext| of each joint on validation free motion, sliding and near stiction apart [Lim2021].

    Where a joint was never near stiction, or less wrong there, its near-stiction limit is the sliding one: a stuck
    joint's friction is known no better than a moving one's. A joint that never slid has in both regions the limit that
    it has at rest: nothing is known of it in motion, and `warning` says so. Contacts, with margins, are left out.

    Raises:
        TrainingError: no healthy sample of free motion, or a joint whose |tau_ext| is zero throughout.
    """
    n = bundle.joints
    sliding, near, samples = np.zeros(n), np.zeros(n), 0
    for recording in recordings:
        _, error, stuck, counted = errors(bundle, recording, threads, margins)
        error, stuck = error[counted], stuck[counted]
        sliding = np.maximum(sliding, np.where(stuck, 0, error).max(axis=0, initial=0))
        near = np.maximum(near, np.where(stuck, error, 0).max(axis=0, initial=0))
        samples += len(error)
    if samples == 0:
        raise no_free_motion(bundle, margins)
    names = [link.joint_name for link in bundle.links]
    if (np.maximum(sliding, near) == 0).any():
        name = names[int(np.argmin(np.maximum(sliding, near)))]
        raise TrainingError(
            f"joint '{name}': |tau_ext| is zero throughout the validation recordings, so its limit cannot be found; "
            "is its torque recorded?"
        )
    stand = standing_joints([r.recording if isinstance(r, Judged) else r for r in recordings])
    both = np.maximum(sliding, near)
    sliding = np.where(stand | (sliding == 0), both, sliding)
    return LevelLimits(sliding, both, tuple(name for name, stands in zip(names, stand, strict=True) if stands))


def at_rest_sentence(joints: Sequence[str], of: int) -> str:
    """What limits of joints that stood still are worth, in words."""
    which = "no joint moves" if len(joints) == of else f"{', '.join(joints)} stand{'s' * (len(joints) == 1)} still"
    return f"limits at rest only: {which} in the recordings; in motion expect false alarms"


def set_limits(bundle: _core.Bundle, limits: LevelLimits, alarm: AlarmConfig) -> None:
    """Put limits and hold times into a bundle. The paper has one limit: contact and collision differ in time only."""
    bundle.sliding_limit_nm = bundle.contact_sliding_limit_nm = limits.sliding_nm.tolist()
    bundle.near_stiction_limit_nm = bundle.contact_near_stiction_limit_nm = limits.near_stiction_nm.tolist()
    bundle.hold_s = alarm.collision_hold_s
    bundle.contact_hold_s = alarm.contact_hold_s
    bundle.contact_release_s = alarm.contact_release_s


def raise_limits(bundle: _core.Bundle, factor: float, by_nm: np.ndarray | float = 0.0) -> None:
    """Multiply every limit of a bundle, in both regions and of both alarms, and add so much of each joint, [N m]."""
    for kind in ("sliding", "near_stiction", "contact_sliding", "contact_near_stiction"):
        name = f"{kind}_limit_nm"
        setattr(bundle, name, (factor * np.array(getattr(bundle, name)) + by_nm).tolist())


def usual_speed_rad_s(recordings: Sequence[Recording | Judged]) -> np.ndarray:
    """What a joint's speed stays below for 95 % of the recording where that is largest, (n,), [rad/s]."""
    speeds = [np.quantile(np.abs(recording.dq), 0.95, axis=0) for recording in whole_recordings(recordings)]
    return np.max(speeds, axis=0)
