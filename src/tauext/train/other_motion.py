"""By how much limits from minutes of data fail in motion that the minutes do not show: each recording in turn is judged
by limits that follow from the others."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from tauext._core import MotionFeature
from tauext.train.error_scale import FEATURES, Rows, limit_weights
from tauext.train.held_minimum import held_minimum, hold_lengths
from tauext.train.held_peaks import PeakCollector, cluster_peaks, separate_peaks
from tauext.train.promise import duration
from tauext.train.promised_limits import PromisedLimits, limits_of
from tauext.train.tail import TooFewPeaks

FEWEST = 3
"""Recordings. With two, one alone would have to show every error of the other."""
NOT_MEASURED = (
    f"How the limits hold in other kinds of motion is unknown: that takes {FEWEST} recordings or more, each long "
    "enough to be left out in turn."
)
MOST_TURNS = 40
"""More recordings than this are left out several at a time."""
UPPER = 1.645
"""One-sided 95 % of a normal distribution, in standard deviations."""


@dataclass(frozen=True)
class OtherMotion:
    """False alarms in recordings whose limits follow from the others."""

    false: dict[str, int]
    """Of each recording."""
    promised: float
    """False alarms that the budget of these limits allows in the same time."""
    hours: float
    kept_by: float
    """Limits so many times as high would have kept the promise in them."""

    @property
    def factor(self) -> float:
        """False alarms for each promised one."""
        return sum(self.false.values()) / self.promised

    @property
    def at_most(self) -> float:
        """The factor's upper bound at 95 %, as far as these recordings differ: they count, not their alarms."""
        counts = np.array(list(self.false.values()), dtype=float)
        return self.factor + UPPER * math.sqrt(len(counts)) * float(counts.std(ddof=1)) / self.promised

    def sentence(self) -> str:
        """In words."""
        some = {name: count for name, count in self.false.items() if count}
        words = (
            f"Each recording was judged by limits from the others. False alarms in {duration(self.hours)}: "
            f"{sum(some.values())}, in {len(some)} of {len(self.false)} recordings; promised: {self.promised:.2g}."
        )
        if self.at_most <= 1:
            return f"{words} So the promise also holds from one recording to the next."
        words += (
            f" In motion of a kind that no recording shows, expect {self.factor:.2g} times the promised false alarms "
            f"(up to {self.at_most:.2g} times, at 95 % confidence)."
        )
        if self.factor <= 1:
            return words
        most = max(some, key=lambda name: some[name])
        return (
            f"{words} Most, {some[most]}, came in {most}: more recordings of such motion help. Limits "
            f"{self.kept_by:.2g} times as high (--alarm.minutes-factor) would have kept the promise, and detect less."
        )

    def facts(self) -> dict:
        """All of it for JSON."""
        return asdict(self) | {"factor": self.factor, "at_most": self.at_most, "sentence": self.sentence()}


def other_motion(
    rows: Rows,
    joints: Sequence[str],
    promised: PromisedLimits,
    level_confidence: float,
    factor: float,
    reserve_nm: tuple[np.ndarray, np.ndarray] | None = None,
) -> OtherMotion | None:
    """Count false alarms in each recording by limits from the others, found as set_supported_limits finds them.

    The error scale is fitted to the other recordings, too, and ends at the largest that they show. What remains of the
    recording itself is in the prior, if that was not fitted without it.

    Args:
        rows: errors on free motion, of all recordings.
        joints: their names.
        promised: what the limits of all recordings are set for, and their hold time.
        level_confidence: with which each limit keeps its share of the budget.
        factor: on the limits.
        reserve_nm: what is added to the limits at rest [N m], and for each rad/s, (joints,) each.

    Returns:
        None where the recordings are too few, or too short to find limits without one of them.
    """
    numbers = np.unique(rows.recording)
    if len(numbers) < FEWEST:
        return None
    rows = rows.only(np.lexsort((rows.t_ns, rows.recording)))
    counts = dict.fromkeys(rows.recordings, 0)
    peaks: list[np.ndarray] = []
    for turn in np.array_split(numbers, min(len(numbers), MOST_TURNS)):
        left_out = np.isin(rows.recording, turn)
        own, others = rows.only(left_out), rows.only(~left_out)
        try:
            limit_nm = factor * _limits(others, own, joints, promised, level_confidence)
        except TooFewPeaks:
            return None
        if reserve_nm is not None:
            at_rest, per_speed = reserve_nm
            limit_nm += at_rest + per_speed * own.features[:, :, FEATURES.index(MotionFeature.speed)]
        ratio = own.error_nm / limit_nm
        for number in turn:
            at = own.recording == number
            held = _held(ratio[at], own.t_ns[at], promised.hold_s)
            counts[rows.recordings[number]] = len(cluster_peaks(held, 1e-9 * (own.t_ns[at] - own.t_ns[at][0]), floor=1))
            peaks.append(separate_peaks(held, own.t_ns[at], floor=1))
    allowed = promised.budget.rate_per_hour * rows.hours
    over = np.sort(np.concatenate(peaks))[::-1]
    kept_by = float(over[int(allowed)]) if len(over) > allowed else 1.0
    return OtherMotion(counts, allowed, rows.hours, kept_by)


def _limits(
    others: Rows, own: Rows, joints: Sequence[str], promised: PromisedLimits, level_confidence: float
) -> np.ndarray:
    """The collision limits that other rows ask for on these, (own rows, joints), [N m].

    Raises:
        TooFewPeaks: there are too few others.
    """
    weights = np.array([limit_weights(others, j) for j in range(len(joints))])
    scale = np.einsum("rjf,jf->rj", others.features, weights)
    collector = PeakCollector(joints, promised.hold_s)
    for number in np.unique(others.recording):
        at = others.recording == number
        healthy = np.ones(int(at.sum()), dtype=bool)
        collector.add(others.t_ns[at], others.error_nm[at] / scale[at], others.near_stiction[at], healthy)
    found, _ = limits_of(collector.peaks(), promised.budget, level_confidence, at_most_seen=True)
    own_scale = np.minimum(np.einsum("rjf,jf->rj", own.features, weights), scale.max(axis=0))
    return own_scale * np.where(own.near_stiction, found.near_stiction_nm, found.sliding_nm)


def _held(ratio: np.ndarray, t_ns: np.ndarray, hold_s: float) -> np.ndarray:
    """Of errors by their limits, (rows, joints), the held minimum of the joint that is farthest over, (rows,)."""
    hold, healthy = hold_lengths(t_ns, hold_s), np.ones(len(t_ns), dtype=bool)
    return np.max([held_minimum(of_joint, healthy, hold) for of_joint in ratio.T], axis=0)
