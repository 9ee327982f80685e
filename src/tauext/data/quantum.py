"""The step in which a signal counts: that of a register, of an encoder, of a velocity."""

from __future__ import annotations

import math

import numpy as np

LOOKED_AT = 200_000
"""Values that are looked at: all levels of a coarse signal are among them."""
LEAST_LEVELS = 3
FINEST = 1e-5
"""Share of the range that a step is at least: finer ones are those of the number's own precision."""
ROUNDED_TO = 6
"""Decimals of a position, [rad], that count."""
NEAR = 0.01
"""Share by which a turn's counts may be off a power of two: a register that is told in rounded numbers."""
FEWEST_BITS, MOST_BITS = 8, 24


def step_of(values: np.ndarray) -> float | None:
    """Step of which all values are whole multiples but for one offset, in their unit; None where there is none.

    A signal whose every second value is a level of its own counts too finely to tell.

    Args:
        values: one signal of one joint, any order.
    """
    values = values[:: max(1, len(values) // LOOKED_AT)]
    levels = np.unique(values)
    if not LEAST_LEVELS <= len(levels) <= 0.5 * len(values):
        return None
    gaps = np.diff(levels)
    step = float(np.median(gaps[gaps < 1.5 * np.percentile(gaps, 10)]))
    if step <= FINEST * (levels[-1] - levels[0]):
        return None
    above = levels - levels[0]
    for reach in 8 ** np.arange(1, 9):  # what is known of a few counts tells the number of more, and those the step
        near = above < (reach + 0.5) * step
        counts = np.round(above[near] / step)
        step = float(counts @ above[near] / max(counts @ counts, 1.0)) or step
    counts = above / step
    return step if np.mean(np.abs(counts - np.round(counts)) < 0.02 + 1e-4 * counts) > 0.95 else None


def position_step(q: np.ndarray) -> float | None:
    """Step of an encoder, [rad]; None where it is too fine to tell, or the joint takes too few places.

    Encoders that count a power of two a turn are told from positions stored as float32 by that: 2 pi / 4096 and not
    0.001533951.

    Args:
        q: positions of one joint, [rad].
    """
    step = step_of(np.round(q, ROUNDED_TO))  # rounding of single precision is no level
    if step is None or step < 10.0 ** (1 - ROUNDED_TO):
        return None
    bits = math.log2(2 * math.pi / step)
    whole = round(bits)
    near = abs(2.0 ** (bits - whole) - 1) < NEAR and FEWEST_BITS <= whole <= MOST_BITS
    return 2 * math.pi / 2**whole if near else step
