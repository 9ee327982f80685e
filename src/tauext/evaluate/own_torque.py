"""The robot's own external torque as one more method: what a bundle must be compared with where there is one."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from tauext.config import EventsConfig
from tauext.data.free_motion import free_samples
from tauext.data.recording import Recording
from tauext.evaluate.events import EventMeasures


class OwnTorque:
    """Alarms where the recording's tau_ext column exceeds the largest that it showed in free time elsewhere."""

    def __init__(self, limit_nm: np.ndarray, config: EventsConfig, near_stiction_rad_s: float) -> None:
        self.limit_nm = limit_nm
        self._measures = EventMeasures(config, near_stiction_rad_s)
        self._complete = True

    def add(self, recording: Recording) -> None:
        """Take in one recording; where one has no tau_ext there is nothing to compare."""
        if recording.tau_ext is None:
            self._complete &= recording.contact is None or not (recording.contact == 1).any()
            return
        share = np.abs(recording.tau_ext) / self.limit_nm
        healthy = np.ones(recording.samples, dtype=bool)
        self._measures.add(recording, (share > 1).any(axis=1), healthy, share, recording.tau_ext)

    def summary(self) -> dict | None:
        """The entry `own_torque` of results.json; None where some recording with events has no tau_ext."""
        return {"limit_nm": self.limit_nm.tolist(), "events": self._measures.summary()} if self._complete else None


def own_limits(recordings: Iterable[Recording]) -> np.ndarray | None:
    """Largest |tau_ext| of each joint in free time, (joints,), [N m]; None where a recording has no such column, or a
    joint's is zero throughout, as a simulation's is."""
    largest = None
    for recording in recordings:
        if recording.tau_ext is None:
            return None
        free = free_samples(recording)
        here = np.abs(recording.tau_ext[free]).max(axis=0, initial=0)
        largest = here if largest is None else np.maximum(largest, here)
    return largest if largest is not None and (largest > 0).all() else None
