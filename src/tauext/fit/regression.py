"""Ridge regression of all joints at once, from normal equations, with positive definite bounds."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np

from tauext.fit.stable_choice import simplest

# --- Positive definite matrices: inverses that stay positive definite, and minima within bounds on some unknowns.


def solve_within(matrix: np.ndarray, right: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    r"""Minimise w A w / 2 - b w with low <= w <= high: A's own metric decides what gives way.

    A primal active-set method: every step goes towards the minimum on the free unknowns and stops at the first bound,
    so that the result is within the bounds to the last bit. Without a bound in the way it is np.linalg.solve(A, b).

    Args:
        matrix: A, (m, m), symmetric, positive definite.
        right: b, (m,).
        low, high: (m,), infinite where there is no bound.
    """
    w = np.linalg.solve(matrix, right)
    if np.all((low <= w) & (w <= high)):
        return w
    w = np.clip(w, low, high)
    free = (low < w) & (w < high)
    for _ in range(10 * len(w)):  # finite, but rounding could make it go round
        aim = w.copy()
        aim[free] = np.linalg.solve(matrix[np.ix_(free, free)], right[free] - matrix[np.ix_(free, ~free)] @ w[~free])
        step = aim - w
        with np.errstate(divide="ignore", invalid="ignore"):
            to_bound = np.where(step > 0, (high - w) / step, np.where(step < 0, (low - w) / step, np.inf))
        to_bound[~free] = np.inf
        first = int(np.argmin(to_bound))
        if to_bound[first] < 1:
            w = np.clip(w + to_bound[first] * step, low, high)
            w[first] = high[first] if step[first] > 0 else low[first]
            free[first] = False
            continue
        w = np.clip(aim, low, high)
        slope = matrix @ w - right
        inward = np.where(free | (low == high), 0.0, np.where(w <= low, -slope, slope))
        best = int(np.argmax(inward))
        # A smaller share of the largest slope is rounding.
        if inward[best] <= 1e-9 * float(np.abs(right).max()):
            return w
        free[best] = True
    return w


def inverse(matrix: np.ndarray) -> np.ndarray:
    """Inverse of a symmetric, positive definite matrix, (m, m); symmetric and positive definite itself.

    Directions whose eigenvalue, with the diagonal scaled to 1, is lost in rounding count as if it were the least that
    shows: np.linalg.inv may give a negative variance there.
    """
    if len(matrix) == 0:
        return matrix.copy()
    size = np.sqrt(np.diag(matrix))
    values, vectors = np.linalg.eigh(matrix / np.outer(size, size))
    least = np.finfo(float).eps * len(matrix) * values[-1]
    root = vectors / np.sqrt(np.maximum(values, least)) / size[:, None]
    return np.asarray(root @ root.T)


# --- Ridge regression of all joints at once, from normal equations that are summed up once and solved many times.


RIDGES = 10.0 ** np.arange(-7, 2.0)
FOLDS = 5
RIDGE_TIE = 1e-6
"""Share of the squared error by cross-validation: if the data determine everything, weak ridges differ by rounding
alone, and the strongest of them is taken. A stronger ridge would distort what the data determine."""
LEAST_SQUARE = 1e-12
"""Smallest mean square of a joint's r used as its weight, [N m squared]."""


@dataclass
class NormalEquations:
    """Equations of one part of the recordings: each joint's target on the columns that it can depend on.

    Without a model a joint has hundreds of columns of its own and shares none: seven joints as one dense matrix would
    be fifty times as large.
    """

    columns: tuple[np.ndarray, ...]
    """Indices of each joint's own and shared columns, rising."""
    gram: list[np.ndarray]
    """(columns of the joint, the same) each."""
    moment: list[np.ndarray]
    energy: np.ndarray  # (n,) sum of squares of each joint's target
    rows: int

    def __add__(self, other: NormalEquations) -> NormalEquations:
        gram = [a + b for a, b in zip(self.gram, other.gram, strict=True)]
        moment = [a + b for a, b in zip(self.moment, other.moment, strict=True)]
        return NormalEquations(self.columns, gram, moment, self.energy + other.energy, self.rows + other.rows)

    def squares(self, solution: np.ndarray) -> np.ndarray:
        """Residual sum of squares of a solution, (n,)."""
        left = self.energy.copy()
        for i, (at, gram, moment) in enumerate(zip(self.columns, self.gram, self.moment, strict=True)):
            w = solution[at]
            left[i] += w @ gram @ w - 2 * moment @ w
        return left


class Regression:
    """minimise sum_i |y_i - X_i w|^2 / s_i^2 + ridge rows |w scaled|^2, over stretches of the recordings.

    Columns are scaled to unit RMS over all stretches, s_i is the RMS of y_i. Columns that were never excited are left
    out, as are those that `fix` gives a value or `used` shuts off. Every solution is within the bounds of `bound`.

    Args:
        equations: of each stretch, at least one; every FOLDS-th makes a fold of the cross-validation.
    """

    def __init__(self, equations: Sequence[NormalEquations]) -> None:
        self.folds = [sum(equations[k::FOLDS][1:], start=equations[k]) for k in range(min(FOLDS, len(equations)))]
        self.whole = sum(self.folds[1:], start=self.folds[0])
        self._weight = 1 / np.maximum(self.whole.energy / self.whole.rows, LEAST_SQUARE)
        width = 1 + max(int(at.max(initial=-1)) for at in self.whole.columns)
        mean = np.zeros(width)
        for at, gram, weight in zip(self.whole.columns, self.whole.gram, self._weight, strict=True):
            mean[at] += weight * np.diag(gram) / self.whole.rows
        self._scale = np.sqrt(np.maximum(mean, 0.0))
        self.used = self._scale > 1e-9  # a smaller regressor was not excited
        self._fixed = np.zeros(width)
        self.low, self.high = np.full(width, -np.inf), np.full(width, np.inf)
        self._groups = coupled(self.whole.columns)

    def copy(self) -> Regression:
        """A copy whose fixed columns can differ."""
        other = copy(self)
        other.used, other._fixed = self.used.copy(), self._fixed.copy()
        other.low, other.high = self.low.copy(), self.high.copy()
        return other

    def bound(self, columns: np.ndarray, low: np.ndarray, high: np.ndarray) -> None:
        """Keep the coefficients of these columns, fixed ones included, within these bounds, low <= high."""
        self.low[columns], self.high[columns] = low, high
        self._fixed = np.clip(self._fixed, self.low, self.high)

    def fix(self, column: int, value: float) -> None:
        """Give a column's coefficient instead of finding it."""
        self.used[column], self._fixed[column] = False, value

    def solve(self, equations: NormalEquations, ridge: float) -> np.ndarray:
        """Coefficients of all columns, (columns,)."""
        solution = self._fixed.copy()
        for joints in self._groups:
            columns, gram, moment = self._scaled(equations, joints)
            floor, scale = ridge * equations.rows * np.eye(len(gram)), self._scale[columns]
            low, high = self.low[columns], self.high[columns]
            found = solve_within(gram + floor, moment, low * scale, high * scale) / scale
            solution[columns] = np.clip(found, low, high)  # scaling back may round beyond
        return solution

    def choose_ridge(self) -> tuple[float, np.ndarray]:
        """The ridge of the least error by cross-validation over folds, and the RMSE on what was left out, (n,)."""
        errors = {float(ridge): self._left_out(float(ridge)) for ridge in reversed(RIDGES)}
        ridge = simplest(list(errors), lambda one: float((errors[one] * self._weight).sum()), RIDGE_TIE)
        return ridge, np.sqrt(errors[ridge])

    def score(self, ridge: float) -> float:
        """Mean over joints of the squared error on what was left out, as a share of the target's."""
        return float((self._left_out(ridge) * self._weight).mean())

    def leave_one(self, ridge: float) -> np.ndarray:
        """Coefficients without one fold after the other, (folds, columns)."""
        return np.array([self.solve(self.without(k), ridge) for k in range(len(self.folds))])

    def standard_errors(self, leave_one: np.ndarray) -> np.ndarray:
        """Standard error of every coefficient, from `leave_one` (jackknife), (columns,)."""
        count = len(leave_one)
        return np.sqrt((count - 1) / count * ((leave_one - leave_one.mean(axis=0)) ** 2).sum(axis=0))

    def determined(self, ridge: float) -> np.ndarray:
        """1 where the data alone determine a coefficient, 0 where the ridge alone does, (columns,)."""
        shares, floor = np.zeros(len(self._scale)), ridge * self.whole.rows
        for joints in self._groups:
            columns, gram, _ = self._scaled(self.whole, joints)
            shares[columns] = 1 - floor * np.diag(np.linalg.inv(gram + floor * np.eye(len(gram))))
        return shares

    def without(self, k: int) -> NormalEquations:
        """All folds but one; with a single fold, that one."""
        rest = [fold for j, fold in enumerate(self.folds) if j != k] or self.folds
        return sum(rest[1:], start=rest[0])

    def _scaled(self, equations: NormalEquations, joints: list[int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Used columns of joints that are solved together, and their weighted equations in scaled columns."""
        columns = np.unique(np.concatenate([equations.columns[i] for i in joints]))
        gram, moment = np.zeros((len(columns), len(columns))), np.zeros(len(columns))
        for i in joints:
            at = np.searchsorted(columns, equations.columns[i])
            known = equations.gram[i] @ self._fixed[equations.columns[i]]
            gram[np.ix_(at, at)] += self._weight[i] * equations.gram[i]
            moment[at] += self._weight[i] * (equations.moment[i] - known)
        used = self.used[columns]
        columns = columns[used]
        scale = self._scale[columns]
        return columns, gram[np.ix_(used, used)] / np.outer(scale, scale), moment[used] / scale

    def _left_out(self, ridge: float) -> np.ndarray:
        total = np.zeros(len(self.whole.energy))
        for k, fold in enumerate(self.folds):
            total += fold.squares(self.solve(self.without(k), ridge))
        return np.maximum(total / self.whole.rows, 0.0)


def coupled(columns: Sequence[np.ndarray]) -> list[list[int]]:
    """Joints in groups that share columns, directly or through others: each group is solved by itself."""
    groups: list[tuple[list[int], set[int]]] = []
    for joint, at in enumerate(columns):
        joints, together = [joint], set(at.tolist())
        for group in [g for g in groups if g[1] & together]:
            groups.remove(group)
            joints, together = sorted(joints + group[0]), together | group[1]
        groups.append((joints, together))
    return [joints for joints, _ in groups]
