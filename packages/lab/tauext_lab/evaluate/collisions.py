"""Collisions in recordings: whether and when an alarm latched, on which link, of which kind."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from tauext import _core
from tauext.bundle.estimates import COLLISION, Estimates
from tauext.data.recording import Recording
from tauext.monitor.touch_place import FOLLOWED_S, find_places, strongest_sample
from tauext_lab.evaluate.results import (
    CollisionVerdict,
    FoundBin,
    LabelledCollision,
    Latched,
    LinkProbability,
    LinkTable,
    Number,
    Numbers,
    StrengthBin,
    Touches,
    TouchEstimate,
)

# --- Collisions in a recording, and whether and when they were found.


BOUNCE_S = 0.3
"""Touches closer together than this are one collision: a padded body may bounce."""
GRACE_S = 0.2
"""After the touch has ended a detection still counts as this collision's: the observer lags by 1/K0 = 0.05 s."""
STRONG_PEAK = 2.0
"""Multiple of the limits: collisions whose sensor torque peaks this high can be chosen for the figures."""
CURVE_EDGES = (0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0, 3.0, 5.0)


@dataclass(frozen=True)
class Collision:
    """One physical touch. Indices are samples of its recording; peaks are per joint, [N m]."""

    id: str
    recording: str
    kind: str
    begin: int  # first sample in contact
    end: int  # one after the last
    start_s: float
    end_s: float
    link: int
    true_peak_nm: np.ndarray
    sensor_peak_nm: np.ndarray

    def summary(self) -> LabelledCollision:
        peaks = (tuple(peak.tolist()) for peak in (self.true_peak_nm, self.sensor_peak_nm))
        return LabelledCollision(self.id, self.recording, self.kind, self.start_s, self.end_s, self.link, *peaks)


def find_collisions(recording: Recording) -> list[Collision]:
    """The touches that the recording's `contact` column marks, in order of time.

    Recordings without a true torque or a sensor have zero peaks there; without the column there are no collisions.
    """
    if recording.contact is None:
        return []
    at = np.flatnonzero(recording.contact == 1)
    if len(at) == 0:
        return []
    breaks = np.flatnonzero(np.diff(recording.t_ns[at]) > BOUNCE_S * 1e9)
    begins = at[np.append(0, breaks + 1)]
    ends = at[np.append(breaks, len(at) - 1)] + 1
    grace = round(GRACE_S * recording.rate_hz)

    def peak(signal: np.ndarray | None, begin: int, end: int) -> np.ndarray:
        return np.zeros(len(recording.joints)) if signal is None else np.abs(signal[begin : end + grace]).max(axis=0)

    return [
        Collision(
            id=f"{recording.name}:{number}",
            recording=recording.name,
            kind=str(recording.provenance.get("contacts", "unknown")),
            begin=int(begin),
            end=int(end),
            start_s=float(recording.time_s[begin]),
            end_s=float(recording.time_s[end - 1]),
            link=int(recording.contact_link[begin]) if recording.contact_link is not None else -1,
            true_peak_nm=peak(recording.tau_ext, begin, end),
            sensor_peak_nm=peak(recording.tau_ext_sensor, begin, end),
        )
        for number, (begin, end) in enumerate(zip(begins, ends, strict=True))
    ]


def judge(collision: Collision, recording: Recording, estimates: Estimates) -> CollisionVerdict:
    """Whether it was found, by which joint, and the delays after its onset and after the sensor at the same limit.

    The limit is the one that holds at each sample; `peak_over_limit` is the largest ratio of the sensor to it. Delays
    are those of the first joint that exceeds it, and of every joint alone.
    """
    window = slice(collision.begin, min(collision.end + round(GRACE_S * recording.rate_hz), recording.samples))
    seconds = (recording.t_ns[window] - recording.t_ns[collision.begin]) * 1e-9
    before = max(collision.begin - 1, 0)
    found = first_rise(estimates.detection[window], bool(estimates.detection[before]))
    sensor = peak = None
    joint_delays_s: Numbers = (None,) * len(recording.joints)
    if recording.tau_ext_sensor is not None:
        part, lead = slice(before, window.stop), collision.begin - before
        limit = estimates.limit_nm[part]
        ratio = np.nan_to_num(np.abs(recording.tau_ext_sensor[part]) / limit)
        over = estimates.healthy[part, None] & (np.abs(estimates.tau_ext[part]) > limit)

        def rise(flags: np.ndarray) -> int | None:
            return first_rise(flags[lead:], bool(flags[0]))

        sensor = rise((ratio > 1).any(axis=1))
        peak = float(ratio[lead:].max())
        pairs = zip(map(rise, over.T), map(rise, (ratio > 1).T), strict=True)
        joint_delays_s = tuple(difference_s(seconds, *pair) for pair in pairs)
    joint = None
    if found is not None:
        margin = np.abs(estimates.tau_ext[window][found]) / estimates.limit_nm[window][found]
        joint = recording.joints[int(np.argmax(margin))]
    return CollisionVerdict(
        id=collision.id,
        found=found is not None,
        joint=joint,
        delay_s=None if found is None else float(seconds[found]),
        peak_over_limit=peak,
        sensor_delay_s=None if sensor is None else float(seconds[sensor]),
        delay_against_sensor_s=difference_s(seconds, found, sensor),
        joint_delays_against_sensor_s=joint_delays_s,
    )


def difference_s(seconds: np.ndarray, found: int | None, sensor: int | None) -> Number:
    """Time from the sensor's sample to that of the estimate; None without both."""
    return None if found is None or sensor is None else float(seconds[found] - seconds[sensor])


def first_rise(flags: np.ndarray, before: bool) -> int | None:
    """Index of the first flag that is true after a false one; `before` is the flag before the first."""
    rises = np.flatnonzero(flags & ~np.append(before, flags[:-1]))
    return int(rises[0]) if len(rises) else None


def choose_ten(
    collisions: list[Collision], largest_limit_nm: np.ndarray, seed: int, weak: Collection[str] = ()
) -> list[str]:
    """Ids of ten collisions, drawn by seed, whose sensor reference peaks at twice the limit or more on some joint.

    largest_limit_nm: the largest sliding limit over all bundles, or their median, a joint, so that the set is the same
    for every bundle. If fewer than ten are that strong, all of these. In recordings without a sensor, any ten.
    weak: ids of collisions that are not that strong at limits that move.
    """
    sensed = any(c.sensor_peak_nm.any() for c in collisions)
    strong = [
        c.id
        for c in collisions
        if not sensed or (c.id not in weak and (c.sensor_peak_nm >= STRONG_PEAK * largest_limit_nm).any())
    ]
    if len(strong) <= 10:
        return strong
    return [strong[k] for k in sorted(np.random.default_rng([seed, 10]).choice(len(strong), 10, replace=False))]


def found_curve(verdicts: Sequence[CollisionVerdict]) -> tuple[FoundBin, ...]:
    """Found collisions over `peak_over_limit`; those without a sensor are left out."""
    sensed = [(verdict.peak_over_limit, verdict.found) for verdict in verdicts if verdict.peak_over_limit]
    curve = []
    for low, high in zip(CURVE_EDGES, (*CURVE_EDGES[1:], None), strict=True):
        inside = [found for ratio, found in sensed if low <= ratio < (high or np.inf)]
        curve.append(FoundBin(low, high, len(inside), sum(inside)))
    return tuple(curve)


# --- Collisions as a monitor would have latched them, against a sensor with the same limit and hold time.


STRONG = 1.5
"""A collision is strong if its sensor reference exceeds this multiple of the limit ..."""
STRONG_FOR_S = 0.02
"""... for this time plus the hold time; a strong collision must be found."""


@dataclass(frozen=True)
class LatchVerdict:
    """Whether a monitor would have latched one collision; None where a delay does not exist."""

    latched: bool
    strong: bool
    unhealthy: bool
    delay_s: Number
    delay_against_sensor_s: Number


def judge_latched(
    collision: Collision, recording: Recording, estimates: Estimates, hold_s: float, reference: np.ndarray | None
) -> LatchVerdict:
    """Whether it was latched, the delays after its onset and after the sensor, and whether it was strong.

    The reference is low-passed like the observer (`sensor_reference`), so that the observer's own lag does not count
    against the method. It has the same limit at every sample, and the same hold time. A joint that exceeded its limit
    before the touch began does not find it.
    """
    hold = round(hold_s * recording.rate_hz)
    long = hold + round(STRONG_FOR_S * recording.rate_hz)
    # The sample before the onset, and as many before that as the longest hold time needs.
    first = max(collision.begin - 1 - long, 0)
    last = min(collision.end + round(GRACE_S * recording.rate_hz), recording.samples)
    part, window = slice(first, last), slice(collision.begin - first, last - first)
    latched = _first_rise_in(estimates.held_alarm[part] == COLLISION, window)
    sensor, strong = None, False
    if reference is not None:
        size, limit = np.abs(reference[part]), estimates.limit_nm[part]
        sensor = _first_rise_in(np.asarray(held(size > limit, hold).any(axis=1)), window)
        strong = bool(held(size > STRONG * limit, long)[window].any())
    seconds = (recording.t_ns[collision.begin : last] - recording.t_ns[collision.begin]) * 1e-9
    return LatchVerdict(
        latched=latched is not None,
        strong=strong,
        unhealthy=bool(np.mean(estimates.healthy[collision.begin : collision.end]) < 0.5),
        delay_s=None if latched is None else float(seconds[latched]),
        delay_against_sensor_s=difference_s(seconds, latched, sensor),
    )


def held(over: np.ndarray, hold_samples: int) -> np.ndarray:
    """Whether each flag and the hold_samples before it are all true: (samples, n), along the samples."""
    runs = np.cumsum(over, axis=0)
    before = np.zeros_like(runs)
    before[hold_samples + 1 :] = runs[: -hold_samples - 1]
    return runs - before == hold_samples + 1


def latched_summary(verdicts: Sequence[LatchVerdict]) -> Latched:
    return Latched(
        len(verdicts),
        sum(v.latched for v in verdicts),
        sum(v.strong for v in verdicts),
        sum(v.unhealthy for v in verdicts),
        sum(v.strong and v.latched for v in verdicts),
        *delay_quantiles(v.delay_s for v in verdicts),
        *delay_quantiles(v.delay_against_sensor_s for v in verdicts),
    )


def delay_quantiles(delays_s: Iterable[Number]) -> tuple[Number, Number]:
    """Median and 95 % quantile of the delays that exist."""
    known = [delay for delay in delays_s if delay is not None]
    return (float(np.quantile(known, 0.5)), float(np.quantile(known, 0.95))) if known else (None, None)


def _first_rise_in(flags: np.ndarray, window: slice) -> int | None:
    """Index within the window of the first flag that is true after a false one."""
    return first_rise(flags[window], bool(flags[window.start - 1]) if window.start else False)


# --- Collisions latched, and their delays, over their strength in N m: one scale for all methods and limits.


EDGES_NM = (0.0, 1.0, 2.0, 4.0, 8.0, 16.0, 40.0)


def by_strength(touches: Sequence[Collision], verdicts: Sequence[LatchVerdict]) -> tuple[StrengthBin, ...]:
    """Latched collisions over their strength.

    Args:
        touches: their strength is the sensor reference's peak on the joint where that is largest, [N m].
        verdicts: their results of `judge_latched`, in the same order; those in unhealthy time are in no bin.
    """
    unseen = [v.unhealthy for v in verdicts]
    # NaN: no sensor, in no bin
    peak_nm = np.where(unseen, np.nan, [touch.sensor_peak_nm.max() or np.nan for touch in touches])
    bins = []
    for low, high in zip(EDGES_NM, (*EDGES_NM[1:], None), strict=True):
        inside = [verdicts[k] for k in np.flatnonzero((peak_nm >= low) & (peak_nm < (high or np.inf))).tolist()]
        delays = delay_quantiles(v.delay_s for v in inside)
        bins.append(StrengthBin(low, high, len(inside), sum(v.latched for v in inside), *delays))
    return tuple(bins)


# --- Onsets of events: labels are late or early by tens of milliseconds.


BASELINE_S = 0.1
"""A reference is measured from its mean over this time before the window."""
SLOPE_S = 0.02
"""Time span of the residual's derivative."""
QUANTILE, RESERVE = 0.999, 1.5


class Onsets:
    """Onsets of events in one recording, by a reference.

    The reference is the robot's own tau_ext, measured from its mean over the 0.1 s before the window; where the
    recording has none, the change of the residual over 20 ms, which lags a step by little. A joint's noise band is 1.5
    times what 99.9 % of the free samples stay within, these measured from the mean of the 0.1 s that ended 0.1 s
    earlier, all of it free. Without such samples there is no band, and no onset.

    Args:
        windows: from and to, counted from the first sample, [s].
    """

    def __init__(self, recording: Recording, windows: Sequence[tuple[float, float]]) -> None:
        time_s, own = recording.time_s, recording.tau_ext
        self._time_s, self._own, self._windows = time_s, own, windows
        if not windows:
            return
        self._began = np.searchsorted(time_s, time_s - 2 * BASELINE_S)
        if own is not None:
            self._ago = own - means(time_s, own, time_s - 2 * BASELINE_S, time_s - BASELINE_S)
            begin_s = np.array([begin_s for begin_s, _ in windows])
            self._levels = means(time_s, own, begin_s - BASELINE_S, begin_s)

    def find(self, residual: np.ndarray, free: np.ndarray) -> list[float | None]:
        """The first time in each window at which the reference leaves its noise band on some joint, [s]; None: never.

        Args:
            residual: (samples, joints), [N m]; NaN counts as zero.
            free: (samples,) bool.
        """
        if not self._windows:
            return []
        time_s = self._time_s
        if self._own is not None:
            signal, ago, levels = self._own, self._ago, self._levels
        else:
            residual = np.nan_to_num(residual.astype(float))
            before = np.clip(np.searchsorted(time_s, time_s - SLOPE_S), 0, None)
            signal = ago = residual - residual[before]
            levels = np.zeros((len(self._windows), signal.shape[1]))
        busy = np.append(0, np.cumsum(~free))
        usable = (busy[1:] == busy[self._began]) & (time_s > 2 * BASELINE_S)
        if not usable.any():
            return [None] * len(self._windows)
        band = RESERVE * np.quantile(np.abs(ago[usable]), QUANTILE, axis=0)
        onsets: list[float | None] = []
        for (begin_s, end_s), level in zip(self._windows, levels, strict=True):
            inside = np.flatnonzero((time_s >= begin_s) & (time_s <= end_s))
            left = inside[(np.abs(signal[inside] - level) > band).any(axis=1)]
            onsets.append(float(time_s[left[0]]) if len(left) else None)
        return onsets


def means(time_s: np.ndarray, signal: np.ndarray, from_s: np.ndarray, to_s: np.ndarray) -> np.ndarray:
    """Mean of a signal over stretches of time, at least one sample each, (stretches, joints)."""
    sums = np.vstack([np.zeros((1, signal.shape[1])), np.cumsum(signal, axis=0)])
    first = np.clip(np.searchsorted(time_s, from_s), 0, len(time_s) - 1)
    last = np.maximum(np.searchsorted(time_s, to_s), first + 1)
    return (sums[last] - sums[first]) / (last - first)[:, None]


# --- A bundle's estimates of each collision (link, force, kind), compared with the labels.


STATED = 0.9
"""A link with this probability or more is stated."""


@dataclass
class TouchMeasures:
    """One bundle's links and kinds, collision by collision."""

    bundle: _core.Bundle
    _reported: list[TouchEstimate] = field(default_factory=list)
    _labels: list[tuple[int, str]] = field(default_factory=list)
    """Touched link (-1: unknown), and the recording's name for the kind of its contacts."""

    def add(self, touches: Sequence[Collision], recording: Recording, estimates: Estimates) -> None:
        """Take in the collisions of a recording that raised an alarm, contact or collision."""
        model = _core.PlaceModel(self.bundle) if touches else None  # here, since it is not to be kept with the numbers
        for touch in touches:
            rows = alarm_rows(touch, recording, estimates)
            if model is None or len(rows) == 0:
                continue
            estimate = TouchEstimate(touch.id, kind_of(touch, recording, estimates))
            self._reported.append(estimate if model.refused else placed(estimate, model, rows, recording, estimates))
            self._labels.append((touch.link, touch.kind))

    def summary(self) -> Touches:
        return Touches(STATED, self._links(), self._kinds(), tuple(self._reported))

    def _links(self) -> LinkTable | None:
        """None if no place was estimated for a collision whose link is labelled."""
        names = tuple(link.joint_name for link in self.bundle.links)
        known = [
            (names[link], [one.joint for one in estimate.links], estimate.links[0].probability)
            for (link, _), estimate in zip(self._labels, self._reported, strict=True)
            if 0 <= link < len(names) and estimate.links
        ]
        if not known:
            return None
        stated = [true == ranked[0] for true, ranked, probability in known if probability >= STATED]
        return LinkTable(
            joints=names,
            table=tuple(
                tuple(sum(true == row and ranked[0] == name for true, ranked, _ in known) for name in names)
                for row in names
            ),
            collisions=len(known),
            first=sum(true == ranked[0] for true, ranked, _ in known),
            first_two=sum(true in ranked[:2] for true, ranked, _ in known),
            stated=len(stated),
            stated_right=sum(stated),
        )

    def _kinds(self) -> dict[str, dict[str, int]]:
        """Number of collisions by estimated kind, for each kind in the recordings."""
        counts: dict[str, dict[str, int]] = {}
        for (_, word), reported in zip(self._labels, self._reported, strict=True):
            if reported.kind is not None:
                row = counts.setdefault(word, {})
                row[reported.kind] = row.get(reported.kind, 0) + 1
        return counts


def alarm_rows(touch: Collision, recording: Recording, estimates: Estimates) -> np.ndarray:
    """Rows at which some joint was over a limit, from the first in the collision on, for at most FOLLOWED_S."""
    last = min(touch.end + round(GRACE_S * recording.rate_hz), recording.samples)
    rows = touch.begin + np.flatnonzero(estimates.held_alarm[touch.begin : last] > 0)
    return rows[recording.t_ns[rows] <= recording.t_ns[rows[0]] + FOLLOWED_S * 1e9] if len(rows) else rows


def placed(
    estimate: TouchEstimate, model: _core.PlaceModel, rows: np.ndarray, recording: Recording, estimates: Estimates
) -> TouchEstimate:
    """The estimate with links and force of the strongest row, from the joint that is most over its limit on, if any."""
    assert estimates.sigma_nm is not None and estimates.contact_sigma_nm is not None
    signals = (recording.q, recording.dq, estimates.tau_ext, estimates.sigma_nm, estimates.contact_sigma_nm)
    joint = int(np.argmax(np.abs(estimates.tau_ext[rows[0]]) / estimates.limit_nm[rows[0]]))
    sample = strongest_sample(joint, *(signal[rows] for signal in signals))
    found = None if model.refused else find_places(model, sample)
    if found is None or found.best is None:
        return estimate
    return replace(
        estimate,
        links=tuple(LinkProbability(recording.joints[link], found.probability[link]) for link in found.ranked[:3]),
        force_n=found.force_n,
        point_m=tuple(found.best.point),
        spread_m=found.best.spread_m,
        consistent=found.consistent,
    )


def kind_of(touch: Collision, recording: Recording, estimates: Estimates) -> str:
    """The estimated kind after the end of the collision."""
    last = min(touch.end + round(GRACE_S * recording.rate_hz), recording.samples) - 1
    return str(_core.Touch(int(estimates.touch[last])).name)
