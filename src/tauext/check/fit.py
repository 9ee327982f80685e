"""Least squares of one joint's torque on what it may consist of, with errors that know how little a trajectory says."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tauext.check.regressors import FRICTION, Rows

BLOCKS = 10
"""Of time, left out in turn: errors of neighbouring rows are one error."""
SEEN = 0.02
"""A model torque whose spread is a smaller share of the measured one's says nothing in the presence of friction."""
HUBER = 2.0
"""Rows off by more than twice the robust spread count less: a bump in the data is no reason for a wrong sign."""
LEAST_ROWS = 100
"""Four seconds: fewer rows than that cannot be fitted."""
LEAST_SINGULAR = 3e-3
"""Of the scaled columns, as a share of the largest: directions that the motion hardly shows stay 0."""
CONSTANT = 3
"""Column of the constant."""


@dataclass(frozen=True)
class JointFit:
    """Weights of the columns gravity, inertial, acceleration, then friction; 0 for a column that shows nowhere."""

    weights: np.ndarray  # (columns,)
    left_out: np.ndarray  # (BLOCKS, columns): weights with one block of time left out
    predicted: np.ndarray  # (rows,) [N m]
    torque_nm: float  # standard deviations [N m]: of the torque,
    error_nm: float  # of what is left, robust,
    gravity_nm: float  # and of each part
    inertial_nm: float
    friction_nm: float

    @property
    def explained(self) -> float:
        """Share of the torque's variance."""
        return 1 - (self.error_nm / self.torque_nm) ** 2 if self.torque_nm > 0 else 0.0

    @property
    def gravity_factor(self) -> tuple[float, float]:
        """Torque a unit of the model's gravity, and its standard error."""
        return float(self.weights[0]), spread_of(self.left_out[:, 0])

    @property
    def inertial_factor(self) -> tuple[float, float]:
        """The same of the model's inertial torque."""
        return float(self.weights[1]), spread_of(self.left_out[:, 1])


def spread_of(values: np.ndarray) -> float:
    """Jackknife standard error of a number that is known with each block left out."""
    return float(np.sqrt((BLOCKS - 1) / BLOCKS * ((values - values.mean()) ** 2).sum()))


def columns_of(rows: Rows, joint: int) -> np.ndarray:
    """(rows, 3 + FRICTION), and without a model sines and cosines of the joints, the shape of most of gravity."""
    own = (rows.gravity[:, joint], rows.inertial[:, joint], rows.acceleration[:, joint])
    columns = np.column_stack([*own, rows.friction[:, joint]])
    return columns if rows.has_model else np.column_stack([columns, np.sin(rows.q), np.cos(rows.q)])


def solve(columns: np.ndarray, torque: np.ndarray, trust: np.ndarray) -> np.ndarray:
    """Weighted least squares, columns centred and scaled; one that hardly varies beside the torque gets 0."""
    share = trust / trust.sum()
    middle, level = share @ columns, float(share @ torque)
    centred = columns - middle
    scale = np.sqrt(share @ centred**2)
    scale[CONSTANT] = 0.0
    seen = scale > np.r_[np.full(2, SEEN * torque.std()), np.full(columns.shape[1] - 2, 1e-6)]
    root = np.sqrt(share)
    weights = np.zeros(columns.shape[1])
    scaled = root[:, None] * centred[:, seen] / scale[seen]
    weights[seen] = np.linalg.lstsq(scaled, root * (torque - level), rcond=LEAST_SINGULAR)[0] / scale[seen]
    weights[CONSTANT] = level - middle @ weights
    return weights


def robust_spread(error: np.ndarray) -> float:
    """Standard deviation by the median of the magnitudes: a collision in the data does not enlarge it."""
    return float(1.4826 * np.median(np.abs(error - np.median(error))))


def robust_solve(columns: np.ndarray, torque: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weights, and how much each row is trusted (Huber's)."""
    trust = np.ones(len(torque))
    for _ in range(3):
        weights = solve(columns, torque, trust)
        error = np.abs(torque - columns @ weights)
        trust = np.minimum(1.0, HUBER * robust_spread(torque - columns @ weights) / np.maximum(error, 1e-12))
        trust = np.maximum(trust, 1e-6)
    return weights, trust


def fit_joint(rows: Rows, joint: int) -> JointFit:
    """Robust fit of one joint; at least LEAST_ROWS rows."""
    columns, torque = columns_of(rows, joint), rows.tau[:, joint]
    weights, trust = robust_solve(columns, torque)
    blocks = np.array_split(np.arange(len(torque)), BLOCKS)
    left_out = np.stack([solve(*(np.delete(x, b, axis=0) for x in (columns, torque, trust))) for b in blocks])
    friction = slice(CONSTANT, CONSTANT + FRICTION)
    shape = [0, *range(CONSTANT + FRICTION, columns.shape[1])]
    return JointFit(
        weights,
        left_out,
        columns @ weights,
        float(torque.std()),
        robust_spread(torque - columns @ weights),
        float((columns[:, shape] @ weights[shape]).std()),
        float((columns[:, 1:3] @ weights[1:3]).std()),
        float((columns[:, friction] @ weights[friction]).std()),
    )
