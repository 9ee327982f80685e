"""What each joint of a recording did, at a glance: a swap of joints or columns shows in two correlations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tauext._core import Tree
from tauext.data.recording import Recording

SHOWN_S = 600.0
"""Time of the recordings that is looked at, [s]."""
LEAST_SPREAD_NM = 1e-6
"""A torque of gravity that varies by less is constant, and no correlation exists."""


@dataclass(frozen=True)
class JointMotion:
    """Motion and torque of one joint."""

    name: str
    low_rad: float
    high_rad: float
    speed_rad_s: float
    """Largest speed."""
    torque: float
    """Largest torque, in the recording's unit."""
    velocity_correlation: float
    """Correlation of the velocity with the derivative of the position; NaN at rest."""
    gravity_correlation: float
    """Correlation of the torque with the model's gravity; NaN without a model, or where gravity stays the same."""


def joint_motions(recordings: Sequence[Recording], tree: Tree | None) -> list[JointMotion]:
    """Motion and torque of every joint, over the first ten minutes of the recordings.

    Args:
        recordings: of the same joints, at least one.
        tree: model of the same joints; None: there is none.
    """
    shown, seconds = [], 0.0
    for recording in recordings:
        shown.append(recording)
        seconds += recording.duration_s
        if seconds > SHOWN_S:
            break
    q, dq, tau = (np.concatenate([getattr(one, name) for one in shown]) for name in ("q", "dq", "tau"))
    slopes = np.concatenate([_slopes(one) for one in shown])
    gravity = np.zeros_like(q) if tree is None else tree.momentum(q, np.zeros_like(q))[1]
    return [
        JointMotion(
            joint,
            float(q[:, j].min()),
            float(q[:, j].max()),
            float(np.abs(dq[:, j]).max()),
            float(np.abs(tau[:, j]).max()),
            _correlation(dq[:, j], slopes[:, j]),
            _correlation(tau[:, j], gravity[:, j]),
        )
        for j, joint in enumerate(shown[0].joints)
    ]


def _slopes(recording: Recording) -> np.ndarray:
    """Derivative of the position, (samples, joints), [rad/s]."""
    if recording.samples < 2:
        return np.zeros_like(recording.q)
    return np.gradient(recording.q, recording.time_s, axis=0)


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    a, b = a - a.mean(), b - b.mean()
    size = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(a @ b) / size if b.std() > LEAST_SPREAD_NM and size > 0 else float("nan")


def as_lines(motions: Sequence[JointMotion], torque_unit: str) -> list[str]:
    """The table for a terminal."""
    head = ["joint", "range rad", "speed rad/s", f"torque {torque_unit}", "dq ~ dq/dt", "tau ~ gravity"]
    rows = [
        [
            one.name,
            f"{one.low_rad:.2f} to {one.high_rad:.2f}",
            f"{one.speed_rad_s:.2f}",
            f"{one.torque:.3g}",
            *(
                "-" if np.isnan(value) else f"{value:.2f}"
                for value in (one.velocity_correlation, one.gravity_correlation)
            ),
        ]
        for one in motions
    ]
    widths = [max(len(row[k]) for row in [head, *rows]) for k in range(len(head))]
    return [
        "  ".join(
            [row[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True))]
        )
        for row in [head, *rows]
    ]
