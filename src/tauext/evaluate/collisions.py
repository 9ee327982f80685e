"""Collisions in recordings: whether and when an alarm latched, on which link, of which kind."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field

import numpy as np

from tauext import _core
from tauext.bundle.estimates import COLLISION, Estimates
from tauext.data.recording import Recording
from tauext.monitor.places import FOLLOWED_S, newtons, strongest_place

# --- Collisions in a recording, and whether and when they were found.


BOUNCE_S = 0.3
"""Touches closer together than this are one collision: a padded body may bounce."""
GRACE_S = 0.2
"""After the touch has ended a detection still counts as this collision's: the observer lags by 1/K0 = 0.05 s."""
STRONG_PEAK = 2.0
"""Of the limits: a sensor that peaks so high makes a collision that may be chosen to be shown."""
CURVE_EDGES = (0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0, 3.0, 5.0)


@dataclass(frozen=True)
class Collision:
    """One physical touch. Indices are samples of its recording; peaks are a joint each, [N m]."""

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

    def summary(self) -> dict:
        """Its entry in results.json."""
        return {
            "id": self.id,
            "recording": self.recording,
            "kind": self.kind,
            "start_s": self.start_s,
            "end_s": self.end_s,
            "link": self.link,
            "true_peak_nm": self.true_peak_nm.tolist(),
            "sensor_peak_nm": self.sensor_peak_nm.tolist(),
        }


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


def judge(collision: Collision, recording: Recording, estimates: Estimates) -> dict:
    """Was it found, by which joint, how long after its onset, and how long after the sensor at the same limit?

    The limit is the one that holds at each sample; `peak_over_limit` is the largest ratio of the sensor to it.
    """
    window = slice(collision.begin, min(collision.end + round(GRACE_S * recording.rate_hz), recording.samples))
    seconds = (recording.t_ns[window] - recording.t_ns[collision.begin]) * 1e-9
    before = max(collision.begin - 1, 0)
    found = first_rise(estimates.detection[window], bool(estimates.detection[before]))
    sensor = peak = None
    if recording.tau_ext_sensor is not None:
        part = slice(before, window.stop)
        ratio = np.nan_to_num(np.abs(recording.tau_ext_sensor[part]) / estimates.limit_nm[part]).max(axis=1)
        over = ratio > 1
        sensor = first_rise(over[collision.begin - before :], bool(over[0]))
        peak = float(ratio[collision.begin - before :].max())
    result = {"id": collision.id, "found": found is not None, "joint": None, "delay_s": None}
    if found is not None:
        margin = np.abs(estimates.tau_ext[window][found]) / estimates.limit_nm[window][found]
        result |= {"joint": recording.joints[int(np.argmax(margin))], "delay_s": float(seconds[found])}
    result["peak_over_limit"] = peak
    result["sensor_delay_s"] = None if sensor is None else float(seconds[sensor])
    both = found is not None and sensor is not None
    result["delay_against_sensor_s"] = float(seconds[found] - seconds[sensor]) if both else None
    return result


def first_rise(flags: np.ndarray, before: bool) -> int | None:
    """Index of the first flag that is true after a false one; `before` stands before the first."""
    rises = np.flatnonzero(flags & ~np.append(before, flags[:-1]))
    return int(rises[0]) if len(rises) else None


def choose_ten(
    collisions: list[Collision], largest_limit_nm: np.ndarray, seed: int, weak: Collection[str] = ()
) -> list[str]:
    """Ids of ten collisions, drawn by seed, whose sensor reference peaks at twice the limit or more on some joint.

    largest_limit_nm: the largest sliding limit over all bundles, or their median, a joint, so that the set is the same
    for every bundle. All of them where fewer than ten are that strong. Of recordings without a sensor any ten.
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


def found_curve(verdicts: Sequence[dict]) -> list[dict]:
    """Found collisions over `peak_over_limit`; those without a sensor are left out."""
    sensed = [verdict for verdict in verdicts if verdict["peak_over_limit"]]
    ratio = np.array([verdict["peak_over_limit"] for verdict in sensed])
    found = np.array([verdict["found"] for verdict in sensed], dtype=bool)
    upper = [*CURVE_EDGES[1:], np.inf]
    curve = []
    for low, high in zip(CURVE_EDGES, upper, strict=True):
        inside = (ratio >= low) & (ratio < high)
        curve.append(
            {
                "peak_over_limit_from": low,
                "peak_over_limit_to": None if np.isinf(high) else high,
                "collisions": int(inside.sum()),
                "found": int(found[inside].sum()),
            }
        )
    return curve


# --- Collisions as a monitor would have latched them: hold time and all, against a sensor with the same limit and hold.


STRONG = 1.5
"""A collision is strong whose sensor reference exceeds so many times the limit ..."""
STRONG_FOR_S = 0.02
"""... for so long beside the hold time: then it must be found."""


def judge_latched(
    collision: Collision, recording: Recording, estimates: Estimates, hold_s: float, reference: np.ndarray | None
) -> dict:
    """Was it latched, how long after its onset, how long after the sensor would have been, and was it strong?

    The reference is low-passed as the observer is (`sensor_reference`), so that the observer's own lag is not held
    against the method; it gets the same limit at every sample, and the same hold time. What was over its limit before
    the touch began does not find it.
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
    both = latched is not None and sensor is not None
    return {
        "id": collision.id,
        "latched": latched is not None,
        "strong": strong,
        "unhealthy": bool(np.mean(estimates.healthy[collision.begin : collision.end]) < 0.5),
        "delay_s": None if latched is None else float(seconds[latched]),
        "delay_against_sensor_s": float(seconds[latched] - seconds[sensor]) if both else None,
    }


def held(over: np.ndarray, hold_samples: int) -> np.ndarray:
    """Whether each flag and the hold_samples before it are all true: (samples, n), along the samples."""
    runs = np.cumsum(over, axis=0)
    before = np.zeros_like(runs)
    before[hold_samples + 1 :] = runs[: -hold_samples - 1]
    return runs - before == hold_samples + 1


def latched_summary(verdicts: Sequence[dict]) -> dict:
    """The entry `latched` of a bundle in results.json."""
    return {
        "collisions": len(verdicts),
        "latched": sum(v["latched"] for v in verdicts),
        "strong": sum(v["strong"] for v in verdicts),
        "unhealthy": sum(v["unhealthy"] for v in verdicts),
        "strong_latched": sum(v["strong"] and v["latched"] for v in verdicts),
        **delay_quantiles(verdicts, "delay"),
        **delay_quantiles(verdicts, "delay_against_sensor"),
    }


def delay_quantiles(verdicts: Sequence[dict], key: str) -> dict[str, float | None]:
    """Median and 95 % quantile of the verdicts' delays, as KEY_median_s and KEY_p95_s."""
    known = [verdict[f"{key}_s"] for verdict in verdicts if verdict[f"{key}_s"] is not None]
    quantiles = {"median": 0.5, "p95": 0.95}
    return {f"{key}_{name}_s": float(np.quantile(known, q)) if known else None for name, q in quantiles.items()}


def _first_rise_in(flags: np.ndarray, window: slice) -> int | None:
    """Index within the window of the first flag that is true after a false one."""
    return first_rise(flags[window], bool(flags[window.start - 1]) if window.start else False)


# --- Collisions latched, and how soon, over how hard they were in N m: one scale for all methods and limits.


EDGES_NM = (0.0, 1.0, 2.0, 4.0, 8.0, 16.0, 40.0)


def by_strength(touches: Sequence[Collision], verdicts: Sequence[dict]) -> list[dict]:
    """The entry `by_strength` of a bundle in results.json.

    Args:
        touches: their strength is the sensor reference's peak on the joint where that is largest, [N m].
        verdicts: their results of `judge_latched`, in the same order; those in unhealthy time are in no bin.
    """
    unseen = [v["unhealthy"] for v in verdicts]
    # NaN: no sensor, in no bin
    peak_nm = np.where(unseen, np.nan, [touch.sensor_peak_nm.max() or np.nan for touch in touches])
    entries = []
    for low, high in zip(EDGES_NM, (*EDGES_NM[1:], np.inf), strict=True):
        inside = [verdicts[k] for k in np.flatnonzero((peak_nm >= low) & (peak_nm < high)).tolist()]
        entries.append(
            {
                "peak_nm_from": low,
                "peak_nm_to": None if np.isinf(high) else high,
                "collisions": len(inside),
                "latched": sum(v["latched"] for v in inside),
                **delay_quantiles(inside, "delay"),
            }
        )
    return entries


# --- When an event really began: labels are late or early by tens of milliseconds.


BASELINE_S = 0.1
"""A reference is measured from its mean over so long before the window."""
SLOPE_S = 0.02
"""Of the residual's derivative."""
QUANTILE, RESERVE = 0.999, 1.5


def onset_s(
    recording: Recording, windows: Sequence[tuple[float, float]], residual: np.ndarray, free: np.ndarray
) -> list[float | None]:
    """The first time in each window at which the reference leaves its noise band on some joint, [s]; None: it does not.

    The reference is the robot's own tau_ext, measured from its mean over the 0.1 s before the window; where the
    recording has none, the change of the residual over 20 ms, which lags a step by little. A joint's noise band is 1.5
    times what 99.9 % of the free samples stay within, these measured from the mean of the 0.1 s that ended 0.1 s
    earlier, all of it free. Without such samples there is no band, and no onset.

    Args:
        windows: from and to, counted from the first sample, [s].
        residual: (samples, joints), [N m]; NaN counts as zero.
        free: (samples,) bool.
    """
    if not windows:
        return []
    time_s = recording.time_s
    if recording.tau_ext is not None:
        signal = recording.tau_ext
        ago = signal - means(time_s, signal, time_s - 2 * BASELINE_S, time_s - BASELINE_S)
    else:
        residual = np.nan_to_num(residual.astype(float))
        before = np.clip(np.searchsorted(time_s, time_s - SLOPE_S), 0, None)
        signal = ago = residual - residual[before]
    busy = np.append(0, np.cumsum(~free))
    began = np.searchsorted(time_s, time_s - 2 * BASELINE_S)
    usable = (busy[1:] == busy[began]) & (time_s > 2 * BASELINE_S)
    if not usable.any():
        return [None] * len(windows)
    band = RESERVE * np.quantile(np.abs(ago[usable]), QUANTILE, axis=0)
    onsets: list[float | None] = []
    for begin_s, end_s in windows:
        inside = np.flatnonzero((time_s >= begin_s) & (time_s <= end_s))
        level = np.zeros(signal.shape[1])
        if recording.tau_ext is not None:
            level = means(time_s, signal, np.array([begin_s - BASELINE_S]), np.array([begin_s]))[0]
        left = inside[(np.abs(signal[inside] - level) > band).any(axis=1)]
        onsets.append(float(time_s[left[0]]) if len(left) else None)
    return onsets


def means(time_s: np.ndarray, signal: np.ndarray, from_s: np.ndarray, to_s: np.ndarray) -> np.ndarray:
    """Mean of a signal over stretches of time, at least one sample each, (stretches, joints)."""
    sums = np.vstack([np.zeros((1, signal.shape[1])), np.cumsum(signal, axis=0)])
    first = np.clip(np.searchsorted(time_s, from_s), 0, len(time_s) - 1)
    last = np.maximum(np.searchsorted(time_s, to_s), first + 1)
    return (sums[last] - sums[first]) / (last - first)[:, None]


# --- A bundle's estimates of each collision: link, force, kind; and how they agree with the labels.


STATED = 0.9
"""A link that is so probable is stated."""


@dataclass
class TouchMeasures:
    """One bundle's links and kinds, collision by collision."""

    bundle: _core.Bundle
    _reported: list[dict] = field(default_factory=list)
    _labels: list[tuple[int, str]] = field(default_factory=list)
    """Touched link, -1 where unknown, and the recording's word for the kind of its contacts."""

    def add(self, touches: Sequence[Collision], recording: Recording, estimates: Estimates) -> None:
        """Take in the collisions of a recording that raised an alarm, contact or collision."""
        model = _core.PlaceModel(self.bundle) if touches else None  # here, since it is not to be kept with the numbers
        for touch in touches:
            rows = alarm_rows(touch, recording, estimates)
            if model is None or len(rows) == 0:
                continue
            place = {} if model.refused else place_of(model, rows, recording, estimates)
            self._reported.append({"id": touch.id, "kind": kind_of(touch, recording, estimates), **place})
            self._labels.append((touch.link, touch.kind))

    def summary(self) -> dict:
        """The entry `touches` of a bundle in results.json."""
        return {"stated_from": STATED, "links": self._links(), "kinds": self._kinds(), "reported": self._reported}

    def _links(self) -> dict | None:
        """The entry `links`; None if no place was estimated for a collision whose link is labelled."""
        names = [link.joint_name for link in self.bundle.links]
        known = [
            (names[link], place)
            for (link, _), place in zip(self._labels, self._reported, strict=True)
            if 0 <= link < len(names) and place.get("links")
        ]
        if not known:
            return None
        ranked_links = [
            (true, [one["joint"] for one in place["links"]], place["links"][0]["probability"]) for true, place in known
        ]
        stated = [true == ranked[0] for true, ranked, probability in ranked_links if probability >= STATED]
        return {
            "joints": names,
            "table": [
                [sum(true == row and ranked[0] == name for true, ranked, _ in ranked_links) for name in names]
                for row in names
            ],
            "collisions": len(ranked_links),
            "first": sum(true == ranked[0] for true, ranked, _ in ranked_links),
            "first_two": sum(true in ranked[:2] for true, ranked, _ in ranked_links),
            "stated": len(stated),
            "stated_right": sum(stated),
        }

    def _kinds(self) -> dict[str, dict[str, int]]:
        """Number of collisions estimated to be of each kind, by the recording's word."""
        counts: dict[str, dict[str, int]] = {}
        for (_, word), reported in zip(self._labels, self._reported, strict=True):
            if reported["kind"] is not None:
                row = counts.setdefault(word, {})
                row[reported["kind"]] = row.get(reported["kind"], 0) + 1
        return counts


def alarm_rows(touch: Collision, recording: Recording, estimates: Estimates) -> np.ndarray:
    """Rows at which some joint was over a limit, from the first in the collision on, for at most FOLLOWED_S."""
    last = min(touch.end + round(GRACE_S * recording.rate_hz), recording.samples)
    rows = touch.begin + np.flatnonzero(estimates.held_alarm[touch.begin : last] > 0)
    return rows[recording.t_ns[rows] <= recording.t_ns[rows[0]] + FOLLOWED_S * 1e9] if len(rows) else rows


def place_of(model: _core.PlaceModel, rows: np.ndarray, recording: Recording, estimates: Estimates) -> dict:
    """Estimated links and force at the row with the largest tau_ext over its standard error; empty if none."""
    assert estimates.sigma_nm is not None and estimates.contact_sigma_nm is not None
    signals = (recording.q, recording.dq, estimates.tau_ext, estimates.sigma_nm, estimates.contact_sigma_nm)
    found = strongest_place(model, *(signal[rows] for signal in signals))
    if found is None or found.best is None:
        return {}
    return {
        "links": [
            {"joint": recording.joints[link], "probability": found.probability[link]} for link in found.ranked[:3]
        ],
        "force_n": newtons(found.best),
        "point_m": list(found.best.point),
        "spread_m": found.best.spread_m,
        "consistent": found.consistent,
    }


def kind_of(touch: Collision, recording: Recording, estimates: Estimates) -> str:
    """The estimated kind after the end of the collision."""
    last = min(touch.end + round(GRACE_S * recording.rate_hz), recording.samples) - 1
    return str(_core.Touch(int(estimates.touch[last])).name)
