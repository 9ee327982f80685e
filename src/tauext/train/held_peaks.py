"""Peaks of the error in free motion behind a hold time, and moments that alone determine a limit."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from copy import copy
from dataclasses import asdict, dataclass, replace

import numpy as np
from scipy.ndimage import minimum_filter1d

from tauext import _core
from tauext.config import FreeMotionConfig
from tauext.data.recording import Recording
from tauext.files.checkpoint import Checkpoint
from tauext.train.error_scale import HeldOut, judge_all, no_free_motion

# --- Held minimum: the error that remains behind a hold time.
#
# An alarm rises at sample k when |tau_ext| of a joint was over its limit L at all samples since one that is `hold_s`
# old or older. Equivalently, the held minimum exceeds L:
#
# .. math:: m(t_k) = \min_{s \le j \le k} |\tau_{ext}(t_j)|, \quad s = \max\{j : t_j \le t_k - hold\}, \qquad m(t_k) > L
#
# m replaces |tau_ext| wherever limits are compared. Without hold time m is |tau_ext| itself.


def held_minimum(error: np.ndarray, healthy: np.ndarray, hold_samples: np.ndarray) -> np.ndarray:
    """Least error of the last hold_samples + 1 samples, for every sample, of the shape of `error`.

    NaN where one of them is unhealthy or NaN, or would lie before the first: no alarm can rise there.

    Args:
        error: |tau_ext|, or its ratio to the limit, (samples, joints).
        healthy: (samples,), bool.
        hold_samples: (samples,), as `hold_lengths` gives.
    """
    over = np.where(healthy[:, None] & ~np.isnan(error), error, -np.inf)
    least, whole = np.full_like(over, -np.inf), hold_samples <= np.arange(len(over))
    for length in np.unique(hold_samples[whole]).tolist():  # one, unless stamps jitter
        at = whole & (hold_samples == length)
        least[at] = minimum_filter1d(over, length + 1, axis=0, origin=length // 2)[at]
    return np.where(np.isneginf(least), np.nan, least)


def hold_lengths(t_ns: np.ndarray, hold_s: float) -> np.ndarray:
    """Samples back to the latest that is hold_s old or older, (samples,), int64; k + 1 if there is none.

    As in the alarm, it follows from stamps, not from a rate: with lost samples, fewer fill the same time.

    Args:
        t_ns: sample times, increasing, (samples,), [ns].
    """
    return np.arange(1, len(t_ns) + 1) - np.searchsorted(t_ns, t_ns - round(hold_s * 1e9), side="right")


# --- Peaks of the held minimum in free motion.
#
# A joint has one limit for sliding and one near stiction. A window with samples of both counts for both: an alarm there
# has every sample over its own limit, hence the window's minimum over the lower of the two. So the alarms of an arm are
# at most the sum over joints and regions.


REGIONS = ("sliding", "near_stiction")


@dataclass(frozen=True)
class PeakConfig:
    """Which peaks count, and which moments are reported as decisive."""

    gap_s: float = 0.5
    """Alarms less than this apart are one false alarm, [s]."""
    keep: int = 4000
    """Largest peaks kept for each joint and region. A tail uses at most a twentieth of them."""
    moment_s: float = 1.0
    """Time around a peak that belongs to its moment, [s]: a touch or a stop with its decay."""
    moment_share: float = 0.6
    """A moment is reported if the limit without it is below this share of the limit: the moment then has more effect
    than the factor of 1.6 on limits from minutes. By chance a tail of shape 0.2 has such a largest peak once in 13
    times (0.6^5), Gaussian noise hardly ever."""


def count_episodes(values: np.ndarray, t_ns: np.ndarray, floor: float, gap_s: float = PeakConfig.gap_s) -> int:
    """Number of false alarms over a limit: sets of values > floor, each less than gap_s after the one before.

    Args:
        values: (samples,); NaN is never over the floor.
        t_ns: increasing, (samples,), [ns].
    """
    at = t_ns[values > floor]
    return int(len(at) > 0) + int((np.diff(at) >= round(gap_s * 1e9)).sum())


def peak_indices(
    values: np.ndarray, t_ns: np.ndarray, floor: float = 0.0, gap_s: float = PeakConfig.gap_s
) -> np.ndarray:
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


class Peaks:
    """The largest peaks of every joint and region in the recordings added so far, independent of their order.

    Once config.keep peaks are stored, the least of them is the floor for new ones.
    """

    def __init__(self, joints: Sequence[str], hold_s: float, config: PeakConfig = PeakConfig()) -> None:
        self.joints, self.hold_s, self._config = tuple(joints), hold_s, config
        self.recordings: list[str] = []
        """Names in order of addition; a recording with several spans occurs several times."""
        self.hours = 0.0
        """Hours of healthy operation, to which a budget of false alarms refers."""
        self.region_hours = np.zeros((len(self.joints), len(REGIONS)))
        """(joints, regions): hours of a joint in a region."""
        self.nm = [[np.zeros(0) for _ in REGIONS] for _ in self.joints]
        """[joint][region]: peaks, descending, (peaks,), [N m]."""
        self.at = [[np.zeros((0, 2), dtype=np.int64) for _ in REGIONS] for _ in self.joints]
        """[joint][region]: recording of each peak and time after its first sample [ns], (peaks, 2)."""

    def add(
        self, name: str, t_ns: np.ndarray, tau_ext: np.ndarray, near_stiction: np.ndarray, healthy: np.ndarray
    ) -> None:
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
        self.hours += float(step_h.sum())
        hold, keep = hold_lengths(t_ns, self.hold_s), self._config.keep
        first = np.maximum(np.arange(len(t_ns)) - hold, 0)
        held_nm = held_minimum(np.abs(tau_ext), healthy, hold)
        for joint, held in enumerate(held_nm.T):
            near = near_stiction[:, joint]
            near_before = np.r_[0, np.cumsum(near)]
            for region, inside in enumerate((~near, near)):
                self.region_hours[joint, region] += float(step_h @ inside[1:])
                kept = self.nm[joint][region]
                floor = float(kept[-1]) if len(kept) == keep else 0.0
                at = np.flatnonzero(held > floor)  # few, as the floor rises
                near_samples = near_before[at + 1] - near_before[first[at]]
                touched = at[near_samples > 0 if region else near_samples < at + 1 - first[at]]
                found = touched[peak_indices(held[touched], t_ns[touched], floor, self._config.gap_s)]
                values = np.r_[kept, held[found]]
                places = np.column_stack([np.full(len(found), len(self.recordings)), t_ns[found] - t_ns[0]])
                order = np.argsort(-values, kind="stable")[:keep]
                self.nm[joint][region] = values[order]
                self.at[joint][region] = np.concatenate([self.at[joint][region], places])[order]
        self.recordings.append(name)

    def forget(self, recording: int, from_ns: int, to_ns: int) -> None:
        """Leave out the peaks of a time of one recording, which turned out to be a touch.

        Args:
            recording: its number, from 0 in order of add().
            from_ns, to_ns: after its first sample, [ns].
        """
        for nm, at in zip(self.nm, self.at, strict=True):
            for region, places in enumerate(at):
                stays = (places[:, 0] != recording) | (places[:, 1] < from_ns) | (places[:, 1] > to_ns)
                nm[region], at[region] = nm[region][stays], places[stays]

    def of_joints(self, chosen: np.ndarray) -> Peaks:
        """The peaks of these joints alone, (chosen,) indices."""
        some = copy(self)
        some.joints = tuple(self.joints[j] for j in chosen)
        some.region_hours = self.region_hours[chosen]
        some.nm, some.at = [self.nm[j] for j in chosen], [self.at[j] for j in chosen]
        return some

    def worst(self, limits_nm: np.ndarray) -> np.ndarray:
        """Peaks of the largest ratio of a joint's error to its limit, moment_s or more apart, descending, (peaks,).

        Args:
            limits_nm: (regions, joints), [N m].
        """
        columns = [
            np.column_stack([at, nm / limit])
            for of_at, of_nm, limits in zip(self.at, self.nm, limits_nm.T, strict=True)
            for at, nm, limit in zip(of_at, of_nm, limits, strict=True)
        ]
        rows = np.concatenate(columns)
        recording, t_ns, ratio = rows[np.lexsort((rows[:, 1], rows[:, 0]))].T
        # One time axis for all recordings; peaks of two are always apart.
        apart_ns = 1e9 * self._config.moment_s
        ends = np.maximum.reduceat(t_ns, np.r_[0, 1 + np.flatnonzero(np.diff(recording))]) if len(t_ns) else t_ns
        starts = np.r_[0, np.cumsum(ends + 2 * apart_ns)]
        at_ns = (t_ns + starts[np.unique(recording, return_inverse=True)[1]]).astype(np.int64)
        found: np.ndarray = np.sort(ratio[peak_indices(ratio, at_ns, gap_s=self._config.moment_s)])[::-1]
        return found

    @property
    def largest_nm(self) -> np.ndarray:
        """Largest peak of each joint and region, 0 without one, (joints, regions), [N m]."""
        return np.array([[nm[0] if len(nm) else 0.0 for nm in of_joint] for of_joint in self.nm])


def collect_peaks(
    bundle: _core.Bundle,
    recordings: Iterable[Recording | HeldOut],
    holds_s: Sequence[float],
    threads: int,
    margins: FreeMotionConfig = FreeMotionConfig(),  # noqa: B008
    before: Sequence[Peaks] = (),
    checkpoint: Checkpoint | None = None,
) -> list[Peaks]:
    """Run the bundle on recordings of free motion; returns the peaks for each hold time, in order.

    Contacts, with margins, are left out. Recordings are loaded one at a time, and the next few are estimated while the
    peaks of one are collected. They must fit the bundle and must not be its training recordings.

    Args:
        threads: threads of the estimates, 0: one a core. The result does not depend on it.
        before: peaks of earlier recordings, to which those of these are added.
        checkpoint: is offered the peaks after each recording.

    Raises:
        TrainingError: no recording with a healthy sample of free motion.
    """
    joints = [link.joint_name for link in bundle.links]
    found = list(before) or [Peaks(joints, hold_s) for hold_s in holds_s]
    for motion, estimates, error, counted in judge_all(bundle, recordings, threads, margins):
        for peaks in found:
            peaks.add(motion.name, motion.t_ns, error, estimates["near_stiction"], counted)
        if checkpoint:
            checkpoint.offer(found)
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
    """The limit without it."""

    def scaled(self, factor: float, by_nm: float = 0.0) -> Moment:
        """Return the moment for limits that are raised afterwards."""
        return replace(self, limit_nm=factor * self.limit_nm + by_nm, without_nm=factor * self.without_nm + by_nm)

    def sentence(self, unit: str = "Nm") -> str:
        """Message that asks the user to inspect the moment."""
        return (
            f"warning: one-moment-limit ({self.joint}): one moment of '{self.recording}', at {self.time_s:.1f} s, "
            f"sets its threshold {self.region.replace('_', ' ')}: {self.limit_nm:.3g} {unit}; without it "
            f"{self.without_nm:.3g} {unit}. If something touched the arm there, label it; if a signal failed, cut it "
            "out"
        )

    def facts(self) -> dict:
        """Facts for provenance, as plain JSON."""
        return asdict(self)


def carrying_moments(
    peaks: Peaks, limits_of: Callable[[int, Sequence[np.ndarray]], np.ndarray], config: PeakConfig = PeakConfig()
) -> list[Moment]:
    """Find moments without which a limit would fall below config.moment_share of it; one a joint and moment, for the
    region with the largest effect.

    Only peaks are used: those within config.moment_s of a region's largest one are left out of both regions.

    Args:
        limits_of: both limits of a joint (regions,), [N m], from its peaks in each region, descending.
    """
    first: dict[str, int] = {}
    same = np.array([first.setdefault(name, k) for k, name in enumerate(peaks.recordings)])
    near_ns = config.moment_s * 1e9
    found = []
    for j, joint in enumerate(peaks.joints):
        with_nm = limits_of(j, peaks.nm[j])
        seen: list[tuple[int, int]] = []
        for at in peaks.at[j]:
            if not len(at):
                continue
            number, at_ns = int(same[at[0, 0]]), int(at[0, 1])
            if any(number == other and abs(at_ns - other_ns) <= near_ns for other, other_ns in seen):
                continue
            seen.append((number, at_ns))
            away = [(same[one[:, 0]] != number) | (np.abs(one[:, 1] - at_ns) > near_ns) for one in peaks.at[j]]
            without_nm = limits_of(j, [nm[stays] for nm, stays in zip(peaks.nm[j], away, strict=True)])
            r = int(np.argmin(without_nm / with_nm))
            if without_nm[r] < config.moment_share * with_nm[r]:
                where = peaks.recordings[number], at_ns * 1e-9
                found.append(Moment(joint, REGIONS[r], *where, float(with_nm[r]), float(without_nm[r])))
    return found
