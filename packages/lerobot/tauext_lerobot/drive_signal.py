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

AROUND_S = 0.1
"""Time before and after a sample: a joint rests if its position stays constant for so long, else it moves."""
PROBES = 11
"""Number of positions checked in that time, since a joint may move away and come back."""
MOVED_RAD = 0.004
"""Least travel of a moving joint in that time; 12-bit encoders count 0.0015 rad."""
LOW = 0.02
"""Share of a signal's 99th percentile up to which it counts as zero ..."""
HIGH = 0.2
"""... and above which it has left zero again."""
LEAST_VISITS = 10
"""Visits of zero during motion, without crossing, from which a signal is unsigned. A signed one crosses zero."""
LEAST_REST = 100
"""Fewest rows at rest for estimating a law."""
BINS = 12
"""Number of equally full bins of the position error; a law is fitted to their means."""
STEPS_SEEN = 1.0
"""Bin means below so many steps of the signal are rounding and left out."""
SCATTER = 0.05
"""Standard deviation of a bin's mean, as a share of it."""
LEAST_BINS = 4
SPREAD = 1.5
"""Least ratio of the largest to the smallest bin's position error for estimating an exponent ..."""
UNSURE = 0.25
"""... and standard error above which the exponent is rejected."""


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


def unsigned_visits(x: np.ndarray, moving: np.ndarray) -> int:
    """Count how often a signal reaches zero during motion and continues on the same side; 0 for signed ones.

    Args:
        x: the signal of one joint, (samples,).
        moving: whether the joint moves, (samples,) bool.
    """
    if x.min() < 0 < x.max() or not moving.any():
        return 0
    size = np.abs(x)
    top = float(np.percentile(size[moving], 99))
    step = step_of(x) or 0.0
    low, high = size <= max(LOW * top, 0.5 * step), size > max(HIGH * top, 1.5 * step)
    levels = np.where(high, 1, np.where(low & moving, -1, 0))
    levels = levels[levels != 0]
    return int(np.count_nonzero((levels[1:] == -1) & (levels[:-1] == 1)))


def motion_of(recording: Recording, j: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows at which a joint moves and at which it rests, (samples,) bool each; some rows are neither."""
    q = recording.q[:, j]
    around = max(1, round(AROUND_S * recording.rate_hz))
    moving, resting = np.zeros(len(q), dtype=bool), np.zeros(len(q), dtype=bool)
    if len(q) > 2 * around:
        shifts = np.unique(np.linspace(0, 2 * around, PROBES).round().astype(int))
        low = high = q[: len(q) - 2 * around]
        for shift in shifts[1:]:
            here = q[shift : len(q) - 2 * around + shift]
            low, high = np.minimum(low, here), np.maximum(high, here)
        moving[around:-around] = np.abs(q[2 * around :] - q[: -2 * around]) > MOVED_RAD
        resting[around:-around] = high - low <= max(1.1 * (position_step(q) or 0.0), 1e-4)
    return moving, resting


def rest_law(
    signals: Sequence[np.ndarray], errors: Sequence[np.ndarray], resting: Sequence[np.ndarray]
) -> RestLaw | None:
    """Fit how a signal depends on goal minus position at rest; None where the error varies too little.

    Args:
        signals: of one joint, one a recording, (samples,).
        errors: goal minus position, as `signals`, [rad].
        resting: rows at rest, as `signals`, bool.
    """
    x = np.concatenate([s[rest] for s, rest in zip(signals, resting, strict=True)])
    e = np.concatenate([s[rest] for s, rest in zip(errors, resting, strict=True)])
    if len(x) < LEAST_REST or not x.any():
        return None
    odd = bool(x.min() < 0 < x.max() and (x * np.sign(e)).mean() > 0.5 * np.abs(x).mean())
    size, order = np.abs(e), np.argsort(np.abs(e))
    step = step_of(np.concatenate(signals)) or 0.0
    parts = [part for part in np.array_split(order, BINS) if len(part)]
    at = np.array([np.median(size[part]) for part in parts])
    level = np.array([np.mean(np.abs(x[part])) for part in parts])
    seen = (level > STEPS_SEEN * step) & (level < 0.9 * np.abs(x).max()) & (at > 0)
    if seen.sum() < LEAST_BINS or at[seen].max() < SPREAD * at[seen].min():
        return None
    scatter = np.sqrt(SCATTER**2 + (0.5 * step / level[seen]) ** 2)  # of the logarithm: friction's, and half a step
    columns = np.column_stack([np.log(at[seen]), np.ones(seen.sum())]) / scatter[:, None]
    target = np.log(level[seen]) / scatter
    (exponent, offset), *_ = np.linalg.lstsq(columns, target, rcond=None)
    left = target - columns @ np.array([exponent, offset])
    wider = max(1.0, float(left @ left) / max(1, int(seen.sum()) - 2))
    error = float(np.sqrt(wider * np.linalg.inv(columns.T @ columns)[0, 0]))
    if error > UNSURE:
        return None
    whole = 2 if exponent > 1.5 else 1
    gain = float(level[seen] @ at[seen] ** whole / (at[seen] ** whole @ at[seen] ** whole))
    return RestLaw(float(exponent), error, gain, odd, len(x))
