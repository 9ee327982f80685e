r"""Weights that are most likely given a fleet's prior distribution: MAP instead of the ridge.

.. math:: \min_w \sum_j \frac{\gamma\,\eta_j}{s_j^2} |y_j - X_j w|^2 + (w - \mu)^T \Sigma^{-1} (w - \mu)

eta_j is the share of the rows that are independent of each other, since errors stay what they are for a while, and
gamma how much a row of the arm's own counts beside the fleet. s_j, the size of a joint's error, is found in what is
left.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tauext.fit.regression import NormalEquations, Regression, inverse, solve_within

ROUNDS = 8
LEAST_ERROR = 0.5
"""Smallest error as a share of the fleet's: no minute is twice as quiet as the fleet."""


@dataclass(frozen=True)
class WeightPrior:
    """Distribution of all columns before the arm moves."""

    mean: np.ndarray  # (columns,)
    covariance: np.ndarray  # (columns, columns); 0 on the diagonal: no arm excites the column, and it stays
    error_nm: np.ndarray  # (n,) usual size of each joint's error
    memory_s: np.ndarray  # (n,) its correlation time
    trust: float = 1.0
    """Weight of the arm's own rows, gamma."""

    @property
    def known(self) -> np.ndarray:
        """Columns that may move, (columns,) bool."""
        return np.diag(self.covariance) > 0

    def precision(self) -> np.ndarray:
        """Inverse of the covariance of the columns that may move, 0 elsewhere."""
        known = self.known
        out = np.zeros_like(self.covariance)
        size = np.sqrt(np.diag(self.covariance)[known])
        correlation = self.covariance[np.ix_(known, known)] / np.outer(size, size)
        out[np.ix_(known, known)] = inverse(correlation) / np.outer(size, size)
        return (out + out.T) / 2


class MapRegression(Regression):
    """A regression whose ridge is a fleet's prior distribution; the `ridge` of its methods has no effect.

    Args:
        equations: of each stretch, at least one.
        prior: of the same columns.
        period_s: between two rows.
    """

    def __init__(self, equations: Sequence[NormalEquations], prior: WeightPrior, period_s: float) -> None:
        super().__init__(equations)
        self._prior, self._precision = prior, prior.precision()
        self.used = prior.known.copy()
        self._fixed = np.where(self.used, 0.0, prior.mean)
        self._independent = prior.trust * np.minimum(1.0, period_s / prior.memory_s)
        self.error_nm = prior.error_nm.copy()
        self._find_errors()

    def solve(self, equations: NormalEquations, ridge: float = 0.0) -> np.ndarray:
        """The most likely coefficients of all columns, (columns,)."""
        information, moment = self._normal(equations)
        used, solution = self.used, self._fixed.copy()
        right = moment[used] - information[np.ix_(used, ~used)] @ solution[~used]
        # Fixed columns are fixed in the fleet's mean too; another mean would pull the other columns along.
        size = 1 / np.sqrt(np.diag(information)[used])
        scaled = information[np.ix_(used, used)] * np.outer(size, size)
        low, high = self.low[used], self.high[used]
        found = size * solve_within(scaled, size * right, low / size, high / size)
        solution[used] = np.clip(found, low, high)  # scaling back may round beyond
        return solution

    def choose_ridge(self) -> tuple[float, np.ndarray]:
        """0, and the RMSE on what was left out, (n,)."""
        return 0.0, np.sqrt(self._left_out(0.0))

    def determined(self, ridge: float = 0.0) -> np.ndarray:
        """1 where the arm's own motion alone determines a coefficient, 0 where the fleet alone does, (columns,)."""
        information, _ = self._normal(self.whole)
        used, shares = self.used, np.zeros(len(self._fixed))
        before = 1 / np.diag(inverse(self._scaled_block(self._precision)))
        after = 1 / np.diag(inverse(self._scaled_block(information)))
        shares[used] = 1 - before / after
        return shares

    def covariance(self) -> np.ndarray:
        """Covariance of the coefficients, with all of the motion, (columns, columns)."""
        information, _ = self._normal(self.whole)
        size = self._sizes()
        out = np.zeros_like(information)
        out[np.ix_(self.used, self.used)] = inverse(self._scaled_block(information)) * np.outer(size, size)
        return out

    def _find_errors(self) -> None:
        """Size of each joint's error, (n,), from the residual over this number of independent rows."""
        least = LEAST_ERROR * self._prior.error_nm
        for _ in range(ROUNDS):
            solution, covariance = self.solve(self.whole), self.covariance()
            left = np.maximum(self.whole.squares(solution), 0.0)
            rows = self.whole.rows
            spent = np.array(
                [
                    c * float(np.sum(covariance[np.ix_(at, at)] * gram))
                    for c, at, gram in zip(self._counts(), self.whole.columns, self.whole.gram, strict=True)
                ]
            )
            share = np.clip(1 - spent / np.maximum(self._independent * rows, 1.0), 0.1, 1.0)
            self.error_nm = np.maximum(np.sqrt(left / (rows * share)), least)

    def _counts(self) -> np.ndarray:
        return self._independent / self.error_nm**2

    def _normal(self, equations: NormalEquations) -> tuple[np.ndarray, np.ndarray]:
        """Information matrix of all columns, and its right-hand side."""
        information, moment = self._precision.copy(), self._precision @ self._prior.mean
        for c, at, gram, own in zip(self._counts(), equations.columns, equations.gram, equations.moment, strict=True):
            information[np.ix_(at, at)] += c * gram
            moment[at] += c * own
        return information, moment

    def _sizes(self) -> np.ndarray:
        """Standard deviations in the fleet of the columns that are used."""
        return np.sqrt(np.diag(self._prior.covariance)[self.used])

    def _scaled_block(self, matrix: np.ndarray) -> np.ndarray:
        """Block of a matrix for the used columns, in units of their spread in the fleet."""
        size = self._sizes()
        return matrix[np.ix_(self.used, self.used)] * np.outer(size, size)
