"""Scores of a method on one track: contacts detected at equal measured false alarms and at its own limits, errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tauext.data.recording import Recording
from tauext_lab.bench.methods import WARM_UP_S, Answer
from tauext_lab.bench.track import Track
from tauext_lab.evaluate.collisions import delay_quantiles
from tauext_lab.evaluate.events import event_time, labelled_events
from tauext_lab.evaluate.missed_curve import Detected, Scored, detected, equal_false_alarms

MOST_PER_HOUR = 120.0
"""The curve ends there."""
RESAMPLES = 1000
FACTORS = np.geomspace(0.1, 10.0, 61)
"""Of the point's factor: a resample of the recordings chooses among them."""
LEAST_RESAMPLED = 3
"""Recordings with a contact that a bootstrap over recordings needs."""
REST_RAD_S = 0.02


@dataclass(frozen=True)
class Judged:
    """One test recording as a method answered it, and what is known of it."""

    scored: Scored
    own: Scored
    """By the method's own alarm."""
    onsets_s: tuple[float, ...]
    """From the begin of each contact's time to its label, [s]."""
    free_error: np.ndarray | None
    """Sum of |tau_ext| over free samples and their number, (joints + 1,); None: the method has no tau_ext."""
    contact_error: np.ndarray | None
    """The same of |tau_ext - true| in contacts; None also without truth."""


def judge(recording: Recording, answer: Answer, track: Track) -> Judged:
    """Compare an answer with the labels, which the method has not seen.

    An alarm finds a contact if it rises from tolerance_s before its label to tolerance_s after it. Free time ends and
    begins again rest_s later than that.
    """
    time_s = recording.time_s
    late = time_s < WARM_UP_S
    events, _ = labelled_events(recording, track.events, REST_RAD_S)
    spans = [
        (max(one.start_s - track.tolerance_s, 0.0), one.end_s + track.tolerance_s, one.start_s)
        for one in events
        if one.start_s >= WARM_UP_S
    ]
    free = ~event_time(recording, track.tolerance_s) & ~late
    for _, end_s, _ in spans:
        free &= ~((time_s > end_s) & (time_s <= end_s + track.rest_s))
    indices = [(int(np.searchsorted(time_s, a)), int(np.searchsorted(time_s, b, "right"))) for a, b, _ in spans]
    ratio = np.where(late, 0.0, answer.ratio)
    own = ratio if answer.alarm is None else np.where(late, 0.0, 2.0 * answer.alarm)
    errors: list[np.ndarray | None] = [None, None]
    if answer.tau_ext is not None:
        touched = np.zeros(recording.samples, bool)
        for begin, end in indices:
            touched[begin:end] = True
        errors[0] = _sums(answer.tau_ext[free])
        if track.truth and recording.tau_ext is not None:
            errors[1] = _sums((answer.tau_ext - recording.tau_ext)[touched])
    return Judged(
        Scored(recording.t_ns, ratio, free, indices),
        Scored(recording.t_ns, own, free, indices),
        tuple(onset - begin for begin, _, onset in spans),
        *errors,
    )


def _sums(error: np.ndarray) -> np.ndarray:
    known = error[np.isfinite(error).all(axis=1)]
    return np.append(np.abs(known).sum(axis=0), len(known))


def summary(judged: Sequence[Judged], per_hour: float, timed: bool = True) -> dict[str, Any]:
    """All scores as plain JSON.

    Args:
        per_hour: measured false alarms an hour at which methods are compared, at most MOST_PER_HOUR.
        timed: whether labels are exact enough for delays.

    Raises:
        ConfigError: the recordings have no free time.
    """
    scored, own = [one.scored for one in judged], [one.own for one in judged]
    onsets_s = [one.onsets_s for one in judged] if timed else None
    hours = sum(one.hours for one in scored)
    curve, _ = equal_false_alarms(scored, MOST_PER_HOUR)
    point = [one for one in curve if one.false <= per_hour * hours][-1]  # the highest peak as limit raises none
    return {
        "equal": _point(point, scored, onsets_s) | {"found_over_recordings": _bootstrap(scored, point, per_hour)},
        "own": _point(detected(own), own, onsets_s),
        "curve": [[one.false, one.found, round(one.factor, 6)] for one in curve],
        "l1_free": _mean([one.free_error for one in judged]),
        "l1_contact": _mean([one.contact_error for one in judged]),
    }


def _mean(sums: Sequence[np.ndarray | None]) -> list[float] | None:
    """Mean error of each joint; None without any sample."""
    there = [one for one in sums if one is not None]
    total = np.sum(there, axis=0) if there else np.zeros(1)
    return (total[:-1] / total[-1]).tolist() if total[-1] > 0 else None


def _point(at: Detected, scored: Sequence[Scored], onsets_s: Sequence[Sequence[float]] | None) -> dict[str, Any]:
    """Counts with intervals, and delays from the labels."""
    delays = []
    for one, of_contacts in zip(scored, onsets_s or (), strict=onsets_s is not None):
        for (begin, end), onset_s in zip(one.contacts, of_contacts, strict=True):
            if (rise := one.rise(begin, end, at.factor)) is not None:
                delays.append(float(one.t_ns[rise] - one.t_ns[begin]) * 1e-9 - onset_s)
    median_s, p95_s = delay_quantiles(delays)
    return {
        "factor": at.factor, "false": at.false, "hours": at.hours, "false_per_hour": list(at.false_per_hour),
        "found": at.found, "contacts": at.contacts, "found_share": list(at.found_share),
        "delay_median_s": median_s, "delay_p95_s": p95_s,
    }  # fmt: skip


def _bootstrap(scored: Sequence[Scored], point: Detected, per_hour: float) -> list[float] | None:
    """95 % interval of the share that is found, as recordings are drawn anew, each draw at its own equal false alarms.

    None with fewer than LEAST_RESAMPLED recordings with a contact.
    """
    contacts = np.array([len(one.contacts) for one in scored])
    if (contacts > 0).sum() < LEAST_RESAMPLED:
        return None
    factors = np.sort(point.factor * FACTORS)[::-1]  # from the highest on, as equal_false_alarms() goes
    false = np.array([[one.false_alarms(factor) for factor in factors.tolist()] for one in scored])
    found = np.array([[len(one.delays_s(factor)) for factor in factors.tolist()] for one in scored])
    hours = np.array([one.hours for one in scored])
    rng = np.random.default_rng(0)
    shares = []
    for _ in range(RESAMPLES):
        drawn = np.bincount(rng.integers(len(scored), size=len(scored)), minlength=len(scored))
        if not drawn @ contacts:
            continue
        allowed = np.maximum.accumulate(drawn @ false) <= per_hour * (drawn @ hours)
        shares.append((drawn @ found)[allowed][-1] / (drawn @ contacts) if allowed.any() else 0.0)
    return np.quantile(shares, (0.025, 0.975)).tolist()
