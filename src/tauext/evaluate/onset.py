"""When an event really began: labels are late or early by tens of milliseconds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tauext.data.recording import Recording

BASELINE_S = 0.1
"""A reference is measured from its mean over so long before the window."""
SLOPE_S = 0.02
"""Of the residual's derivative."""
QUANTILE, RESERVE = 0.999, 1.5


def onset_s(
    recording: Recording, windows: Sequence[tuple[float, float]], residual: np.ndarray, free: np.ndarray
) -> list[float | None]:
    """The first time in each window at which the reference leaves its noise band on some joint, [s]; None: it does not.

    The reference is the robot's own tau_ext, measured from its mean over the 0.1 s before the window; where the
    recording has none, the change of the residual over 20 ms, which lags a step by little. A joint's noise band is 1.5
    times what 99.9 % of the free samples stay within, these measured from the mean of the 0.1 s that ended 0.1 s
    earlier, all of it free. Without such samples there is no band, and no onset.

    Args:
        windows: from and to, counted from the first sample, [s].
        residual: (samples, joints), [N m]; NaN counts as zero.
        free: (samples,) bool.
    """
    if not windows:
        return []
    time_s = recording.time_s
    if recording.tau_ext is not None:
        signal = recording.tau_ext
        ago = signal - means(time_s, signal, time_s - 2 * BASELINE_S, time_s - BASELINE_S)
    else:
        residual = np.nan_to_num(residual.astype(float))
        before = np.clip(np.searchsorted(time_s, time_s - SLOPE_S), 0, None)
        signal = ago = residual - residual[before]
    busy = np.append(0, np.cumsum(~free))
    began = np.searchsorted(time_s, time_s - 2 * BASELINE_S)
    usable = (busy[1:] == busy[began]) & (time_s > 2 * BASELINE_S)
    if not usable.any():
        return [None] * len(windows)
    band = RESERVE * np.quantile(np.abs(ago[usable]), QUANTILE, axis=0)
    onsets: list[float | None] = []
    for begin_s, end_s in windows:
        inside = np.flatnonzero((time_s >= begin_s) & (time_s <= end_s))
        level = np.zeros(signal.shape[1])
        if recording.tau_ext is not None:
            level = means(time_s, signal, np.array([begin_s - BASELINE_S]), np.array([begin_s]))[0]
        left = inside[(np.abs(signal[inside] - level) > band).any(axis=1)]
        onsets.append(float(time_s[left[0]]) if len(left) else None)
    return onsets


def means(time_s: np.ndarray, signal: np.ndarray, from_s: np.ndarray, to_s: np.ndarray) -> np.ndarray:
    """Mean of a signal over stretches of time, at least one sample each, (stretches, joints)."""
    sums = np.vstack([np.zeros((1, signal.shape[1])), np.cumsum(signal, axis=0)])
    first = np.clip(np.searchsorted(time_s, from_s), 0, len(time_s) - 1)
    last = np.maximum(np.searchsorted(time_s, to_s), first + 1)
    return (sums[last] - sums[first]) / (last - first)[:, None]
