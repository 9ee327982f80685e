"""What each joint of a recording did, at a glance: a swap of joints or columns shows in two correlations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from tauext._core import Tree
from tauext.data.recording import Recording


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
        if seconds > 600.0:
            break
    rows = [_rows(one, 20_000 // len(shown)) for one in shown]
    q, dq, tau, slopes = (np.concatenate(parts) for parts in zip(*rows, strict=True))
    gravity = np.zeros_like(q) if tree is None else tree.momentum(q, np.zeros_like(q))[1]

    def extreme(signal: str, of: Callable[[np.ndarray], float], j: int) -> list[float]:
        return [of(getattr(one, signal)[:, j]) for one in shown]

    return [
        JointMotion(
            joint,
            float(min(extreme("q", np.min, j))),
            float(max(extreme("q", np.max, j))),
            float(max(extreme("dq", _largest, j))),
            float(max(extreme("tau", _largest, j))),
            _correlation(dq[:, j], slopes[:, j]),
            _correlation(tau[:, j], gravity[:, j]),
        )
        for j, joint in enumerate(shown[0].joints)
    ]


def _largest(values: np.ndarray) -> float:
    return float(np.abs(values).max())


def _rows(recording: Recording, most: int) -> tuple[np.ndarray, ...]:
    """q, dq, tau and the derivative of q in at most so many rows, (rows, joints) each; none of fewer than three."""
    at = np.arange(1, recording.samples - 1, max(1, recording.samples // max(1, most)))
    steps_s = (recording.t_ns[at + 1] - recording.t_ns[at - 1])[:, None] * 1e-9
    slopes = (recording.q[at + 1] - recording.q[at - 1]) / steps_s
    return recording.q[at], recording.dq[at], recording.tau[at], slopes


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    if not len(a):
        return float("nan")
    a, b = a - a.mean(), b - b.mean()
    size = float(np.linalg.norm(a) * np.linalg.norm(b))
    # a torque of gravity that varies by less is constant
    return float(a @ b) / size if b.std() > 1e-6 and size > 0 else float("nan")


def cells(motions: Sequence[JointMotion], torque_unit: str) -> list[list[str]]:
    """The table as text, its heading first."""
    head = ["joint", "range rad", "speed rad/s", f"torque {torque_unit}", "dq ~ dq/dt", "tau ~ gravity"]
    return [head] + [
        [
            one.name,
            f"{one.low_rad:.2f} to {one.high_rad:.2f}",
            f"{one.speed_rad_s:.2f}",
            f"{one.torque:.3g}",
            *(
                "-" if np.isnan(share) else f"{share:.2f}"
                for share in (one.velocity_correlation, one.gravity_correlation)
            ),
        ]
        for one in motions
    ]
