"""Joints that never move: of them nothing but what they show at rest can be learned."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from tauext.data.recording import Recording

STANDING_RAD = 0.02
"""A joint that stays within so much in every recording stands still, [rad]. Its speed does not tell: that of a standing
arm may be noise of 0.05 rad/s."""


def standing_joints(recordings: Iterable[Recording]) -> np.ndarray:
    """Whether each joint stands still in every recording, (joints,) bool; at least one recording."""
    return np.all([np.ptp(recording.q, axis=0) < STANDING_RAD for recording in recordings], axis=0)
