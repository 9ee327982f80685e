"""Which samples of recordings are used: free motion, joints that move, values that an arm can send."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace

import numpy as np

from tauext import _core
from tauext.config import FreeMotionConfig
from tauext.data.recording import FLAGS, SIGNALS, Recording, runs_of
from tauext.errors import TrainingError

# --- Some samples of a recording, as a recording of its own.


def cut(recording: Recording, span: slice | np.ndarray) -> Recording:
    """Some samples of a recording, at least one, under its name: those of a slice, or those whose flag is set."""
    arrays = {name: getattr(recording, name) for name in ("t_ns", *SIGNALS, *FLAGS)}
    return replace(recording, **{name: a[span] for name, a in arrays.items() if a is not None})


def between(recording: Recording, first: int, last: int, name: str) -> Recording:
    """Rows first to last, last left out, under another name; its provenance has the part's times, in seconds."""
    part = {"of": recording.name, "from_s": round(float(recording.time_s[first]), 6)}
    part["to_s"] = round(float(recording.time_s[last - 1]), 6)
    provenance = recording.provenance | {"part": part}
    return replace(cut(recording, slice(first, last)), name=name, provenance=provenance)


def within(recording: Recording, from_s: float, to_s: float, name: str) -> Recording | None:
    """What of it lies in [from_s, to_s), seconds of its source; itself where that is all, None where it is nothing."""
    time_s = recording.time_s + recording.provenance.get("start_s", 0.0)
    rows = np.flatnonzero((time_s >= from_s) & (time_s < to_s))
    if not len(rows):
        return None
    return recording if len(rows) == recording.samples else between(recording, rows[0], rows[-1] + 1, name)


# --- The beginning of a set of recordings: how good is a method that is trained on minutes?


def length_s(recording: Recording) -> float:
    """Time that its samples stand for, [s]: a sample period more than from the first to the last."""
    return recording.duration_s + 1 / recording.rate_hz


def total_s(recordings: Sequence[Recording]) -> float:
    """Total length of the recordings, [s]."""
    return sum(map(length_s, recordings))


def first_seconds(recordings: Sequence[Recording], seconds: float) -> list[Recording]:
    """The first recordings that together last so long, [s], the last one cut; all of them where they last less."""
    taken, left = [], seconds
    for recording in recordings:
        if left < 1 / recording.rate_hz:
            break
        whole = length_s(recording) <= left + 1e-6
        taken.append(recording if whole else cut(recording, slice(0, _samples(recording, left))))
        left -= length_s(recording)
    return taken


def _samples(recording: Recording, seconds: float) -> int:
    return int((recording.time_s < seconds - 1e-6).sum())


# --- Joints that never move: of them nothing but what they show at rest can be learned.


STANDING_RAD = 0.02
"""A joint that stays within so much in every recording stands still, [rad]. Its speed is no evidence: that of a
standing arm may be noise of 0.05 rad/s."""


def standing_joints(recordings: Iterable[Recording]) -> np.ndarray:
    """Whether each joint stands still in every recording, (joints,) bool; at least one recording."""
    return np.all([np.ptp(recording.q, axis=0) < STANDING_RAD for recording in recordings], axis=0)


# --- Which stretches of a recording are free motion, and how a set of recordings is cut by time.


SHORTEST_S = 1.0
"""Of a stretch that is kept, [s]."""
MARGINS = FreeMotionConfig()


def has_contact(recording: Recording) -> bool:
    """Whether a sample is in contact."""
    return recording.contact is not None and bool((recording.contact == 1).any())


def free_samples(recording: Recording, margins: FreeMotionConfig = MARGINS) -> np.ndarray:
    """Whether each sample is free motion: no contact there nor within the margins, (samples,) bool.

    Samples of which it is unknown whether something touches are none, unless the whole recording is unlabelled.
    """
    contact = recording.contact
    if contact is None or (contact == -1).all():
        return np.ones(recording.samples, dtype=bool)
    return (contact == 0) & _far_from(contact == 1, recording.t_ns, margins.before_s, margins.after_s)


def free_pieces(recordings: Iterable[Recording], margins: FreeMotionConfig = MARGINS) -> list[Recording]:
    """The free motion of recordings: themselves where nothing touches, else their stretches of a second or more.

    Each stretch is a recording by itself, under the same name, on which filters and windows restart: none reaches
    into a contact.
    """
    pieces = []
    for recording in recordings:
        free = free_samples(recording, margins)
        if free.all():
            pieces.append(recording)
            continue
        pieces += [cut(recording, slice(*run)) for run in _runs(free, recording.t_ns, SHORTEST_S)]
    return pieces


def free_stretches(recording: Recording, before_s: float, after_s: float, least_s: float) -> list[Recording]:
    """Stretches without contact, each a recording NAME-free-00, -01, ...; the recording itself where it has none.

    Samples whose label is neither contact nor free are taken for contacts, margins and all: what goes into a dataset as
    free motion must be known to be.

    Args:
        before_s: left out before a contact, too, [s]: a label may come late.
        after_s: left out after one, [s]: the observer rings down, and the arm may still swing.
        least_s: a shorter stretch is left out, [s].
    """
    if recording.contact is None or (recording.contact == 0).all():
        return [recording]
    free = _far_from(recording.contact != 0, recording.t_ns, before_s, after_s)
    runs = _runs(free, recording.t_ns, least_s)
    return [between(recording, first, last, f"{recording.name}-free-{k:02d}") for k, (first, last) in enumerate(runs)]


def split_by_time(
    recordings: Sequence[Recording], share: float, gap_s: float, least_s: float
) -> tuple[list[Recording], list[Recording]]:
    """The beginning of every recording, and its last `share` after a gap; for datasets without validation recordings.

    A recording whose last share is shorter than least_s stays whole, among the beginnings.

    Args:
        share: of each recording's time, > 0 and < 1.
        gap_s: between the two parts, so that no window and no filter reaches from one into the other, [s].
        least_s: what the second part must last to be of use, [s].
    """
    first, last = [], []
    for recording in recordings:
        time_s = recording.time_s
        at_s = (1 - share) * recording.duration_s
        if share * recording.duration_s < least_s or at_s <= gap_s:
            first.append(recording)
            continue
        begin = int(np.searchsorted(time_s, at_s))
        first.append(cut(recording, slice(0, int(np.searchsorted(time_s, at_s - gap_s)))))
        last.append(cut(recording, slice(begin, recording.samples)))
    return first, last


def _far_from(touched: np.ndarray, t_ns: np.ndarray, before_s: float, after_s: float) -> np.ndarray:
    """Whether each sample is neither touched nor so soon before or after one that is, (samples,) bool."""
    far = np.ones(len(t_ns), dtype=bool)
    for begin, end in runs_of(touched):
        first, last = t_ns[begin] - int(before_s * 1e9), t_ns[end - 1] + int(after_s * 1e9)
        far[np.searchsorted(t_ns, first) : np.searchsorted(t_ns, last, side="right")] = False
    return far


def _runs(free: np.ndarray, t_ns: np.ndarray, least_s: float) -> list[tuple[int, int]]:
    """(first, one after the last) sample of every stretch of true flags that lasts so long, [s]."""
    return [(first, last) for first, last in runs_of(free).tolist() if (t_ns[last - 1] - t_ns[first]) * 1e-9 >= least_s]


# --- Samples that no arm sends: found by the core's own check, left out as a gap is, and reported.


MOST_SHARE = 1e-3
"""Of the samples that are checked: more are no glitches, but another unit, a wrong conversion or a broken encoder.
Bounds follow from the largest values but for this share, so that it cannot hold with more."""
LISTED = 3
"""Samples that a sentence names; provenance names more."""
KEPT = 100


@dataclass(frozen=True)
class SignalBounds:
    """What an arm can do at most, whatever touches it; a value a joint, infinite where unknown."""

    torque_nm: np.ndarray
    """Of \\|tau\\|, in the unit of the answers."""
    speed_rad_s: np.ndarray
    """Of \\|dq\\|, and of how fast q changes."""

    @classmethod
    def of(cls, bundle: _core.Bundle) -> SignalBounds:
        """A bundle's bounds."""
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
    """Checked."""
    found: list[ImpossibleSample] = field(default_factory=list)
    recordings: int = 0
    """That hold some."""

    def find(self, recording: Recording, observer: _core.ObserverSettings, bounds: SignalBounds) -> np.ndarray:
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
            f"{MOST_SHARE:.1%}: {self._listed()}; check the units and the encoders (`tauext check`)"
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
        return {"samples": len(self.found), "of": self.samples, "listed": [asdict(one) for one in self.found[:KEPT]]}

    def _listed(self) -> str:
        more = len(self.found) - LISTED
        others = f" and {more} more in {self.recordings} recording{'s' * (self.recordings > 1)}" if more > 0 else ""
        return ", ".join(map(str, self.found[:LISTED])) + others


def possible_parts(
    recordings: Sequence[Recording], observer: _core.ObserverSettings, bounds: SignalBounds, left_out: LeftOut
) -> list[Recording]:
    """The recordings without their impossible samples: themselves where there are none.

    More than a network period is left out after each, so that the chain restarts there as after a gap: what follows
    is what a monitor gets after it refused the sample.

    Raises:
        TrainingError: too many samples are impossible.
    """
    found = [left_out.find(recording, observer, bounds) for recording in recordings]
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
