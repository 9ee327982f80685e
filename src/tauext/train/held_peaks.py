"""Peaks of the error in free motion behind a hold time, and moments that alone determine a limit."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Protocol

import numpy as np

from tauext import _core
from tauext.config import FreeMotionConfig
from tauext.data.recording import Recording
from tauext.errors import ConfigError
from tauext.files.checkpoint import Checkpoint
from tauext.fit.tail import held_minimum, hold_lengths
from tauext.train.error_scale import Judged, judge_all, no_free_motion

# --- Peaks of calibration recordings kept from an interrupted process.


class PeakStore(Protocol):
    """Peaks of recordings that need not be read again."""

    collectors: list[Any]
    """One for each hold time; empty: none yet."""
    names: list[str]
    """Of the recordings, in order of their addition."""

    def offer(self, collectors: list[Any], names: Sequence[str]) -> None:
        """Receive the collectors after one more recording."""


class KeptPeaks:
    """Checkpoint of the peaks: those of an interrupted process, and this process's own."""

    def __init__(self, checkpoint: Checkpoint):
        self._checkpoint = checkpoint
        self.collectors: list[Any]
        self.names: list[str]
        self.collectors, self.names = checkpoint.load(tuple[list[PeakCollector], list[str]]) or ([], [])
        self._taken = len(self.names)

    def offer(self, collectors: list[Any], names: Sequence[str]) -> None:
        """Offer a checkpoint after one more recording; `names` includes the next few, already estimated."""
        self._taken += 1
        self._checkpoint.offer((collectors, list(names[: self._taken])))


# --- Peaks of the held minimum in free motion.
#
# A joint has one limit for sliding and one near stiction. A window with samples of both counts for both: an alarm there
# has every sample over its own limit, hence the window's minimum over the lower of the two. So the alarms of an arm are
# at most the sum over joints and regions.


REGIONS = ("sliding", "near_stiction")
GAP_S = 0.5
"""Alarms less than this apart are one false alarm, [s]."""
KEEP = 4000
"""Largest peaks kept for each joint and region. A tail uses at most a twentieth of them."""


def cluster_peaks(values: np.ndarray, times_s: np.ndarray, gap_s: float = GAP_S, floor: float = 0.0) -> np.ndarray:
    """Largest value of each episode over a floor, (episodes,), in order of time; over a limit, its false alarms.

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
    """Indices of values > floor without a larger value less than gap_s before or after, (peaks,), ascending.

    Of equal values the first counts. Peaks are gap_s or more apart. **Over any level above the floor there are at least
    as many peaks as episodes**, because the largest value of each episode is a peak. Largest values of episodes over a
    low floor are no substitute: one episode may give several alarms at a higher limit.

    Args:
        values: (samples,); NaN is ignored.
        t_ns: increasing, (samples,), [ns].
    """
    at = np.flatnonzero(values > floor)  # values below the floor cannot exceed a peak
    if len(at) == 0:
        return at
    value, t, gap_ns = values[at], t_ns[at], max(1, round(gap_s * 1e9))
    # Values of one block lie less than a gap apart, so only its largest, and of equal ones the first, can be a peak.
    starts = np.r_[0, 1 + np.flatnonzero(np.diff(t // gap_ns))]
    ends = np.append(starts[1:], len(at))
    of_block = np.repeat(np.arange(len(starts)), ends - starts)
    largest = np.flatnonzero(value == np.maximum.reduceat(value, starts)[of_block])
    k = largest[np.unique(of_block[largest], return_index=True)[1]]
    # Other values less than a gap away are at the end of the block before and the beginning of the next one.
    first, last = np.searchsorted(t, t[k] - gap_ns, side="right"), np.searchsorted(t, t[k] + gap_ns, side="left")
    before, after = _largest_between(value, first, starts), _largest_between(value, ends, last)
    return at[k[(value[k] > before) & (value[k] >= after)]]


@dataclass(frozen=True, eq=False)
class Peaks:
    """Peaks of the held error in free motion, and the time observed."""

    joints: tuple[str, ...]
    hold_s: float
    gap_s: float
    hours: float
    """Hours of healthy operation, to which a budget of false alarms refers."""
    region_hours: np.ndarray
    """(joints, regions): hours of a joint in a region."""
    nm: tuple[tuple[np.ndarray, ...], ...]
    """[joint][region]: the largest peaks, descending, (peaks,), [N m]."""
    at: tuple[tuple[np.ndarray, ...], ...]
    """[joint][region]: recording of each peak and time after its first sample [ns], (peaks, 2), int64."""
    recordings: tuple[str, ...] = ()
    """Names in order of input; a recording with several spans occurs several times."""

    def of_joints(self, chosen: np.ndarray) -> Peaks:
        """The peaks of these joints alone, (chosen,) indices."""
        nm, at = (tuple(some[j] for j in chosen) for some in (self.nm, self.at))
        joints = tuple(self.joints[j] for j in chosen)
        return replace(self, joints=joints, nm=nm, at=at, region_hours=self.region_hours[chosen])


class PeakCollector:
    """Collects the largest peaks of every joint and region from one recording after the other.

    Once `keep` peaks are stored, the least of them is the floor for new ones. The result is the largest peaks of all
    recordings, independent of their order.

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
        """Add one recording of free motion; peaks of two recordings are always separate.

        Args:
            t_ns: increasing, (samples,), [ns].
            tau_ext: (samples, joints), [N m]; unhealthy samples are ignored.
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
                at = np.flatnonzero(held > floor)  # few, as the floor rises
                near_samples = near_before[at + 1] - near_before[first[at]]
                touched = at[near_samples > 0 if region else near_samples < at + 1 - first[at]]
                found = touched[peak_places(held[touched], t_ns[touched], self._gap_s, floor)]
                values = np.r_[kept, held[found]]
                places = np.column_stack([np.full(len(found), self._recordings), t_ns[found] - t_ns[0]])
                order = np.argsort(-values, kind="stable")[: self._keep]
                self._nm[joint][region] = values[order]
                self._at[joint][region] = np.concatenate([self._at[joint][region], places])[order]
        self._recordings += 1

    def forget(self, recording: int, from_ns: int, to_ns: int) -> None:
        """Leave out the peaks of a time of one recording, which turned out to be a touch.

        Args:
            recording: its number, from 0 in order of add().
            from_ns, to_ns: after its first sample, [ns].
        """
        for nm, at in zip(self._nm, self._at, strict=True):
            for region, places in enumerate(at):
                stays = (places[:, 0] != recording) | (places[:, 1] < from_ns) | (places[:, 1] > to_ns)
                nm[region], at[region] = nm[region][stays], places[stays]

    def peaks(self, recordings: Sequence[str] = ()) -> Peaks:
        """Peaks found so far, in recordings of these names."""
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
    kept: PeakStore | None = None,
) -> tuple[Peaks, ...]:
    """Run the bundle on recordings of free motion; returns the peaks for each hold time, in order.

    Contacts, with margins, are left out.

    Recordings are loaded one at a time, and the next few are estimated while the peaks of one are collected. Memory is
    needed for AT_A_TIME recordings and two more. They must fit the bundle and must not be its training recordings.

    Args:
        threads: threads of the estimates, 0: one a core. The result does not depend on it.
        kept: results of an interrupted process; `recordings` begins after them.

    Raises:
        TrainingError: no recording with a healthy sample of free motion.
        ConfigError: see PeakCollector.
    """
    collectors = [PeakCollector([link.joint_name for link in bundle.links], hold, gap_s, keep) for hold in holds_s]
    names: list[str] = []
    if kept and kept.collectors:
        collectors, names = kept.collectors, list(kept.names)

    def named() -> Iterator[Recording | Judged]:
        for one in recordings:
            names.append((one.recording if isinstance(one, Judged) else one).name)
            yield one

    for motion, estimates, error, counted in judge_all(bundle, named(), threads, margins):
        for collector in collectors:
            collector.add(motion.t_ns, error, estimates["near_stiction"], counted)
        if kept:
            kept.offer(collectors, names)
    found = tuple(collector.peaks(names) for collector in collectors)
    if any(peaks.hours == 0 for peaks in found):
        raise no_free_motion(bundle, margins)
    return found


def _largest_between(values: np.ndarray, first: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Largest of values[first..end - 1] for each pair of indices, -inf where there is none."""
    out, some = np.full(len(first), -np.inf), first < end
    pairs = np.stack([first[some], end[some]], axis=1).ravel()
    out[some] = np.maximum.reduceat(np.append(values, -np.inf), pairs)[::2]  # an end may be one past the last value
    return out


# --- Limits that depend on one moment: an end-of-program stop, an unlabelled touch, a glitch, or a true error. The
# limit is kept, since limits must cover large errors of free motion. But the moment is reported.


CODE = "one-moment-limit"
MOMENT_S = 1.0
"""Time around a peak that belongs to its moment, [s]: a touch or a stop with its decay."""
CARRIED = 0.6
"""A moment is reported if the limit without it is below this share of the limit: the moment then has more effect than
the factor of 1.6 on limits from minutes. By chance a tail of shape 0.2 has such a largest peak once in 13 times
(0.6^5), Gaussian noise hardly ever."""


@dataclass(frozen=True)
class Moment:
    """A moment that alone determines one joint's limit in one region."""

    joint: str
    region: str
    recording: str
    time_s: float
    """Time of its largest peak after the recording's first sample."""
    limit_nm: float
    without_nm: float

    def scaled(self, factor: float, by_nm: float = 0.0) -> Moment:
        """Return the moment for limits that are raised afterwards."""
        return replace(self, limit_nm=factor * self.limit_nm + by_nm, without_nm=factor * self.without_nm + by_nm)

    def sentence(self, unit: str = "Nm") -> str:
        """Message that asks the user to inspect the moment."""
        return (
            f"warning: {CODE} ({self.joint}): one moment of '{self.recording}', at {self.time_s:.1f} s, sets its limit "
            f"{self.region.replace('_', ' ')}: {self.limit_nm:.3g} {unit}; without it {self.without_nm:.3g} {unit}. If "
            "something touched the arm there, label it; if a signal failed, cut it out"
        )

    def facts(self) -> dict:
        """Facts for provenance, as plain JSON."""
        return asdict(self)


def carrying_moments(peaks: Peaks, limits_of: Callable[[int, Sequence[np.ndarray]], np.ndarray]) -> list[Moment]:
    """Find moments without which a limit would fall below its share CARRIED; one a joint and moment, for the region
    with the largest effect.

    Only peaks are used: those within MOMENT_S of a region's largest one are left out of both regions.

    Args:
        limits_of: both limits of a joint (regions,), [N m], from its peaks in each region, descending.
    """
    first: dict[str, int] = {}
    same = np.array([first.setdefault(name, k) for k, name in enumerate(peaks.recordings)])
    found = []
    for j, joint in enumerate(peaks.joints):
        with_nm = limits_of(j, peaks.nm[j])
        reported: list[tuple[int, int]] = []
        for at in peaks.at[j]:
            if not len(at):
                continue
            number, at_ns = int(same[at[0, 0]]), int(at[0, 1])
            if any(number == other and abs(at_ns - other_ns) <= MOMENT_S * 1e9 for other, other_ns in reported):
                continue
            reported.append((number, at_ns))
            without_nm = limits_of(j, _without(peaks.nm[j], peaks.at[j], same, number, at_ns))
            r = int(np.argmin(without_nm / with_nm))
            if without_nm[r] < CARRIED * with_nm[r]:
                where = peaks.recordings[number], at_ns * 1e-9
                found.append(Moment(joint, REGIONS[r], *where, float(with_nm[r]), float(without_nm[r])))
    return found


def _without(
    nm: Sequence[np.ndarray], at: Sequence[np.ndarray], same: np.ndarray, number: int, at_ns: int
) -> list[np.ndarray]:
    """Peaks of each region outside of a moment."""
    near = [(same[one[:, 0]] == number) & (np.abs(one[:, 1] - at_ns) <= MOMENT_S * 1e9) for one in at]
    return [values[~left_out] for values, left_out in zip(nm, near, strict=True)]
