"""Least squares of one joint's torque on its regressors, with errors that allow for poor excitation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from tauext import _core
from tauext.check.motion import FIT_CUTOFF_HZ, FIT_ROWS_HZ, Stretch, low_pass

# --- Rows of a linear regression: a joint's torque and its possible parts, all through one zero-phase filter.


COULOMB_SPEEDS_RAD_S = (0.02, 0.2)
"""Smoothings of sign(speed), [rad/s]: a narrow one for sharp reversals, a wide one for friction that grows at low
speed."""
PRESLIDING_RAD = (5e-4, 5e-3)
"""Travel over which friction reverses, [rad]. Presliding states keep their value at rest, where sign(speed) is 0.
Without them the fit would assign friction at rest to gravity."""
END_S = 0.2
FRICTION = 2 + len(COULOMB_SPEEDS_RAD_S) + len(PRESLIDING_RAD)  # constant, viscous, Coulomb, presliding


@dataclass(frozen=True)
class FitRows:
    """Regressors and torque at FIT_ROWS_HZ; arrays (rows, joints) [N m] unless stated."""

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

    def taken(self, at: np.ndarray | slice) -> FitRows:
        """Select rows."""
        return FitRows(*(getattr(self, field.name)[at] for field in fields(self)))

    @staticmethod
    def joined(parts: Sequence[FitRows]) -> FitRows:
        """Concatenate rows."""
        return FitRows(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(FitRows)))


def rows_of(
    stretches: Sequence[Stretch],
    tree: _core.Tree | None,
    lag_s: float = 0.0,
    cutoff_hz: float = FIT_CUTOFF_HZ,
    rows_hz: float = FIT_ROWS_HZ,
    end_s: float = END_S,
) -> FitRows:
    r"""LP(tau) beside LP(dp/dt + beta) and friction of the same motion.

    With p = M dq and beta = g - C^T dq of the sweep, dp/dt + beta is the model's torque: no acceleration is needed, and
    the low-pass, the same for all, keeps the equation.

    Args:
        tree: the model; None: its torques are 0.
        lag_s: time by which the torque is read later than its stamp, [s]; positive where torque lags motion.
        cutoff_hz: of the low-pass.
        rows_hz: rows a second.
        end_s: left out at both ends of a stretch.
    """
    parts = [_measured(stretch, lag_s, cutoff_hz, rows_hz, end_s) for stretch in stretches]
    time_s, recording, q, dq, tau, acceleration, friction = (np.concatenate(x) for x in zip(*parts, strict=True))
    gravity = inertial = np.zeros_like(q)
    if tree is not None:
        gravity, inertial = model_of(stretches, tree, cutoff_hz, rows_hz, end_s)
    return FitRows(time_s, recording, q, dq, tau, gravity, inertial, acceleration, friction)


def model_of(
    stretches: Sequence[Stretch],
    tree: _core.Tree,
    cutoff_hz: float = FIT_CUTOFF_HZ,
    rows_hz: float = FIT_ROWS_HZ,
    end_s: float = END_S,
) -> tuple[np.ndarray, np.ndarray]:
    """gravity and inertial of `rows_of` alone."""
    parts = []
    for s in stretches:
        momentum, beta = tree.momentum(s.q, s.dq)
        gravity = tree.momentum(s.q, np.zeros_like(s.q))[1]
        inertial = np.gradient(momentum, 1 / s.rate_hz, axis=0) + beta - gravity
        parts.append(_filtered([gravity, inertial], s.rate_hz, cutoff_hz, rows_hz, end_s))
    gravity, inertial = (np.concatenate(x) for x in zip(*parts, strict=True))
    return gravity, inertial


def with_model(rows: FitRows, stretches: Sequence[Stretch], tree: _core.Tree) -> FitRows:
    """The rows with the model's torques of this motion."""
    gravity, inertial = model_of(stretches, tree)
    return replace(rows, gravity=gravity, inertial=inertial)


def _measured(stretch: Stretch, lag_s: float, cutoff_hz: float, rows_hz: float, end_s: float) -> tuple[np.ndarray, ...]:
    """Regressors of a stretch that need no model: time, recording, q, dq, tau, acceleration, friction."""
    q, dq, rate = stretch.q, stretch.dq, stretch.rate_hz
    friction = [np.ones_like(dq), dq] + [np.tanh(dq / speed) for speed in COULOMB_SPEEDS_RAD_S]
    friction += list(np.moveaxis(presliding(q, PRESLIDING_RAD, rate), 2, 0))
    time = picked(stretch.start_s + np.arange(len(q)) / rate, rate, rows_hz, end_s)
    signals = [q, dq, delayed(stretch.tau, lag_s, rate), np.gradient(dq, 1 / rate, axis=0), *friction]
    parts = _filtered(signals, rate, cutoff_hz, rows_hz, end_s)
    return (time, np.full(len(time), stretch.recording), *parts[:4], np.stack(parts[4:], axis=2))


def _filtered(
    signals: Sequence[np.ndarray], rate_hz: float, cutoff_hz: float, rows_hz: float, end_s: float
) -> list[np.ndarray]:
    """Filter signals (samples, joints) and pick rows."""
    return [picked(low_pass(x, min(cutoff_hz, rate_hz / 6), rate_hz), rate_hz, rows_hz, end_s) for x in signals]


def presliding(q: np.ndarray, widths_rad: Sequence[float], rate_hz: float) -> np.ndarray:
    """The core's stop operators on positions (samples, joints): (samples, joints, widths), in -1 to 1.

    Stepped at PRESLIDING_RATE_HZ, since encoder noise at 1 kHz would distort them, and interpolated linearly. A state
    is 0 until the joint has moved far enough to determine it.
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
    parts = []
    for s in stretches:
        tau = low_pass(delayed(s.tau, lag_s, s.rate_hz), min(FIT_CUTOFF_HZ, s.rate_hz / 6), s.rate_hz)
        parts.append(picked(tau, s.rate_hz))
    return np.concatenate(parts)


def delayed(x: np.ndarray, lag_s: float, rate_hz: float) -> np.ndarray:
    """x at t + lag: compensates a delay."""
    if lag_s == 0:
        return x
    at = np.arange(len(x)) / rate_hz
    return np.stack([np.interp(at + lag_s, at, column) for column in x.T], axis=1)


def picked(x: np.ndarray, rate_hz: float, rows_hz: float = FIT_ROWS_HZ, end_s: float = END_S) -> np.ndarray:
    """A copy of the rows at `rows_hz`. The ends are left out: there a forward-backward filter has data on one side
    only."""
    end = int(end_s * rate_hz)
    return x[end : len(x) - end : max(1, round(rate_hz / rows_hz))].copy(order="K")


# --- Robust least squares of one joint's torque on its parts, with jackknife errors.


BLOCKS = 10
"""Number of blocks of time, left out in turn, since errors of neighbouring rows are correlated."""
SEEN = 0.02
"""A model torque is ignored if its spread is a smaller share of the measured torque's spread."""
HUBER = 2.0
"""Rows with an error above twice the robust spread get less weight, so that a bump does not change a sign."""
LEAST_ROWS = 100
"""Four seconds: fewer rows than that cannot be fitted."""
CONSTANT = 3
"""Column of the constant."""
SIGN = 2
"""Friction column with the sharp sign of the speed."""


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


def columns_of(rows: FitRows, joint: int) -> np.ndarray:
    """Regressors (rows, 3 + FRICTION). Without a model, sines and cosines of the joints stand in for gravity."""
    own = (rows.gravity[:, joint], rows.inertial[:, joint], rows.acceleration[:, joint])
    columns = np.column_stack([*own, rows.friction[:, joint]])
    return columns if rows.has_model else np.column_stack([columns, np.sin(rows.q), np.cos(rows.q)])


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
        error = np.abs(torque - columns @ weights)
        trust = np.minimum(1.0, HUBER * robust_spread(torque - columns @ weights) / np.maximum(error, 1e-12))
        trust = np.maximum(trust, 1e-6)
    return weights, trust


def fit_joint(rows: FitRows, joint: int) -> JointFit:
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
