"""Collisions in a recording, and whether and when they were found."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from tauext.bundle.estimates import Estimates
from tauext.data.recording import Recording

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
        ratio = np.nan_to_num(np.abs(recording.tau_ext_sensor[part]) / estimates.limit[part]).max(axis=1)
        over = ratio > 1
        sensor = first_rise(over[collision.begin - before :], bool(over[0]))
        peak = float(ratio[collision.begin - before :].max())
    result = {"id": collision.id, "found": found is not None, "joint": None, "delay_s": None}
    if found is not None:
        margin = np.abs(estimates.tau_ext[window][found]) / estimates.limit[window][found]
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
