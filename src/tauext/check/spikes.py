"""Isolated spikes: a few samples that leap from their neighbours and back, as no drive, arm or encoder can."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tauext.check.finding import Finding, Severity
from tauext.check.motion import repeated_rows
from tauext.data.recording import Recording
from tauext.data.servo import derives_velocity

LONGEST_S = 0.012
"""A run that is no longer is a spike, as a single sample is: stops and impacts move the torque for 30 ms and more."""
LONGEST_IMPOSSIBLE_S, LONGEST_IMPOSSIBLE_ROWS = 0.3, 300
"""Positions that leap and leap back, and velocities that no position follows, are none of an arm's for so long."""
RETURNED = 0.35
"""The leap back is the leap but for this share."""
USUAL = 99.0
"""Percentile of the leaps and returns of a recording: noise, steps of a current, chatter of an encoder."""
TIMES_USUAL = 6.0
"""White noise of a million samples reaches 2.5 times its own percentile."""
SHARE = 0.5
"""A torque or velocity leaps by that share of all it usually does, or it is no matter."""
TOLD_BEYOND = 1.5
"""... and only beyond so much of the normal range, as BEYOND: within, it moves no limit."""
SPARSE = 2.0
"""Times SHARE, where a single sample is longer than LONGEST_S."""
LEAST_STEPS = 3.0
"""A leap is of more steps than this, where a signal has steps ..."""
LEAST_NM = 0.01
"""... and of a larger share of what the strongest joint usually does: a joint that holds still has no range."""
LEAST_RAD_S = 0.1
LEAST_RAD, FASTEST_RAD_S2 = 1e-3, 200.0
"""A position leaps further than that, and than an impact could accelerate it within a sample."""
NORMAL = 0.5
"""Percentiles (this and 100 less it) between which a signal's normal range lies: repeated spikes do not widen it."""
BEYOND = 5.0
"""A fault beyond so many times the normal range, from its middle in halves of it. A joint that mostly carries little
reaches 3 times in a hard stop."""
SPEED_RAD_S = 20.0
"""No joint of an arm turns faster: a position that says so would be taken for a collision."""
DRIVE = 1.5
"""Times the robot file's limit of effort: more than a drive's short peak."""
UNHEARD = 20.0
"""Times half the normal range: a fault whatever its length, if it begins or ends by a leap and is rare."""
RARE = 1e-3
"""Share of the samples, or FEW_ROWS."""
FEW_ROWS = 10
GAP = 3.0
"""Steps of more than three periods: what happens across them is no leap."""
LARGEST = 1e6
"""Of any signal, whatever its unit."""
TOLD = 3
UNITS = {"tau": "Nm", "q": "rad", "dq": "rad/s"}
NAMES = {"tau": "torque", "q": "position", "dq": "velocity"}


@dataclass(frozen=True)
class Spikes:
    """Of one signal of one joint in one recording."""

    signal: str
    joint: int
    rows: np.ndarray  # of the recording
    before: np.ndarray  # value before each of these rows' runs
    beyond: float  # the largest distance from the middle of the normal range, in halves of it
    severity: Severity


@dataclass(frozen=True)
class Normal:
    """What a joint's signal usually is, over all recordings."""

    middle: float
    half: float


def normal_ranges(recordings: Sequence[Recording]) -> dict[str, list[Normal]]:
    """Of each signal and joint, the same weight to each sample; for many recordings, a share of the samples of each."""
    found: dict[str, list[Normal]] = {}
    stride = max(1, sum(r.samples for r in recordings) // 200_000)
    for signal in UNITS:
        x = np.concatenate([getattr(r, signal)[::stride] for r in recordings])
        low, high = np.percentile(x, [NORMAL, 100 - NORMAL], axis=0)
        found[signal] = [Normal(float(a + b) / 2, float(b - a) / 2) for a, b in zip(low, high, strict=True)]
    return found


def spikes_of(
    recording: Recording, normal: dict[str, list[Normal]], torque_limits_nm: np.ndarray | None = None
) -> list[Spikes]:
    """All spikes of a recording.

    Args:
        normal: of its dataset (`normal_ranges`).
        torque_limits_nm: (joints,) of the robot file, infinite or 0 where it has none.
    """
    rows = np.flatnonzero(~repeated_rows(recording))
    if len(rows) < 8:
        return []
    steps_s = np.diff(recording.t_ns[rows]) * 1e-9
    found = []
    least = {"tau": LEAST_NM * max(x.half for x in normal["tau"]), "dq": LEAST_RAD_S, "q": LEAST_RAD}
    for signal in UNITS:
        if signal == "dq" and derives_velocity(recording):
            continue  # it says nothing that the position does not, and a count of that is a leap of it
        values = getattr(recording, signal)[rows]
        for j in range(len(recording.joints)):
            limit = float("inf")
            if signal == "tau" and torque_limits_nm is not None and torque_limits_nm[j] > 0:
                limit = float(torque_limits_nm[j])
            q = recording.q[rows, j]
            one = _of_signal(signal, j, values[:, j], q, steps_s, normal[signal][j], least[signal], limit)
            if one is not None:
                found.append(replace(one, rows=rows[one.rows]))
    return found


def _of_signal(
    signal: str, j: int, x: np.ndarray, q: np.ndarray, steps_s: np.ndarray, normal: Normal, least: float, limit: float
) -> Spikes | None:
    period = float(np.median(steps_s))
    leap = np.diff(x)
    leap[steps_s > GAP * period] = 0.0
    sparse = period > LONGEST_S
    far_enough = FASTEST_RAD_S2 * period**2 if signal == "q" else SHARE * (SPARSE if sparse else 1) * 2 * normal.half
    if signal == "q":  # a spike is a reversal at more than full speed
        far_enough = max(far_enough, float(np.percentile(np.abs(leap), 100 - NORMAL)))
    sizes = np.abs(leap[leap != 0])
    least = max(least, far_enough, TIMES_USUAL * _usual(leap), LEAST_STEPS * float(sizes.min()) if len(sizes) else 0.0)
    short = max(1, int(LONGEST_S / period))
    longest = short if signal == "tau" else min(LONGEST_IMPOSSIBLE_ROWS, max(1, int(LONGEST_IMPOSSIBLE_S / period)))
    runs = _runs(leap, least, longest)
    if signal == "dq":
        runs = [(a, b) for a, b in runs if b - a <= short or not _followed(x, q, period, a, b)]
    far = np.abs(x - normal.middle)
    runs += _unheard(far, leap, normal.half, limit)
    if not runs:
        return None
    spiked = np.zeros(len(x), dtype=bool)
    for first, last in runs:
        spiked[first:last] = True
    at = np.flatnonzero(spiked)
    good = np.maximum.accumulate(np.where(spiked, -1, np.arange(len(x))))
    before = x[np.where(good[at] >= 0, good[at], int(np.argmin(spiked)))]
    beyond = float(far[at].max()) / max(normal.half, 1e-12)
    if signal != "q" and beyond < TOLD_BEYOND:
        return None
    fault = beyond > BEYOND or float(np.abs(x[at]).max()) > DRIVE * limit
    if signal == "q":
        fault = bool(np.abs(x[at] - before).max() > SPEED_RAD_S * period)
    return Spikes(signal, j, at, before, beyond, "fault" if fault else "warning")


def _usual(leap: np.ndarray) -> float:
    """USUAL percentile of what leaps and comes back at once."""
    a, b = leap[:-1], leap[1:]
    return float(np.percentile(np.where((a < 0) != (b < 0), np.minimum(np.abs(a), np.abs(b)), 0.0), USUAL))


def _runs(leap: np.ndarray, least: float, longest: int) -> list[tuple[int, int]]:
    """First row and row after the last, of runs that begin and end by leaps of at least so much, the second undoing
    the first."""
    found: list[tuple[int, int]] = []
    at = np.flatnonzero(np.abs(leap) > least)
    rows, sizes = at.tolist(), leap[at].tolist()
    for i, (first, up) in enumerate(zip(rows, sizes, strict=True)):
        if found and first < found[-1][1]:
            continue
        for back, down in zip(rows[i + 1 : i + 1 + longest], sizes[i + 1 : i + 1 + longest], strict=True):
            if back - first > longest:
                break
            if (up < 0) != (down < 0) and abs(up + down) < RETURNED * min(abs(up), abs(down)):
                found.append((first + 1, back + 1))
                break
    return found


def _followed(dq: np.ndarray, q: np.ndarray, period: float, first: int, last: int) -> bool:
    """Whether the position went where the velocity of these rows says, and not where the rows beside them do."""
    said = float(dq[first:last].sum()) * period
    beside = 0.5 * float(dq[first - 1] + dq[last]) * (last - first) * period
    went = float(q[last - 1] - q[first - 1])
    return abs(went - said) < abs(went - beside)


def _unheard(far: np.ndarray, leap: np.ndarray, half: float, limit: float) -> list[tuple[int, int]]:
    """Runs far beyond everything, however long or at an end, that a leap begins or ends."""
    beyond = (far > UNHEARD * half) | (far > max(DRIVE * limit, BEYOND * half) + half)
    if half == 0 or not beyond.any() or beyond.sum() > max(FEW_ROWS, RARE * len(far)):
        return []
    edges = np.flatnonzero(np.diff(np.r_[0, beyond.astype(np.int8), 0]))
    jump = np.r_[0.0, np.abs(leap), 0.0]
    return [
        (first, last)
        for first, last in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
        if max(jump[first], jump[last]) > SHARE * far[first:last].max()
    ]


def spike_findings(recording: Recording, spikes: Sequence[Spikes], normal: dict[str, list[Normal]]) -> list[Finding]:
    """One a joint: a spike of the position makes one of the velocity that is derived from it."""
    found = []
    for j in sorted({s.joint for s in spikes}):
        own = [s for s in spikes if s.joint == j]
        told = "; ".join(_told(recording, s, normal[s.signal][j]) for s in own)
        severity: Severity = "fault" if any(s.severity == "fault" for s in own) else "warning"
        advice = "a lost or mixed-up message, or a glitch of a sensor: cut these moments out, or record anew"
        found.append(
            Finding("spike", severity, recording.joints[j], f"'{recording.name}': {told}", advice, recording.name)
        )
    return found


def _told(recording: Recording, spikes: Spikes, normal: Normal) -> str:
    x, j, unit = getattr(recording, spikes.signal), spikes.joint, UNITS[spikes.signal]
    order = np.argsort(-np.abs(x[spikes.rows, j] - spikes.before))[:TOLD]
    parts = [
        f"{x[spikes.rows[k], j]:.4g} {unit} at {recording.time_s[spikes.rows[k]]:.3f} s beside {spikes.before[k]:.4g}"
        for k in order.tolist()
    ]
    more = len(spikes.rows) - len(parts)
    others = f" and {more} more" if more > 0 else ""
    low, high = normal.middle - normal.half, normal.middle + normal.half
    return f"{NAMES[spikes.signal]} {', '.join(parts)}{others}, where 99 % lie in {low:.4g} to {high:.4g}"


def without_spikes(recording: Recording, spikes: Sequence[Spikes]) -> Recording:
    """The recording with its spikes bridged by straight lines, for the checks that follow; what is beyond LARGEST
    all the same is cut off there, so that their sums stay finite."""
    beyond = {signal for signal in UNITS if np.abs(getattr(recording, signal)).max(initial=0) > LARGEST}
    if not spikes and not beyond:
        return recording
    names = {s.signal for s in spikes} | beyond
    signals: dict[str, Any] = {name: np.clip(getattr(recording, name), -LARGEST, LARGEST) for name in names}
    for s in spikes:
        x, good = signals[s.signal], np.ones(recording.samples, dtype=bool)
        good[s.rows] = False
        x[s.rows, s.joint] = np.interp(s.rows, np.flatnonzero(good), x[good, s.joint])
    return replace(recording, **signals)
