"""Peaks of the error in free motion, as an alarm with a hold time sees it: of the held minimum (held_minimum.py).

A joint has one limit for sliding and one near stiction. A window with samples of both counts for both: an alarm there
has every sample over its own limit, hence the window's minimum over the lower of the two. So the alarms of an arm are
at most the sum of what is counted for its joints and regions.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from tauext import _core
from tauext.config import FreeMotionConfig
from tauext.data.recording import Recording
from tauext.errors import ConfigError
from tauext.train.held_minimum import held_minimum, hold_lengths
from tauext.train.judged import Judged, errors, no_free_motion
from tauext.train.kept_peaks import KeptPeaks

REGIONS = ("sliding", "near_stiction")
GAP_S = 0.5
"""Alarms less than this apart are one false alarm, [s]."""
KEEP = 4000
"""Peaks that are kept of each joint and region: the largest. A tail is a twentieth of them at most."""
AT_A_TIME = 4
"""Recordings that are estimated at a time, at most."""


def cluster_peaks(values: np.ndarray, times_s: np.ndarray, gap_s: float = GAP_S, floor: float = 0.0) -> np.ndarray:
    """The largest value of each episode over a floor, (episodes,), in order of time. Over a limit: its false alarms.

    An episode is a set of values > floor, each less than gap_s after the one before; NaN is never over the floor.

    Args:
        values: (samples,).
        times_s: increasing, (samples,), [s].
    """
    at = np.flatnonzero(values > floor)
    if len(at) == 0:
        return np.zeros(0)
    return np.maximum.reduceat(values[at], np.r_[0, 1 + np.flatnonzero(np.diff(times_s[at]) >= gap_s)])


def separate_peaks(values: np.ndarray, t_ns: np.ndarray, gap_s: float = GAP_S, floor: float = 0.0) -> np.ndarray:
    """The values at `peak_places`, (peaks,), in order of time."""
    return values[peak_places(values, t_ns, gap_s, floor)]


def peak_places(values: np.ndarray, t_ns: np.ndarray, gap_s: float = GAP_S, floor: float = 0.0) -> np.ndarray:
    """Indices of values > floor with none larger less than gap_s before or after, (peaks,), rising.

    Of equal ones the first. Any two lie gap_s or more apart, and **over any level from the floor up there are at least
    as many peaks as episodes**, because the largest value of each episode is a peak. The largest values of episodes
    over a low floor are no substitute: one of those may be several alarms to a higher limit, which then would be
    promised too few.

    Args:
        values: (samples,); NaN is no value.
        t_ns: increasing, (samples,), [ns].
    """
    at = np.flatnonzero(values > floor)  # what is larger than a value over the floor is over it too
    if len(at) == 0:
        return at
    value, t, gap_ns = values[at], t_ns[at], max(1, round(gap_s * 1e9))
    # Values of one block lie less than a gap apart, so only its largest, and of equal ones the first, can be a peak.
    starts = np.r_[0, 1 + np.flatnonzero(np.diff(t // gap_ns))]
    ends = np.append(starts[1:], len(at))
    of_block = np.repeat(np.arange(len(starts)), ends - starts)
    largest = np.flatnonzero(value == np.maximum.reduceat(value, starts)[of_block])
    k = largest[np.unique(of_block[largest], return_index=True)[1]]
    # What else is less than a gap away stands at the end of the block before and at the beginning of the next one.
    first, last = np.searchsorted(t, t[k] - gap_ns, side="right"), np.searchsorted(t, t[k] + gap_ns, side="left")
    before, after = _largest_between(value, first, starts), _largest_between(value, ends, last)
    return at[k[(value[k] > before) & (value[k] >= after)]]


@dataclass(frozen=True, eq=False)
class Peaks:
    """Peaks of the held error in free motion, and the time in which they were seen."""

    joints: tuple[str, ...]
    hold_s: float
    gap_s: float
    hours: float
    """Of healthy operation: what a budget of false alarms counts."""
    region_hours: np.ndarray
    """(joints, regions): how long a joint was in a region."""
    nm: tuple[tuple[np.ndarray, ...], ...]
    """[joint][region]: the largest peaks, falling, (peaks,), [N m]."""
    at: tuple[tuple[np.ndarray, ...], ...]
    """[joint][region]: which recording each of them is of, and when after its first sample [ns], (peaks, 2), int64."""
    recordings: tuple[str, ...] = ()
    """Names, in the order in which they came; a recording of which several spans are judged comes several times."""


class PeakCollector:
    """Takes in one recording after the other and keeps the largest peaks of every joint and region.

    The floor under which peaks are left out is the least that is kept, once `keep` are there: what is kept at the end
    are the largest of all recordings, in whatever order they came.

    Raises:
        ConfigError: a hold time outside 0 to 60 s, a gap not > 0 or keep < 1.
    """

    def __init__(self, joints: Sequence[str], hold_s: float, gap_s: float = GAP_S, keep: int = KEEP) -> None:
        for ok, what, rule in (
            (0 <= hold_s <= 60, f"hold_s = {hold_s}", "0 to 60"),
            (gap_s > 0, f"gap_s = {gap_s}", "> 0"),
            (keep >= 1, f"keep = {keep}", ">= 1"),
        ):
            if not ok:
                raise ConfigError(f"{what} must be {rule}")
        self._joints, self._hold_s, self._gap_s, self._keep = tuple(joints), hold_s, gap_s, keep
        self._hours = 0.0
        self._region_hours = np.zeros((len(self._joints), len(REGIONS)))
        self._nm = [[np.zeros(0) for _ in REGIONS] for _ in self._joints]
        self._at = [[np.zeros((0, 2), dtype=np.int64) for _ in REGIONS] for _ in self._joints]
        self._recordings = 0

    def add(self, t_ns: np.ndarray, tau_ext: np.ndarray, near_stiction: np.ndarray, healthy: np.ndarray) -> None:
        """Take in one recording of free motion; peaks of two recordings are separate however they follow.

        Args:
            t_ns: increasing, (samples,), [ns].
            tau_ext: (samples, joints), [N m]; what it is while unhealthy does not matter.
            near_stiction: (samples, joints), bool.
            healthy: (samples,), bool.
        """
        healthy, near_stiction = np.asarray(healthy, dtype=bool), np.asarray(near_stiction, dtype=bool)
        # A step counts where both its ends are healthy, so that warming up and long gaps do not.
        step_h = np.where(healthy[1:] & healthy[:-1], np.diff(t_ns), 0) / 3.6e12
        self._hours += float(step_h.sum())
        hold = hold_lengths(t_ns, self._hold_s)
        first = np.maximum(np.arange(len(t_ns)) - hold, 0)
        for joint in range(len(self._joints)):
            held = held_minimum(np.abs(tau_ext[:, joint]), healthy, hold)
            near = near_stiction[:, joint]
            near_before = np.r_[0, np.cumsum(near)]
            for region, inside in enumerate((~near, near)):
                self._region_hours[joint, region] += float(step_h @ inside[1:])
                kept = self._nm[joint][region]
                floor = float(kept[-1]) if len(kept) == self._keep else 0.0
                at = np.flatnonzero(held > floor)  # soon few, so what follows costs little
                near_samples = near_before[at + 1] - near_before[first[at]]
                touched = at[near_samples > 0 if region else near_samples < at + 1 - first[at]]
                found = touched[peak_places(held[touched], t_ns[touched], self._gap_s, floor)]
                values = np.r_[kept, held[found]]
                places = np.column_stack([np.full(len(found), self._recordings), t_ns[found] - t_ns[0]])
                order = np.argsort(-values, kind="stable")[: self._keep]
                self._nm[joint][region] = values[order]
                self._at[joint][region] = np.concatenate([self._at[joint][region], places])[order]
        self._recordings += 1

    def peaks(self, recordings: Sequence[str] = ()) -> Peaks:
        """What was found so far, in recordings of these names."""
        nm, at = (
            tuple(tuple(of_region.copy() for of_region in of_joint) for of_joint in kept)
            for kept in (self._nm, self._at)
        )
        hours = self._region_hours.copy()
        return Peaks(self._joints, self._hold_s, self._gap_s, self._hours, hours, nm, at, tuple(recordings))


def collect_peaks(
    bundle: _core.Bundle,
    recordings: Iterable[Recording | Judged],
    holds_s: Sequence[float],
    threads: int,
    gap_s: float = GAP_S,
    keep: int = KEEP,
    margins: FreeMotionConfig = FreeMotionConfig(),  # noqa: B008
    kept: KeptPeaks | None = None,
) -> tuple[Peaks, ...]:
    """Run the bundle on recordings of free motion; the peaks for each hold time, in their order.

    Contacts and what is near them are left out.

    Recordings are taken one at a time, and the next few are estimated while the peaks of one are picked: a generator
    that loads them needs the memory of AT_A_TIME and two more. They must fit the bundle, and be none that it was
    trained on.

    Args:
        threads: of the estimates, 0: one a core. The result does not depend on it.
        kept: what a killed process has done of this; `recordings` begins behind that.

    Raises:
        TrainingError: no recording with a healthy sample of free motion.
        ConfigError: as PeakCollector.
    """
    collectors = [PeakCollector([link.joint_name for link in bundle.links], hold, gap_s, keep) for hold in holds_s]
    names: list[str] = []
    if kept and kept.collectors:
        collectors, names = kept.collectors, list(kept.names)

    def named() -> Iterator[Recording | Judged]:
        for one in recordings:
            names.append((one.recording if isinstance(one, Judged) else one).name)
            yield one

    for samples in _errors(bundle, named(), threads or os.cpu_count() or 1, margins):
        for collector in collectors:
            collector.add(*samples)
        if kept:
            kept.offer(collectors, names)
    found = tuple(collector.peaks(names) for collector in collectors)
    if any(peaks.hours == 0 for peaks in found):
        raise no_free_motion(bundle, margins)
    return found


def _errors(
    bundle: _core.Bundle, recordings: Iterable[Recording | Judged], threads: int, margins: FreeMotionConfig
) -> Iterator[tuple[np.ndarray, ...]]:
    """What PeakCollector.add takes, for each recording in their order; up to AT_A_TIME are estimated at a time, since
    only the network's part of an estimate runs in several threads."""
    workers = min(threads, AT_A_TIME)
    with ThreadPoolExecutor(workers) as pool:
        coming: deque[Future] = deque()
        for recording in recordings:
            coming.append(pool.submit(errors, bundle, recording, threads // workers, margins))
            if len(coming) > workers:
                yield coming.popleft().result()
        while coming:
            yield coming.popleft().result()


def _largest_between(values: np.ndarray, first: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Largest of values[first..end - 1] for each pair of indices, -inf where there is none."""
    out, some = np.full(len(first), -np.inf), first < end
    pairs = np.stack([first[some], end[some]], axis=1).ravel()
    out[some] = np.maximum.reduceat(np.append(values, -np.inf), pairs)[::2]  # an end may be one past the last value
    return out
