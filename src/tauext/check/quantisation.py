"""Quantisation step of a signal: of a register, an encoder or a velocity."""

from __future__ import annotations

import math

import numpy as np

MOST_VALUES = 200_000
"""Largest number of values used; they contain all levels of a coarse signal."""
LEAST_LEVELS = 3
FINEST = 1e-5
"""Least step as a share of the range; finer ones come from the number format."""
ROUNDED_TO = 6
"""Decimals to which positions are rounded, [rad]."""
NEAR = 0.01
"""Largest relative deviation of the counts a turn from a power of two, for rounded registers."""
FEWEST_BITS, MOST_BITS = 8, 24


def step_of(values: np.ndarray) -> float | None:
    """Step of which all values are whole multiples, up to one offset, in their unit; None: no such step.

    A signal in which every second value is a new level has no detectable step.

    Args:
        values: one signal of one joint, any order.
    """
    values = values[:: max(1, len(values) // MOST_VALUES)]
    levels = np.unique(values)
    if not LEAST_LEVELS <= len(levels) <= 0.5 * len(values):
        return None
    gaps = np.diff(levels)
    step = float(np.median(gaps[gaps < 1.5 * np.percentile(gaps, 10)]))
    if step <= FINEST * (levels[-1] - levels[0]):
        return None
    above = levels - levels[0]
    for reach in 8 ** np.arange(1, 9):  # refine: a step from few counts numbers more of them
        near = above < (reach + 0.5) * step
        counts = np.round(above[near] / step)
        step = float(counts @ above[near] / max(counts @ counts, 1.0)) or step
    counts = above / step
    return step if np.mean(np.abs(counts - np.round(counts)) < 0.02 + 1e-4 * counts) > 0.95 else None


def position_step(q: np.ndarray) -> float | None:
    """Step of an encoder, [rad]; None: too fine to detect, or too few positions.

    A step near a power of two of counts a turn is set to it: 2 pi / 4096 and not 0.001533951, since positions may be
    stored as float32.

    Args:
        q: positions of one joint, [rad].
    """
    step = step_of(np.round(q, ROUNDED_TO))  # removes rounding of single precision
    if step is None or step < 10.0 ** (1 - ROUNDED_TO):
        return None
    bits = math.log2(2 * math.pi / step)
    whole = round(bits)
    near = abs(2.0 ** (bits - whole) - 1) < NEAR and FEWEST_BITS <= whole <= MOST_BITS
    return 2 * math.pi / 2**whole if near else step
