"""What a servo tells of its drive: whether it has a sign, and how it goes with the error of position.

A position-controlled servo drives with a duty that is its gain times the error of position, limited. The current of
its motor follows the duty, less what its speed induces; the current of its supply is the motor's times the duty, hence
never negative while it drives, and at rest goes with the square of the duty.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tauext.data.quantum import position_step, step_of
from tauext.data.recording import Recording

AROUND_S = 0.1
"""To either side: a joint rests whose position keeps its place for so long, and moves where it does not."""
LOOKS = 11
"""At positions in that time: a joint that comes back in between rests at others."""
MOVED_RAD = 0.004
"""By which it then goes at least; encoders of 12 bits count 0.0015."""
LOW = 0.02
"""Share of a signal's 99th percentile up to which it is down at zero ..."""
HIGH = 0.2
"""... and above which it has left it again."""
LEAST_VISITS = 10
"""So often a signal comes down to zero while its joint moves, and goes on on the same side. A signed one crosses it."""
LEAST_REST = 100
"""Rows at rest from which on a law is told."""
BINS = 12
"""Of the error of position, equally full: their means are what a law goes through."""
STEPS_SEEN = 1.0
"""Steps of a signal below which its means are rounding."""
SCATTER = 0.05
"""Of a bin's mean, as a share of it."""
LEAST_BINS = 4
SPREAD = 1.5
"""Times which the largest bin's error of position is the smallest's, for an exponent to be told ..."""
UNSURE = 0.25
"""... and its standard error from which on it is not."""


@dataclass(frozen=True)
class RestLaw:
    """What a signal is of goal minus position at rest: sign as it has, size gain |error|^exponent."""

    exponent: float
    exponent_error: float
    gain: float
    """Of the whole exponent beside it, 1 or 2: unit of the signal per rad, or per rad^2."""
    odd: bool
    """Whether it has the sign of the error."""
    rows: int


def unsigned_visits(x: np.ndarray, moving: np.ndarray) -> int:
    """How often a signal comes down to zero while its joint moves and goes on on the same side; 0 for one with a sign.

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
    told = np.where(high, 1, np.where(low & moving, -1, 0))
    told = told[told != 0]
    return int(np.count_nonzero((told[1:] == -1) & (told[:-1] == 1)))


def motion_of(recording: Recording, j: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows at which a joint moves, and at which it rests, (samples,) bool each; those between the two are neither."""
    q = recording.q[:, j]
    around = max(1, round(AROUND_S * recording.rate_hz))
    moving, resting = np.zeros(len(q), dtype=bool), np.zeros(len(q), dtype=bool)
    if len(q) > 2 * around:
        shifts = np.unique(np.linspace(0, 2 * around, LOOKS).round().astype(int))
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
    """How a signal goes with goal minus position while the joint rests; None where the error varies too little.

    Args:
        signals: of one joint, one a recording, (samples,).
        errors: goal minus position, likewise, [rad].
        resting: rows at rest, likewise, bool.
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
    said = np.log(level[seen]) / scatter
    (exponent, offset), *_ = np.linalg.lstsq(columns, said, rcond=None)
    left = said - columns @ np.array([exponent, offset])
    wider = max(1.0, float(left @ left) / max(1, int(seen.sum()) - 2))
    error = float(np.sqrt(wider * np.linalg.inv(columns.T @ columns)[0, 0]))
    if error > UNSURE:
        return None
    whole = 2 if exponent > 1.5 else 1
    gain = float(level[seen] @ at[seen] ** whole / (at[seen] ** whole @ at[seen] ** whole))
    return RestLaw(float(exponent), error, gain, odd, len(x))
