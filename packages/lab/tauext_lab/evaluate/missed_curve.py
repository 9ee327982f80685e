"""Missed collisions against false alarms an hour, as all limits of a bundle are scaled by one factor."""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce

import numpy as np

from tauext.bundle.estimates import Estimates
from tauext.data.recording import Recording
from tauext.train.held_peaks import held_minimum, hold_lengths
from tauext_lab.evaluate.collisions import GRACE_S, Collision
from tauext_lab.evaluate.free_motion import FALSE_ALARM_QUIET_S
from tauext_lab.evaluate.results import CurvePoint

SCALES = np.sort(np.append(np.geomspace(0.05, 10, 60), 1.0))
"""Factors of the limits; 1, the bundle's own, is one of them."""


class MissedCurve:
    r"""Counts, for every factor s, the false alarms and missed collisions with limits s times as high.

    An alarm of limits s L holds at a sample exactly where

    .. math:: \rho(t) = \max_j \min_{t - hold \le t' \le t} |\tau_{ext,j}(t')| / L_j(t') > s

    so one pass over a recording serves all factors.
    """

    def __init__(self, hold_s: float) -> None:
        self._hold_s = hold_s
        self._hours = 0.0
        self._false = np.zeros(len(SCALES), dtype=int)
        self._peaks: list[float] = []

    def add_free(self, recording: Recording, estimates: Estimates) -> None:
        """Add one recording of free motion."""
        rho = held_ratio(estimates, self._hold_s)
        quiet = round(FALSE_ALARM_QUIET_S * recording.rate_hz)
        self._hours += estimates.healthy.sum() / recording.rate_hz / 3600
        at = np.arange(len(rho))
        for k, scale in enumerate(SCALES):  # a value over a limit is over all lower ones
            at = at[rho[at] > scale]
            if len(at) == 0:
                break
            self._false[k] += 1 + int((np.diff(at) > quiet).sum())

    def add_collisions(self, touches: Sequence[Collision], recording: Recording, estimates: Estimates) -> None:
        """Add the collisions of one recording, each by its largest ratio from onset to the end of the grace time."""
        if touches:
            rho = held_ratio(estimates, self._hold_s)
            grace = round(GRACE_S * recording.rate_hz)
            self._peaks += [float(rho[touch.begin : touch.end + grace].max()) for touch in touches]

    def summary(self) -> tuple[CurvePoint, ...]:
        """One point per factor."""
        peaks, hours = np.array(self._peaks), self._hours
        return tuple(
            CurvePoint(scale, false / hours if hours else None, int((peaks <= scale).sum()))
            for scale, false in zip(SCALES.tolist(), self._false.tolist(), strict=True)
        )


def held_ratio(estimates: Estimates, hold_s: float) -> np.ndarray:
    """rho of every sample, (samples,): see MissedCurve; 0 unless its whole hold time is past and healthy."""
    ratio = np.abs(estimates.tau_ext) / estimates.limit_nm
    held = held_minimum(ratio, estimates.healthy, hold_lengths(estimates.t_ns, hold_s))
    return np.nan_to_num(reduce(np.maximum, held.T))  # over joints; along short rows it would be slow
