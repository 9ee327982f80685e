"""Isolated spikes: a few samples that jump away from their neighbours and back."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tauext.check.examination import Examination
from tauext.check.finding import Finding
from tauext.check.motion import repeated_rows
from tauext.data.recording import Recording, runs_of
from tauext.data.servo import derives_velocity, torque_unit

NAMES = {"tau": ("torque", "Nm"), "q": ("position", "rad"), "dq": ("velocity", "rad/s")}  # name and unit of each signal


@dataclass(frozen=True)
class SpikeRules:
    """What makes samples a spike."""

    longest_s: float = 0.012  # of the torque; a single sample always may be one. Stops and impacts last 30 ms and more
    longest_impossible_s: float = 0.3  # of positions, and of velocities that the position does not follow
    longest_impossible_rows: int = 300
    usual: float = 99.0  # percentile of jumps that is usual: noise, steps of a current, chatter of an encoder
    share: float = 0.5  # smallest jump of a torque or velocity that matters, as a share of its normal range
    reported_beyond: float = 1.5  # ... and its least distance, as `beyond`: a jump within it changes no limit
    least_steps: float = 3.0  # a jump has more steps than this, where a signal has steps ...
    least_nm: float = 0.01  # ... and exceeds this share of the strongest joint's range: a joint at rest has no range
    least_rad: float = 1e-3  # smallest jump of a position; it must also exceed ...
    fastest_rad_s2: float = 200.0  # ... what an impact causes within a sample
    normal: float = 0.5  # percentile from which the normal range lies to 100 less it: spikes do not widen it
    beyond: float = 5.0  # half ranges from the middle for a fault; a lightly loaded joint reaches 3 in a hard stop
    drive: float = 1.5  # multiple of the robot file's effort limit that exceeds a drive's short peak


RULES = SpikeRules()


@dataclass(frozen=True)
class Spikes:
    """Spikes of one signal of one joint in one recording."""

    signal: str
    joint: int
    rows: np.ndarray  # of the recording
    before: np.ndarray  # value before each of these rows' runs
    fault: bool


Ranges = dict[str, list[tuple[float, float]]]
"""Normal range of each signal and joint: its middle and half of its width."""


def normal_ranges(recordings: Sequence[Recording]) -> Ranges:
    """Normal ranges over all recordings. Each sample has the same weight; many recordings are subsampled."""
    stride = max(1, sum(r.samples for r in recordings) // 200_000)
    found: Ranges = {}
    for signal in NAMES:
        x = np.concatenate([getattr(r, signal)[::stride] for r in recordings])
        low, high = np.percentile(x, [RULES.normal, 100 - RULES.normal], axis=0)
        found[signal] = [(float(a + b) / 2, float(b - a) / 2) for a, b in zip(low, high, strict=True)]
    return found


def spikes_of(recording: Recording, normal: Ranges, torque_limits_nm: np.ndarray | None = None) -> list[Spikes]:
    """All spikes of a recording, by the normal ranges of its dataset and the robot file's limits, 0: it has none."""
    rows = np.flatnonzero(~repeated_rows(recording))
    if len(rows) < 8:
        return []
    steps_s, found = np.diff(recording.t_ns[rows]) * 1e-9, []
    limits_nm = np.zeros(len(recording.joints)) if torque_limits_nm is None else torque_limits_nm
    least = {"tau": RULES.least_nm * max(half for _, half in normal["tau"]), "dq": 0.1, "q": RULES.least_rad}
    for signal in NAMES:
        if signal == "dq" and derives_velocity(recording):
            continue  # it adds no information, and one count of the position is a jump of the velocity
        values = getattr(recording, signal)[rows]
        for j in range(len(recording.joints)):
            limit = float(limits_nm[j]) if signal == "tau" and limits_nm[j] > 0 else float("inf")
            q = recording.q[rows, j]
            one = _of_signal(signal, j, values[:, j], q, steps_s, normal[signal][j], least[signal], limit)
            if one is not None:
                found.append(replace(one, rows=rows[one.rows]))
    return found


def _of_signal(
    signal: str,
    j: int,
    x: np.ndarray,
    q: np.ndarray,
    steps_s: np.ndarray,
    normal: tuple[float, float],
    least: float,
    limit: float,
) -> Spikes | None:
    period, (middle, half) = float(np.median(steps_s)), normal
    leap = np.diff(x)
    leap[steps_s > 3.0 * period] = 0.0  # a change across such a step is no jump
    if signal == "q":  # a spike is a reversal at more than full speed
        usual_rad = float(np.percentile(np.abs(leap), 100 - RULES.normal))
        far_enough = max(RULES.fastest_rad_s2 * period**2, usual_rad)
    else:
        far_enough = RULES.share * (2.0 if period > RULES.longest_s else 1) * 2 * half
    a, b, sizes = leap[:-1], leap[1:], np.abs(leap[leap != 0])
    back = np.where((a < 0) != (b < 0), np.minimum(np.abs(a), np.abs(b)), 0.0)  # jumps that come back at once
    # white noise of a million samples reaches 2.5 times its usual jump
    usual = 6.0 * float(np.percentile(back, RULES.usual))
    least = max(least, far_enough, usual, RULES.least_steps * float(sizes.min()) if len(sizes) else 0.0)
    short = max(1, int(RULES.longest_s / period))
    impossible = min(RULES.longest_impossible_rows, max(1, int(RULES.longest_impossible_s / period)))
    runs = _runs(leap, least, short if signal == "tau" else impossible)
    if signal == "dq":
        runs = [(a, b) for a, b in runs if b - a <= short or not _followed(x, q, period, a, b)]
    far = np.abs(x - middle)
    runs += _extreme_runs(far, leap, half, limit)
    if not runs:
        return None
    spiked = np.zeros(len(x), dtype=bool)
    for first, last in runs:
        spiked[first:last] = True
    at = np.flatnonzero(spiked)
    good = np.maximum.accumulate(np.where(spiked, -1, np.arange(len(x))))
    before = x[np.where(good[at] >= 0, good[at], int(np.argmin(spiked)))]
    if signal == "q":
        # no joint turns faster, [rad/s]: such a jump of position would raise a collision alarm
        return Spikes(signal, j, at, before, bool(np.abs(x[at] - before).max() > 20.0 * period))
    beyond = float(far[at].max()) / max(half, 1e-12)
    if beyond < RULES.reported_beyond:
        return None
    fault = beyond > RULES.beyond or float(np.abs(x[at]).max()) > RULES.drive * limit
    return Spikes(signal, j, at, before, fault)


def _runs(leap: np.ndarray, least: float, longest: int) -> list[tuple[int, int]]:
    """First row and row after the last of runs between two opposite jumps of at least this size."""
    found: list[tuple[int, int]] = []
    at = np.flatnonzero(np.abs(leap) > least)
    rows, sizes = at.tolist(), leap[at].tolist()
    for i, (first, up) in enumerate(zip(rows, sizes, strict=True)):
        if found and first < found[-1][1]:
            continue
        for back, down in zip(rows[i + 1 : i + 1 + longest], sizes[i + 1 : i + 1 + longest], strict=True):
            if back - first > longest:
                break
            if (up < 0) != (down < 0) and abs(up + down) < 0.35 * min(abs(up), abs(down)):
                found.append((first + 1, back + 1))
                break
    return found


def _followed(dq: np.ndarray, q: np.ndarray, period: float, first: int, last: int) -> bool:
    """Whether the position follows the velocity of these rows rather than that of the rows beside them."""
    expected = float(dq[first:last].sum()) * period
    beside = 0.5 * float(dq[first - 1] + dq[last]) * (last - first) * period
    went = float(q[last - 1] - q[first - 1])
    return abs(went - expected) < abs(went - beside)


def _extreme_runs(far: np.ndarray, leap: np.ndarray, half: float, limit: float) -> list[tuple[int, int]]:
    """Runs far outside the normal range, of any length, that begin or end with a jump."""
    beyond = (far > 20.0 * half) | (far > max(RULES.drive * limit, RULES.beyond * half) + half)
    if half == 0 or not beyond.any() or beyond.sum() > max(10, 1e-3 * len(far)):
        return []
    jump = np.r_[0.0, np.abs(leap), 0.0]
    return [
        (first, last)
        for first, last in runs_of(beyond).tolist()
        if max(jump[first], jump[last]) > RULES.share * far[first:last].max()
    ]


def spike_findings(x: Examination) -> Iterator[Finding]:
    """Findings of spikes, one a joint: a spike of the position also appears in the velocity derived from it. Takes the
    spikes out of the recordings."""
    normal = normal_ranges(x.recordings)
    spikes = [spikes_of(r, normal, x.torque_limits_nm) for r in x.recordings]
    advice = "a lost or mixed-up message, or a glitch of a sensor: cut these moments out, or record again"
    for r, found in zip(x.recordings, spikes, strict=True):
        for j in sorted({s.joint for s in found}):
            own = [s for s in found if s.joint == j]
            evidence = f"'{r.name}': {'; '.join(_described(r, s, *normal[s.signal][j]) for s in own)}"
            severe = any(s.fault for s in own)
            yield Finding("spike", "fault" if severe else "warning", r.joints[j], evidence, advice, r.name)
    x.correct(recordings=[without_spikes(r, found) for r, found in zip(x.recordings, spikes, strict=True)])


def _described(recording: Recording, spikes: Spikes, middle: float, half: float) -> str:
    x, j = getattr(recording, spikes.signal), spikes.joint
    name, unit = NAMES[spikes.signal]
    unit = torque_unit([recording]) if spikes.signal == "tau" else unit
    order = np.argsort(-np.abs(x[spikes.rows, j] - spikes.before))[:3]
    parts = [
        f"{x[spikes.rows[k], j]:.4g} {unit} at {recording.time_s[spikes.rows[k]]:.3f} s beside {spikes.before[k]:.4g}"
        for k in order.tolist()
    ]
    more = len(spikes.rows) - len(parts)
    others = f" and {more} more" if more > 0 else ""
    return f"{name} {', '.join(parts)}{others}, where 99 % lie in {middle - half:.4g} to {middle + half:.4g}"


def without_spikes(recording: Recording, spikes: Sequence[Spikes]) -> Recording:
    """The recording with its spikes interpolated linearly, for the following checks. Values beyond a million, in any
    unit, are clipped, so that sums stay finite."""
    beyond = {signal for signal in NAMES if np.abs(getattr(recording, signal)).max(initial=0) > 1e6}
    if not spikes and not beyond:
        return recording
    names = {s.signal for s in spikes} | beyond
    signals: dict[str, Any] = {name: np.clip(getattr(recording, name), -1e6, 1e6) for name in names}
    for s in spikes:
        x, good = signals[s.signal], np.ones(recording.samples, dtype=bool)
        good[s.rows] = False
        x[s.rows, s.joint] = np.interp(s.rows, np.flatnonzero(good), x[good, s.joint])
    return replace(recording, **signals)
