"""Selection of samples: free motion, joints that move, values that an arm can send."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace

import numpy as np

from tauext import _core
from tauext.config import FreeMotionConfig
from tauext.data.recording import FLAGS, SIGNALS, Recording, runs_of
from tauext.errors import TrainingError


def cut(recording: Recording, span: slice | np.ndarray) -> Recording:
    """Return part of a recording under its name: a slice or the flagged samples, at least one."""
    arrays = {name: getattr(recording, name) for name in ("t_ns", *SIGNALS, *FLAGS)}
    return replace(recording, **{name: a[span] for name, a in arrays.items() if a is not None})


def between(recording: Recording, first: int, last: int, name: str) -> Recording:
    """Return rows first to last (exclusive) under another name; provenance has the part's times, in seconds."""
    part = {"of": recording.name, "from_s": round(float(recording.time_s[first]), 6)}
    part["to_s"] = round(float(recording.time_s[last - 1]), 6)
    provenance = recording.provenance | {"part": part}
    return replace(cut(recording, slice(first, last)), name=name, provenance=provenance)


def within(recording: Recording, from_s: float, to_s: float, name: str) -> Recording | None:
    """Return the part in [from_s, to_s), seconds of its source; itself if that is all, None if empty."""
    time_s = recording.time_s + recording.provenance.get("start_s", 0.0)
    rows = np.flatnonzero((time_s >= from_s) & (time_s < to_s))
    if not len(rows):
        return None
    return recording if len(rows) == recording.samples else between(recording, rows[0], rows[-1] + 1, name)


def length_s(recording: Recording) -> float:
    """Duration of its samples, [s]: one sample period more than from the first to the last."""
    return recording.duration_s + 1 / recording.rate_hz


def total_s(recordings: Sequence[Recording]) -> float:
    """Total length of the recordings, [s]."""
    return sum(map(length_s, recordings))


def first_seconds(recordings: Sequence[Recording], seconds: float) -> list[Recording]:
    """Return the first recordings up to this total length, [s], with the last one cut; all if they last less."""
    taken, left = [], seconds
    for recording in recordings:
        if left < 1 / recording.rate_hz:
            break
        whole, samples = length_s(recording) <= left + 1e-6, int((recording.time_s < left - 1e-6).sum())
        taken.append(recording if whole else cut(recording, slice(0, samples)))
        left -= length_s(recording)
    return taken


def standing_joints(recordings: Iterable[Recording], range_rad: float = 0.02) -> np.ndarray:
    """Whether each joint stands still in every recording, (joints,) bool; at least one recording.

    Args:
        range_rad: largest range of its positions, [rad]. The speed is no evidence: a standing arm's may be noise of
            0.05 rad/s.
    """
    return np.all([np.ptp(recording.q, axis=0) < range_rad for recording in recordings], axis=0)


# --- Free motion of recordings, and splits by time.


def has_contact(recording: Recording) -> bool:
    """Whether a sample is in contact."""
    return recording.contact is not None and bool((recording.contact == 1).any())


def unknown_s(recordings: Iterable[Recording]) -> float:
    """Time of which it is unknown whether something touches the arm (contact = -1), [s]."""
    return sum(float((r.contact == -1).sum()) / r.rate_hz for r in recordings if r.contact is not None)


def free_samples(recording: Recording, margins: FreeMotionConfig = FreeMotionConfig()) -> np.ndarray:  # noqa: B008
    """Whether each sample is free motion: no contact there nor within the margins, (samples,) bool.

    Samples with an unknown label are not free; a recording without labels is.
    """
    contact = recording.contact
    if contact is None:
        return np.ones(recording.samples, dtype=bool)
    return (contact == 0) & _far_from(contact == 1, recording.t_ns, margins.before_s, margins.after_s)


@dataclass
class NotFree:
    """Time of recordings that is no free motion."""

    margins: FreeMotionConfig
    left_out_s: float = 0.0
    unknown_s: float = 0.0
    """Of it: time of which it is unknown whether something touches the arm (contact = -1)."""

    def add(self, recordings: Iterable[Recording]) -> NotFree:
        """Count these recordings, too."""
        for one in recordings:
            self.left_out_s += float((~free_samples(one, self.margins)).sum() / one.rate_hz)
            self.unknown_s += unknown_s([one])
        return self

    def sentence(self) -> str:
        """Text for the user; empty: all is free motion."""
        if not self.left_out_s:
            return ""
        unknown = f"; of {self.unknown_s:.1f} s the contact is unknown (-1)" if self.unknown_s else ""
        return (
            f"{self.left_out_s:.1f} s are left out: in contact, {self.margins.before_s:g} s before one or "
            f"{self.margins.after_s:g} s after{unknown}"
        )


def free_pieces(
    recordings: Iterable[Recording],
    margins: FreeMotionConfig = FreeMotionConfig(),  # noqa: B008
) -> list[Recording]:
    """Return the free motion: recordings without contact unchanged, else their free stretches of a second or more.

    Each stretch is a recording of the same name. Filters and windows restart in each, so none reaches into a contact.
    """
    pieces = []
    for recording in recordings:
        free = free_samples(recording, margins)
        if free.all():
            pieces.append(recording)
            continue
        pieces += [cut(recording, slice(*run)) for run in _runs(free, recording.t_ns, 1.0)]
    return pieces


def free_stretches(recording: Recording, before_s: float, after_s: float, least_s: float) -> list[Recording]:
    """Return stretches without contact as recordings NAME-free-00, -01, ...; the recording itself if untouched.

    Samples with an unknown label count as contacts, with margins: only motion known to be free goes into a dataset.

    Args:
        before_s: time left out before a contact, [s]: a label may come late.
        after_s: time left out after a contact, [s]: the observer decays, and the arm may still swing.
        least_s: shortest stretch that is kept, [s].
    """
    if recording.contact is None or (recording.contact == 0).all():
        return [recording]
    free = _far_from(recording.contact != 0, recording.t_ns, before_s, after_s)
    runs = _runs(free, recording.t_ns, least_s)
    return [between(recording, first, last, f"{recording.name}-free-{k:02d}") for k, (first, last) in enumerate(runs)]


def split_by_time(
    recordings: Sequence[Recording], share: float, gap_s: float, least_s: float
) -> tuple[list[Recording], list[Recording]]:
    """Split every recording into its beginning and its last `share`, for datasets without validation recordings.

    A recording whose last share is shorter than least_s stays whole and counts as a beginning.

    Args:
        share: share of each recording's time, > 0 and < 1.
        gap_s: gap between the two parts, so that no window or filter spans both, [s].
        least_s: least length of the second part, [s].
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
    """Whether each sample lies outside all contacts and their margins, (samples,) bool."""
    far = np.ones(len(t_ns), dtype=bool)
    for begin, end in runs_of(touched):
        first, last = t_ns[begin] - int(before_s * 1e9), t_ns[end - 1] + int(after_s * 1e9)
        far[np.searchsorted(t_ns, first) : np.searchsorted(t_ns, last, side="right")] = False
    return far


def _runs(free: np.ndarray, t_ns: np.ndarray, least_s: float) -> list[tuple[int, int]]:
    """(first, one after the last) sample of every stretch of true flags of at least least_s, [s]."""
    return [(first, last) for first, last in runs_of(free).tolist() if (t_ns[last - 1] - t_ns[first]) * 1e-9 >= least_s]


# --- Impossible samples: found by the core's check, left out like a gap, and reported.


MOST_SHARE = 1e-3
"""Largest share of impossible samples. More are no glitches but a wrong unit or conversion or a broken encoder. Bounds
follow from the largest values without this share, so they cannot hold with more."""


@dataclass(frozen=True)
class SignalBounds:
    """Largest values that an arm can reach, with contact too; one a joint, infinite where unknown."""

    torque_nm: np.ndarray
    """Largest \\|tau\\|, in the unit of the estimates."""
    speed_rad_s: np.ndarray
    """Largest \\|dq\\| and rate of change of q."""

    @classmethod
    def of(cls, bundle: _core.Bundle) -> SignalBounds:
        """A bundle's bounds."""
        return cls(np.array(bundle.possible_torque_nm), np.array(bundle.possible_speed_rad_s))


@dataclass(frozen=True)
class ImpossibleSample:
    """One sample that no arm can send."""

    recording: str
    time_s: float
    """Time since the recording's first sample."""
    joint: str
    cause: str
    """Cause in the core: impossible torque, impossible velocity, impossible position."""
    value: float
    """Recorded value; for a position its jump from the one before."""

    def __str__(self) -> str:
        """Return a phrase such as "joint2's torque of 1e+06 at 12.3 s of 'run-03'"."""
        if self.cause == "impossible position":
            what = f"position that jumps by {self.value:.4g}"
        else:
            what = f"{self.cause.removeprefix('impossible ')} of {self.value:.4g}"
        return f"{self.joint}'s {what} at {self.time_s:.6g} s of '{self.recording}'"


@dataclass
class LeftOut:
    """Counts samples left out of recordings."""

    what: str
    """Name of the set: training, calibration."""
    samples: int = 0
    """Number of samples checked."""
    found: list[ImpossibleSample] = field(default_factory=list)
    recordings: int = 0
    """Number of recordings with impossible samples."""

    def find(self, recording: Recording, observer: _core.ObserverSettings, bounds: SignalBounds) -> np.ndarray:
        """Find and count the samples that a monitor with these bounds refuses: their indices, (impossible,)."""
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
        """Raise TrainingError if too many samples are impossible."""
        if len(self.found) <= max(1.0, MOST_SHARE * self.samples):
            return
        raise TrainingError(
            f"{len(self.found)} of {self.samples} samples of the {self.what} recordings are impossible, more than "
            f"{MOST_SHARE:.1%}: {self._listed()}; check the units and the encoders (`tauext check`)"
        )

    def sentence(self) -> str:
        """Message about samples left out; empty if there are none."""
        count = len(self.found)
        if not count:
            return ""
        samples = "1 impossible sample" if count == 1 else f"{count} impossible samples"
        return f"left out {samples} of the {self.what} recordings: {self._listed()}"

    def facts(self) -> dict:
        """Number and first samples, for provenance."""
        return {"samples": len(self.found), "of": self.samples, "listed": [asdict(one) for one in self.found[:100]]}

    def _listed(self) -> str:
        more = len(self.found) - 3
        others = f" and {more} more in {self.recordings} recording{'s' * (self.recordings > 1)}" if more > 0 else ""
        return ", ".join(map(str, self.found[:3])) + others


def possible_parts(
    recordings: Sequence[Recording], observer: _core.ObserverSettings, bounds: SignalBounds, left_out: LeftOut
) -> list[Recording]:
    """Return the recordings without impossible samples; unchanged where there are none.

    More than a network period is left out after each, so that the chain restarts as after a gap. That equals a
    monitor's behaviour after it has refused the sample.

    Raises:
        TrainingError: too many samples are impossible.
    """
    found = [left_out.find(recording, observer, bounds) for recording in recordings]
    left_out.expect_few()
    parts = []
    for recording, samples in zip(recordings, found, strict=True):
        keep = np.ones(recording.samples, dtype=bool)
        # Stamps jitter by up to a tick, so leave out a few ticks more than the clock bridges.
        gap_ns = (observer.network_stride + 4) * observer.sample_period_ns
        ends = np.searchsorted(recording.t_ns, recording.t_ns[samples] + gap_ns)
        for first, end in zip(samples.tolist(), ends.tolist(), strict=True):
            keep[first:end] = False
        if keep.any():
            parts.append(recording if keep.all() else cut(recording, keep))
    return parts
