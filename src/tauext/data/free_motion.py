"""Which stretches of a recording are free motion, and how a set of recordings is cut by time."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from tauext.config import FreeMotionConfig
from tauext.data.recording import FLAGS, SIGNALS, Recording

SHORTEST_S = 1.0
"""Of a stretch that is kept, [s]."""
MARGINS = FreeMotionConfig()


def free_samples(recording: Recording, margins: FreeMotionConfig = MARGINS) -> np.ndarray:
    """Whether each sample is free motion: no contact there nor within the margins, (samples,) bool.

    Samples of which it is unknown whether something touches are none, unless the whole recording is unlabelled.
    """
    contact = recording.contact
    if contact is None or (contact == -1).all():
        return np.ones(recording.samples, dtype=bool)
    free = contact == 0
    touched = recording.t_ns[contact == 1]
    if len(touched):
        # The nearest touched sample after each, and the nearest before it.
        after = touched[np.minimum(np.searchsorted(touched, recording.t_ns), len(touched) - 1)]
        before = touched[np.maximum(np.searchsorted(touched, recording.t_ns, side="right") - 1, 0)]
        soon = (after >= recording.t_ns) & (after - recording.t_ns <= margins.before_s * 1e9)
        just = (before <= recording.t_ns) & (recording.t_ns - before <= margins.after_s * 1e9)
        free &= ~soon & ~just
    return free


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
        edges = np.flatnonzero(np.diff(np.r_[False, free, False]))
        spans = (slice(a, b) for a, b in edges.reshape(-1, 2))
        pieces += [piece for piece in (cut(recording, span) for span in spans) if piece.duration_s >= SHORTEST_S]
    return pieces


def cut(recording: Recording, span: slice) -> Recording:
    """Some samples of a recording in a row, at least one."""
    arrays = {name: getattr(recording, name) for name in ("t_ns", *SIGNALS, *FLAGS)}
    return replace(recording, **{name: a[span] for name, a in arrays.items() if a is not None})


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
