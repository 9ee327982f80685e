"""Samples in order of time: late packets, repeated stamps, repeated measurements, gaps."""

from __future__ import annotations

from collections import Counter

import numpy as np

REPEAT_S = 0.1
"""Rows that stay the same for no longer than this repeat one measurement; longer, the arm or its sensor stands."""
GAP_STEPS = 1.5
"""A step of more than so many median steps is a gap: at least a sample is missing."""
BRIDGE_STEPS = 2.5
"""Over more than so many median steps nothing is interpolated or differentiated."""


def ordered(t_ns: np.ndarray, values: np.ndarray, counts: Counter[str]) -> tuple[np.ndarray, np.ndarray]:
    """Rows sorted by time, the first of each stamp kept; what was done is counted.

    Args:
        t_ns: (samples,) int64, [ns], in any order.
        values: (samples, columns).
    """
    late = t_ns < np.maximum.accumulate(t_ns)
    if late.any():
        counts["samples out of order, sorted by their stamps"] += int(late.sum())
        order = np.argsort(t_ns, kind="stable")
        t_ns, values = t_ns[order], values[order]
    again = np.r_[False, t_ns[1:] == t_ns[:-1]]
    if again.any():
        rows = np.flatnonzero(again)
        same = _same_as_before(values)[rows]
        counts["samples dropped: stamp and values repeat the sample before"] += int(same.sum())
        counts["samples dropped: stamp repeats the sample before, values differ"] += int((~same).sum())
        t_ns, values = t_ns[~again], values[~again]
    return t_ns, values


def fresh(t_ns: np.ndarray, measured: np.ndarray, drop: bool, counts: Counter[str]) -> np.ndarray:
    """Rows that are measurements of their own, (samples,) bool: the first of each run of equal rows up to 0.1 s long.

    A longer run is kept whole: an arm at rest without noise, or a stuck sensor. `drop` false keeps all, and counts.

    Args:
        t_ns: (samples,), increasing, [ns].
        measured: (samples, columns) as the sensors gave them.
    """
    again = _same_as_before(measured)
    begins = np.flatnonzero(~again)
    lengths = np.diff(np.r_[begins, len(t_ns)])
    lasts = begins + lengths - 1
    standing = (t_ns[lasts] - t_ns[begins]) * 1e-9 > REPEAT_S
    long_run = np.repeat(standing, lengths)
    counts["samples that stay the same for more than 0.1 s kept: at rest, or stuck"] += int((again & long_run).sum())
    repeats = again & ~long_run
    counts[f"repeated samples {'dropped' if drop else 'kept'}: all values equal the sample before"] += int(
        repeats.sum()
    )
    return ~repeats if drop else np.ones(len(t_ns), bool)


def count_gaps(t_ns: np.ndarray, counts: Counter[str]) -> float:
    """Longest step, [s], 0 for a single sample; steps that are gaps are counted."""
    if len(t_ns) < 2:
        return 0.0
    steps = np.diff(t_ns)
    counts[f"gaps: steps of more than {GAP_STEPS:g} median steps"] += int((steps > GAP_STEPS * np.median(steps)).sum())
    return float(steps.max()) * 1e-9


def lost_share(t_ns: np.ndarray) -> float:
    """Share of the samples that gaps left out, were all steps the median one; stamps increasing, (samples,), [ns]."""
    if len(t_ns) < 2:
        return 0.0
    steps = np.diff(t_ns)
    lost = float((np.round(steps[steps > GAP_STEPS * np.median(steps)] / np.median(steps)) - 1).sum())
    return lost / (lost + len(t_ns))


def _same_as_before(values: np.ndarray) -> np.ndarray:
    return np.r_[False, (values[1:] == values[:-1]).all(axis=1)] if values.shape[1] else np.zeros(len(values), bool)
