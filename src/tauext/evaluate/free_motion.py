"""How wrong the estimate is where nothing touches the arm: there tau_ext is the error."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from tauext.bundle.estimates import COLLISION, Estimates
from tauext.data.recording import Recording

FALSE_ALARM_QUIET_S = 0.5
"""Detections closer together than this are one false alarm."""


@dataclass
class FreeMotionErrors:
    """Sums over the healthy samples of test recordings, a joint each."""

    joints: int
    near_stiction_rad_s: float = 0.02
    """Of the paper's two regions, by which errors of all bundles are told apart, whatever their limits go by."""
    recordings: list[str] = field(default_factory=list)
    samples: int = 0
    seconds: float = 0.0
    false_alarms: int = 0
    """Of single samples over a limit."""
    false_collisions: int = 0
    """That were held: what a monitor would have latched."""

    def __post_init__(self) -> None:
        zeros = np.zeros(self.joints)
        self._l1, self._square, self._near_square, self._near = (zeros.copy() for _ in range(4))
        self._largest_r = zeros.copy()

    def add(self, recording: Recording, estimates: Estimates) -> None:
        """Take in one recording of free motion."""
        healthy = estimates.healthy
        error = estimates.tau_ext[healthy].astype(float)
        near = np.abs(recording.dq[healthy]) < self.near_stiction_rad_s
        square = error**2
        ones = np.ones(len(error))  # sums as products: along so short rows they would take ten times as long
        self._l1 += ones @ np.abs(error)
        self._square += ones @ square
        self._near_square += ones @ np.where(near, square, 0)
        self._near += ones @ near
        largest = [np.abs(column).max(initial=0) for column in estimates.r[healthy].T]
        self._largest_r = np.maximum(self._largest_r, largest)
        self.samples += int(healthy.sum())
        self.seconds += healthy.sum() / recording.rate_hz
        self.recordings.append(recording.name)
        quiet = round(FALSE_ALARM_QUIET_S * recording.rate_hz)
        self.false_alarms += count_episodes(estimates.detection, quiet)
        if estimates.held_alarm is not None:
            self.false_collisions += count_episodes(estimates.held_alarm == COLLISION, quiet)

    def summary(self) -> dict:
        """The entry `free_motion` of results.json."""
        sliding = self.samples - self._near
        with np.errstate(invalid="ignore", divide="ignore"):
            mse = self._square / self.samples
            near_rmse = np.sqrt(self._near_square / self._near)
            sliding_rmse = np.sqrt((self._square - self._near_square) / sliding)
        hours = self.seconds / 3600
        return {
            "recordings": self.recordings,
            "hours": hours,
            "samples": self.samples,
            "l1_nm": numbers(self._l1 / max(self.samples, 1)),
            "l2_nm": numbers(np.sqrt(mse)),
            "mse_nm2": numbers(mse),
            "rmse_near_stiction_nm": numbers(near_rmse),
            "rmse_sliding_nm": numbers(sliding_rmse),
            "near_stiction_share": numbers(self._near / max(self.samples, 1)),
            "observer_peak_nm": numbers(self._largest_r),
            "false_alarms": self.false_alarms,
            "false_alarms_per_hour": self.false_alarms / hours if hours else None,
            "false_collisions": self.false_collisions,
        }


def count_episodes(flags: np.ndarray, quiet_samples: int) -> int:
    """Runs of true flags, those less than quiet_samples apart counted as one."""
    at = np.flatnonzero(flags)
    return 0 if len(at) == 0 else 1 + int((np.diff(at) > quiet_samples).sum())


def numbers(values: np.ndarray) -> list[float | None]:
    """For JSON, which knows no NaN: null where a number does not exist."""
    return [float(v) if np.isfinite(v) else None for v in values]
