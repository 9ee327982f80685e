"""Least squares of one joint's torque on its regressors, with errors that allow for poor excitation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from tauext import _core
from tauext.check.motion import FIT_CUTOFF_HZ, FIT_ROWS_HZ, Stretch, low_pass

# --- What a joint's torque may consist of, all through one zero-phase filter: rows of a linear regression.


COULOMB_SPEEDS_RAD_S = (0.02, 0.2)
"""Smoothings of the sign of the speed: a sharp reversal, and friction that still grows at a crawl."""
PRESLIDING_RAD = (5e-4, 5e-3)
"""Travel in which friction turns round after a reversal. It is kept at rest, where a sign of the speed is 0 and what
friction holds would be taken for gravity: a joint mostly comes to rest from the side of its middle."""
PRESLIDING_RATE_HZ = 100.0
END_S = 0.2
FRICTION = 2 + len(COULOMB_SPEEDS_RAD_S) + len(PRESLIDING_RAD)  # constant, viscous, Coulomb, presliding


@dataclass(frozen=True)
class Rows:
    """Regressors and torque at FIT_ROWS_HZ; arrays (rows, joints) [N m] unless stated."""

    time_s: np.ndarray  # (rows,)
    recording: np.ndarray  # (rows,)
    q: np.ndarray  # [rad]
    dq: np.ndarray  # [rad/s]
    tau: np.ndarray
    gravity: np.ndarray  # of the model
    inertial: np.ndarray  # of the model: M ddq + C dq, rotor inertia of the file included
    acceleration: np.ndarray  # [rad/s^2]: what a rotor inertia of 1 kg m^2 more would take
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

    def taken(self, at: np.ndarray | slice) -> Rows:
        """Some of the rows."""
        return Rows(*(getattr(self, field.name)[at] for field in fields(self)))

    @staticmethod
    def joined(parts: Sequence[Rows]) -> Rows:
        """The rows of all parts."""
        return Rows(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(Rows)))


def rows_of(
    stretches: Sequence[Stretch],
    tree: _core.Tree | None,
    lag_s: float = 0.0,
    cutoff_hz: float = FIT_CUTOFF_HZ,
    rows_hz: float = FIT_ROWS_HZ,
    end_s: float = END_S,
) -> Rows:
    r"""LP(tau) beside LP(dp/dt + beta) and friction of the same motion.

    With p = M dq and beta = g - C^T dq of the sweep, dp/dt + beta is the model's torque: no acceleration is needed, and
    the low-pass, the same for all, keeps the equation.

    Args:
        tree: None: no model, its torques are 0.
        lag_s: the torque is taken so much later than its stamp; positive where torque lags behind motion.
        cutoff_hz: of the low-pass.
        rows_hz: rows a second.
        end_s: left out at both ends of a stretch.
    """
    parts = [_measured(stretch, lag_s, cutoff_hz, rows_hz, end_s) for stretch in stretches]
    time_s, recording, q, dq, tau, acceleration, friction = (np.concatenate(x) for x in zip(*parts, strict=True))
    gravity = inertial = np.zeros_like(q)
    if tree is not None:
        gravity, inertial = model_of(stretches, tree, cutoff_hz, rows_hz, end_s)
    return Rows(time_s, recording, q, dq, tau, gravity, inertial, acceleration, friction)


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


def _measured(stretch: Stretch, lag_s: float, cutoff_hz: float, rows_hz: float, end_s: float) -> tuple[np.ndarray, ...]:
    """Of a stretch all that no model is needed for: time, recording, q, dq, tau, acceleration, friction."""
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
    """Rows of signals (samples, joints), all through one filter."""
    together = low_pass(np.concatenate(signals, axis=1), min(cutoff_hz, rate_hz / 6), rate_hz)
    return np.split(picked(together, rate_hz, rows_hz, end_s), len(signals), axis=1)


def presliding(q: np.ndarray, widths_rad: Sequence[float], rate_hz: float) -> np.ndarray:
    """The core's stop operators on positions (samples, joints): (samples, joints, widths), in -1 to 1.

    Stepped at PRESLIDING_RATE_HZ, as encoders' noise at 1 kHz would bend them, and straight in between; 0 until the
    joint has moved so far that they are known.
    """
    every = max(1, int(rate_hz / PRESLIDING_RATE_HZ))
    states = _core.presliding_states(np.ascontiguousarray(q[::every]), widths_rad)
    if every == 1:
        return states
    at = np.minimum(np.arange(len(q)) / every, len(states) - 1)
    low = np.minimum(at.astype(np.int64), max(0, len(states) - 2))
    share = (at - low)[:, None, None]
    return states[low] + share * (states[np.minimum(low + 1, len(states) - 1)] - states[low])


def torque_rows(stretches: Sequence[Stretch], lag_s: float) -> np.ndarray:
    """The torque of `rows_of` alone, taken so much later: (rows, joints), [N m]."""
    parts = []
    for s in stretches:
        tau = low_pass(delayed(s.tau, lag_s, s.rate_hz), min(FIT_CUTOFF_HZ, s.rate_hz / 6), s.rate_hz)
        parts.append(picked(tau, s.rate_hz))
    return np.concatenate(parts)


def delayed(x: np.ndarray, lag_s: float, rate_hz: float) -> np.ndarray:
    """x at t + lag, so that what came late stands where it belongs."""
    if lag_s == 0:
        return x
    at = np.arange(len(x)) / rate_hz
    return np.stack([np.interp(at + lag_s, at, column) for column in x.T], axis=1)


def picked(x: np.ndarray, rate_hz: float, rows_hz: float = FIT_ROWS_HZ, end_s: float = END_S) -> np.ndarray:
    """Rows at `rows_hz`, the ends left out, where a filter that runs both ways has one side only."""
    end = int(end_s * rate_hz)
    return x[end : len(x) - end : max(1, round(rate_hz / rows_hz))]


# --- Least squares of one joint's torque on its possible parts, with errors that allow for motion that excites little.


BLOCKS = 10
"""Of time, left out in turn: errors of neighbouring rows are one error."""
SEEN = 0.02
"""A model torque whose spread is a smaller share of the measured one's is no evidence in the presence of friction."""
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
        """Torque a unit of the model's inertial torque, and its standard error."""
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
