"""Sensors: stuck or clipped signals, coarse steps, too little noise."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from tauext.check.examination import Examination
from tauext.check.finding import Finding
from tauext.check.motion import MOVING_RAD_S, repeated_rows
from tauext.config import ObserverConfig
from tauext.data.free_motion import cut
from tauext.data.recording import TURN, Recording, runs_of
from tauext.data.servo import derives_velocity, makes_torque, torque_unit
from tauext.data.unmeasured import unmeasured

# --- Saturated signals: many rows at one extreme.


def saturated_findings(x: Examination) -> Iterator[Finding]:
    """Findings of saturated torques and velocities; a position at its extreme is a pose."""
    moving = [(np.abs(r.dq) > MOVING_RAD_S).any(axis=1) & ~repeated_rows(r) for r in x.recordings]
    advice = "the sensor or its message ends there: slower motion, or a wider range; leave these samples out"
    for j, joint in enumerate(x.joints):
        evidence = next(_saturated(x.recordings, moving, j), None)
        if evidence is not None:
            yield Finding("saturated", "fault", joint, evidence, advice)


def _saturated(
    recordings: Sequence[Recording], moving: Sequence[np.ndarray], j: int, least: int = 20, times: float = 3.0
) -> Iterator[str]:
    """Evidence of one joint's saturation: so many rows at one extreme, and so many times those beside it."""
    for signal, unit in (("tau", torque_unit(recordings)), ("dq", "rad/s")):
        x = np.concatenate([getattr(r, signal)[m, j] for r, m in zip(recordings, moving, strict=True)])
        if len(x) < 100 or np.ptp(x) == 0:
            continue
        for side in (1, -1):
            y = side * x
            at_extreme = y == y.max()
            next_level = y[~at_extreme].max()
            beside = int(((y >= min(y.max() - 0.01 * np.ptp(y), next_level)) & ~at_extreme).sum())
            piled = int(at_extreme.sum())
            if piled < max(least, 0.001 * len(y)) or piled < times * beside:
                continue
            if signal == "tau" or _faster_than_limit(recordings, j, side, float(y.max())):
                yield (
                    f"{signal}: {piled} samples ({piled / len(y):.2%} of the motion) at exactly "
                    f"{side * y.max():.5g} {unit}, {beside} in the hundredth of its range beside it"
                )


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


# --- Signals that are missing: a torque that is 0 below a threshold, or refreshed more slowly than the position.


@dataclass(frozen=True)
class Band:
    """A torque's dead band."""

    share: float  # of the samples in motion, in which the torque is 0
    least: float  # smallest other torque, in the unit of tau


def dead_band(recordings: Sequence[Recording], j: int) -> Band | None:
    """Dead band of a joint's torque: 0 far more often, in motion, than any other value; None: it has none.

    Rows in which all joints have no torque are left out: there it was not measured. A torque in coarse steps has other
    values as often as 0.
    """
    if sum(int((r.tau[:, j] == 0).sum()) for r in recordings) < 5:
        return None
    parts = [r.tau[(np.abs(r.dq[:, j]) > MOVING_RAD_S) & (r.tau != 0).any(axis=1), j] for r in recordings]
    tau = np.abs(np.concatenate(parts))
    zero = tau == 0
    if len(tau) < 100 or zero.mean() < 0.05 or zero.all():
        return None
    _, counts = np.unique(tau[~zero], return_counts=True)
    if zero.sum() < 20 * counts.max():
        return None
    return Band(float(zero.mean()), float(np.percentile(tau[~zero], 1)))


def dead_findings(x: Examination) -> Iterator[Finding]:
    """Findings of torques that are 0 below a threshold."""
    for j, joint in enumerate(x.joints if not any(map(makes_torque, x.recordings)) else ()):
        band = dead_band(x.recordings, j)
        if band is not None:
            evidence = f"tau is 0 in {band.share:.0%} of the samples in motion, else {band.least:.3g} {x.unit} or more"
            advice = (
                "a dead band of the drive, or a threshold of its message: touches of less torque are not detected "
                "there, and friction and gravity are hardly learned; record the unfiltered current, or lower the band"
            )
            yield Finding("dead-band", "warning", joint, evidence, advice)


def refresh_rows(recordings: Sequence[Recording], signal: str, most_rows: int = 20_000) -> float:
    """Usual number of rows from one new measurement of a signal to the next, in motion; 1: every row is one, or they
    come without order."""
    lengths = []
    for r in (cut(r, slice(0, most_rows)) for r in recordings):
        values, rows = getattr(r, signal), np.flatnonzero((np.abs(r.dq) > MOVING_RAD_S).any(axis=1)[1:])
        changed = np.zeros(r.samples - 1, dtype=bool)
        left = rows
        for column in values.T:  # most rows drop out after the first column
            new = column[left + 1] != column[left]
            changed[left[new]] = True
            left = left[~new]
        at = np.flatnonzero(changed)
        steps = np.diff(at)
        # within one motion: rests in between are none of the refresh
        resting = np.r_[0, np.cumsum(np.abs(r.dq).max(axis=1) <= MOVING_RAD_S)]
        lengths.append(steps[resting[at[1:] + 1] == resting[at[:-1] + 1]])
    steps = np.concatenate(lengths)
    if len(steps) < 50:
        return 1.0
    usual = float(np.median(steps))
    regular = np.abs(steps - usual) <= max(1.0, 0.25 * usual)
    return float(steps[regular].mean()) if usual >= 2 and regular.mean() > 0.8 else 1.0


def refresh_findings(x: Examination) -> Iterator[Finding]:
    """Finding of a signal that is refreshed more slowly than the others."""
    if any(map(makes_torque, x.recordings)):
        return
    names = {"q": "positions", "dq": "velocities", "tau": "torques"}
    rows = {signal: refresh_rows(x.recordings, signal) for signal in names}
    fastest = min(rows.values())
    slow = [signal for signal, every in rows.items() if every > 1.5 * fastest]
    if not slow:
        return
    rate_hz = x.recordings[0].rate_hz
    evidence = "; ".join(f"{names[k]} are new in every {every:.3g} rows, {rate_hz / every:.3g} a second"
                         for k, every in rows.items()).replace("every 1 rows", "every row")  # fmt: skip
    advice = (
        f"{' and '.join(names[k] for k in slow)} are refreshed more slowly than they are logged, and late by half of "
        "that time: log them at the rate of the others, or all signals at the slowest rate"
    )
    yield Finding("refresh-slow", "warning", None, evidence, advice)


# --- Stuck signals: constant while their joint turns.


def stuck_findings(x: Examination) -> Iterator[Finding]:
    """Findings of signals that have not changed by a bit while their joint turns, or until they jump."""
    bad = [unmeasured(r.t_ns, r.q, r.tau[:, : 0 if makes_torque(r) else None], TURN) for r in x.recordings]
    yield from _unmeasured(x.recordings, bad)
    repeated = [repeated_rows(r) | rows for r, rows in zip(x.recordings, bad, strict=True)]
    # the torque from a servo's counts stays 0 while the current is small: no fault
    counted = any(map(makes_torque, x.recordings))
    dead = {one.joint for one in x.all_found if one.code == "dead-band"}
    for j, joint in enumerate(x.joints):
        absent = _absent(x.recordings, j)
        if absent is not None:
            yield Finding("stuck", "fault", joint, *absent)
        coarse = counted or joint in dead or absent is not None or _coarse_step(x.recordings, j) is not None
        signals = ("q", "dq") if coarse else ("q", "dq", "tau")
        ends = {signal: _ends(x.recordings, signal, j) for signal in ("tau", "dq")}  # there it is saturated
        steps = [np.abs(np.diff(r.dq[:, j])) for r in x.recordings]
        least_rad_s = min(float(step[step > 0].min()) if step.any() else 0.0 for step in steps)
        runs = [
            (seconds, f"{signal} stays {value:.5g} for {seconds:.2f} s at {at_s:.2f} s of '{r.name}'")
            for r, whole in zip(x.recordings, repeated, strict=True)
            for signal in signals
            for seconds, value, at_s in _stuck(r, whole, signal, j, least_rad_s)
            if value not in ends.get(signal, ())
        ]
        if runs:
            longest = max(runs, key=lambda run: run[0])[1]
            evidence = f"{len(runs)} times, the longest: {longest}, while the joint turns"
            advice = (
                "a driver that repeats its last value: check for lost packets of this joint; leave these stretches out"
            )
            yield Finding("stuck", "fault", joint, evidence, advice)


def _unmeasured(recordings: Sequence[Recording], bad: Sequence[np.ndarray]) -> Iterator[Finding]:
    """Findings of rows that a driver did not measure, of each recording."""
    for r, rows in zip(recordings, bad, strict=True):
        if not rows.any():
            continue
        runs = runs_of(rows)
        first, after = runs[np.argmax(np.ptp(runs, axis=1))]
        evidence = (
            f"'{r.name}': {int(rows.sum())} samples are constant beside a jump that no motion makes, {len(runs)} "
            f"time{'s' * (len(runs) > 1)}, the longest from {r.time_s[first]:.2f} to {r.time_s[after - 1]:.2f} s"
        )
        advice = "the driver measured nothing there: import the log again, which leaves these samples out"
        yield Finding("stuck", "fault", None, evidence, advice, r.name)


def _absent(recordings: Sequence[Recording], j: int) -> tuple[str, str] | None:
    """Evidence and advice where a joint's torque has one value throughout, while the joint turns."""
    value = recordings[0].tau[0, j]
    turns = max(float(np.ptp(r.q[:, j])) for r in recordings) > 0.1
    if not turns or any((r.tau[:, j] != value).any() for r in recordings):
        return None
    advice = (
        "the log has no effort of this joint: a simulator or driver that gives none. Record the torque or the current "
        "of its motor, or take the joint out of [robot] joints and lock it"
    )
    return f"tau is {value + 0.0:.5g} in all samples, while the joint turns", advice


def _stuck(
    r: Recording, repeated: np.ndarray, signal: str, j: int, least_rad_s: float, stuck_s: float = 0.2
) -> Iterator[tuple[float, float, float]]:
    """Length, [s], value and beginning, [s], of each run of one value for `stuck_s` in which the joint turns by 0.02
    rad; also 10 times as long as 99 % of its runs, since a signal of few levels keeps each for a while."""
    values, other = getattr(r, signal)[:, j], (r.dq if signal == "q" else r.q)[:, j]
    runs = runs_of((values[1:] == values[:-1]) & ~repeated[1:])
    lasted = (r.t_ns[runs[:, 1]] - r.t_ns[runs[:, 0]]) * 1e-9
    if signal != "q" and len(lasted) >= 100:
        stuck_s = max(stuck_s, 10.0 * float(np.percentile(lasted, 99)))
    long = (lasted >= stuck_s) & (np.ptp(runs, axis=1) >= 10)
    for (first, last), seconds in zip(runs[long], lasted[long], strict=True):
        rows = slice(first, last + 1)
        way = abs(float(other[rows].mean())) * seconds if signal == "q" else float(np.ptp(other[rows]))
        if way < 0.02 or (signal == "dq" and _cruises(r, j, rows, max(0.05 * way, least_rad_s * seconds))):
            continue
        yield seconds, values[first], (r.t_ns[first] - r.t_ns[0]) * 1e-9


def _cruises(r: Recording, j: int, rows: slice, within_rad: float) -> bool:
    """Whether the position moves at one speed throughout, close to these rows' velocity: no fault. A velocity from
    counts in step with the samples has a constant ripple, up to a fifth where the position is a line to 0.5 %."""
    since_s = (r.t_ns[rows] - r.t_ns[rows.start]) * 1e-9
    gone, speed = r.q[rows, j] - r.q[rows.start, j], r.dq[rows.start, j]
    if np.abs(gone - speed * since_s).max() < within_rad:
        return True
    slope, start = np.polyfit(since_s, gone, 1)
    straight = np.abs(gone - start - slope * since_s).max() < 0.005 * abs(gone[-1])
    return bool(straight and abs(speed - slope) < 0.2 * abs(slope))


def _ends(recordings: Sequence[Recording], signal: str, j: int) -> tuple[float, ...]:
    columns = [getattr(r, signal)[:, j] for r in recordings]
    low, high = min(float(x.min()) for x in columns), max(float(x.max()) for x in columns)
    return (low, high) if low < high else ()  # a signal that never changes has no ends


# --- Quantisation step of a signal: of a register, an encoder or a velocity.


MOST_VALUES = 200_000  # largest number of values used; they contain all levels of a coarse signal


def step_of(values: np.ndarray) -> float | None:
    """Step of which all values are whole multiples, up to one offset, in their unit; None: there is none, or every
    second value is a new level."""
    values = values[:: max(1, len(values) // MOST_VALUES)]
    levels = np.unique(values)
    if not 3 <= len(levels) <= 0.5 * len(values):
        return None
    gaps = np.diff(levels)
    step = float(np.median(gaps[gaps < 1.5 * np.percentile(gaps, 10)]))
    if step <= 1e-5 * (levels[-1] - levels[0]):  # a finer one comes from the number format
        return None
    above = levels - levels[0]
    for reach in 8 ** np.arange(1, 9):  # refine: a step from few counts numbers more of them
        near = above < (reach + 0.5) * step
        counts = np.round(above[near] / step)
        step = float(counts @ above[near] / max(counts @ counts, 1.0)) or step
    counts = above / step
    return step if np.mean(np.abs(counts - np.round(counts)) < 0.02 + 1e-4 * counts) > 0.95 else None


def position_step(q: np.ndarray, decimals: int = 6) -> float | None:
    """Step of an encoder, [rad]; None: too fine to detect, or too few positions. Rounds first, as positions may be
    stored as float32. A step within 1 % of a power of two of counts a turn is set to it: 2 pi / 4096."""
    step = step_of(np.round(q, decimals))
    if step is None or step < 10.0 ** (1 - decimals):
        return None
    bits = math.log2(2 * math.pi / step)
    whole = round(bits)
    near = abs(2.0 ** (bits - whole) - 1) < 0.01 and 8 <= whole <= 24
    return 2 * math.pi / 2**whole if near else step


def torque_step_nm(recordings: Sequence[Recording], j: int) -> float | None:
    """Step of which every torque is a whole multiple, [N m]; None: no such step."""
    stride = max(1, sum(r.samples for r in recordings) // MOST_VALUES)
    return step_of(np.concatenate([r.tau[::stride, j] for r in recordings]))


def steps_of(recordings: Sequence[Recording], j: int) -> tuple[float | None, float | None]:
    """Steps of one joint's position, [rad], and velocity, [rad/s]; None where they are too fine to detect."""
    q, dq = (np.concatenate([getattr(r, name)[:, j] for r in recordings]) for name in ("q", "dq"))
    return position_step(q), step_of(dq)


# --- Resolution: coarse torques and velocities, and torques with less noise than a measurement.


def _coarse_step(recordings: Sequence[Recording], j: int) -> tuple[float, float] | None:
    """Step of a coarse torque, and the torque's spread; None: it is not coarse."""
    step, spread = torque_step_nm(recordings, j), float(np.concatenate([r.tau[:, j] for r in recordings]).std())
    return (step, spread) if step is not None and step >= 0.1 * spread else None


def coarse_torques(x: Examination) -> Iterator[Finding]:
    """Findings of torques of few levels."""
    for j, joint in enumerate(x.joints):
        coarse = _coarse_step(x.recordings, j)
        if coarse is not None and max(float(np.ptp(r.q[:, j])) for r in x.recordings) > 0.1:
            step, spread = (f"{value:.4g} {x.unit}" for value in coarse)
            evidence = f"the torque has whole multiples of {step}, and a spread of {spread}"
            advice = "pushes below a step or two are not detected; is there a finer signal, a current for instance?"
            yield Finding("resolution", "warning", joint, evidence, advice)


def coarse_velocities(x: Examination, line_s: float = 0.1) -> Iterator[Finding]:
    """Findings of velocities whose step exceeds all speeds near stiction, so that a creeping joint reads 0, and that
    are off by more than twice the slope of a line over `line_s` of rounded positions; motion changes more slowly."""
    rounded = math.sqrt(12)  # step divided by the standard deviation of the rounding error
    rate_hz = x.recordings[0].rate_hz
    for j, joint in enumerate(x.joints if not any(map(derives_velocity, x.recordings)) else ()):
        position_rad, velocity_rad_s = steps_of(x.recordings, j)
        if velocity_rad_s is None or velocity_rad_s <= 2 * ObserverConfig.near_stiction_rad_s:
            continue
        n, off = max(3, round(line_s * rate_hz) + 1), velocity_rad_s / rounded
        line_rad_s = (position_rad or 0.0) / rounded * math.sqrt(12 / (n * (n * n - 1))) * rate_hz
        if off < 2.0 * line_rad_s:
            continue
        evidence = f"the velocity counts in steps of {velocity_rad_s:.3g} rad/s: off by {off:.2g}"
        if position_rad is not None:
            evidence += (
                f", where {line_s:g} s of positions in steps of {position_rad:.3g} rad at {rate_hz:.0f} Hz give it to "
                f"{line_rad_s:.1g}; one step of position in one sample is {position_rad * rate_hz:.3g} rad/s"
            )
        advice = (
            "leave the columns of [signals.dq] in arm.toml empty: the velocity is then derived from position; with "
            "[servo] over as many samples as its steps require"
        )
        yield Finding("resolution", "warning", joint, evidence, advice)


def noise_nm(recordings: Sequence[Recording]) -> np.ndarray:
    """White noise of the torque (joints,), [N m], by its fourth differences, free of motion; 0 without five rows."""
    total, rows = np.zeros((1, len(recordings[0].joints))), 0
    for r in recordings:
        squares = (np.diff(r.tau[~repeated_rows(r)], 4, axis=0) / np.sqrt(70)) ** 2
        total, rows = np.concatenate([total, squares]).sum(axis=0, keepdims=True), rows + len(squares)
    return np.sqrt(total[0] / max(rows, 1))


def smoothed_findings(x: Examination) -> Iterator[Finding]:
    """Finding of torques with less noise than a measurement has, 0.01 to 0.2 of the torque's spread."""
    tau = np.concatenate([r.tau for r in x.recordings])
    # at lower rates, [Hz], motion fills the spectrum
    if len(tau) < 500 or x.recordings[0].rate_hz < 60.0:
        return
    noise, spread = noise_nm(x.recordings), tau.std(axis=0)
    moves = np.max([np.ptp(r.q, axis=0) for r in x.recordings], axis=0) > 0.1
    clean = moves & (spread > 0) & (noise < 1e-3 * spread)
    if not clean.any():
        return
    evidence = (
        f"noise of the torque {noise[clean].min():.2g} to {noise[clean].max():.2g} {x.unit} on "
        f"{int(clean.sum())} of {len(clean)} joints, {np.max(noise[clean] / spread[clean]):.1g} of its spread; "
        f"a measurement has 0.01 or more. Nothing above {_empty_above(x.recordings, clean):.0f} Hz"
    )
    advice = (
        "smoothed after the fact, or computed: good enough for a friction fit, but thresholds found on it would be too "
        "low and the filter's delay is unknown; record the raw signal"
    )
    joint = x.joints[int(np.argmax(clean))] if clean.sum() == 1 else None
    yield Finding("resolution", "warning", joint, evidence, advice)


def _empty_above(recordings: Sequence[Recording], joints: np.ndarray) -> float:
    """Frequency above which less than a millionth of the torque's variance lies, [Hz]."""
    longest = max(recordings, key=lambda r: r.samples)
    tau = longest.tau[:, joints]
    x = (tau - tau.mean(axis=0)) * np.hanning(len(tau))[:, None]
    power = (np.abs(np.fft.rfft(x, axis=0)) ** 2).sum(axis=1)
    above = np.cumsum(power[::-1])[::-1] / power.sum()
    return float(np.fft.rfftfreq(len(x), 1 / longest.rate_hz)[np.argmax(above < 1e-6)])
