"""Stretches of time in which something holds: contacts, alarms, gaps, health that is not ok."""

from __future__ import annotations

import numpy as np

from tauext.bundle.estimates import COLLISION, CONTACT, Estimates

Stretch = tuple[float, float]
APART_S = 0.1
"""Alarms closer together are one, as `tauext evaluate` counts them."""


def stretches(holds: np.ndarray, time_s: np.ndarray, apart_s: float = 0.0) -> list[Stretch]:
    """First and last time of every stretch in which it holds, [s]; those closer than apart_s are one."""
    at = np.flatnonzero(holds)
    if len(at) == 0:
        return []
    parts = np.flatnonzero((np.diff(at) > 1) & (time_s[at[1:]] - time_s[at[:-1]] >= apart_s))
    return [
        (float(a), float(b))
        for a, b in zip(time_s[at[np.append(0, parts + 1)]], time_s[at[np.append(parts, len(at) - 1)]], strict=True)
    ]


def alarms(estimates: Estimates, time_s: np.ndarray) -> list[tuple[float, float, int]]:
    """First and last time of every alarm and its level, collisions first.

    A monitor's are latched; without a monitor they last as long as they are held. Of detections, where no alarms are
    known.
    """
    level_at = estimates.held_alarm if estimates.alarm is None else estimates.alarm
    if level_at is None:
        return [(*one, COLLISION) for one in stretches(estimates.detection, time_s, APART_S)]
    return [(*one, level) for level in (COLLISION, CONTACT) for one in stretches(level_at == level, time_s, APART_S)]


def gaps(t_ns: np.ndarray, gap_ns: float) -> list[Stretch]:
    """The samples before and after every step longer than gap_ns, [s] from the first."""
    at = np.flatnonzero(np.diff(t_ns) > gap_ns)
    return [(float(t_ns[k] - t_ns[0]) * 1e-9, float(t_ns[k + 1] - t_ns[0]) * 1e-9) for k in at]
