"""Find recordings whose positions, velocities or torques have other units or joints than their dataset."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np

from tauext.check.examination import Examination
from tauext.check.finding import Finding, Severity
from tauext.check.motion import DEGREES, FIT, LEAST_CORRELATION, LEAST_SPEED_RAD_S, Stretch
from tauext.data.recording import Recording


@dataclass(frozen=True)
class OddRules:
    """By how much a recording differs from all others."""

    rate: float = 0.1  # twice the monitor's tolerance, since logs lose a few percent of their rows
    faster: float = 5.0  # degrees give 57 times the speed and range; recordings of one arm hardly differ by ...
    further: float = 3.0  # ... these
    margin_rad: float = 0.5  # around the range of the other recordings
    torques: float = 20.0  # times the others' torque, of joints that move in all, beyond any load or pose
    late_s: float = 0.015  # delay of the velocity, all joints together, beyond any drive's filter
    factor: float = 0.3  # of a velocity; those of signals that rest at times differ by less
    unlike: float = 0.5  # correlation of a velocity that is another joint's ...
    unlike_beside: float = 0.75  # ... and where all others correlate above ...
    alike: float = 0.95  # ... this


RULES = OddRules()


@dataclass(frozen=True)
class Motion:
    """Motion of one recording; arrays (joints,)."""

    low: np.ndarray  # [rad]
    high: np.ndarray
    speed: np.ndarray  # 99th percentile [rad/s]
    factor: np.ndarray  # velocity by derivative of the position; NaN where the joint hardly moves
    correlation: np.ndarray
    lag_s: np.ndarray  # of the velocity, where it is small
    torque_nm: np.ndarray  # 95th percentile of its size

    @property
    def moves(self) -> np.ndarray:
        return np.isfinite(self.factor)


def motion_of(recording: Recording, stretches: Sequence[Stretch]) -> Motion:
    """`stretches`: of this recording, at least one."""
    low, high = np.percentile(recording.q, [0.1, 99.9], axis=0)
    products, rows = np.zeros((6, len(recording.joints))), 0
    for s in stretches:
        true, recorded = FIT.filtered(s.dq, s.rate_hz), FIT.filtered(s.dq_raw, s.rate_hz)
        signals = (true, recorded, np.gradient(true, 1 / s.rate_hz, axis=0))
        # the filters' transients at both ends would be a lag of 30 ms in a recording of four seconds
        true, recorded, slope = (FIT.inner(x, s.rate_hz) for x in signals)
        pairs = ((true, true), (true, recorded), (recorded, recorded), (true, slope), (recorded, slope), (slope, slope))
        products += [(a * b).sum(axis=0) for a, b in pairs]
        rows += len(true)
    tt, tr, rr, ts, rs, ss = products
    moves = tt > LEAST_SPEED_RAD_S**2 * rows
    with np.errstate(divide="ignore", invalid="ignore"):
        factor = np.where(moves, tr / tt, np.nan)
        correlation = np.where(moves, np.abs(tr) / np.sqrt(tt * rr), np.nan)
        # least squares of recorded = a true - a lag slope, since a recording that begins in motion has ts != 0
        lag_s = np.where(moves, (tr * ts - rs * tt) / (tr * ss - rs * ts), 0.0)
    dq = np.concatenate([s.dq for s in stretches])
    speed, torque_nm = np.percentile(np.abs(dq), 99, axis=0), np.percentile(np.abs(recording.tau), 95, axis=0)
    return Motion(low, high, speed, factor, np.nan_to_num(correlation, nan=0.0), lag_s, torque_nm)


def odd_rates(x: Examination) -> list[Finding]:
    """Findings of recordings whose rate differs from the most common one: a bundle has one rate."""
    seconds = [(r.rate_hz, r.duration_s) for r in x.recordings]
    usual = max(seconds, key=lambda one: sum(s for rate, s in seconds if abs(rate / one[0] - 1) < RULES.rate))[0]
    advice = "bring it to the others' rate at import, or leave it out"
    return [
        _odd(r, None, f" has {r.rate_hz:.4g} samples a second, the other recordings {usual:.4g}", advice)
        for r in x.recordings
        if abs(r.rate_hz / usual - 1) > RULES.rate
    ]


def odd_motions(x: Examination) -> list[Finding]:
    """Findings of recordings in degrees among radians, and of velocities that do not fit where the others' do. At most
    one a recording, and of half of the recordings."""
    by = [[s for s in x.motion if s.recording == k] for k in range(len(x.recordings))]
    seen = {k: motion_of(r, by[k]) for k, r in enumerate(x.recordings) if by[k]}
    found = []
    for k, one in seen.items():
        others = [m for other, m in seen.items() if other != k]
        ways = (find(x.recordings[k], one, others) for find in WAYS) if others else ()
        found += [odd for odd in [next(chain.from_iterable(ways), None)] if odd is not None]
    return found if len(found) <= len(seen) / 2 else []


def _odd(
    r: Recording,
    joint: str | None,
    evidence: str,
    advice: str = "give it the others' units at import, or leave it out",
    severity: Severity = "fault",
) -> Finding:
    return Finding("odd-recording", severity, joint, f"'{r.name}'{evidence}", advice, r.name)


def _range(others: Sequence[Motion], low: str = "low", high: str = "high") -> tuple[np.ndarray, np.ndarray]:
    return np.min([getattr(m, low) for m in others], axis=0), np.max([getattr(m, high) for m in others], axis=0)


def _degrees(r: Recording, one: Motion, others: Sequence[Motion]) -> Iterator[Finding]:
    (low, high), speed = _range(others), np.max([m.speed for m in others], axis=0)
    far = np.maximum(np.abs(one.low), np.abs(one.high))
    usual = np.maximum(np.abs(low), np.abs(high))
    within = (one.low / DEGREES > low - RULES.margin_rad) & (one.high / DEGREES < high + RULES.margin_rad)
    fast = (one.speed > RULES.faster * speed) & (speed > 0)
    wrong = (far > np.maximum(RULES.further * usual, 2 * np.pi)) & fast & within
    if wrong.any():
        j = int(np.argmax(np.where(wrong, one.speed / np.maximum(speed, 1e-9), 0)))
        evidence = (
            f" seems to be in degrees: '{r.joints[j]}' goes from {one.low[j]:.4g} to {one.high[j]:.4g} at up to "
            f"{one.speed[j]:.3g} a second, in the other recordings from {low[j]:.3g} to {high[j]:.3g} at up to "
            f"{speed[j]:.3g}"
        )
        yield _odd(r, r.joints[j] if wrong.sum() == 1 < len(wrong) else None, evidence)


def _velocity(r: Recording, one: Motion, others: Sequence[Motion]) -> Iterator[Finding]:
    moves = np.array([m.moves for m in others])
    agree = np.array([(np.abs(m.factor - 1) < 0.1) & (m.correlation > LEAST_CORRELATION) for m in others])
    usual = agree.any(axis=0) & (agree | ~moves).all(axis=0)
    unit = (one.correlation > LEAST_CORRELATION) & (np.abs(one.factor - 1) > RULES.factor)
    sure = np.array([(m.correlation > RULES.alike) | ~m.moves for m in others]).all(axis=0)
    unlike = one.correlation < np.where(sure, RULES.unlike_beside, RULES.unlike)
    for j, names, joint in _first(r, usual & one.moves & (unit | unlike)):
        evidence = (
            f": the velocity is {one.factor[j]:.4g} times the derivative of the position, correlation "
            f"{one.correlation[j]:.3f}, at {names}; elsewhere it is the derivative"
        )
        yield _odd(r, joint, evidence)


def _torque_unit(r: Recording, one: Motion, others: Sequence[Motion]) -> Iterator[Finding]:
    low, high = _range(others, "torque_nm", "torque_nm")
    moves = np.all([m.moves for m in (one, *others)], axis=0)
    wrong = moves & (low > 0) & ((one.torque_nm > RULES.torques * high) | (one.torque_nm < low / RULES.torques))
    for j, names, joint in _first(r, wrong):
        evidence = (
            f": torques of {names} are of another unit, as it seems: '{r.joints[j]}' takes {one.torque_nm[j]:.3g}, "
            f"elsewhere {low[j]:.3g} to {high[j]:.3g}"
        )
        yield _odd(r, joint, evidence)


def _first(r: Recording, wrong: np.ndarray) -> list[tuple[int, str, str | None]]:
    """The first joint that is wrong, names of all, and the joint if it is the only one."""
    joints = [joint for joint, is_wrong in zip(r.joints, wrong, strict=True) if is_wrong]
    return [(int(np.argmax(wrong)), ", ".join(joints), joints[0] if len(joints) == 1 else None)] if joints else []


def _turns(r: Recording, one: Motion, others: Sequence[Motion]) -> Iterator[Finding]:
    """A joint whose positions are whole turns off the others'."""
    low, high = _range(others)
    turns = np.round(((one.low + one.high) - (low + high)) / (4 * np.pi))
    by = 2 * np.pi * turns
    within = (one.low - by > low - RULES.margin_rad) & (one.high - by < high + RULES.margin_rad)
    apart = (one.low > high) | (one.high < low)
    for j in np.flatnonzero((turns != 0) & within & apart & (high - low < 2 * np.pi)).tolist():
        evidence = (
            f": '{r.joints[j]}' is {turns[j]:+.0f} turns from where it is in the others: "
            f"{one.low[j]:.4g} to {one.high[j]:.4g} rad, {low[j]:.4g} to {high[j]:.4g}"
        )
        advice = "a counter of turns that began elsewhere: take the turns away at import"
        yield _odd(r, r.joints[j], evidence, advice, "warning")


def _late(r: Recording, one: Motion, others: Sequence[Motion]) -> Iterator[Finding]:
    usual = np.median([m.lag_s for m in others], axis=0)
    moves = one.moves & (one.correlation > RULES.unlike)
    if not moves.any() or np.abs(usual[moves]).max() > RULES.late_s:
        return
    off = one.lag_s[moves] - usual[moves]
    later_s = float(np.median(off))
    if abs(later_s) >= RULES.late_s and np.ptp(np.sign(off)) == 0:
        evidence = (
            f": the velocity comes {1e3 * abs(later_s):.0f} ms {'later' if later_s > 0 else 'earlier'} after the "
            "position than in the others"
        )
        advice = "derive the velocity from the position at import, or leave it out"
        yield _odd(r, None, evidence, advice, "warning")


WAYS: tuple[Callable[[Recording, Motion, Sequence[Motion]], Iterator[Finding]], ...] = (
    _degrees,
    _velocity,
    _torque_unit,
    _turns,
    _late,
)
"""In which a recording may differ; the first one found counts."""
