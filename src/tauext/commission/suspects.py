"""Touches that nobody reported, found by a bundle in the motion that it was trained on or will be judged by."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tauext import _core
from tauext.config import FreeMotionConfig
from tauext.data.recording import Recording, runs_of
from tauext.train.error_scale import judge

WINDOW_S = 0.5
MOVING_RAD_S = 0.05
USUAL = 90
"""Percentile of the windows' largest errors, in units of the predicted error, that counts as usual for a joint."""
CHANCE = 0.02
"""Probability that free motion alone contains a suspect, if its largest errors go on as they begin above the usual
one: with an exponential tail. Motion with rare, large errors (abrupt stops) so has higher thresholds."""
LEAST_NM = 2.0
"""A window that is a suspect by its error in the unit of the estimates alone must also exceed this multiple of the
usual error in units of the predicted error: model errors grow with the motion, and so does their prediction."""
EDGE = 1.5
"""Neighbouring windows above this multiple belong to the same touch."""
WARM_S = 1.0
"""Begin of each recording that is not searched, [s]: the joints' static friction is unknown there."""
LEAST_WINDOWS = 60
MOST_SHARE = 0.1
"""A larger share of suspects is an error of the model and no touches; nothing is then suspected."""


@dataclass(frozen=True)
class Suspect:
    """One interval of a recording that looks like a touch."""

    epoch: int
    from_ns: int
    to_ns: int
    times: float
    """Its largest error, in multiples of the usual one."""


def find_suspects(bundle: _core.Bundle, recordings: Sequence[Recording], threads: int = 1) -> list[Suspect]:
    """Intervals whose error is far beyond what the errors of all other motion suggest.

    A touch in the training motion raises the limits and the predicted error, so the limits do not find it. Quantiles of
    the errors of all windows hardly depend on single touches.

    Args:
        recordings: of `tauext commission`, with their labels; labelled motion is not searched.
    """
    windows = [Windows.of(bundle, recording, threads) for recording in recordings]
    searched = [one.counts & one.moves for one in windows]
    if sum(int(one.sum()) for one in searched) < LEAST_WINDOWS:
        return []
    found: list[Suspect] = []
    count = total = 0
    usual, usual_nm = (
        np.maximum(np.percentile(np.concatenate(of), USUAL, axis=0), 1e-12)
        for of in (
            [one.largest[rows] for one, rows in zip(windows, searched, strict=True)],
            [one.largest_nm[rows] for one, rows in zip(windows, searched, strict=True)],
        )
    )
    multiples = [
        tuple(np.where(one.counts, of.max(axis=1), 0.0) for of in (one.largest / usual, one.largest_nm / usual_nm))
        for one in windows
    ]
    most, most_nm = (
        beyond_chance(np.concatenate([of[which][rows] for of, rows in zip(multiples, searched, strict=True)]))
        for which in (0, 1)
    )
    for one, recording, (times, times_nm) in zip(windows, recordings, multiples, strict=True):
        touched = (times > most) | ((times_nm > most_nm) & (times > LEAST_NM))
        total, count = total + int(one.counts.sum()), count + int(touched.sum())
        for first, end in runs_of((times > EDGE) | touched).tolist():
            if touched[first:end].any():
                last = min(one.begins[end], recording.samples) - 1
                span = int(recording.t_ns[one.begins[first]]), int(recording.t_ns[last])
                found.append(Suspect(int(recording.provenance["epoch"]), *span, float(times[first:end].max())))
    return found if count <= MOST_SHARE * total else []


def beyond_chance(values: np.ndarray) -> float:
    """The value that the largest of as many values exceeds with probability CHANCE, if those above the quantile USUAL
    have an exponential tail; its scale follows from their median, which few outliers do not move."""
    usual = float(np.percentile(values, USUAL))
    above = values[values > usual]
    if not len(above):
        return usual
    scale = float(np.median(above - usual)) / math.log(2)
    return usual + scale * (math.log(len(above)) - math.log(CHANCE))


@dataclass(frozen=True)
class Windows:
    """Half-second windows of one recording."""

    begins: np.ndarray
    """First sample of each window, and the number of samples, (windows + 1,)."""
    largest: np.ndarray
    """Largest error of each joint in units of the predicted error, (windows, joints)."""
    largest_nm: np.ndarray
    """Largest error in the unit of the estimates."""
    counts: np.ndarray
    """Whether the window has free motion that is compared with limits, (windows,)."""
    moves: np.ndarray

    @classmethod
    def of(cls, bundle: _core.Bundle, recording: Recording, threads: int) -> Windows:
        """Run the bundle on the recording."""
        _, estimates, error, counted = judge(bundle, recording, threads, FreeMotionConfig())
        counted &= recording.time_s >= WARM_S
        rows = max(1, round(WINDOW_S * recording.rate_hz))
        at = np.arange(0, recording.samples, rows)
        largest, largest_nm = (
            np.maximum.reduceat(np.where(counted[:, None], values, 0.0), at, axis=0)
            for values in (error, np.abs(estimates["tau_ext"]))
        )
        return cls(
            np.append(at, recording.samples),
            largest,
            largest_nm,
            np.logical_or.reduceat(counted, at),
            np.logical_or.reduceat(np.abs(recording.dq).max(axis=1) > MOVING_RAD_S, at),
        )
