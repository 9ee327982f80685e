"""Ridge regression of all joints at once, from normal equations that are summed up once and solved many times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

RIDGES = 10.0 ** np.arange(-7, 2.0)
FOLDS = 5
LEAST_RMS = 1e-9  # a regressor that never exceeds it was not excited


@dataclass
class NormalEquations:
    """Of one part of the recordings: gram (n, columns, columns) and moment (n, columns) of each joint's target."""

    gram: np.ndarray
    moment: np.ndarray
    energy: np.ndarray  # (n,) sum of squares of each joint's target
    rows: int

    def __add__(self, other: NormalEquations) -> NormalEquations:
        return NormalEquations(
            self.gram + other.gram, self.moment + other.moment, self.energy + other.energy, self.rows + other.rows
        )

    def squares(self, solution: np.ndarray) -> np.ndarray:
        """Sum of squares that a solution leaves, (n,)."""
        return self.energy - 2 * self.moment @ solution + np.einsum("iab,a,b->i", self.gram, solution, solution)


class Regression:
    """minimise sum_i |y_i - X_i w|^2 / s_i^2 + ridge rows |w scaled|^2, over parts of the recordings.

    Columns are scaled to unit RMS over all parts, s_i is the RMS of y_i. Columns that were never excited are left out,
    as are those that `fix` gives a value or `used` shuts off.

    Args:
        parts: at least one; every FOLDS-th makes a fold of the cross-validation.
    """

    def __init__(self, parts: Sequence[NormalEquations]) -> None:
        self.folds = [sum(parts[k::FOLDS][1:], start=parts[k]) for k in range(min(FOLDS, len(parts)))]
        self.whole = sum(self.folds[1:], start=self.folds[0])
        self._weight = 1 / np.maximum(self.whole.energy / self.whole.rows, 1e-12)
        mean = np.einsum("iaa,i->a", self.whole.gram, self._weight) / self.whole.rows
        self._scale = np.sqrt(np.maximum(mean, 0.0))
        self.used = self._scale > LEAST_RMS
        self._fixed = np.zeros(len(self._scale))

    def fix(self, column: int, value: float) -> None:
        """Give a column's coefficient instead of finding it."""
        self.used[column], self._fixed[column] = False, value

    def solve(self, equations: NormalEquations, ridge: float) -> np.ndarray:
        """Coefficients of all columns, (columns,)."""
        scale = self._scale[self.used]
        known = np.einsum("iab,i,b->a", equations.gram, self._weight, self._fixed)
        moment = (self._weight @ equations.moment - known)[self.used] / scale
        solution = self._fixed.copy()
        gram = self._scaled_gram(equations)
        solution[self.used] = np.linalg.solve(gram + ridge * equations.rows * np.eye(len(gram)), moment) / scale
        return solution

    def choose_ridge(self) -> tuple[float, np.ndarray]:
        """The ridge of the least error by cross-validation over folds, and the RMSE on what was left out, (n,)."""
        errors = {float(ridge): self._left_out(float(ridge)) for ridge in RIDGES}
        ridge = min(errors, key=lambda one: float((errors[one] * self._weight).sum()))
        return ridge, np.sqrt(errors[ridge])

    def standard_errors(self, ridge: float) -> np.ndarray:
        """Of every coefficient, from leaving out one fold after the other (jackknife), (columns,)."""
        count = len(self.folds)
        leave_one = np.array([self.solve(self._without(k), ridge) for k in range(count)])
        return np.sqrt((count - 1) / count * ((leave_one - leave_one.mean(axis=0)) ** 2).sum(axis=0))

    def determined(self, ridge: float) -> np.ndarray:
        """1 where the data alone determine a coefficient, 0 where the ridge alone does, (columns,)."""
        shares, floor = np.zeros(len(self._scale)), ridge * self.whole.rows
        gram = self._scaled_gram(self.whole)
        shares[self.used] = 1 - floor * np.diag(np.linalg.inv(gram + floor * np.eye(len(gram))))
        return shares

    def _scaled_gram(self, equations: NormalEquations) -> np.ndarray:
        scale = self._scale[self.used]
        gram = np.einsum("iab,i->ab", equations.gram, self._weight)[np.ix_(self.used, self.used)]
        return gram / np.outer(scale, scale)

    def _left_out(self, ridge: float) -> np.ndarray:
        total = np.zeros(len(self.whole.energy))
        for k, fold in enumerate(self.folds):
            total += fold.squares(self.solve(self._without(k), ridge))
        return np.maximum(total / self.whole.rows, 0.0)

    def _without(self, k: int) -> NormalEquations:
        rest = [fold for j, fold in enumerate(self.folds) if j != k] or self.folds
        return sum(rest[1:], start=rest[0])
