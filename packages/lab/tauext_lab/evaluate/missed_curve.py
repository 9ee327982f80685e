"""Missed collisions against false alarms an hour, as all limits of a method are scaled by one factor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
from scipy.stats import binomtest

from tauext.bundle.estimates import Estimates
from tauext.data.recording import Recording
from tauext.errors import ConfigError
from tauext.fit.tail import rate_interval
from tauext.train.held_peaks import count_episodes, held_minimum, hold_lengths, peak_indices
from tauext_lab.evaluate.collisions import GRACE_S, Collision, first_rise
from tauext_lab.evaluate.free_motion import FALSE_ALARM_QUIET_S
from tauext_lab.evaluate.results import CurvePoint

SCALES = np.sort(np.append(np.geomspace(0.05, 10, 60), 1.0))
"""Factors of the limits; 1, the bundle's own, is one of them."""


class MissedCurve:
    r"""Counts, for every factor s, the false alarms and missed collisions with limits s times as high.

    An alarm of limits s L holds at a sample exactly where

    .. math:: \rho(t) = \max_j \min_{t - hold \le t' \le t} |\tau_{ext,j}(t')| / L_j(t') > s

    so one pass over a recording serves all factors.
    """

    def __init__(self, hold_s: float) -> None:
        self._hold_s = hold_s
        self._hours = 0.0
        self._false = np.zeros(len(SCALES), dtype=int)
        self._peaks: list[float] = []

    def add_free(self, recording: Recording, estimates: Estimates) -> None:
        """Add one recording of free motion."""
        rho = held_ratio(estimates, self._hold_s)
        quiet = round(FALSE_ALARM_QUIET_S * recording.rate_hz)
        self._hours += estimates.healthy.sum() / recording.rate_hz / 3600
        at = np.arange(len(rho))
        for k, scale in enumerate(SCALES):  # a value over a limit is over all lower ones
            at = at[rho[at] > scale]
            if len(at) == 0:
                break
            self._false[k] += 1 + int((np.diff(at) > quiet).sum())

    def add_collisions(self, touches: Sequence[Collision], recording: Recording, estimates: Estimates) -> None:
        """Add the collisions of one recording, each by its largest ratio from onset to the end of the grace time."""
        if touches:
            rho = held_ratio(estimates, self._hold_s)
            grace = round(GRACE_S * recording.rate_hz)
            self._peaks += [float(rho[touch.begin : touch.end + grace].max()) for touch in touches]

    def summary(self) -> tuple[CurvePoint, ...]:
        """One point per factor."""
        peaks, hours = np.array(self._peaks), self._hours
        return tuple(
            CurvePoint(scale, false / hours if hours else None, int((peaks <= scale).sum()))
            for scale, false in zip(SCALES.tolist(), self._false.tolist(), strict=True)
        )


def held_ratio(estimates: Estimates, hold_s: float) -> np.ndarray:
    """rho of every sample, (samples,): see MissedCurve; 0 unless its whole hold time is past and healthy."""
    ratio = np.abs(estimates.tau_ext) / estimates.limit_nm
    held = held_minimum(ratio, estimates.healthy, hold_lengths(estimates.t_ns, hold_s))
    return np.nan_to_num(reduce(np.maximum, held.T))  # over joints; along short rows it would be slow


# --- Methods of any kind at equal measured false alarms, by the score of every sample.


@dataclass(frozen=True)
class Scored:
    """One recording as a method scores it: by the ratio to its own limit, so that a factor scales all limits."""

    t_ns: np.ndarray  # (samples,)
    score: np.ndarray  # (samples,)
    free: np.ndarray  # (samples,) bool: an alarm there is false
    contacts: Sequence[tuple[int, int]] = ()
    """First sample of each labelled contact, and the one after the last in which an alarm finds it."""

    @property
    def hours(self) -> float:
        """Free time: each sample counts for the time to the next."""
        steps = np.diff(self.t_ns, append=self.t_ns[-1])
        return float(steps[self.free].sum()) * 1e-9 / 3600

    def false_alarms(self, factor: float) -> int:
        """Number of them with limits so many times as high."""
        return count_episodes(np.where(self.free, self.score, np.nan), self.t_ns, factor)

    def delays_s(self, factor: float) -> list[float]:
        """Time from the begin of each contact that is found to its alarm, [s]; an alarm that was already on finds
        nothing."""
        found = [(begin, self.rise(begin, end, factor)) for begin, end in self.contacts]
        return [float(self.t_ns[at] - self.t_ns[begin]) * 1e-9 for begin, at in found if at is not None]

    def rise(self, begin: int, end: int, factor: float) -> int | None:
        """First sample from `begin` to before `end` at which an alarm rises with limits so many times as high."""
        over = self.score[max(begin - 1, 0) : end] > factor
        first = first_rise(over[1:], bool(over[0])) if begin > 0 else first_rise(over, False)
        return None if first is None else begin + first


@dataclass(frozen=True)
class Detected:
    """What a method detects with limits scaled by one factor, and its false alarms."""

    factor: float
    false: int
    hours: float
    delays_s: tuple[float, ...]
    """Of the contacts that are found."""
    contacts: int

    @property
    def found(self) -> int:
        """Number of contacts that are found."""
        return len(self.delays_s)

    @property
    def false_per_hour(self) -> tuple[float, float]:
        """95 % interval of the rate of false alarms, see rate_interval."""
        return rate_interval(self.false, self.hours)

    @property
    def found_share(self) -> tuple[float, float]:
        """95 % interval of the share of contacts that are found, by Clopper and Pearson; (0, 1) of no contact."""
        interval = binomtest(self.found, self.contacts).proportion_ci() if self.contacts else (0.0, 1.0)
        return float(interval[0]), float(interval[1])


def detected(recordings: Sequence[Scored], factor: float = 1.0) -> Detected:
    """What a method detects in these recordings with limits so many times as high."""
    return Detected(
        factor,
        sum(one.false_alarms(factor) for one in recordings),
        sum(one.hours for one in recordings),
        tuple(delay for one in recordings for delay in one.delays_s(factor)),
        sum(len(one.contacts) for one in recordings),
    )


def equal_false_alarms(recordings: Sequence[Scored], per_hour: float) -> tuple[tuple[Detected, ...], Detected]:
    """What a method detects for each number of false alarms that is allowed, from 0 on; and the last point.

    The factor of a point is the lowest that raises no more false alarms in these recordings, nor does any higher one:
    `false` is the largest number over these factors. The last points of several methods on the same recordings compare
    them at equal measured false alarms.

    Args:
        per_hour: largest measured rate of false alarms, [1/h].

    Raises:
        ConfigError: the recordings have no free time.
    """
    hours = sum(one.hours for one in recordings)
    if not hours > 0:
        raise ConfigError("the recordings have no free time, so false alarms cannot be counted")
    free = [np.where(one.free, one.score, np.nan) for one in recordings]
    # A new false alarm appears only where the factor falls below a peak.
    peaks = [values[peak_indices(values, one.t_ns)] for values, one in zip(free, recordings, strict=True)]
    lowest: dict[int, float] = {}
    false = 0
    for factor in np.unique(np.concatenate([*peaks, [0.0]]))[::-1].tolist():
        false = max(false, sum(one.false_alarms(factor) for one in recordings))
        if false > per_hour * hours:
            break
        lowest[false] = factor
    curve = tuple(replace(detected(recordings, factor), false=false) for false, factor in lowest.items())
    return curve, curve[-1]
