"""Sensors: stuck or clipped signals, coarse steps, isolated spikes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tauext.check.finding import Finding, Severity
from tauext.check.motion import MOVING_RAD_S, repeated_rows
from tauext.config import ObserverConfig
from tauext.data.drive_signal import MOST_VALUES, position_step, step_of
from tauext.data.recording import Recording, runs_of
from tauext.data.servo import derives_velocity, makes_torque, torque_unit

# --- Single signals: saturated, stuck, in coarse steps, or with less noise than a measurement.


PILED_ROWS, PILED_SHARE = 20, 3.0
"""A signal is saturated if at least so many rows lie at one extreme, and so many times more than in the adjacent
hundredth of its range."""
STUCK_S = 0.2
"""A signal is stuck if it has not changed by a bit for this time while its joint turns by 0.02 rad."""
STUCK_TIMES = 10.0
"""... and so many times longer than 99 % of its constant runs: a signal of few levels keeps each for a while."""
STRAIGHT, BEAT = 0.005, 0.2
"""Permitted error of such a velocity where the position follows a line of its own: velocities from encoder counts have
a ripple, which is constant where counts come in step with the samples."""


def saturated_findings(recordings: Sequence[Recording]) -> list[Finding]:
    """Findings of saturated torques and velocities; a position at its extreme is a pose."""
    moving = [(np.abs(r.dq) > MOVING_RAD_S).any(axis=1) & ~repeated_rows(r) for r in recordings]
    found = (_saturated(recordings, moving, j, joint) for j, joint in enumerate(recordings[0].joints))
    return [finding for finding in found if finding is not None]


def _saturated(recordings: Sequence[Recording], moving: Sequence[np.ndarray], j: int, joint: str) -> Finding | None:
    """Saturation of one joint; `moving`: samples of each recording, (samples,) bool, at which the arm moves."""
    for signal, unit in (("tau", torque_unit(recordings)), ("dq", "rad/s")):
        x = np.concatenate([getattr(r, signal)[m, j] for r, m in zip(recordings, moving, strict=True)])
        if len(x) < 100 or np.ptp(x) == 0:
            continue
        for side in (1, -1):
            y = side * x
            at_extreme = y == y.max()
            next_level = y[~at_extreme].max()
            beside = (y >= min(y.max() - 0.01 * np.ptp(y), next_level)) & ~at_extreme
            piled = int(at_extreme.sum())
            if piled < max(PILED_ROWS, 0.001 * len(y)) or piled < PILED_SHARE * beside.sum():
                continue
            if signal == "dq" and not _faster_than_limit(recordings, j, side, float(y.max())):
                continue
            evidence = (
                f"{signal}: {piled} samples ({piled / len(y):.2%} of the motion) at exactly {side * y.max():.5g} {unit}"
                f", {int(beside.sum())} in the hundredth of its range beside it"
            )
            advice = "the sensor or its message ends there: slower motion, or a wider range; leave these samples out"
            return Finding("saturated", "fault", joint, evidence, advice)
    return None


def _faster_than_limit(recordings: Sequence[Recording], j: int, side: int, limit: float) -> bool:
    """Whether positions change faster than the velocity's extreme: a cruise at constant speed is no limit."""
    for r in recordings:
        rows = np.flatnonzero(side * r.dq[:, j] == limit)
        rows = rows[(rows >= 5) & (rows < r.samples - 5)]
        if len(rows):
            rise = side * (r.q[rows + 5, j] - r.q[rows - 5, j]) / ((r.t_ns[rows + 5] - r.t_ns[rows - 5]) * 1e-9)
            if np.median(rise) > 1.03 * limit:
                return True
    return False


def stuck_findings(recordings: Sequence[Recording]) -> list[Finding]:
    repeated = [repeated_rows(r) for r in recordings]
    found = (_stuck(recordings, repeated, j, joint) for j, joint in enumerate(recordings[0].joints))
    return [finding for finding in found if finding is not None]


def _stuck(recordings: Sequence[Recording], repeated: Sequence[np.ndarray], j: int, joint: str) -> Finding | None:
    count, longest, longest_run = 0, 0.0, ""
    ends = {name: _ends(recordings, name, j) for name in ("tau", "dq")}  # there a signal is saturated, not stuck
    # Torque from a servo's counts stays 0 while the current is small: no fault either.
    counted = any(makes_torque(r) for r in recordings)
    signals = ("q", "dq") if counted or _coarse_step(recordings, j) else ("q", "dq", "tau")
    velocity_step = min((_least_step(r.dq[:, j]) for r in recordings), default=0.0)
    for r, whole in zip(recordings, repeated, strict=True):
        travelled = {"q": r.dq, "dq": r.q, "tau": r.q}
        for signal in signals:
            x = getattr(r, signal)[:, j]
            runs = runs_of((x[1:] == x[:-1]) & ~whole[1:])
            lasted = (r.t_ns[runs[:, 1]] - r.t_ns[runs[:, 0]]) * 1e-9
            least_s = STUCK_S
            if signal != "q" and len(lasted) >= 100:
                least_s = max(STUCK_S, STUCK_TIMES * float(np.percentile(lasted, 99)))
            long = (lasted >= least_s) & (np.ptp(runs, axis=1) >= 10)
            for (first, last), seconds in zip(runs[long], lasted[long], strict=True):
                if x[first] in ends.get(signal, ()):
                    continue
                other = travelled[signal][first : last + 1, j]
                way = abs(float(other.mean())) * seconds if signal == "q" else float(np.ptp(other))
                if way < 0.02:
                    continue
                if signal == "dq" and _cruises(r, j, first, last, max(0.05 * way, velocity_step * seconds)):
                    continue
                count += 1
                if seconds > longest:
                    longest = seconds
                    at = (r.t_ns[first] - r.t_ns[0]) * 1e-9
                    longest_run = f"{signal} stays {x[first]:.5g} for {seconds:.2f} s at {at:.2f} s of '{r.name}'"
    if not count:
        return None
    evidence = f"{count} times, the longest: {longest_run}, while the joint turns"
    advice = "a driver that repeats its last value: check for lost packets of this joint; leave these stretches out"
    return Finding("stuck", "fault", joint, evidence, advice)


def _cruises(r: Recording, j: int, first: int, last: int, within_rad: float) -> bool:
    """Whether the position moves at one speed throughout, close to these rows' velocity: no fault."""
    since_s = (r.t_ns[first : last + 1] - r.t_ns[first]) * 1e-9
    gone = r.q[first : last + 1, j] - r.q[first, j]
    if np.abs(gone - r.dq[first, j] * since_s).max() < within_rad:
        return True
    speed, start = np.polyfit(since_s, gone, 1)
    straight = np.abs(gone - start - speed * since_s).max() < STRAIGHT * abs(gone[-1])
    return bool(straight and abs(r.dq[first, j] - speed) < BEAT * abs(speed))


def _least_step(x: np.ndarray) -> float:
    """Smallest difference between two values of a signal; 0: the signal is constant."""
    steps = np.abs(np.diff(x))
    return float(steps[steps > 0].min(initial=np.inf)) if (steps > 0).any() else 0.0


def torque_step_nm(recordings: Sequence[Recording], j: int) -> float | None:
    """Step of which every torque is a whole multiple, [N m]; None: no such step."""
    stride = max(1, sum(r.samples for r in recordings) // MOST_VALUES)
    return step_of(np.concatenate([r.tau[::stride, j] for r in recordings]))


def _ends(recordings: Sequence[Recording], signal: str, j: int) -> tuple[float, float]:
    columns = [getattr(r, signal)[:, j] for r in recordings]
    low, high = min(float(x.min()) for x in columns), max(float(x.max()) for x in columns)
    return (low, high) if low < high else (math.nan, math.nan)  # a signal that never changes has no ends


def _coarse_step(recordings: Sequence[Recording], j: int) -> tuple[float, float] | None:
    """Step of a coarse torque, and the torque's spread; None: it is not coarse."""
    step, spread = torque_step_nm(recordings, j), float(np.concatenate([r.tau[:, j] for r in recordings]).std())
    return (step, spread) if step is not None and step >= 0.1 * spread else None


def coarse_torques(recordings: Sequence[Recording]) -> list[Finding]:
    """Findings of torques of few levels."""
    found, unit = [], torque_unit(recordings)
    advice = "pushes below a step or two are not detected; is there a finer signal, a current for instance?"
    for j, joint in enumerate(recordings[0].joints):
        coarse = _coarse_step(recordings, j)
        if coarse is not None and max(float(np.ptp(r.q[:, j])) for r in recordings) > 0.1:
            step, spread = (f"{x:.4g} {unit}" for x in coarse)
            evidence = f"the torque has whole multiples of {step}, and a spread of {spread}"
            found.append(Finding("resolution", "warning", joint, evidence, advice))
    return found


def noise_nm(recordings: Sequence[Recording]) -> np.ndarray:
    """White noise of the torque (joints,), [N m], from its fourth differences: of motion they hold nothing.

    0 where no recording has five rows that differ.
    """
    total, rows = np.zeros((1, len(recordings[0].joints))), 0
    for r in recordings:
        squares = (np.diff(r.tau[~repeated_rows(r)], 4, axis=0) / np.sqrt(70)) ** 2
        total, rows = np.concatenate([total, squares]).sum(axis=0, keepdims=True), rows + len(squares)
    return np.sqrt(total[0] / max(rows, 1))


def smoothed_findings(recordings: Sequence[Recording]) -> list[Finding]:
    """Finding of torques with less noise than a measurement has, 0.01 to 0.2 of the torque's spread."""
    tau = np.concatenate([r.tau for r in recordings])
    # at lower rates, [Hz], motion fills the spectrum
    if len(tau) < 500 or recordings[0].rate_hz < 60.0:
        return []
    noise, spread = noise_nm(recordings), tau.std(axis=0)
    moves = np.max([np.ptp(r.q, axis=0) for r in recordings], axis=0) > 0.1
    clean = moves & (spread > 0) & (noise < 1e-3 * spread)
    if not clean.any():
        return []
    evidence = (
        f"noise of the torque {noise[clean].min():.2g} to {noise[clean].max():.2g} {torque_unit(recordings)} on "
        f"{int(clean.sum())} of {len(clean)} joints, {np.max(noise[clean] / spread[clean]):.1g} of its spread; "
        f"a measurement has 0.01 or more. Nothing above {_empty_above(recordings, clean):.0f} Hz"
    )
    advice = (
        "smoothed after the fact, or computed: good enough for a friction fit, but limits found on it would be too low "
        "and the filter's delay is unknown; record the raw signal"
    )
    joint = recordings[0].joints[int(np.argmax(clean))] if clean.sum() == 1 else None
    return [Finding("resolution", "warning", joint, evidence, advice)]


def _empty_above(recordings: Sequence[Recording], joints: np.ndarray) -> float:
    """Frequency above which less than a millionth of the torque's variance lies, [Hz]."""
    longest = max(recordings, key=lambda r: r.samples)
    tau = longest.tau[:, joints]
    x = (tau - tau.mean(axis=0)) * np.hanning(len(tau))[:, None]
    power = (np.abs(np.fft.rfft(x, axis=0)) ** 2).sum(axis=1)
    above = np.cumsum(power[::-1])[::-1] / power.sum()
    return float(np.fft.rfftfreq(len(x), 1 / longest.rate_hz)[np.argmax(above < 1e-6)])


# --- Resolution of signals, and velocities coarser than the derivative of their positions.


ROUNDED = math.sqrt(12)
"""Step divided by the standard deviation of the rounding error."""
LINE_S = 0.1
"""Time over which a line is fitted to positions, [s]; motion of arms changes more slowly."""


def steps_of(recordings: Sequence[Recording], j: int) -> tuple[float | None, float | None]:
    """Steps of one joint's position, [rad], and velocity, [rad/s]; None where they are too fine to detect."""
    q, dq = (np.concatenate([getattr(r, name)[:, j] for r in recordings]) for name in ("q", "dq"))
    return position_step(q), step_of(dq)


def speed_error_rad_s(step_rad: float, rate_hz: float) -> float:
    """Standard deviation of the slope of a line fitted to LINE_S of rounded positions, [rad/s]."""
    n = max(3, round(LINE_S * rate_hz) + 1)
    return step_rad / ROUNDED * math.sqrt(12 / (n * (n * n - 1))) * rate_hz


def coarse_velocities(recordings: Sequence[Recording]) -> list[Finding]:
    """Findings of velocities whose step exceeds all speeds near stiction, so that a creeping joint reads 0."""
    if any(map(derives_velocity, recordings)):
        return []  # derived already
    found = []
    for j, joint in enumerate(recordings[0].joints):
        position_rad, velocity_rad_s = steps_of(recordings, j)
        if velocity_rad_s is None or velocity_rad_s <= 2 * ObserverConfig.near_stiction_rad_s:
            continue
        rate_hz = recordings[0].rate_hz
        line_rad_s = speed_error_rad_s(position_rad or 0.0, rate_hz)
        if velocity_rad_s / ROUNDED < 2.0 * line_rad_s:
            continue
        evidence = f"the velocity counts in steps of {velocity_rad_s:.3g} rad/s: off by {velocity_rad_s / ROUNDED:.2g}"
        if position_rad is not None:
            evidence += (
                f", where {LINE_S:g} s of positions in steps of {position_rad:.3g} rad at {rate_hz:.0f} Hz give it to "
                f"{line_rad_s:.1g}; one step of position in one sample is {position_rad * rate_hz:.3g} rad/s"
            )
        advice = (
            "leave the columns of [signals.dq] in arm.toml empty: the velocity is then derived from position; with "
            "[servo] over as many samples as its steps require"
        )
        found.append(Finding("resolution", "warning", joint, evidence, advice))
    return found


# --- Isolated spikes: a few samples that jump away from their neighbours and back.


LONGEST_S = 0.012
"""Longest spike of the torque, [s]; a single sample always may be one. Stops and impacts last 30 ms and more."""
LONGEST_IMPOSSIBLE_S, LONGEST_IMPOSSIBLE_ROWS = 0.3, 300
"""Longest spike of positions that jump back, and of velocities that the position does not follow, [s]."""
USUAL = 99.0
"""Percentile of a recording's jumps that counts as usual: noise, steps of a current, chatter of an encoder."""
SHARE = 0.5
"""Smallest jump of a torque or velocity that matters, as a share of its normal range."""
REPORTED_BEYOND = 1.5
"""... and its least distance from the normal range, counted as BEYOND: a jump within it changes no limit."""
LEAST_STEPS = 3.0
"""A jump has more steps than this, where a signal has steps ..."""
LEAST_NM = 0.01
"""... and exceeds this share of the strongest joint's normal range, since a joint at rest has no range."""
LEAST_RAD, FASTEST_RAD_S2 = 1e-3, 200.0
"""Smallest jump of a position, [rad]; it must also exceed what an impact causes within a sample."""
NORMAL = 0.5
"""Percentiles (this and 100 less it) between which a signal's normal range lies: repeated spikes do not widen it."""
BEYOND = 5.0
"""Distance from the middle of the normal range, in half ranges, from which a spike is a fault. A lightly loaded joint
reaches 3 in a hard stop."""
DRIVE = 1.5
"""Multiple of the robot file's effort limit that exceeds a drive's short peak."""
LARGEST = 1e6
"""Largest accepted magnitude of any signal, in any unit."""
UNITS = {"tau": "Nm", "q": "rad", "dq": "rad/s"}
NAMES = {"tau": "torque", "q": "position", "dq": "velocity"}


@dataclass(frozen=True)
class Spikes:
    """Spikes of one signal of one joint in one recording."""

    signal: str
    joint: int
    rows: np.ndarray  # of the recording
    before: np.ndarray  # value before each of these rows' runs
    beyond: float  # the largest distance from the middle of the normal range, in halves of it
    severity: Severity


@dataclass(frozen=True)
class Normal:
    """Normal range of one signal of one joint over all recordings."""

    middle: float
    half: float


def normal_ranges(recordings: Sequence[Recording]) -> dict[str, list[Normal]]:
    """Normal ranges of each signal and joint. Each sample has the same weight; many recordings are subsampled."""
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
    least = {"tau": LEAST_NM * max(x.half for x in normal["tau"]), "dq": 0.1, "q": LEAST_RAD}
    for signal in UNITS:
        if signal == "dq" and derives_velocity(recording):
            continue  # it adds no information, and one count of the position is a jump of the velocity
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
    # steps of more than three periods: a change across them is no jump
    leap[steps_s > 3.0 * period] = 0.0
    sparse = period > LONGEST_S
    far_enough = FASTEST_RAD_S2 * period**2 if signal == "q" else SHARE * (2.0 if sparse else 1) * 2 * normal.half
    if signal == "q":  # a spike is a reversal at more than full speed
        far_enough = max(far_enough, float(np.percentile(np.abs(leap), 100 - NORMAL)))
    sizes = np.abs(leap[leap != 0])
    # white noise of a million samples reaches 2.5 times its usual jump
    least = max(least, far_enough, 6.0 * _usual(leap), LEAST_STEPS * float(sizes.min()) if len(sizes) else 0.0)
    short = max(1, int(LONGEST_S / period))
    longest = short if signal == "tau" else min(LONGEST_IMPOSSIBLE_ROWS, max(1, int(LONGEST_IMPOSSIBLE_S / period)))
    runs = _runs(leap, least, longest)
    if signal == "dq":
        runs = [(a, b) for a, b in runs if b - a <= short or not _followed(x, q, period, a, b)]
    far = np.abs(x - normal.middle)
    runs += _extreme_runs(far, leap, normal.half, limit)
    if not runs:
        return None
    spiked = np.zeros(len(x), dtype=bool)
    for first, last in runs:
        spiked[first:last] = True
    at = np.flatnonzero(spiked)
    good = np.maximum.accumulate(np.where(spiked, -1, np.arange(len(x))))
    before = x[np.where(good[at] >= 0, good[at], int(np.argmin(spiked)))]
    beyond = float(far[at].max()) / max(normal.half, 1e-12)
    if signal != "q" and beyond < REPORTED_BEYOND:
        return None
    fault = beyond > BEYOND or float(np.abs(x[at]).max()) > DRIVE * limit
    if signal == "q":
        # no joint turns faster, [rad/s]: such a jump of position would raise a collision alarm
        fault = bool(np.abs(x[at] - before).max() > 20.0 * period)
    return Spikes(signal, j, at, before, beyond, "fault" if fault else "warning")


def _usual(leap: np.ndarray) -> float:
    """USUAL percentile of jumps that come back at once."""
    a, b = leap[:-1], leap[1:]
    return float(np.percentile(np.where((a < 0) != (b < 0), np.minimum(np.abs(a), np.abs(b)), 0.0), USUAL))


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
    beyond = (far > 20.0 * half) | (far > max(DRIVE * limit, BEYOND * half) + half)
    if half == 0 or not beyond.any() or beyond.sum() > max(10, 1e-3 * len(far)):
        return []
    jump = np.r_[0.0, np.abs(leap), 0.0]
    return [
        (first, last)
        for first, last in runs_of(beyond).tolist()
        if max(jump[first], jump[last]) > SHARE * far[first:last].max()
    ]


def spike_findings(recording: Recording, spikes: Sequence[Spikes], normal: dict[str, list[Normal]]) -> list[Finding]:
    """Findings of spikes, one a joint: a spike of the position also appears in the velocity derived from it."""
    found = []
    for j in sorted({s.joint for s in spikes}):
        own = [s for s in spikes if s.joint == j]
        evidence = "; ".join(_described(recording, s, normal[s.signal][j]) for s in own)
        severity: Severity = "fault" if any(s.severity == "fault" for s in own) else "warning"
        advice = "a lost or mixed-up message, or a glitch of a sensor: cut these moments out, or record again"
        found.append(
            Finding("spike", severity, recording.joints[j], f"'{recording.name}': {evidence}", advice, recording.name)
        )
    return found


def _described(recording: Recording, spikes: Spikes, normal: Normal) -> str:
    x, j = getattr(recording, spikes.signal), spikes.joint
    unit = torque_unit([recording]) if spikes.signal == "tau" else UNITS[spikes.signal]
    order = np.argsort(-np.abs(x[spikes.rows, j] - spikes.before))[:3]
    parts = [
        f"{x[spikes.rows[k], j]:.4g} {unit} at {recording.time_s[spikes.rows[k]]:.3f} s beside {spikes.before[k]:.4g}"
        for k in order.tolist()
    ]
    more = len(spikes.rows) - len(parts)
    others = f" and {more} more" if more > 0 else ""
    low, high = normal.middle - normal.half, normal.middle + normal.half
    return f"{NAMES[spikes.signal]} {', '.join(parts)}{others}, where 99 % lie in {low:.4g} to {high:.4g}"


def without_spikes(recording: Recording, spikes: Sequence[Spikes]) -> Recording:
    """The recording with its spikes interpolated linearly, for the following checks. Values beyond LARGEST are clipped,
    so that sums stay finite."""
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
