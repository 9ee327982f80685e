"""Detectors that know nothing, judged as the methods are: what a number is worth that they reach as well."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from tauext.bundle.estimates import COLLISION, Estimates
from tauext.data.recording import Recording
from tauext.evaluate.collisions import GRACE_S, Collision
from tauext.evaluate.free_motion import FALSE_ALARM_QUIET_S
from tauext.evaluate.latched import judge_latched

RANDOM_PER_HOUR = 60.0
RANDOM_S = 0.1
WORTH = {
    "always": "in alarm at every collision, but at every other moment too: one unbroken alarm, which latches nothing",
    "never": "no false alarm, and no collision",
    "random": f"alarms of {RANDOM_S:g} s at random times, {RANDOM_PER_HOUR:g} an hour: what is found so is chance",
}


@dataclass
class Sanity:
    """One such detector; takes in the recordings that the methods are evaluated on, in their order."""

    name: str
    """always, never or random."""
    seed: int
    _false: int = 0
    _alarmed: int = 0
    _samples: int = 0
    _hours: float = 0.0
    _in_alarm: bool = False
    _found: list[bool] = field(default_factory=list)
    _latched: list[bool] = field(default_factory=list)

    def add_free(self, number: int, recording: Recording) -> None:
        """Take in one recording of free motion; an alarm that goes on from the one before is no new one."""
        alarm = self.alarms(number, recording)
        at = np.flatnonzero(alarm)
        apart = np.diff(at) > round(FALSE_ALARM_QUIET_S * recording.rate_hz)
        self._false += (len(at) > 0 and not (self._in_alarm and alarm[0])) + int(apart.sum())
        self._in_alarm = bool(alarm[-1])
        self._alarmed += len(at)
        self._samples += recording.samples
        self._hours += recording.samples / recording.rate_hz / 3600

    def add_collisions(
        self, number: int, touches: Sequence[Collision], recording: Recording, estimates: Estimates
    ) -> None:
        """Take in the collisions of one recording; of the estimates only the times and limits count."""
        alarm = self.alarms(number, recording)
        said = replace(estimates, held_alarm=np.where(alarm, COLLISION, 0).astype(np.int8))
        for touch in touches:
            self._latched.append(judge_latched(touch, recording, said, 0.0, None)["latched"])
            self._found.append(bool(alarm[touch.begin : touch.end + round(GRACE_S * recording.rate_hz)].any()))

    def alarms(self, number: int, recording: Recording) -> np.ndarray:
        """Whether it is in alarm, (samples,) bool; the random one by seed and number of the recording."""
        if self.name != "random":
            return np.full(recording.samples, self.name == "always")
        rng = np.random.default_rng([self.seed, number])
        length_s = recording.samples / recording.rate_hz
        starts_s = rng.uniform(0, length_s, rng.poisson(RANDOM_PER_HOUR * length_s / 3600))
        time_s = recording.time_s
        begun = np.searchsorted(time_s, starts_s)
        ended = np.searchsorted(time_s, starts_s + RANDOM_S)
        steps = np.bincount(begun, minlength=recording.samples + 1) - np.bincount(
            ended, minlength=recording.samples + 1
        )
        return np.cumsum(steps)[:-1] > 0

    def summary(self) -> dict:
        """Its entry in `sanity` of results.json."""
        return {
            "name": self.name,
            "false_per_hour": self._false / self._hours if self._hours else None,
            "time_in_alarm_share": self._alarmed / self._samples if self._samples else None,
            "collisions": len(self._found),
            "found": sum(self._found),
            "latched": sum(self._latched),
            "worth": WORTH[self.name],
        }


def sanity_detectors(seed: int) -> list[Sanity]:
    """One of each."""
    return [Sanity(name, seed) for name in WORTH]
