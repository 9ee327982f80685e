"""Alarms on recordings of the simulated servo arm against what is true of them: one judge for every method."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from tauext.bundle.estimates import COLLISION, Estimates
from tauext.config import EventsConfig
from tauext.data.recording import Recording
from tauext.evaluate.collisions import GRACE_S, Collision, find_collisions, first_rise, judge_latched
from tauext.evaluate.errors import sensor_reference
from tauext.evaluate.events import event_time
from tauext.evaluate.free_motion import FALSE_ALARM_QUIET_S, beginnings, time_since_touch

AFTER_CONTACT_S = 3.0
"""An alarm so soon after a contact is counted apart: the arm snaps back, and its gears settle."""


@dataclass
class Verdicts:
    """One method on all test recordings of one rate."""

    peaks_nm: list[float] = field(default_factory=list)
    """Largest true torque of each contact."""
    found: list[bool] = field(default_factory=list)
    strong: list[bool] = field(default_factory=list)
    """Over 1.5 times the limits of the method that limits are known of, for its hold time and 20 ms."""
    delays_s: list[float] = field(default_factory=list)
    false_free: int = 0
    false_after: int = 0
    free_hours: float = 0.0

    def add(self, recording: Recording, alarm: np.ndarray, healthy: np.ndarray) -> list[Collision]:
        """Take in one recording, with contacts or without; says its contacts.

        Args:
            alarm: (samples,) bool.
            healthy: (samples,) bool: while a method can say nothing, time is not free.
        """
        free = ~event_time(recording, EventsConfig().tolerance_s) & healthy
        self.free_hours += float(free.sum()) / recording.rate_hz / 3600
        begun = beginnings(alarm, round(FALSE_ALARM_QUIET_S * recording.rate_hz))
        since_s = time_since_touch(recording) if recording.contact is not None else np.full(recording.samples, np.inf)
        false_since_s = since_s[begun[free[begun]]]
        after = int((false_since_s <= AFTER_CONTACT_S).sum())
        self.false_after, self.false_free = self.false_after + after, self.false_free + len(false_since_s) - after
        touches = find_collisions(recording)
        for touch in touches:
            window = slice(touch.begin, min(touch.end + round(GRACE_S * recording.rate_hz), recording.samples))
            rise = first_rise(alarm[window], bool(alarm[touch.begin - 1]))
            self.peaks_nm.append(float(touch.true_peak_nm.max()))
            self.found.append(rise is not None)
            if rise is not None:
                self.delays_s.append(float(recording.t_ns[window][rise] - recording.t_ns[touch.begin]) * 1e-9)
        return touches

    def add_estimates(self, recording: Recording, estimates: Estimates, hold_s: float, gain_per_s: float) -> None:
        """Take in what a bundle said, as a monitor would have latched it."""
        touches = self.add(recording, estimates.held_alarm == COLLISION, estimates.healthy)
        reference = sensor_reference(recording, gain_per_s)
        self.strong += [judge_latched(t, recording, estimates, hold_s, reference)["strong"] for t in touches]

    def found_among(self, chosen: Sequence[bool] | np.ndarray) -> tuple[int, int]:
        """Found, and how many there are, of the contacts that are chosen."""
        chosen = np.asarray(chosen, dtype=bool)
        return int(np.array(self.found)[chosen].sum()), int(chosen.sum())


def at_as_many_false(judged: Callable[[float], Verdicts], false: int) -> tuple[float, Verdicts]:
    """Limits times the smallest of many factors that leaves a method with no more false alarms than another has."""
    for factor in np.geomspace(0.2, 20, 60):
        verdicts = judged(float(factor))
        if verdicts.false_free + verdicts.false_after <= false:
            return float(factor), verdicts
    return float(factor), verdicts
