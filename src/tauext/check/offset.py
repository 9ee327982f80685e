"""A joint whose zero is elsewhere than the robot file's: gravity fits far better with its position shifted."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from tauext import _core
from tauext.check.fit import CONSTANT, columns_of, robust_spread
from tauext.check.regressors import FRICTION, Rows

GRID_RAD = math.radians(15.0)
LEAST_RAD = 0.05
"""A calibrated arm's zero is right within a hundredth; less than this is what a rough model's masses look like."""
RESISTS = 0.1
"""Friction of that share of the torque tells the torque's sign, and gravity must have the same."""


@dataclass(frozen=True)
class Offset:
    """What must be added to a joint's position."""

    joint: int
    by_rad: float
    gain: float  # sum over joints of the logarithm of how much the error falls, by gravity alone

    def told(self) -> str:
        return f"{self.by_rad:+.2f} rad ({math.degrees(self.by_rad):+.0f} degrees)"


def best_offset(rows: Rows, tree: _core.Tree) -> Offset | None:
    """The shift of one joint that makes gravity fit best, each joint's torque with a factor of its own.

    Gravity is evaluated at the rows' own positions; inertia, which a shift changes little beside friction, stays.
    None where no shift of LEAST_RAD is better than none.
    """
    others, signs = _rest(rows)
    zero = _log_errors(rows.gravity, others, signs)
    best: Offset | None = None
    for j in range(rows.joints):

        def total(by: float, j: int = j) -> float:
            q = rows.q.copy()
            q[:, j] += by
            return float((_log_errors(tree.momentum(q, np.zeros_like(q))[1], others, signs)).sum())

        grid = np.arange(-math.pi, math.pi - 1e-9, GRID_RAD)
        middle = float(grid[np.argmin([total(by) for by in grid])])
        found = minimize_scalar(total, bounds=(middle - GRID_RAD, middle + GRID_RAD), method="bounded",
                                options={"xatol": 1e-3})  # fmt: skip
        by, gain = math.remainder(float(found.x), 2 * math.pi), float(zero.sum() - found.fun)
        if abs(by) > LEAST_RAD and gain > (best.gain if best else 0.0):
            best = Offset(j, by, gain)
    return best


def _rest(rows: Rows) -> tuple[list[tuple[np.ndarray, np.ndarray]], list[float]]:
    """Of each joint a basis of all that is not gravity, and the torque without it; and the torque's sign, 0 unknown."""
    parts, signs, resists = [], [], slice(CONSTANT, CONSTANT + FRICTION - 1)  # after the constant; gravity left out
    for j in range(rows.joints):
        columns, y = columns_of(rows, j), rows.tau[:, j]
        own = columns[:, 1:] / np.maximum(np.sqrt((columns[:, 1:] ** 2).mean(axis=0)), 1e-9)
        u, size, v = np.linalg.svd(own, full_matrices=False)
        kept = size > 1e-3 * size[0]
        basis = u[:, kept]
        weights = v[kept].T @ ((basis.T @ y) / size[kept])
        friction = own[:, resists] @ weights[resists]
        tells = friction.std() > RESISTS * max(float(y.std()), 1e-12)
        signs.append(float(np.sign((friction * rows.dq[:, j]).mean())) if tells else 0.0)
        parts.append((basis, y - basis @ (basis.T @ y)))
    return parts, signs


def _log_errors(gravity: np.ndarray, others: Sequence[tuple[np.ndarray, np.ndarray]], signs: list[float]) -> np.ndarray:
    """Logarithm of each joint's robust error with this gravity, (joints,)."""
    errors = np.empty(len(others))
    for j, (basis, y) in enumerate(others):
        x = gravity[:, j] - basis @ (basis.T @ gravity[:, j])
        power = float(x @ x)
        factor = float(x @ y) / power if power > 1e-9 * len(x) else 0.0
        if signs[j] * factor < 0:
            factor = 0.0
        errors[j] = math.log(robust_spread(y - factor * x) + 1e-9 + 1e-3 * float(np.abs(y).mean()))
    return errors
