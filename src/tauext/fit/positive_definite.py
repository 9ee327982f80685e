"""Positive definite matrices: inverses that stay positive definite, and minima within bounds on some unknowns."""

from __future__ import annotations

import numpy as np

RELEASED = 1e-9
"""Share of the largest slope from which on a bound is left again: less is rounding."""


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
        if inward[best] <= RELEASED * float(np.abs(right).max()):
            return w
        free[best] = True
    return w


def inverse(matrix: np.ndarray) -> np.ndarray:
    """Of a symmetric, positive definite matrix, (m, m); symmetric and positive definite itself.

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
