"""The beginning of a set of recordings: how good is a method that has seen only minutes?"""

from __future__ import annotations

from collections.abc import Sequence

from tauext.data.cut import cut
from tauext.data.recording import Recording


def length_s(recording: Recording) -> float:
    """Time that its samples stand for, [s]: a sample period more than from the first to the last."""
    return recording.duration_s + 1 / recording.rate_hz


def total_s(recordings: Sequence[Recording]) -> float:
    """The same of all together, [s]."""
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
