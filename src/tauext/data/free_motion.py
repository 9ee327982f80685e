"""Which stretches of a recording are free motion, and how a set of recordings is cut by time."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from tauext.config import FreeMotionConfig
from tauext.data.cut import between, cut
from tauext.data.recording import Recording

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

    Each stretch is a recording by itself, under the same name, on which filters and windows begin anew: none reaches
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
    for begin, end in np.flatnonzero(np.diff(np.r_[False, touched, False])).reshape(-1, 2):
        first, last = t_ns[begin] - int(before_s * 1e9), t_ns[end - 1] + int(after_s * 1e9)
        far[np.searchsorted(t_ns, first) : np.searchsorted(t_ns, last, side="right")] = False
    return far


def _runs(free: np.ndarray, t_ns: np.ndarray, least_s: float) -> list[tuple[int, int]]:
    """(first, one after the last) sample of every stretch of true flags that lasts so long, [s]."""
    runs = np.flatnonzero(np.diff(np.r_[False, free, False])).reshape(-1, 2).tolist()
    return [(first, last) for first, last in runs if (t_ns[last - 1] - t_ns[first]) * 1e-9 >= least_s]
