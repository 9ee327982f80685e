"""Recordings as evenly sampled stretches of smooth free motion: what every fit of the doctor starts from."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache

import numpy as np

from tauext.data.recording import Recording

LEAST_STRETCH_S = 2.0
"""A shorter stretch holds hardly more than the ends of its filters."""
POSITION_CUTOFF_HZ = 15.0
"""Of the positions that are differentiated: above what an arm moves by, below what an encoder's steps make."""
FIT_CUTOFF_HZ = 5.0
"""Of torque and model alike before they are compared: friction at a reversal and inertia still show, noise does not."""
FIT_ROWS_HZ = 25.0
MOST_HZ, THINNED_CUTOFF_HZ = 250.0, 60.0
"""Faster recordings are low-passed and thinned: no fit looks above 15 Hz."""
CONTACT_MARGIN_S = 0.5
"""Left out on both sides of a labelled contact: labels come late, and an arm springs back."""
REPEATS_S = 0.25
"""Rows that repeat for longer end a stretch."""
GAP_PERIODS = 5.0
"""A step of so many periods ends a stretch: what is in between cannot be interpolated."""


@dataclass(frozen=True)
class Stretch:
    """Free motion without a gap on an even clock of at most MOST_HZ; arrays (samples, joints)."""

    recording: int
    start_s: float  # after the beginning of the first recording; recordings follow one another without a pause
    rate_hz: float
    q: np.ndarray  # [rad], smooth
    dq: np.ndarray  # [rad/s], derivative of q, no delay
    tau: np.ndarray  # [N m], as recorded, thinned
    q_raw: np.ndarray  # [rad], as recorded, thinned
    dq_raw: np.ndarray  # [rad/s], as recorded, thinned

    @property
    def seconds(self) -> float:
        return len(self.q) / self.rate_hz


PADDED_ROWS = 9
"""With which the filter begins at either end."""


def low_pass(x: np.ndarray, cutoff_hz: float, rate_hz: float) -> np.ndarray:
    """Second-order Butterworth there and back over axis 0, no delay. Too high a cut-off, few rows: unchanged."""
    if cutoff_hz >= 0.45 * rate_hz or len(x) <= PADDED_ROWS:
        return x
    from scipy.signal import sosfiltfilt  # 0.6 s to load, which most commands never need

    return sosfiltfilt(_butterworth(cutoff_hz, rate_hz), x, axis=0)


@cache
def _butterworth(cutoff_hz: float, rate_hz: float) -> np.ndarray:
    from scipy.signal import butter

    return butter(2, cutoff_hz, fs=rate_hz, output="sos")


def stretches(recordings: Iterable[Recording], contacts: bool = False) -> list[Stretch]:
    """All stretches of at least LEAST_STRETCH_S; rows equal to the one before and labelled contacts are left out.

    Args:
        contacts: they are not.
    """
    found, start_s = [], 0.0
    for number, recording in enumerate(recordings):
        for rows in _whole(recording, contacts):
            stretch = _even(recording, rows, number, start_s)
            if stretch is not None:
                found.append(stretch)
        start_s += recording.duration_s
    return found


def repeated_rows(recording: Recording) -> np.ndarray:
    """(samples,) bool: every signal of every joint equals the row before."""
    repeated = np.zeros(recording.samples, dtype=bool)
    repeated[1:] = True
    for x in (recording.q, recording.dq, recording.tau):
        for column in x.T:
            at = np.flatnonzero(repeated)  # most rows are out after the first column
            repeated[at[column[at] != column[at - 1]]] = False
    return repeated


def _whole(recording: Recording, contacts: bool) -> list[np.ndarray]:
    """Rows of each stretch, repeats left out."""
    keep = ~repeated_rows(recording)
    if recording.contact is not None and not contacts:
        touched = recording.time_s[recording.contact == 1]
        if len(touched):
            after = np.searchsorted(touched, recording.time_s)
            to_next = touched[np.minimum(after, len(touched) - 1)] - recording.time_s
            since = recording.time_s - touched[np.maximum(after - 1, 0)]
            keep &= (np.abs(to_next) > CONTACT_MARGIN_S) & (np.abs(since) > CONTACT_MARGIN_S)
    rows = np.flatnonzero(keep)
    if not len(rows):
        return []
    step_ns = np.median(np.diff(recording.t_ns)) if recording.samples > 1 else 1
    period_ns = max(step_ns, 1e9 / recording.rate_hz)
    # rows left out in between are repeats (contacts leave a wider margin): the clock went on there
    longest_ns = np.where(np.diff(rows) > 1, max(REPEATS_S * 1e9, GAP_PERIODS * period_ns), GAP_PERIODS * period_ns)
    breaks = np.flatnonzero(np.diff(recording.t_ns[rows]) > longest_ns)
    return [part for part in np.split(rows, breaks + 1) if len(part) > 8]


def _even(recording: Recording, rows: np.ndarray, number: int, start_s: float) -> Stretch | None:
    t = (recording.t_ns[rows] - recording.t_ns[0]) * 1e-9
    if t[-1] - t[0] < LEAST_STRETCH_S:
        return None
    rate_hz = min(recording.rate_hz, (len(rows) - 1) / (t[-1] - t[0]) * 1.25)
    even = np.arange(t[0], t[-1], 1 / rate_hz)

    every = max(1, int(rate_hz / MOST_HZ + 0.5)) if rate_hz > MOST_HZ else 1

    def on_clock(x: np.ndarray) -> np.ndarray:
        x = np.stack([np.interp(even, t, x[rows, j]) for j in range(x.shape[1])], axis=1)
        return x if every == 1 else np.ascontiguousarray(low_pass(x, THINNED_CUTOFF_HZ, rate_hz)[::every])

    raw, tau, said = on_clock(recording.q), on_clock(recording.tau), on_clock(recording.dq)
    rate_hz /= every
    smooth = low_pass(raw, min(POSITION_CUTOFF_HZ, 0.3 * rate_hz), rate_hz)
    dq = np.gradient(smooth, 1 / rate_hz, axis=0)
    return Stretch(number, start_s + even[0], rate_hz, smooth, dq, tau, raw, said)
