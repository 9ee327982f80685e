"""Alarms against labelled events, and the same for the robot's own external torque."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from tauext.bundle.estimates import COLLISION, Estimates
from tauext.data.free_motion import free_samples
from tauext.data.recording import Recording
from tauext_lab.evaluate.collisions import Onsets, delay_quantiles
from tauext_lab.evaluate.config import EventsConfig
from tauext_lab.evaluate.free_motion import FALSE_ALARM_QUIET_S, beginnings, time_since_touch
from tauext_lab.evaluate.results import EventCounts, Events, EventVerdict, FalseAlarm, OtherEvents, OwnTorqueEvents
from tauext_lab.other_methods import OtherMethod

# --- Alarms against labelled events with uncertain edges: found, false, delays; moving and resting apart.


JOINED_S = 0.05
"""Labelled stretches closer together than this are one event: a label flickers."""
MOVING_OVER_S = 0.25


@dataclass(frozen=True)
class LabelledTouch:
    """One labelled stretch; times count from its recording's first sample, [s]."""

    id: str
    recording: str
    start_s: float
    end_s: float
    moving: bool


def labelled_events(
    recording: Recording, config: EventsConfig, near_stiction_rad_s: float
) -> tuple[list[LabelledTouch], int]:
    """The events of a recording that last shortest_event_s or longer, and the number of shorter ones."""
    at = np.flatnonzero(recording.contact == 1) if recording.contact is not None else np.zeros(0, dtype=int)
    if len(at) == 0:
        return [], 0
    time_s, moving = recording.time_s, is_moving(recording, near_stiction_rad_s)
    breaks = np.flatnonzero(np.diff(time_s[at]) > JOINED_S)
    firsts, lasts = at[np.append(0, breaks + 1)], at[np.append(breaks, len(at) - 1)]
    events = [
        LabelledTouch(f"{recording.name}:{k}", recording.name, float(time_s[a]), float(time_s[b]), bool(moving[a]))
        for k, (a, b) in enumerate(zip(firsts, lasts, strict=True))
    ]
    period_s = 1 / recording.rate_hz
    long = [event for event in events if event.end_s - event.start_s + period_s >= config.shortest_event_s]
    return long, len(events) - len(long)


def is_moving(recording: Recording, near_stiction_rad_s: float) -> np.ndarray:
    """Whether some joint's mean speed over a quarter of a second before or after a sample is above near stiction.

    By position, since the measured speed of a standing arm may be noise of more than that. (samples,) bool.
    """
    time_s, moving = recording.time_s, np.zeros(recording.samples, dtype=bool)
    for step_s in (-MOVING_OVER_S, MOVING_OVER_S):
        other = np.clip(np.searchsorted(time_s, time_s + step_s), 0, recording.samples - 1)
        moving |= (np.abs(recording.q[other] - recording.q) > near_stiction_rad_s * MOVING_OVER_S).any(axis=1)
    return moving


def event_time(recording: Recording, tolerance_s: float) -> np.ndarray:
    """Whether a sample is in a labelled stretch of any length, in the tolerance around it, or unknown: (samples,) bool.

    All other time is free. A recording without labels is free throughout.
    """
    contact = recording.contact
    if contact is None:
        return np.zeros(recording.samples, dtype=bool)
    time_s, at = recording.time_s, np.flatnonzero(contact == 1)
    first = np.searchsorted(time_s, time_s[at] - tolerance_s)
    last = np.searchsorted(time_s, time_s[at] + tolerance_s, side="right")
    steps = np.bincount(first, minlength=recording.samples + 1) - np.bincount(last, minlength=recording.samples + 1)
    return (np.cumsum(steps)[:-1] > 0) | (contact == -1)


class Labels:
    """A recording's labels, the same for every method.

    Args:
        config: how labels are read.
        near_stiction_rad_s: speed below which a joint rests.
    """

    def __init__(self, recording: Recording, config: EventsConfig, near_stiction_rad_s: float) -> None:
        self.recording, self.tolerance_s = recording, config.tolerance_s
        self.events, self.short = labelled_events(recording, config, near_stiction_rad_s)
        self.busy = event_time(recording, config.tolerance_s)
        self.moving = is_moving(recording, near_stiction_rad_s)
        known = recording.contact is not None
        self.since_s = time_since_touch(recording) if known else np.full(recording.samples, np.nan)
        self.onsets = Onsets(recording, [(event.start_s - config.tolerance_s, event.end_s) for event in self.events])


@dataclass
class EventMeasures:
    """One method's alarms on all recordings, added one by one."""

    config: EventsConfig
    _verdicts: list[EventVerdict] = field(default_factory=list)
    _false_alarms: list[FalseAlarm] = field(default_factory=list)
    _left_out: int = 0
    _free_s: np.ndarray = field(default_factory=lambda: np.zeros(2))  # resting, moving

    def add(self, labels: Labels, alarm: np.ndarray, healthy: np.ndarray, share: np.ndarray, r: np.ndarray) -> None:
        """Add one recording, with contacts or without.

        Args:
            alarm: (samples,) bool.
            healthy: (samples,) bool: an event that begins in unhealthy time is not counted, nor is such time free.
            share: |tau_ext| over its limit, (samples, joints): the largest names the joint.
            r: a signal to re-time onsets by where the recording has no tau_ext, (samples, joints), [N m].
        """
        recording, moving = labels.recording, labels.moving
        self._left_out += labels.short
        free = ~labels.busy & healthy
        quiet = round(FALSE_ALARM_QUIET_S * recording.rate_hz)
        begun = beginnings(alarm, quiet)
        for state in (0, 1):
            self._free_s[state] += (free & (moving == bool(state))).sum() / recording.rate_hz
        time_s, tolerance_s = recording.time_s, labels.tolerance_s
        for k in begun[free[begun]].tolist():
            since = float(labels.since_s[k]) if np.isfinite(labels.since_s[k]) else None
            self._false_alarms.append(FalseAlarm(recording.name, float(time_s[k]), bool(moving[k]), since))
        rises = np.flatnonzero(alarm & ~np.append(False, alarm[:-1]))
        for event, onset in zip(labels.events, labels.onsets.find(r, free), strict=True):
            if not healthy[np.searchsorted(time_s, event.start_s)]:
                self._left_out += 1
                continue
            window = (event.start_s - tolerance_s <= time_s[rises]) & (time_s[rises] <= event.end_s + tolerance_s)
            found = rises[window][0] if window.any() else None
            self._verdicts.append(
                EventVerdict(
                    id=event.id,
                    recording=event.recording,
                    start_s=event.start_s,
                    end_s=event.end_s,
                    onset_s=onset,
                    moving=event.moving,
                    found=found is not None,
                    joint=None if found is None else recording.joints[int(np.argmax(share[found]))],
                    delay_s=None if found is None else float(time_s[found] - event.start_s),
                    delay_from_onset_s=None if found is None or onset is None else float(time_s[found] - onset),
                )
            )

    def add_estimates(self, labels: Labels, estimates: Estimates) -> None:
        """Add a bundle's estimates: collisions as a monitor would have latched them."""
        alarm = estimates.healthy & (estimates.held_alarm == COLLISION)
        share = np.abs(np.nan_to_num(estimates.tau_ext)) / estimates.limit_nm
        self.add(labels, alarm, estimates.healthy, share, estimates.residual)

    def summary(self) -> Events:
        return Events(
            shortest_event_s=self.config.shortest_event_s,
            tolerance_s=self.config.tolerance_s,
            left_out=self._left_out,
            all=self._counts((0, 1)),
            resting=self._counts((0,)),
            moving=self._counts((1,)),
            verdicts=tuple(self._verdicts),
            false_alarms_at=tuple(self._false_alarms),
        )

    def _counts(self, states: Sequence[int]) -> EventCounts:
        chosen = [v for v in self._verdicts if v.moving in states]
        hours = float(self._free_s[list(states)].sum()) / 3600
        false = sum(alarm.moving in states for alarm in self._false_alarms)
        delays = delay_quantiles(v.delay_s for v in chosen) + delay_quantiles(v.delay_from_onset_s for v in chosen)
        found = sum(v.found for v in chosen)
        return EventCounts(len(chosen), found, *delays, hours, false, false / hours if hours else None)


# --- The robot's own external torque as one more method to compare with, if recorded.


class OwnTorque:
    """Alarms of the recording's tau_ext column; the limit is its largest value in free time of other recordings."""

    def __init__(self, limit_nm: np.ndarray, config: EventsConfig) -> None:
        self.limit_nm = limit_nm
        self._measures = EventMeasures(config)
        self._complete = True

    def add(self, labels: Labels) -> None:
        """Add one recording; one without tau_ext ends the comparison."""
        recording = labels.recording
        if recording.tau_ext is None:
            self._complete &= recording.contact is None or not (recording.contact == 1).any()
            return
        share = np.abs(recording.tau_ext) / self.limit_nm
        healthy = np.ones(recording.samples, dtype=bool)
        self._measures.add(labels, (share > 1).any(axis=1), healthy, share, recording.tau_ext)

    def summary(self) -> OwnTorqueEvents | None:
        """None if some recording with events has no tau_ext."""
        return OwnTorqueEvents(tuple(self.limit_nm.tolist()), self._measures.summary()) if self._complete else None


@dataclass
class OtherMeasures:
    """Alarms of a method that makes no bundle."""

    name: str
    other: OtherMethod
    measures: EventMeasures

    def add(self, labels: Labels) -> None:
        """Add one recording."""
        ratio = self.other.ratio(labels.recording)
        healthy = np.ones(labels.recording.samples, dtype=bool)
        self.measures.add(labels, np.any(ratio > 1, axis=1), healthy, ratio, ratio)

    def summary(self) -> OtherEvents:
        return OtherEvents(self.name, self.measures.summary())


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
