"""Signals of several clocks onto the stamps of one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from tauext.data.stamps import BRIDGE_STEPS, fitted_period_ns

Table = tuple[np.ndarray, np.ndarray]
"""Stamps (samples,), [ns], increasing, and values (samples, columns)."""


def base_stream(tables: Mapping[str, Table], torque: str, essential: Sequence[str]) -> str:
    """The stream whose stamps all others are brought to: the torque's, or one of the essential ones that is slower.

    Interpolating a slow signal onto fast stamps would invent samples; slower: a sample period over 1.5 times as long.
    """
    steps = {name: fitted_period_ns(tables[name][0]) if len(tables[name][0]) > 1 else 0.0 for name in essential}
    slowest = max(essential, key=lambda name: steps[name])
    return slowest if steps[slowest] > 1.5 * steps[torque] else torque


def interpolated(t_ns: np.ndarray, table: Table, counts: Counter[str], name: str) -> tuple[np.ndarray, np.ndarray]:
    """Values (samples, columns) of another clock at these times, linear between neighbours, and where they are known.

    Unknown, (samples,) false: before its first or after its last sample, or between neighbours of more than 2.5 of its
    sample periods.
    """
    times, values = table
    if len(times) < 2:
        return np.repeat(values[:1], len(t_ns), axis=0), np.isin(t_ns, times)
    after = np.clip(np.searchsorted(times, t_ns), 1, len(times) - 1)
    left, right = times[after - 1], times[after]
    share = ((t_ns - left) / (right - left))[:, None]
    mixed = values[after - 1] * (1 - share) + values[after] * share
    inside = (t_ns >= times[0]) & (t_ns <= times[-1])
    near = (right - left <= BRIDGE_STEPS * fitted_period_ns(times)) | (t_ns == left) | (t_ns == right)
    counts[f"samples dropped: no {name} within its time range, or in a gap of it"] += int((~(inside & near)).sum())
    return mixed, inside & near


def held(t_ns: np.ndarray, table: Table, unknown: float) -> np.ndarray:
    """Last values (samples, columns) of another clock at or before these times; `unknown` before its first."""
    times, values = table
    before = np.searchsorted(times, t_ns, side="right") - 1
    return np.where((before >= 0)[:, None], values[np.maximum(before, 0)], unknown)
