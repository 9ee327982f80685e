"""Least squares of one joint's torque on its regressors, with errors that allow for poor excitation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from tauext import _core
from tauext.check.motion import FIT, MOVING_RAD_S, RowFilter, Stretch

# --- Rows of a linear regression: a joint's torque and its possible parts, all through one zero-phase filter.


COULOMB_SPEEDS_RAD_S = (0.02, 0.2)
"""Smoothings of sign(speed): a narrow one for sharp reversals, a wide one for friction that grows at low speed."""
PRESLIDING_RAD = (5e-4, 5e-3)
"""Travel over which friction reverses. Presliding states keep their value at rest, where sign(speed) is 0. Without them
the fit would assign friction at rest to gravity."""
FRICTION = 2 + len(COULOMB_SPEEDS_RAD_S) + len(PRESLIDING_RAD)  # constant, viscous, Coulomb, presliding
CONSTANT = 3  # column of the constant: gravity, inertial torque and acceleration come before it
RESISTS = slice(CONSTANT + 1, CONSTANT + FRICTION)  # columns of friction without the constant


@dataclass(frozen=True)
class FitRows:
    """Regressors and torque; arrays (rows, joints) [N m] unless stated."""

    time_s: np.ndarray  # (rows,)
    recording: np.ndarray  # (rows,)
    q: np.ndarray  # [rad]
    dq: np.ndarray  # [rad/s]
    tau: np.ndarray
    gravity: np.ndarray  # of the model
    inertial: np.ndarray  # of the model: M ddq + C dq, with the file's rotor inertia
    acceleration: np.ndarray  # [rad/s^2]: torque per kg m^2 of additional rotor inertia
    friction: np.ndarray  # (rows, joints, FRICTION): 1, dq, tanh(dq / speed) ..., presliding states

    @property
    def joints(self) -> int:
        return self.q.shape[1]

    @property
    def has_model(self) -> bool:
        return bool(self.gravity.any() or self.inertial.any())

    @property
    def model(self) -> np.ndarray:
        return self.gravity + self.inertial

    def least_speeds(self) -> np.ndarray:
        """(joints,) speed from which a joint moves, [rad/s]."""
        return np.minimum(MOVING_RAD_S, 0.02 * np.abs(self.dq).max(axis=0))

    def judged(self, joint: int) -> np.ndarray:
        """(rows,) bool: rows in which the joint moves, if it rests in at least half of them; else all rows. In a rest,
        friction holds an unknown part of gravity."""
        moves = np.abs(self.dq[:, joint]) > self.least_speeds()[joint]
        return moves if LEAST_MOVING <= moves.sum() < 0.5 * len(moves) else np.ones_like(moves)

    def columns(self, joint: int) -> np.ndarray:
        """Regressors (rows, 3 + FRICTION). Without a model, sines and cosines of the joints stand in for gravity."""
        own = (self.gravity[:, joint], self.inertial[:, joint], self.acceleration[:, joint])
        columns = np.column_stack([*own, self.friction[:, joint]])
        return columns if self.has_model else np.column_stack([columns, np.sin(self.q), np.cos(self.q)])

    def with_model(self, stretches: Sequence[Stretch], tree: _core.Tree) -> FitRows:
        """The rows with the model's torques of this motion."""
        gravity, inertial = model_of(stretches, tree)
        return replace(self, gravity=gravity, inertial=inertial)

    def taken(self, at: np.ndarray | slice) -> FitRows:
        """Select rows."""
        return FitRows(*(getattr(self, field.name)[at] for field in fields(self)))

    def thinned(self, most: int) -> FitRows:
        """About so many rows, evenly."""
        return self.taken(slice(None, None, max(1, len(self.time_s) // most)))

    @staticmethod
    def joined(parts: Sequence[FitRows]) -> FitRows:
        """Concatenate rows."""
        return FitRows(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(FitRows)))


def rows_of(stretches: Sequence[Stretch], tree: _core.Tree | None, lag_s: float = 0.0, how: RowFilter = FIT) -> FitRows:
    r"""LP(tau) beside LP(dp/dt + beta) and friction of the same motion.

    With p = M dq and beta = g - C^T dq of the sweep, dp/dt + beta is the model's torque: no acceleration is needed, and
    the low-pass, the same for all, keeps the equation.

    Args:
        tree: the model; None: its torques are 0.
        lag_s: time by which the torque is read later than its stamp, [s]; positive where torque lags motion.
    """
    parts = [_measured(stretch, lag_s, how) for stretch in stretches]
    time_s, recording, q, dq, tau, acceleration, friction = (np.concatenate(x) for x in zip(*parts, strict=True))
    gravity = inertial = np.zeros_like(q)
    if tree is not None:
        gravity, inertial = model_of(stretches, tree, how)
    return FitRows(time_s, recording, q, dq, tau, gravity, inertial, acceleration, friction)


def model_of(stretches: Sequence[Stretch], tree: _core.Tree, how: RowFilter = FIT) -> tuple[np.ndarray, np.ndarray]:
    """gravity and inertial of `rows_of` alone."""
    parts = []
    for s in stretches:
        momentum, beta = tree.momentum(s.q, s.dq)
        gravity = gravity_of(tree, s.q)
        inertial = np.gradient(momentum, 1 / s.rate_hz, axis=0) + beta - gravity
        parts.append([how.rows(x, s.rate_hz) for x in (gravity, inertial)])
    gravity, inertial = (np.concatenate(x) for x in zip(*parts, strict=True))
    return gravity, inertial


def gravity_of(tree: _core.Tree, q: np.ndarray) -> np.ndarray:
    """Torque of the model's gravity at these positions (rows, joints)."""
    return tree.momentum(q, np.zeros_like(q))[1]


def _measured(stretch: Stretch, lag_s: float, how: RowFilter) -> tuple[np.ndarray, ...]:
    """Regressors of a stretch that need no model: time, recording, q, dq, tau, acceleration, friction."""
    q, dq, rate = stretch.q, stretch.dq, stretch.rate_hz
    friction = [np.ones_like(dq), dq] + [np.tanh(dq / speed) for speed in COULOMB_SPEEDS_RAD_S]
    friction += list(np.moveaxis(presliding(q, PRESLIDING_RAD, rate), 2, 0))
    time = how.picked(stretch.start_s + np.arange(len(q)) / rate, rate)
    signals = [q, dq, delayed(stretch.tau, lag_s, rate), np.gradient(dq, 1 / rate, axis=0), *friction]
    parts = [how.rows(x, rate) for x in signals]
    return (time, np.full(len(time), stretch.recording), *parts[:4], np.stack(parts[4:], axis=2))


def presliding(q: np.ndarray, widths_rad: Sequence[float], rate_hz: float) -> np.ndarray:
    """The core's stop operators on positions (samples, joints): (samples, joints, widths), in -1 to 1.

    Stepped at 100 Hz, since encoder noise at 1 kHz would distort them, and interpolated linearly. A state is 0 until
    the joint has moved far enough to determine it.
    """
    every = max(1, int(rate_hz / 100.0))
    states = _core.presliding_states(np.ascontiguousarray(q[::every]), widths_rad)
    if every == 1:
        return states
    at = np.minimum(np.arange(len(q)) / every, len(states) - 1)
    low = np.minimum(at.astype(np.int64), max(0, len(states) - 2))
    share = (at - low)[:, None, None]
    return states[low] + share * (states[np.minimum(low + 1, len(states) - 1)] - states[low])


def torque_rows(stretches: Sequence[Stretch], lag_s: float) -> np.ndarray:
    """The delayed torque of `rows_of` alone: (rows, joints), [N m]."""
    return np.concatenate([FIT.rows(delayed(s.tau, lag_s, s.rate_hz), s.rate_hz) for s in stretches])


def delayed(x: np.ndarray, lag_s: float, rate_hz: float) -> np.ndarray:
    """x at t + lag: compensates a delay."""
    if lag_s == 0:
        return x
    at = np.arange(len(x)) / rate_hz
    return np.stack([np.interp(at + lag_s, at, column) for column in x.T], axis=1)


# --- Robust least squares of one joint's torque on its parts, with jackknife errors.


BLOCKS = 10  # number of blocks of time, left out in turn, since errors of neighbouring rows are correlated
HUBER = 2.0  # rows with an error above twice the robust spread get less weight, so that a bump does not change a sign
SEEN = 0.02  # A model torque is ignored if its spread is a smaller share of the measured torque's spread
LEAST_MOVING = 250  # ten seconds: the rests of a joint that moves for less are used, too
LEAST_ROWS = 100  # four seconds: fewer rows than that cannot be fitted


@dataclass(frozen=True)
class JointFit:
    """Weights of the columns gravity, inertial, acceleration, then friction; 0 for a column that is not excited."""

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
        """Explained share of the torque's variance."""
        return 1 - (self.error_nm / self.torque_nm) ** 2 if self.torque_nm > 0 else 0.0

    @property
    def gravity_factor(self) -> tuple[float, float]:
        """Measured torque per unit of the model's gravity, and its standard error."""
        return float(self.weights[0]), spread_of(self.left_out[:, 0])

    @property
    def inertial_factor(self) -> tuple[float, float]:
        """Measured torque per unit of the model's inertial torque, and its standard error."""
        return float(self.weights[1]), spread_of(self.left_out[:, 1])


def spread_of(values: np.ndarray) -> float:
    """Jackknife standard error from estimates with each block left out."""
    return float(np.sqrt((BLOCKS - 1) / BLOCKS * ((values - values.mean()) ** 2).sum()))


def solve(columns: np.ndarray, torque: np.ndarray, trust: np.ndarray) -> np.ndarray:
    """Weighted least squares with centred, scaled columns; a column that hardly varies gets the weight 0."""
    share = trust / trust.sum()
    middle, level = share @ columns, float(share @ torque)
    centred = columns - middle
    scale = np.sqrt(share @ centred**2)
    scale[CONSTANT] = 0.0
    seen = scale > np.r_[np.full(2, SEEN * torque.std()), np.full(columns.shape[1] - 2, 1e-6)]
    root = np.sqrt(share)
    weights = np.zeros(columns.shape[1])
    scaled = root[:, None] * centred[:, seen] / scale[seen]
    # weights along directions of smaller singular values stay 0
    weights[seen] = np.linalg.lstsq(scaled, root * (torque - level), rcond=3e-3)[0] / scale[seen]
    weights[CONSTANT] = level - middle @ weights
    return weights


def rms(columns: np.ndarray) -> np.ndarray:
    """Size of each column, never 0."""
    return np.maximum(np.sqrt((columns**2).mean(axis=0)), 1e-9)


def basis_of(columns: np.ndarray) -> np.ndarray:
    """Orthonormal basis of scaled columns."""
    basis, size, _ = np.linalg.svd(columns, full_matrices=False)
    kept: np.ndarray = basis[:, size > 1e-6 * size[0]]
    return kept


def robust_spread(error: np.ndarray) -> float:
    """Standard deviation from the median magnitude; a collision in the data does not enlarge it."""
    return float(1.4826 * np.median(np.abs(error - np.median(error))))


def robust_solve(columns: np.ndarray, torque: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weights of the columns, and Huber's weight of each row."""
    trust = np.ones(len(torque))
    for _ in range(3):
        weights = solve(columns, torque, trust)
        error = torque - columns @ weights
        trust = np.minimum(1.0, HUBER * robust_spread(error) / np.maximum(np.abs(error), 1e-12))
        trust = np.maximum(trust, 1e-6)
    return weights, trust


def robust_error(columns: np.ndarray, torque: np.ndarray) -> float:
    """Robust spread of what a robust fit leaves."""
    return robust_spread(torque - columns @ robust_solve(columns, torque)[0])


def left_out_error(columns: np.ndarray, torque: np.ndarray, trust: np.ndarray) -> np.ndarray:
    """Error of each row by a fit without its block of time, (rows,)."""
    error = np.empty(len(torque))
    for block in np.array_split(np.arange(len(torque)), BLOCKS):
        weights = solve(*(np.delete(x, block, axis=0) for x in (columns, torque, trust)))
        error[block] = torque[block] - columns[block] @ weights
    return error


def fit_joint(rows: FitRows, joint: int) -> JointFit:
    """Robust fit of one joint in its judged rows; at least LEAST_ROWS rows. It predicts all rows."""
    all_columns, judged = rows.columns(joint), rows.judged(joint)
    columns, torque = all_columns[judged], rows.tau[judged, joint]
    weights, trust = robust_solve(columns, torque)
    blocks = np.array_split(np.arange(len(torque)), BLOCKS)
    left_out = np.stack([solve(*(np.delete(x, b, axis=0) for x in (columns, torque, trust))) for b in blocks])
    of_gravity = [0, *range(CONSTANT + FRICTION, columns.shape[1])]
    parts = (of_gravity, slice(1, 3), slice(CONSTANT, CONSTANT + FRICTION))
    gravity_nm, inertial_nm, friction_nm = (float((columns[:, part] @ weights[part]).std()) for part in parts)
    error_nm, torque_nm = robust_spread(torque - columns @ weights), float(torque.std())
    return JointFit(weights, left_out, all_columns @ weights, torque_nm, error_nm, gravity_nm, inertial_nm, friction_nm)


def model_factor(rows: FitRows, joint: int) -> tuple[float, float]:
    """Measured torque per unit of the model's gravity and inertia together, and its standard error; 0, 0 where the
    model has no torque there. It is as small or as large as another unit makes it: nothing is ignored beside friction.
    """
    judged = rows.judged(joint)
    torque, model = rows.tau[judged, joint], rows.model[judged, joint]
    if not model.std() > 1e-6 * rows.model.std(axis=0).max() or not torque.std() > 0:
        return 0.0, 0.0
    size = torque.std() / model.std()
    own = (rows.acceleration[judged, joint], rows.friction[judged, joint])
    columns = np.column_stack([size * model, np.zeros(len(model)), *own])
    weights, trust = robust_solve(columns, torque)
    blocks = np.array_split(np.arange(len(torque)), BLOCKS)
    left_out = [solve(*(np.delete(x, b, axis=0) for x in (columns, torque, trust)))[0] for b in blocks]
    return size * float(weights[0]), size * spread_of(np.array(left_out))


# --- Numbers common to all joints: the direction of gravity, a load.


def shared_numbers(
    columns: Sequence[np.ndarray],
    torques: Sequence[np.ndarray],
    floor_nm: np.ndarray,
    rcond: float = 1e-9,
    spread: Callable[[np.ndarray], float | np.ndarray] = robust_spread,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Least squares of all joints together, each weighted by its robust error: the numbers, the errors that they leave
    and the weights. `floor_nm`: errors for the first weights; a thousandth is the least of all."""
    floor_nm = np.maximum(floor_nm, 1e-9)
    weights = 1 / floor_nm
    for _ in range(3):
        numbers = weighted_solve(columns, torques, weights, rcond)
        errors = np.array([spread(y - x @ numbers) for x, y in zip(columns, torques, strict=True)])
        weights = 1 / np.maximum(errors, 1e-3 * floor_nm)
    return numbers, errors, weights


def weighted_solve(
    columns: Sequence[np.ndarray], torques: Sequence[np.ndarray], weights: np.ndarray, rcond: float = 1e-9
) -> np.ndarray:
    gram = sum(w**2 * x.T @ x for x, w in zip(columns, weights, strict=True))
    moment = sum(w**2 * x.T @ y for x, y, w in zip(columns, torques, weights, strict=True))
    return np.linalg.lstsq(gram, moment, rcond=rcond)[0]


def without_own(rows: FitRows, shared: np.ndarray, torque: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Columns and torque of each joint without what its own inertia and friction explain."""
    columns: list[np.ndarray] = []
    torques: list[np.ndarray] = []
    for j in range(rows.joints):
        own = rows.columns(j)[:, 2:]
        basis = basis_of(own / rms(own))
        for parts, x in ((columns, shared[:, j]), (torques, torque[:, j])):
            parts.append(x - basis @ (basis.T @ x))
    return columns, torques
