"""The paper's limits: what free motion that the network was not trained on reached at most."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tauext import _core
from tauext.config import AlarmConfig
from tauext.data import Recording
from tauext.errors import TrainingError


@dataclass(frozen=True)
class Limits:
    """A collision is detected where |tau_ext| of a joint exceeds its limit, [N m]."""

    sliding_nm: np.ndarray  # (n,)
    near_stiction_nm: np.ndarray  # (n,), for |dq| below the bundle's near_stiction_rad_s


def paper_limits(bundle: _core.Bundle, recordings: Sequence[Recording], threads: int) -> Limits:
    """Largest |tau_ext| of each joint on validation free motion, sliding and near stiction apart [Lim2021].

    Where a joint was never near stiction, or less wrong there, its near-stiction limit is the sliding one: a stuck
    joint's friction is known no better than a moving one's.

    Raises:
        TrainingError: a recording with contacts, or a joint that never slides after the warm-up.
    """
    n = bundle.joints
    sliding, near = np.zeros(n), np.zeros(n)
    for recording in recordings:
        if recording.contact is not None and (recording.contact == 1).any():
            raise TrainingError(f"{recording.name}: limits need free motion, and this recording holds contacts")
        estimate = _core.estimate(bundle, recording.t_ns, recording.q, recording.dq, recording.tau, threads)
        healthy = estimate["healthy"].astype(bool)
        # What the prior's doubt raises the limits by is no error that limits must stand.
        error = np.maximum(np.abs(estimate["tau_ext"]) - estimate["doubt"], 0)[healthy]
        stuck = estimate["near_stiction"][healthy].astype(bool)
        sliding = np.maximum(sliding, np.where(stuck, 0, error).max(axis=0, initial=0))
        near = np.maximum(near, np.where(stuck, error, 0).max(axis=0, initial=0))
    if (sliding == 0).any():
        joint = bundle.links[int(np.argmin(sliding))].joint_name
        raise TrainingError(
            f"joint '{joint}': it never moves faster than {bundle.near_stiction_rad_s:g} rad/s in the validation "
            "recordings, so its limit cannot be found; record motion of every joint"
        )
    return Limits(sliding, np.maximum(near, sliding))


def set_limits(bundle: _core.Bundle, limits: Limits, alarm: AlarmConfig) -> None:
    """Put limits and hold times into a bundle. The paper has one limit: contact and collision differ in time only."""
    bundle.sliding_limit_nm = bundle.contact_sliding_limit_nm = limits.sliding_nm.tolist()
    bundle.near_stiction_limit_nm = bundle.contact_near_stiction_limit_nm = limits.near_stiction_nm.tolist()
    bundle.hold_s = alarm.collision_hold_s
    bundle.contact_hold_s = alarm.contact_hold_s
    bundle.contact_release_s = alarm.contact_release_s
