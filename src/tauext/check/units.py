"""Degrees taken for radians, seen from positions and their derivative alone, or against the robot file's limits."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from tauext.check.finding import Finding
from tauext.check.motion import Stretch
from tauext.data.recording import Recording

FASTEST_RAD_S = 20.0
"""No joint of an arm turns faster; the wrists of small, fast ones reach 17 rad/s."""
WIDEST_RAD = 4.5 * math.pi
"""Cables allow a turn or two; one joint may wind up further, two such joints are none of an arm's."""


def degree_findings(
    recordings: Sequence[Recording],
    stretches: Sequence[Stretch],
    limits_rad: np.ndarray | None = None,
) -> list[Finding]:
    """Findings of joints whose position is in degrees; a finding without a joint is about all.

    Args:
        limits_rad: (joints, 2) lower and upper limits of the robot file, infinite where it has none.
    """
    joints = recordings[0].joints
    far = np.max([np.abs(r.q).max(axis=0) for r in recordings], axis=0)
    fast = np.zeros(len(joints))
    if stretches:
        fast = np.max([np.percentile(np.abs(s.dq), 99.5, axis=0) for s in stretches], axis=0)
    beyond = np.zeros(len(joints), dtype=bool)
    if limits_rad is not None and np.isfinite(limits_rad).any():
        q = np.radians(np.concatenate([r.q for r in recordings]))
        within = ((q >= limits_rad[:, 0] - 0.1) & (q <= limits_rad[:, 1] + 0.1)).all(axis=0)
        beyond = within & (far > np.maximum(1.5 * np.abs(limits_rad).max(axis=1), 2 * math.pi))
    wide = far > WIDEST_RAD
    certain = (fast > FASTEST_RAD_S) | (far > 2 * WIDEST_RAD)
    if wide.sum() >= 2 or beyond.sum() >= 2:
        certain |= wide | beyond
    if not certain.any():
        return []
    advice = "convert positions and velocities to radians at import"
    if certain.sum() >= min(2, len(joints)):
        j, k = int(np.argmax(far)), int(np.argmax(fast))
        evidence = (
            f"positions up to {far[j]:.4g} ('{joints[j]}'), changing by up to {fast[k]:.4g} a second ('{joints[k]}')"
        )
        if beyond.any():
            evidence += "; the robot file's limits fit degrees"
        return [Finding("degrees", "fault", None, evidence, advice)]
    j = int(np.argmax(certain))
    evidence = (
        f"positions up to {far[j]:.4g}, changing by up to {fast[j]:.4g} a second; the other joints are in radians"
    )
    return [Finding("degrees", "fault", joints[j], evidence, advice)]
