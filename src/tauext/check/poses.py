"""An arm at rest: the torque that holds it against the gravity of the model, pose by pose."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tauext import _core
from tauext.check.finding import Finding
from tauext.data.recording import Recording

REST_RAD = 0.01
"""No joint turns by more in WINDOW_S."""
WINDOW_S = 1.0
APART_RAD = 0.05
"""Poses closer together are one."""
SEVERAL = 3
"""Poses from which on what gravity leaves unexplained says how much friction holds."""
LOADED, LOADED_OF_SEVERAL = 0.2, 0.05
"""Gravity on a joint as a share of the arm's largest: a gear's friction holds a tenth of that."""
ALIKE = 2.5
"""Torque over gravity may differ so much between joints: friction, a tool, torque constants."""
ABOVE_FRICTION = 3.0


def poses_of(recordings: Sequence[Recording]) -> tuple[np.ndarray, np.ndarray]:
    """Medians of position [rad] and torque [N m] of each pose, (poses, joints); labelled contacts are left out."""
    poses: list[tuple[list[np.ndarray], list[np.ndarray]]] = []
    for r in recordings:
        free = np.ones(r.samples, dtype=bool) if r.contact is None else r.contact != 1
        window = (r.time_s // WINDOW_S).astype(int)
        for k in np.unique(window):
            rows = (window == k) & free
            if rows.sum() < 5 or np.ptp(r.q[rows], axis=0).max() > REST_RAD:
                continue
            q, tau = np.median(r.q[rows], axis=0), np.median(r.tau[rows], axis=0)
            for at, held in poses:
                if np.abs(at[0] - q).max() < APART_RAD:
                    at.append(q)
                    held.append(tau)
                    break
            else:
                poses.append(([q], [tau]))
    size = len(recordings[0].joints)
    medians = [[np.median(x, axis=0) for x in signals] for signals in zip(*poses, strict=True)] or [[], []]
    return np.reshape(medians[0], (-1, size)), np.reshape(medians[1], (-1, size))


def pose_findings(recordings: Sequence[Recording], tree: _core.Tree, joints: Sequence[str]) -> list[Finding]:
    """Joints whose torque pushes with gravity instead of against it; none where friction could be the reason.

    One pose or two: joints with much load, whose torque is of the size of gravity. More: also joints with less load, if
    gravity with one factor explains their torques but for a third, which is then friction.
    """
    q, tau = poses_of(recordings)
    if not len(q):
        return []
    anywhere = np.random.default_rng(0).uniform(-np.pi, np.pi, (300, tree.size))
    most = np.abs(tree.momentum(anywhere, 0 * anywhere)[1]).max()
    gravity = tree.momentum(q, np.zeros_like(q))[1]
    power = np.maximum((gravity**2).sum(axis=0), 1e-18)
    factor = (gravity * tau).sum(axis=0) / power
    left = np.sqrt(((tau - factor * gravity) ** 2).mean(axis=0))
    loaded = np.abs(gravity) > LOADED * most
    wrong = loaded.any(axis=0) & ((tau * gravity < 0) | ~loaded).all(axis=0) & _of_one_size(factor, loaded.any(axis=0))
    if len(q) >= SEVERAL:
        load = np.sqrt(power / len(q))
        wrong |= (load > LOADED_OF_SEVERAL * most) & (factor < 0) & (-factor * load > ABOVE_FRICTION * left)
    found = []
    for j in np.flatnonzero(wrong).tolist():
        k = int(np.argmax(np.abs(gravity[:, j])))
        several = f" ({len(q)} poses: {factor[j]:.3g} times gravity, {left[j]:.2g} Nm apart)" if len(q) > 1 else ""
        evidence = f"at rest the effort is {tau[k, j]:.4g} Nm where gravity takes {gravity[k, j]:.4g} Nm{several}"
        advice = "negate the effort at import"
        if (wrong | ~loaded.any(axis=0)).all():
            advice += "; or the arm hangs: then give its gravity direction"
        found.append(Finding("effort-sign", "fault", joints[j], evidence, advice))
    return found


def _of_one_size(factor: np.ndarray, loaded: np.ndarray) -> np.ndarray:
    """Joints whose torque is to gravity as that of the other loaded joints; a single one: as 1."""
    usual = float(np.median(np.abs(factor[loaded]))) if loaded.sum() > 1 else 1.0
    return (np.abs(factor) > usual / ALIKE) & (np.abs(factor) < usual * ALIKE)
