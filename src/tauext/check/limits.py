"""Positions and torques beyond the robot file's own limits."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tauext.check.finding import Finding
from tauext.check.robot_file import RobotFile
from tauext.data.recording import Recording

POSITION_RAD = 0.05
TORQUE_SHARE = 0.05
LEAST_ROWS = 3


def limit_findings(recordings: Sequence[Recording], robot: RobotFile) -> list[Finding]:
    """Beyond a limit by 0.05 rad or 5 %, in at least three rows: encoders and files round."""
    found = []
    for j, joint in enumerate(recordings[0].joints):
        q = np.concatenate([r.q[:, j] for r in recordings])
        tau = np.abs(np.concatenate([r.tau[:, j] for r in recordings]))
        low, high = robot.position_limits_rad[j]
        outside = (q < low - POSITION_RAD) | (q > high + POSITION_RAD)
        if outside.sum() >= LEAST_ROWS:
            evidence = (
                f"positions from {q.min():.4g} to {q.max():.4g} rad, limits {low:.4g} to {high:.4g}; "
                f"{outside.mean():.1%} of the samples are outside"
            )
            advice = "a turn counted too many, another zero position, degrees, or limits of another arm"
            found.append(Finding("position-limit", "warning", joint, evidence, advice))
        over = tau > robot.torque_limits_nm[j] * (1 + TORQUE_SHARE)
        if over.sum() >= LEAST_ROWS:
            limit = robot.torque_limits_nm[j]
            evidence = f"torques up to {tau.max():.4g} Nm, limit {limit:.4g}; {over.mean():.1%} of the samples"
            advice = "another unit of the effort, or limits of another arm"
            found.append(Finding("effort-limit", "warning", joint, evidence, advice))
    return found
