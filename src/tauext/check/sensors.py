"""Signals as such: stuck at an extreme value, standing still, in coarse steps, or cleaner than a measurement."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from tauext.check.finding import Finding
from tauext.check.motion import repeated_rows
from tauext.data.quantum import LOOKED_AT, step_of
from tauext.data.recording import Recording
from tauext.data.servo import makes_torque

PILED_ROWS, PILED_SHARE = 20, 3.0
"""So many rows at one extreme, and so many times more than in the hundredth of the range beside it, is a limit."""
STUCK_S = 0.2
"""A signal that has not changed in a single bit for so long while its joint turns by STUCK_RAD stands still."""
STUCK_RAD = 0.02
STUCK_TIMES = 10.0
"""... and so many times longer than 99 of 100 equal runs: a current or speed of few levels keeps each for a while."""
CRUISE = 0.05
"""Share of the way by which a position may leave the line of a velocity that is constant in truth."""
STRAIGHT, BEAT = 0.005, 0.2
"""Where it keeps to a line of its own so well, by what share such a velocity may be off: a drive reads it off counts
of its encoder, and the ripple of that stands still in every sample where counts come in step with the samples."""
CLEAN = 1e-3
"""Noise as a share of the torque's spread. Motor currents and torque sensors have 0.01 to 0.2, none a thousandth."""
CLEAN_RATE_HZ = 60.0
"""At lower rates motion itself fills the spectrum, and at much higher ones a drive's own filter empties its top."""
COARSE = 0.1
"""Step of the torque as a share of its spread."""
MOVING_RAD_S = 0.02


def sensor_findings(recordings: Sequence[Recording]) -> list[Finding]:
    found = []
    for j, joint in enumerate(recordings[0].joints):
        for finding in (_saturated(recordings, j, joint), _stuck(recordings, j, joint), _coarse(recordings, j, joint)):
            if finding is not None:
                found.append(finding)
    return found + _smoothed(recordings)


def _saturated(recordings: Sequence[Recording], j: int, joint: str) -> Finding | None:
    """Torque and velocity alone: a position that rests at its extreme is a pose."""
    moving = [(np.abs(r.dq) > MOVING_RAD_S).any(axis=1) & ~repeated_rows(r) for r in recordings]
    for signal, unit in (("tau", "Nm"), ("dq", "rad/s")):
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
            if signal == "dq" and not _faster_than_said(recordings, j, side, float(y.max())):
                continue
            evidence = (
                f"{signal}: {piled} samples ({piled / len(y):.2%} of the motion) at exactly {side * y.max():.5g} {unit}"
                f", {int(beside.sum())} in the hundredth of its range beside it"
            )
            advice = "the sensor or its message ends there: slower motion, or a wider range; leave these samples out"
            return Finding("saturated", "fault", joint, evidence, advice)
    return None


def _faster_than_said(recordings: Sequence[Recording], j: int, side: int, limit: float) -> bool:
    """Whether positions change faster than the velocity's extreme: a cruise at constant speed is no limit."""
    for r in recordings:
        rows = np.flatnonzero(side * r.dq[:, j] == limit)
        rows = rows[(rows >= 5) & (rows < r.samples - 5)]
        if len(rows):
            rise = side * (r.q[rows + 5, j] - r.q[rows - 5, j]) / ((r.t_ns[rows + 5] - r.t_ns[rows - 5]) * 1e-9)
            if np.median(rise) > 1.03 * limit:
                return True
    return False


def _stuck(recordings: Sequence[Recording], j: int, joint: str) -> Finding | None:
    count, longest, told = 0, 0.0, ""
    ends = {name: _ends(recordings, name, j) for name in ("tau", "dq")}  # there a signal is saturated, not stuck
    # Nor tau made of a servo's counts, which stay 0 while hardly any current is drawn.
    counted = any(makes_torque(r) for r in recordings)
    signals = ("q", "dq") if counted or _is_coarse(recordings, j) else ("q", "dq", "tau")
    velocity_step = min((_least_step(r.dq[:, j]) for r in recordings), default=0.0)
    for r in recordings:
        whole = repeated_rows(r)
        travelled = {"q": r.dq, "dq": r.q, "tau": r.q}
        for signal in signals:
            x = getattr(r, signal)[:, j]
            edges = np.flatnonzero(np.diff(np.r_[0, ((x[1:] == x[:-1]) & ~whole[1:]).astype(np.int8), 0]))
            lasted = (r.t_ns[edges[1::2]] - r.t_ns[edges[::2]]) * 1e-9
            least_s = STUCK_S
            if signal != "q" and len(lasted) >= 100:
                least_s = max(STUCK_S, STUCK_TIMES * float(np.percentile(lasted, 99)))
            long = (lasted >= least_s) & (edges[1::2] - edges[::2] >= 10)
            for first, last, seconds in zip(edges[::2][long], edges[1::2][long], lasted[long], strict=True):
                if x[first] in ends.get(signal, ()):
                    continue
                other = travelled[signal][first : last + 1, j]
                way = abs(float(other.mean())) * seconds if signal == "q" else float(np.ptp(other))
                if way < STUCK_RAD:
                    continue
                if signal == "dq" and _cruises(r, j, first, last, max(CRUISE * way, velocity_step * seconds)):
                    continue
                count += 1
                if seconds > longest:
                    longest = seconds
                    at = (r.t_ns[first] - r.t_ns[0]) * 1e-9
                    told = f"{signal} stays {x[first]:.5g} for {seconds:.2f} s at {at:.2f} s of '{r.name}'"
    if not count:
        return None
    evidence = f"{count} times, the longest: {told}, while the joint turns"
    advice = "a driver that repeats its last value: look for lost packets of this joint; leave these stretches out"
    return Finding("stuck", "fault", joint, evidence, advice)


def _cruises(r: Recording, j: int, first: int, last: int, within_rad: float) -> bool:
    """Whether the position goes all the while at one speed, about the one that these rows say: no fault."""
    since_s = (r.t_ns[first : last + 1] - r.t_ns[first]) * 1e-9
    gone = r.q[first : last + 1, j] - r.q[first, j]
    if np.abs(gone - r.dq[first, j] * since_s).max() < within_rad:
        return True
    speed, start = np.polyfit(since_s, gone, 1)
    straight = np.abs(gone - start - speed * since_s).max() < STRAIGHT * abs(gone[-1])
    return bool(straight and abs(r.dq[first, j] - speed) < BEAT * abs(speed))


def _least_step(x: np.ndarray) -> float:
    """Between two values that a signal takes; 0 where it takes one."""
    steps = np.abs(np.diff(x))
    return float(steps[steps > 0].min(initial=np.inf)) if (steps > 0).any() else 0.0


def torque_step_nm(recordings: Sequence[Recording], j: int) -> float | None:
    """Step of which every torque is a whole multiple, [N m]; None where there is none."""
    stride = max(1, sum(r.samples for r in recordings) // LOOKED_AT)
    return step_of(np.concatenate([r.tau[::stride, j] for r in recordings]))


def _ends(recordings: Sequence[Recording], signal: str, j: int) -> tuple[float, float]:
    columns = [getattr(r, signal)[:, j] for r in recordings]
    low, high = min(float(x.min()) for x in columns), max(float(x.max()) for x in columns)
    return (low, high) if low < high else (math.nan, math.nan)  # a signal that never changes has no ends


def _is_coarse(recordings: Sequence[Recording], j: int) -> bool:
    step = torque_step_nm(recordings, j)
    return step is not None and step >= COARSE * float(np.concatenate([r.tau[:, j] for r in recordings]).std())


def _coarse(recordings: Sequence[Recording], j: int, joint: str) -> Finding | None:
    spread = float(np.concatenate([r.tau[:, j] for r in recordings]).std())
    moves = max(float(np.ptp(r.q[:, j])) for r in recordings) > 0.1
    step = torque_step_nm(recordings, j)
    if step is None or not moves or not _is_coarse(recordings, j):
        return None
    evidence = f"whole multiples of {step:.4g} Nm, where the torque's spread is {spread:.4g} Nm"
    advice = "pushes below a step or two cannot be seen; is there a finer signal, a current for instance?"
    return Finding("quantised", "warning", joint, evidence, advice)


def noise_nm(recordings: Sequence[Recording]) -> np.ndarray:
    """White noise of the torque (joints,), [N m], from its fourth differences: of motion they hold nothing.

    0 where no recording has five rows that differ.
    """
    parts = [np.diff(r.tau[~repeated_rows(r)], 4, axis=0) / np.sqrt(70) for r in recordings]
    squares = np.concatenate(parts) ** 2
    return np.sqrt(squares.sum(axis=0) / max(len(squares), 1))


def _smoothed(recordings: Sequence[Recording]) -> list[Finding]:
    tau = np.concatenate([r.tau for r in recordings])
    if len(tau) < 500 or recordings[0].rate_hz < CLEAN_RATE_HZ:
        return []
    noise, spread = noise_nm(recordings), tau.std(axis=0)
    moves = np.max([np.ptp(r.q, axis=0) for r in recordings], axis=0) > 0.1
    clean = moves & (spread > 0) & (noise < CLEAN * spread)
    if not clean.any():
        return []
    evidence = (
        f"noise of the torque {noise[clean].min():.2g} to {noise[clean].max():.2g} Nm on {int(clean.sum())} of "
        f"{len(clean)} joints, {np.max(noise[clean] / spread[clean]):.1g} of its spread; "
        f"a measurement has 0.01 or more. Nothing above {_empty_above(recordings, clean):.0f} Hz"
    )
    advice = (
        "smoothed after the fact, or computed: good enough for a friction fit, but limits found on it would be too low "
        "and the filter's delay is unknown; record the raw signal"
    )
    joint = recordings[0].joints[int(np.argmax(clean))] if clean.sum() == 1 else None
    return [Finding("smoothed", "warning", joint, evidence, advice)]


def _empty_above(recordings: Sequence[Recording], joints: np.ndarray) -> float:
    """Frequency above which less than a millionth of the torque's variance lies, [Hz]."""
    longest = max(recordings, key=lambda r: r.samples)
    tau = longest.tau[:, joints]
    x = (tau - tau.mean(axis=0)) * np.hanning(len(tau))[:, None]
    power = (np.abs(np.fft.rfft(x, axis=0)) ** 2).sum(axis=1)
    above = np.cumsum(power[::-1])[::-1] / power.sum()
    return float(np.fft.rfftfreq(len(x), 1 / longest.rate_hz)[np.argmax(above < 1e-6)])
