"""Errors and false alarms in free motion and after contacts, and whether promises and limits hold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from tauext import _core
from tauext.bundle.estimates import COLLISION, CONTACT, Estimates
from tauext.data.free_motion import free_samples
from tauext.data.recording import Recording
from tauext.fit.tail import is_kept, rate_interval
from tauext_lab.evaluate.collisions import GRACE_S, Collision, judge_latched
from tauext_lab.evaluate.noticed_force import LEAST_LIMIT_NM, noticed
from tauext_lab.evaluate.results import AfterContacts, Aftermath, FreeMotion, NoticedForce, Numbers, SanityRow

# --- Errors in free motion, where tau_ext is the error.


FALSE_ALARM_QUIET_S = 0.5
"""Detections closer together than this are one false alarm."""


@dataclass
class FreeMotionErrors:
    """Sums over the healthy samples of test recordings, per joint."""

    joints: int
    near_stiction_rad_s: float = 0.02
    """Speed between the paper's two regions; errors of all bundles are split at it."""
    recordings: list[str] = field(default_factory=list)
    samples: int = 0
    seconds: float = 0.0
    false_alarms: int = 0
    """Single samples over a limit."""
    false_collisions: int = 0
    """Alarms that outlasted the hold time, as a monitor latches them."""

    def __post_init__(self) -> None:
        zeros = np.zeros(self.joints)
        self._l1, self._square, self._near_square, self._near = (zeros.copy() for _ in range(4))
        self._largest_r = zeros.copy()

    def add(self, recording: Recording, estimates: Estimates) -> None:
        """Add one recording of free motion."""
        healthy = estimates.healthy
        error = estimates.tau_ext[healthy].astype(float)
        near = np.abs(recording.dq[healthy]) < self.near_stiction_rad_s
        square = error**2
        ones = np.ones(len(error))  # sums as products: sums along such short rows take ten times as long
        self._l1 += ones @ np.abs(error)
        self._square += ones @ square
        self._near_square += ones @ np.where(near, square, 0)
        self._near += ones @ near
        largest = [np.abs(column).max(initial=0) for column in estimates.residual[healthy].T]
        self._largest_r = np.maximum(self._largest_r, largest)
        self.samples += int(healthy.sum())
        self.seconds += healthy.sum() / recording.rate_hz
        self.recordings.append(recording.name)
        quiet = round(FALSE_ALARM_QUIET_S * recording.rate_hz)
        self.false_alarms += count_episodes(estimates.detection, quiet)
        self.false_collisions += count_episodes(estimates.held_alarm == COLLISION, quiet)

    def summary(self, promised: float | None, at_most: float | None = None) -> FreeMotion:
        """Errors, and whether there are no more false collisions than the limits state.

        promise_consistent: the rate that limits are set for lies in the 95 % interval. promise_kept: the largest rate
        that agrees with the limits makes this many false collisions or more plausible. None without a rate. Without a
        healthy sample of free motion nothing was measured, and everything is None.

        Args:
            promised: rate that limits are set for, [1/h]; None: none.
            at_most: upper end of the interval of extrapolated limits, [1/h]; None: `promised`.
        """
        sliding = self.samples - self._near
        with np.errstate(invalid="ignore", divide="ignore"):
            mean, mse, near_share = self._l1 / self.samples, self._square / self.samples, self._near / self.samples
            near_rmse = np.sqrt(self._near_square / self._near)
            sliding_rmse = np.sqrt((self._square - self._near_square) / sliding)
        hours, false, is_measured = float(self.seconds) / 3600, self.false_collisions, self.seconds > 0
        known, interval = (promised, rate_interval(false, hours)) if is_measured else (None, None)
        most = promised if at_most is None else at_most
        return FreeMotion(
            recordings=tuple(self.recordings),
            hours=hours,
            samples=self.samples,
            l1_nm=numbers(mean),
            l2_nm=numbers(np.sqrt(mse)),
            mse_nm2=numbers(mse),
            rmse_near_stiction_nm=numbers(near_rmse),
            rmse_sliding_nm=numbers(sliding_rmse),
            near_stiction_share=numbers(near_share),
            observer_peak_nm=numbers(self._largest_r if is_measured else np.full(self.joints, np.nan)),
            false_alarms=self.false_alarms if is_measured else None,
            false_alarms_per_hour=self.false_alarms / hours if is_measured else None,
            false_collisions=false if is_measured else None,
            promised_per_hour=promised,
            false_collisions_interval_per_hour=interval,
            promise_consistent=None if known is None or interval is None else interval[0] <= known <= interval[1],
            promise_kept=None if known is None or most is None else is_kept(false, hours, most),
            at_most_per_hour=most,
        )


def count_episodes(flags: np.ndarray, quiet_samples: int) -> int:
    """Number of runs of true flags; runs less than quiet_samples apart count as one."""
    at = np.flatnonzero(flags)
    return 0 if len(at) == 0 else 1 + int((np.diff(at) > quiet_samples).sum())


def numbers(values: np.ndarray) -> Numbers:
    """Values for JSON, which has no NaN: None if a number does not exist."""
    return tuple(float(v) if np.isfinite(v) else None for v in values)


# --- After a contact: errors, and alarms that begin when nothing touches the arm any more.


EDGES_S = (0.2, 0.5, 1.0, 1.5, 2.5)
"""Bins of the time since the end of a touch; before, the observer itself still lags."""
QUIET_S = 0.1
"""An alarm begins if none of its level was held for this time before; alarms that last from the touch do not."""
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
        """Add one recording of free motion."""
        self._add(np.where(estimates.healthy, len(EDGES_S) - 1, -1), recording, estimates)

    def add_touched(self, recording: Recording, estimates: Estimates) -> None:
        """Add one recording with contacts; time with unknown contact state is not counted."""
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
        for name, level in LEVELS.items():
            begun = where[beginnings(estimates.held_alarm >= level, round(QUIET_S * recording.rate_hz))]
            self._begun[name] += np.bincount(begun + 1, minlength=bins + 1)[1:]

    def summary(self) -> AfterContacts:
        *bins, free = (self._aftermath(k, *ends) for k, ends in enumerate((*pairwise(EDGES_S), (None, None))))
        return AfterContacts(tuple(bins), free)

    def _aftermath(self, k: int, from_s: float | None, to_s: float | None) -> Aftermath:
        hours = float(self._seconds[k]) / 3600
        contacts, collisions = (int(begun[k]) for begun in self._begun.values())
        with np.errstate(invalid="ignore"):
            rmse = np.sqrt(self._square[k] / self._samples[k])
        return Aftermath(
            from_s=from_s,
            to_s=to_s,
            hours=hours,
            contacts=contacts,
            contacts_per_hour=contacts / hours if hours else None,
            collisions=collisions,
            collisions_per_hour=collisions / hours if hours else None,
            rmse_nm=numbers(rmse),
        )


def time_since_touch(recording: Recording) -> np.ndarray:
    """Since the last sample of the last touch, (samples,), [s]; NaN during touches, before the first, and from where it
    is unknown whether something touches until the next touch ends."""
    assert recording.contact is not None
    marked = np.where(recording.contact != 0, np.arange(recording.samples), -1)
    last = np.maximum.accumulate(marked)
    ended = (recording.contact == 0) & (last >= 0) & (recording.contact[last] == 1)
    return np.where(ended, (recording.t_ns - recording.t_ns[last]) * 1e-9, np.nan)


def beginnings(flags: np.ndarray, quiet_samples: int) -> np.ndarray:
    """Indices of true flags without another in the quiet_samples before them; no flag precedes the first sample."""
    at = np.flatnonzero(flags)
    return at[np.diff(at, prepend=-quiet_samples - 1) > quiet_samples]


# --- Errors against the reference during contacts.


class DuringContact:
    """Sums over the healthy samples from the onset of each collision to the grace after its end, a joint each."""

    def __init__(self, joints: int) -> None:
        self._square = np.zeros(joints)
        self._samples = 0

    def add(
        self, touches: Sequence[Collision], recording: Recording, estimates: Estimates, reference: np.ndarray | None
    ) -> None:
        """Add the collisions of one recording; without a reference nothing is compared."""
        if reference is None:
            return
        for touch in touches:
            window = slice(touch.begin, touch.end + round(GRACE_S * recording.rate_hz))
            healthy = estimates.healthy[window]
            error = estimates.tau_ext[window][healthy] - reference[window][healthy]
            self._square += (error**2).sum(axis=0)
            self._samples += len(error)

    def rmse_nm(self) -> Numbers:
        with np.errstate(invalid="ignore"):
            return numbers(np.sqrt(self._square / self._samples))


# --- Poses of free motion with their limits, and the smallest force that exceeds these limits.


ROW_S = 1.0
"""Time between the kept poses of a recording; a day of them is 3 MB an arm."""
MOST_POSES = 256
"""Number of poses at which forces are computed, evenly spread in time."""


class LimitsHeld:
    """Poses of the healthy samples of free motion, both limits there, and the standard error."""

    def __init__(self) -> None:
        self._rows: list[np.ndarray] = []

    def add(self, recording: Recording, estimates: Estimates) -> None:
        """Add a recording; unhealthy samples are left out."""
        if estimates.contact_limit_nm is None or estimates.sigma_nm is None:
            return
        columns = (estimates.limit_nm, estimates.contact_limit_nm, estimates.sigma_nm)
        counted = estimates.healthy & np.all([np.isfinite(one).all(axis=1) for one in columns], axis=0)
        at = np.flatnonzero(counted)[:: max(1, round(ROW_S * recording.rate_hz))]
        self._rows.append(np.stack([recording.q[at], *(one[at] for one in columns)], axis=1).astype(np.float32))

    def summary(self, bundle: _core.Bundle, frames: Sequence[str] = ()) -> NoticedForce | None:
        """The result of noticed(), or the reason if the bundle cannot estimate forces; None without any pose."""
        if refused := _core.WrenchModel(bundle).refused:
            return NoticedForce(refused)
        rows = np.concatenate(self._rows) if self._rows else np.empty((0, 4, bundle.joints))
        if len(rows) == 0:
            return None
        at = np.unique(np.linspace(0, len(rows) - 1, min(MOST_POSES, len(rows))).round().astype(int))
        q, limit, contact, sigma = np.moveaxis(rows[at].astype(float), 1, 0)
        error_share = float(np.median(sigma / np.maximum(limit, LEAST_LIMIT_NM)))
        return noticed(bundle, q, {"collision": limit, "contact": contact}, error_share, frames)


# --- Detectors without information, evaluated like the methods: the baseline of every number.


RANDOM_PER_HOUR = 60.0
RANDOM_S = 0.1
WORTH = {
    "always": "in alarm at every collision, but at every other moment too: one unbroken alarm, which latches nothing",
    "never": "no false alarm, and no collision",
    "random": (
        f"alarms of {RANDOM_S:g} s at random times, {RANDOM_PER_HOUR:g} an hour in the long run, which a short test "
        "need not show: what is found so is chance"
    ),
}


@dataclass
class Sanity:
    """One such detector; gets the same recordings as the methods, in the same order."""

    name: str
    """always, never or random."""
    seed: int
    _false: int = 0
    _alarmed: int = 0
    _samples: int = 0
    _hours: float = 0.0
    _in_alarm: bool = False
    _found: list[bool] = field(default_factory=list)
    _latched: list[bool] = field(default_factory=list)

    def add_free(self, number: int, recording: Recording) -> None:
        """Take in one recording of free motion; an alarm continued from the last one is not counted again."""
        free = free_samples(recording)
        alarm = self.alarms(number, recording) & free
        at = np.flatnonzero(alarm)
        apart = np.diff(at) > round(FALSE_ALARM_QUIET_S * recording.rate_hz)
        self._false += (len(at) > 0 and not (self._in_alarm and alarm[0])) + int(apart.sum())
        self._in_alarm = bool(alarm[-1])
        self._alarmed += len(at)
        self._samples += int(free.sum())
        self._hours += free.sum() / recording.rate_hz / 3600

    def add_collisions(
        self, number: int, touches: Sequence[Collision], recording: Recording, estimates: Estimates
    ) -> None:
        """Add the collisions of one recording; only the times and limits of the estimates are used."""
        alarm = self.alarms(number, recording)
        alarmed = replace(estimates, held_alarm=np.where(alarm, COLLISION, 0).astype(np.int8))
        for touch in touches:
            self._latched.append(judge_latched(touch, recording, alarmed, 0.0, None).latched)
            self._found.append(bool(alarm[touch.begin : touch.end + round(GRACE_S * recording.rate_hz)].any()))

    def alarms(self, number: int, recording: Recording) -> np.ndarray:
        """Its alarm, (samples,) bool; the random detector depends on the seed and the number of the recording."""
        if self.name != "random":
            return np.full(recording.samples, self.name == "always")
        rng = np.random.default_rng([self.seed, number])
        length_s = recording.samples / recording.rate_hz
        starts_s = rng.uniform(0, length_s, rng.poisson(RANDOM_PER_HOUR * length_s / 3600))
        time_s = recording.time_s
        begun = np.searchsorted(time_s, starts_s)
        ended = np.searchsorted(time_s, starts_s + RANDOM_S)
        steps = np.bincount(begun, minlength=recording.samples + 1) - np.bincount(
            ended, minlength=recording.samples + 1
        )
        return np.cumsum(steps)[:-1] > 0

    def summary(self) -> SanityRow:
        return SanityRow(
            name=self.name,
            false_per_hour=self._false / self._hours if self._hours else None,
            time_in_alarm_share=self._alarmed / self._samples if self._samples else None,
            collisions=len(self._found),
            found=sum(self._found),
            latched=sum(self._latched),
            worth=WORTH[self.name],
        )


def sanity_detectors(seed: int) -> list[Sanity]:
    """One detector of each kind."""
    return [Sanity(name, seed) for name in WORTH]
