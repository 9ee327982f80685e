"""Drive signal of a servo: whether it has a sign, and how it depends on the position error.

A position-controlled servo's duty is its gain times the position error, limited. Its motor current follows the duty
minus back-EMF. Its supply current is motor current times duty: never negative while the servo drives, and at rest
proportional to the square of the duty.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tauext.check.sensors import position_step, step_of
from tauext.data.recording import Recording

LEAST_VISITS = 10
"""Visits of zero during motion, without crossing, from which a signal is unsigned. A signed one crosses zero."""


@dataclass(frozen=True)
class RestLaw:
    """Law of a signal at rest: its size is gain |error|^exponent, with error = goal minus position."""

    exponent: float
    exponent_error: float
    gain: float
    """Gain for the nearest whole exponent, 1 or 2: unit of the signal per rad, or per rad^2."""
    odd: bool
    """Whether the signal has the sign of the error."""
    rows: int


def unsigned_visits(x: np.ndarray, moving: np.ndarray, zero: float = 0.02, left: float = 0.2) -> int:
    """Count how often a signal reaches zero during motion and continues on the same side; 0 for signed ones.

    Args:
        x: the signal of one joint, (samples,).
        moving: whether the joint moves, (samples,) bool.
        zero: share of the signal's 99th percentile up to which it counts as zero.
        left: share above which it has left zero again.
    """
    if x.min() < 0 < x.max() or not moving.any():
        return 0
    size = np.abs(x)
    top = float(np.percentile(size[moving], 99))
    step = step_of(x) or 0.0
    low, high = size <= max(zero * top, 0.5 * step), size > max(left * top, 1.5 * step)
    levels = np.where(high, 1, np.where(low & moving, -1, 0))
    levels = levels[levels != 0]
    return int(np.count_nonzero((levels[1:] == -1) & (levels[:-1] == 1)))


def motion_of(
    recording: Recording, j: int, around_s: float = 0.1, moved_rad: float = 0.004
) -> tuple[np.ndarray, np.ndarray]:
    """Rows at which a joint moves and at which it rests, (samples,) bool each; some rows are neither.

    Args:
        around_s: time before and after a row, [s]: a joint rests if its position stays constant for so long.
        moved_rad: least travel of a moving joint in that time, [rad]; 12-bit encoders count 0.0015.
    """
    q = recording.q[:, j]
    around = max(1, round(around_s * recording.rate_hz))
    moving, resting = np.zeros(len(q), dtype=bool), np.zeros(len(q), dtype=bool)
    if len(q) > 2 * around:
        shifts = np.unique(np.linspace(0, 2 * around, 11).round().astype(int))  # a joint may move away and come back
        low = high = q[: len(q) - 2 * around]
        for shift in shifts[1:]:
            here = q[shift : len(q) - 2 * around + shift]
            low, high = np.minimum(low, here), np.maximum(high, here)
        moving[around:-around] = np.abs(q[2 * around :] - q[: -2 * around]) > moved_rad
        resting[around:-around] = high - low <= max(1.1 * (position_step(q) or 0.0), 1e-4)
    return moving, resting


def rest_law(
    signals: Sequence[np.ndarray],
    errors: Sequence[np.ndarray],
    resting: Sequence[np.ndarray],
    most_error: float = 0.25,
) -> RestLaw | None:
    """Fit how a signal depends on goal minus position at rest; None where the error varies too little.

    Args:
        signals: of one joint, one a recording, (samples,).
        errors: goal minus position, as `signals`, [rad].
        resting: rows at rest, as `signals`, bool.
        most_error: standard error of the exponent above which the law is rejected.
    """
    x = np.concatenate([s[rest] for s, rest in zip(signals, resting, strict=True)])
    e = np.concatenate([s[rest] for s, rest in zip(errors, resting, strict=True)])
    if len(x) < 100 or not x.any():
        return None
    odd = bool(x.min() < 0 < x.max() and (x * np.sign(e)).mean() > 0.5 * np.abs(x).mean())
    size, order = np.abs(e), np.argsort(np.abs(e))
    step = step_of(np.concatenate(signals)) or 0.0
    parts = [part for part in np.array_split(order, 12) if len(part)]  # the law is fitted to the means of 12 bins
    at = np.array([np.median(size[part]) for part in parts])
    level = np.array([np.mean(np.abs(x[part])) for part in parts])
    seen = (level > step) & (level < 0.9 * np.abs(x).max()) & (at > 0)  # less than a step is rounding
    if seen.sum() < 4 or at[seen].max() < 1.5 * at[seen].min():
        return None
    scatter = np.sqrt(0.05**2 + (0.5 * step / level[seen]) ** 2)  # of the logarithm: friction's 5 %, and half a step
    columns = np.column_stack([np.log(at[seen]), np.ones(seen.sum())]) / scatter[:, None]
    target = np.log(level[seen]) / scatter
    (exponent, offset), *_ = np.linalg.lstsq(columns, target, rcond=None)
    left = target - columns @ np.array([exponent, offset])
    wider = max(1.0, float(left @ left) / max(1, int(seen.sum()) - 2))
    error = float(np.sqrt(wider * np.linalg.inv(columns.T @ columns)[0, 0]))
    if error > most_error:
        return None
    whole = 2 if exponent > 1.5 else 1
    gain = float(level[seen] @ at[seen] ** whole / (at[seen] ** whole @ at[seen] ** whole))
    return RestLaw(float(exponent), error, gain, odd, len(x))
