"""What a contact leaves behind: alarms that begin, and errors, when nothing touches the arm any more."""

from __future__ import annotations

import numpy as np

from tauext.bundle.estimates import COLLISION, CONTACT, Estimates
from tauext.data.recording import Recording
from tauext.evaluate.free_motion import numbers

EDGES_S = (0.2, 0.5, 1.0, 1.5, 2.5)
"""Bins of the time since the end of a touch; before, the observer itself still lags."""
QUIET_S = 0.1
"""An alarm begins where none of its level was held for so long before: one left over from the touch does not."""
LEVELS = {"contact": CONTACT, "collision": COLLISION}


class AfterContact:
    """Sums over the healthy samples of each bin, and of free motion to compare with."""

    def __init__(self, joints: int) -> None:
        bins = len(EDGES_S)  # the last is free motion
        self._seconds = np.zeros(bins)
        self._samples = np.zeros(bins, dtype=int)
        self._square = np.zeros((bins, joints))
        self._begun = {name: np.zeros(bins, dtype=int) for name in LEVELS}

    def add_free(self, recording: Recording, estimates: Estimates) -> None:
        """Take in one recording of free motion."""
        self._add(np.where(estimates.healthy, len(EDGES_S) - 1, -1), recording, estimates)

    def add_touched(self, recording: Recording, estimates: Estimates) -> None:
        """Take in one recording with contacts; where it is unknown whether something touches nothing is counted."""
        if recording.contact is None:
            return
        since_s = time_since_touch(recording)
        where = np.searchsorted(EDGES_S, since_s, side="right") - 1
        where[(where == len(EDGES_S) - 1) | ~estimates.healthy] = -1
        self._add(where, recording, estimates)

    def _add(self, where: np.ndarray, recording: Recording, estimates: Estimates) -> None:
        bins = len(EDGES_S)
        counts = np.bincount(where + 1, minlength=bins + 1)[1:]
        self._samples += counts
        self._seconds += counts / recording.rate_hz
        for k in np.flatnonzero(counts):
            error = estimates.tau_ext[where == k].astype(float)
            self._square[k] += np.einsum("ij,ij->j", error, error)
        assert estimates.held_alarm is not None
        for name, level in LEVELS.items():
            begun = where[beginnings(estimates.held_alarm >= level, round(QUIET_S * recording.rate_hz))]
            self._begun[name] += np.bincount(begun + 1, minlength=bins + 1)[1:]

    def summary(self) -> dict:
        """The entry `after_contact` of a bundle in results.json."""
        entries = [self._entry(k) for k in range(len(EDGES_S))]
        ends = zip(EDGES_S[:-1], EDGES_S[1:], strict=True)
        bins = [{"from_s": a, "to_s": b} | entry for (a, b), entry in zip(ends, entries[:-1], strict=True)]
        return {"bins": bins, "free_motion": entries[-1]}

    def _entry(self, k: int) -> dict:
        hours = float(self._seconds[k]) / 3600
        entry: dict = {"hours": hours}
        for name, begun in self._begun.items():
            entry[f"{name}s"] = int(begun[k])
            entry[f"{name}s_per_hour"] = int(begun[k]) / hours if hours else None
        with np.errstate(invalid="ignore"):
            entry["rmse_nm"] = numbers(np.sqrt(self._square[k] / self._samples[k]))
        return entry


def time_since_touch(recording: Recording) -> np.ndarray:
    """Since the last sample of the last touch, (samples,), [s]; NaN during touches, before the first, and from where it
    is unknown whether something touches until the next touch ends."""
    assert recording.contact is not None
    marked = np.where(recording.contact != 0, np.arange(recording.samples), -1)
    last = np.maximum.accumulate(marked)
    ended = (recording.contact == 0) & (last >= 0) & (recording.contact[last] == 1)
    return np.where(ended, (recording.t_ns - recording.t_ns[last]) * 1e-9, np.nan)


def beginnings(flags: np.ndarray, quiet_samples: int) -> np.ndarray:
    """Indices of true flags with none in the quiet_samples before them; before the first sample all was quiet."""
    at = np.flatnonzero(flags)
    return at[np.diff(at, prepend=-quiet_samples - 1) > quiet_samples]
