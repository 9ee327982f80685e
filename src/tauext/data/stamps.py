"""Samples in order of time: late packets, repeated stamps, repeated measurements, gaps."""

from __future__ import annotations

from collections import Counter

import numpy as np

REPEAT_S = 0.1
"""Rows that stay the same for no longer than this repeat one measurement; longer, the arm or its sensor stands."""
GAP_STEPS = 1.75
"""A step of so many periods or more lost samples; a shorter one is jitter (SignalWatch::kGap)."""
LONGEST_FITTED = 10
"""Periods: a longer step is a pause, and says little about the period."""
BRIDGE_STEPS = 2.5
"""Over more than so many sample periods nothing is interpolated or differentiated."""


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


def fitted_period_ns(t_ns: np.ndarray) -> float:
    """Sample period, [ns], fitted together with the number of periods in each step.

    The period is the time of the steps over the periods in them. Lost samples do not
    lengthen it, as they do the mean; steps that are often a little longer do, unlike the median.

    Args:
        t_ns: increasing, (samples,), at least two, [ns].
    """
    steps = np.diff(t_ns)
    period = float(np.median(steps))
    for _ in range(20):  # most take two
        ticks = periods_of(steps, period)
        fitted = steps <= LONGEST_FITTED * period
        if not fitted.any():
            return period
        before, period = period, float(steps[fitted].sum() / ticks[fitted].sum())
        if abs(period - before) < 1e-9 * before:
            break
    return period


def periods_of(steps_ns: np.ndarray, period_ns: float) -> np.ndarray:
    """Sample periods in each step, a whole number >= 1: more than one where samples were lost.

    A sample that only came late is none that is lost: short steps soon after make up for the long one.
    """
    ratio = steps_ns / period_ns
    whole = np.round(ratio)
    made_up = np.r_[0.0, np.cumsum(np.where(ratio < 0.5, 1 - ratio, 0.0))]
    soon = np.minimum(np.arange(len(ratio)) + 1 + LONGEST_FITTED, len(ratio))
    late = made_up[soon] - made_up[:-1] > 0.5 * (whole - 1)
    return np.where((ratio >= GAP_STEPS) & ~late, whole, 1.0)


def lost_samples(t_ns: np.ndarray) -> np.ndarray:
    """Samples lost in each step, (samples - 1,); stamps increasing, (samples,), [ns]."""
    if len(t_ns) < 2:
        return np.zeros(0)
    return periods_of(np.diff(t_ns), fitted_period_ns(t_ns)) - 1


def _same_as_before(values: np.ndarray) -> np.ndarray:
    return np.r_[False, (values[1:] == values[:-1]).all(axis=1)] if values.shape[1] else np.zeros(len(values), bool)
