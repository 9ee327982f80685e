"""The direction in which the arm's own torques say that things fall."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tauext import _core
from tauext.check.finding import Finding
from tauext.check.fit import columns_of, robust_spread
from tauext.check.motion import Stretch
from tauext.check.regressors import Rows, rows_of

LEAST_DEG = 10.0
"""A mounting plate is level within a degree or two; the rest is for what the model has wrong."""
GAIN = 1.0
"""Sum over joints of the logarithm of how much the error falls."""
HALVED = 0.6


def gravity_finding(stretches: Sequence[Stretch], tree: _core.Tree, rows: Rows) -> tuple[list[Finding], _core.Tree]:
    """A finding where another direction fits far better; and the tree with the better one.

    Gravity torque is linear in the vector of free fall: three columns common to all joints, beside each joint's own
    inertia and friction.
    """
    up = [_core.Tree(list(tree.links), axis) for axis in np.eye(3).tolist()]
    shared = np.stack([rows_of(stretches, t).gravity for t in up], axis=2)
    left, rest, weights, known = [], [], [], []
    given = np.array(tree.gravity)
    for j in range(rows.joints):
        basis = np.linalg.qr(columns_of(rows, j)[:, 2:] + 0.0)[0]
        y = rows.tau[:, j] - rows.inertial[:, j]
        y, x = y - basis @ (basis.T @ y), shared[:, j] - basis @ (basis.T @ shared[:, j])
        left.append(x)
        rest.append(y)
        known.append(robust_spread(y - x @ given))
        weights.append(1 / max(known[-1], 1e-9))
    for _ in range(3):
        gram = sum(w**2 * x.T @ x for x, w in zip(left, weights, strict=True))
        moment = sum(w**2 * x.T @ y for x, y, w in zip(left, rest, weights, strict=True))
        found = np.linalg.lstsq(gram, moment, rcond=1e-6)[0]
        errors = [robust_spread(y - x @ found) for x, y in zip(left, rest, strict=True)]
        weights = [1 / max(e, 1e-9) for e in errors]
    size, usual = float(np.linalg.norm(found)), float(np.linalg.norm(given))
    if size == 0 or usual == 0:
        return [], tree
    angle = float(np.degrees(np.arccos(np.clip(found @ given / size / usual, -1, 1))))
    ratio = np.maximum(errors, 1e-9) / np.maximum(known, 1e-9)
    far_better = -np.log(ratio).sum() > GAIN and ratio.min() < HALVED
    if angle < LEAST_DEG or not far_better or not 0.5 < size / usual < 2:
        return [], tree
    told = ", ".join(f"{x:.2f}" for x in found)
    evidence = (
        f"the torques say ({told}) m/s^2 in the base frame, {angle:.0f} degrees from the model's "
        f"({', '.join(f'{x:.2f}' for x in given)}); a joint's error falls to {ratio.min():.0%}"
    )
    advice = "the arm hangs or is tilted: give its gravity direction in the robot's description"
    unit = (found / size * usual).tolist()
    return [Finding("gravity-direction", "fault", None, evidence, advice)], _core.Tree(list(tree.links), unit)
