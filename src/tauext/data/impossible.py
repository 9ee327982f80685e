"""Samples that no arm sends: found by the core's own check, left out as a gap is, and told in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field

import numpy as np

from tauext import _core
from tauext.data.cut import cut
from tauext.data.recording import Recording
from tauext.errors import TrainingError

MOST_SHARE = 1e-3
"""Of the samples that are looked at: more are no glitches, but another unit, a wrong conversion or a broken encoder.
What is possible is told from the largest values but for this share, so that it cannot hold with more."""
LISTED = 3
"""Samples that a sentence names; provenance names more."""
KEPT = 100


@dataclass(frozen=True)
class SignalBounds:
    """What an arm can do at most, whatever touches it; a value a joint, infinite where nobody knows."""

    torque_nm: np.ndarray
    """Of \\|tau\\|, in the unit of the answers."""
    speed_rad_s: np.ndarray
    """Of \\|dq\\|, and of how fast q changes."""

    @classmethod
    def of(cls, bundle: _core.Bundle) -> SignalBounds:
        """Those that a bundle knows."""
        return cls(np.array(bundle.possible_torque_nm), np.array(bundle.possible_speed_rad_s))


@dataclass(frozen=True)
class ImpossibleSample:
    """One sample that no arm sends."""

    recording: str
    time_s: float
    """Since the recording's first sample."""
    joint: str
    cause: str
    """The core's name of it: impossible torque, impossible velocity, impossible position."""
    value: float
    """As recorded; of a position how far it lies from the one before."""

    def __str__(self) -> str:
        """joint2's torque of 1e+06 at 12.3 s of 'run-03'."""
        if self.cause == "impossible position":
            what = f"position that jumps by {self.value:.4g}"
        else:
            what = f"{self.cause.removeprefix('impossible ')} of {self.value:.4g}"
        return f"{self.joint}'s {what} at {self.time_s:.6g} s of '{self.recording}'"


@dataclass
class LeftOut:
    """Counts what is left out of some recordings."""

    what: str
    """Which recordings: training, calibration."""
    samples: int = 0
    """Looked at."""
    found: list[ImpossibleSample] = field(default_factory=list)
    recordings: int = 0
    """That hold some."""

    def look(self, recording: Recording, observer: _core.ObserverSettings, bounds: SignalBounds) -> np.ndarray:
        """Which samples a monitor refuses whose bundle has these bounds, (impossible,); they are counted."""
        limits = (bounds.torque_nm.tolist(), bounds.speed_rad_s.tolist())
        signals = (recording.t_ns, recording.q, recording.dq, recording.tau)
        found = _core.impossible_samples(observer, *limits, *signals)
        self.samples += recording.samples
        self.recordings += len(found["sample"]) > 0
        for k, cause, joint in zip(*(found[name].tolist() for name in ("sample", "cause", "joint")), strict=True):
            (name,) = _core.cause_names(cause)
            column = {"impossible torque": "tau", "impossible velocity": "dq"}.get(name, "q")
            value = float(getattr(recording, column)[k, joint])
            if column == "q" and k:
                value -= float(recording.q[k - 1, joint])
            time_s = float(recording.time_s[k])
            self.found.append(ImpossibleSample(recording.name, time_s, recording.joints[joint], name, value))
        return found["sample"]

    def expect_few(self) -> None:
        """Raise TrainingError where too many were found for the rest to be trusted."""
        if len(self.found) <= max(1.0, MOST_SHARE * self.samples):
            return
        raise TrainingError(
            f"{len(self.found)} of {self.samples} samples of the {self.what} recordings are impossible, more than "
            f"{MOST_SHARE:.1%}: {self._listed()}; look at the units and at the encoders (`tauext check`)"
        )

    def sentence(self) -> str:
        """What was left out, in words; empty where nothing was."""
        count = len(self.found)
        if not count:
            return ""
        samples = "1 impossible sample" if count == 1 else f"{count} impossible samples"
        return f"left out {samples} of the {self.what} recordings: {self._listed()}"

    def facts(self) -> dict:
        """For provenance: how many, and the first KEPT of them."""
        return {"samples": len(self.found), "of": self.samples, "told": [asdict(one) for one in self.found[:KEPT]]}

    def _listed(self) -> str:
        more = len(self.found) - LISTED
        others = f" and {more} more in {self.recordings} recording{'s' * (self.recordings > 1)}" if more > 0 else ""
        return ", ".join(map(str, self.found[:LISTED])) + others


def possible_parts(
    recordings: Sequence[Recording], observer: _core.ObserverSettings, bounds: SignalBounds, left_out: LeftOut
) -> list[Recording]:
    """The recordings without their impossible samples: themselves where there are none.

    More than a network period is left out after each, so that the chain begins anew there as after a gap: what follows
    is what a monitor sees that refused the sample.

    Raises:
        TrainingError: too many samples are impossible.
    """
    found = [left_out.look(recording, observer, bounds) for recording in recordings]
    left_out.expect_few()
    parts = []
    for recording, samples in zip(recordings, found, strict=True):
        keep = np.ones(recording.samples, dtype=bool)
        # Stamps jitter, and the clock carries up to a tick on: a few ticks more than it bridges.
        gap_ns = (observer.network_stride + 4) * observer.sample_period_ns
        ends = np.searchsorted(recording.t_ns, recording.t_ns[samples] + gap_ns)
        for first, end in zip(samples.tolist(), ends.tolist(), strict=True):
            keep[first:end] = False
        if keep.any():
            parts.append(recording if keep.all() else cut(recording, keep))
    return parts
