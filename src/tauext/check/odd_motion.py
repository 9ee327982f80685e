"""Find recordings whose positions or velocities have other units or joints than their dataset."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from tauext.check.finding import Finding
from tauext.check.motion import (
    DEGREES,
    FACTOR_OFF,
    FIT_CUTOFF_HZ,
    LEAST_CORRELATION,
    LEAST_SPEED_RAD_S,
    Stretch,
    low_pass,
)
from tauext.data.recording import Recording

FASTER, FURTHER = 5.0, 3.0
"""Ratios of speed and range that mean degrees. Degrees give 57; recordings of one arm hardly differ by these ratios."""
MARGIN_RAD = 0.5
"""Margin around the range of the other recordings."""
TORQUES = 20.0
"""Ratio to the other recordings' torque, of joints that move in all, beyond any load or pose."""
LATE_S = 0.015
"""Delay of the velocity against the others', all joints together, beyond any drive's filter."""
UNIT_OFF, UNLIKE = 0.3, 0.5
"""Differences of a velocity's factor and correlation; signals that rest at times differ by less."""
ALIKE, UNLIKE_BESIDE = 0.95, 0.75
"""If all others correlate above the first, a correlation below the second means another joint."""
RATE_OFF = 0.1
"""Tolerance of the rate: twice the monitor's, since logs lose a few percent of their rows."""
ADVICE = "give it the others' units at import, or leave it out"


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


def motion_of(recording: Recording, stretches: Sequence[Stretch]) -> Motion:
    """`stretches`: of this recording, at least one."""
    n = len(recording.joints)
    low, high = np.percentile(recording.q, [0.1, 99.9], axis=0)
    dq = np.concatenate([s.dq for s in stretches])
    products = np.zeros((5, n))
    for s in stretches:
        cutoff = min(FIT_CUTOFF_HZ, s.rate_hz / 6)
        true, recorded = low_pass(s.dq, cutoff, s.rate_hz), low_pass(s.dq_raw, cutoff, s.rate_hz)
        products += [(true * true).sum(axis=0), (true * recorded).sum(axis=0), (recorded * recorded).sum(axis=0),
                     ((true - recorded) * (slope := np.gradient(true, 1 / s.rate_hz, axis=0))).sum(axis=0),
                     (slope * slope).sum(axis=0)]  # fmt: skip
    moves = products[0] > LEAST_SPEED_RAD_S**2 * len(dq)
    with np.errstate(divide="ignore", invalid="ignore"):
        factor = np.where(moves, products[1] / products[0], np.nan)
        correlation = np.where(moves, np.abs(products[1]) / np.sqrt(products[0] * products[2]), np.nan)
        lag_s = np.where(moves, products[3] / products[4], 0.0)
    speed, torque_nm = np.percentile(np.abs(dq), 99, axis=0), np.percentile(np.abs(recording.tau), 95, axis=0)
    return Motion(low, high, speed, factor, np.nan_to_num(correlation, nan=0.0), lag_s, torque_nm)


def odd_rates(recordings: Sequence[Recording]) -> list[Finding]:
    """Findings of recordings whose rate differs from the most common one: a bundle has one rate."""
    seconds = [(r.rate_hz, r.duration_s) for r in recordings]
    usual = max(seconds, key=lambda one: sum(s for rate, s in seconds if abs(rate / one[0] - 1) < RATE_OFF))[0]
    advice = "bring it to the others' rate at import, or leave it out"
    return [
        Finding(
            "odd-recording",
            "fault",
            None,
            f"'{r.name}' has {r.rate_hz:.4g} samples a second, the other recordings {usual:.4g}",
            advice,
            r.name,
        )
        for r in recordings
        if abs(r.rate_hz / usual - 1) > RATE_OFF
    ]


def odd_motions(recordings: Sequence[Recording], motion: Sequence[Stretch]) -> list[Finding]:
    """Findings of recordings in degrees among radians, and of velocities that do not fit where the others' do."""
    by = [[s for s in motion if s.recording == k] for k in range(len(recordings))]
    seen = {k: motion_of(r, by[k]) for k, r in enumerate(recordings) if by[k]}
    found: list[Finding] = []
    for k, one in seen.items():
        others = [m for other, m in seen.items() if other != k]
        if others:
            found += (
                _degrees(recordings[k], one, others)
                or _velocity(recordings[k], one, others)
                or _torque_unit(recordings[k], one, others)
                or _turns(recordings[k], one, others)
                or _late(recordings[k], one, others)
            )
    return found if len({f.recording for f in found}) <= len(seen) / 2 else []


def _degrees(recording: Recording, one: Motion, others: Sequence[Motion]) -> list[Finding]:
    low, high = np.min([m.low for m in others], axis=0), np.max([m.high for m in others], axis=0)
    speed = np.max([m.speed for m in others], axis=0)
    far = np.maximum(np.abs(one.low), np.abs(one.high))
    usual = np.maximum(np.abs(low), np.abs(high))
    within = (one.low / DEGREES > low - MARGIN_RAD) & (one.high / DEGREES < high + MARGIN_RAD)
    wrong = (far > np.maximum(FURTHER * usual, 2 * np.pi)) & (one.speed > FASTER * speed) & within & (speed > 0)
    if not wrong.any():
        return []
    j = int(np.argmax(np.where(wrong, one.speed / np.maximum(speed, 1e-9), 0)))
    evidence = (
        f"'{recording.name}' seems to be in degrees: '{recording.joints[j]}' goes from {one.low[j]:.4g} to "
        f"{one.high[j]:.4g} at up to {one.speed[j]:.3g} a second, in the other recordings from {low[j]:.3g} to "
        f"{high[j]:.3g} at up to {speed[j]:.3g}"
    )
    joint = recording.joints[j] if wrong.sum() == 1 and len(wrong) > 1 else None
    return [Finding("odd-recording", "fault", joint, evidence, ADVICE, recording.name)]


def _fault(recording: Recording, wrong: np.ndarray, evidence: Callable[[int, str], str]) -> list[Finding]:
    """One finding, or none if no joint is wrong. `evidence` receives the first wrong joint and the names of all."""
    joints = [joint for joint, is_wrong in zip(recording.joints, wrong, strict=True) if is_wrong]
    if not joints:
        return []
    words = f"'{recording.name}': {evidence(int(np.argmax(wrong)), ', '.join(joints))}"
    joint = joints[0] if len(joints) == 1 else None
    return [Finding("odd-recording", "fault", joint, words, ADVICE, recording.name)]


def _velocity(recording: Recording, one: Motion, others: Sequence[Motion]) -> list[Finding]:
    moves = np.array([np.isfinite(m.factor) for m in others])
    agree = np.array([(np.abs(m.factor - 1) < FACTOR_OFF) & (m.correlation > LEAST_CORRELATION) for m in others])
    usual = agree.any(axis=0) & (agree | ~moves).all(axis=0)
    unit = (one.correlation > LEAST_CORRELATION) & (np.abs(one.factor - 1) > UNIT_OFF)
    sure = np.array([(m.correlation > ALIKE) | ~np.isfinite(m.factor) for m in others]).all(axis=0)
    unlike = one.correlation < np.where(sure, UNLIKE_BESIDE, UNLIKE)
    return _fault(
        recording,
        usual & np.isfinite(one.factor) & (unit | unlike),
        lambda j, names: (
            f"the velocity is {one.factor[j]:.4g} times the derivative of the position, correlation "
            f"{one.correlation[j]:.3f}, at {names}; elsewhere it is the derivative"
        ),
    )


def _torque_unit(recording: Recording, one: Motion, others: Sequence[Motion]) -> list[Finding]:
    low, high = np.min([m.torque_nm for m in others], axis=0), np.max([m.torque_nm for m in others], axis=0)
    moves = np.isfinite([m.factor for m in (one, *others)]).all(axis=0)
    return _fault(
        recording,
        moves & (low > 0) & ((one.torque_nm > TORQUES * high) | (one.torque_nm < low / TORQUES)),
        lambda j, names: (
            f"torques of {names} are of another unit, as it seems: '{recording.joints[j]}' takes "
            f"{one.torque_nm[j]:.3g}, elsewhere {low[j]:.3g} to {high[j]:.3g}"
        ),
    )


def _turns(recording: Recording, one: Motion, others: Sequence[Motion]) -> list[Finding]:
    """Findings of joints whose positions are whole turns off the others'."""
    low, high = np.min([m.low for m in others], axis=0), np.max([m.high for m in others], axis=0)
    turns = np.round(((one.low + one.high) - (low + high)) / (4 * np.pi))
    by = 2 * np.pi * turns
    within = (one.low - by > low - MARGIN_RAD) & (one.high - by < high + MARGIN_RAD)
    wrong = np.flatnonzero((turns != 0) & within & ((one.low > high) | (one.high < low)) & (high - low < 2 * np.pi))
    if not len(wrong):
        return []
    j = int(wrong[0])
    evidence = (
        f"'{recording.name}': '{recording.joints[j]}' is {turns[j]:+.0f} turns from where it is in the others: "
        f"{one.low[j]:.4g} to {one.high[j]:.4g} rad, {low[j]:.4g} to {high[j]:.4g}"
    )
    advice = "a counter of turns that began elsewhere: take the turns away at import"
    return [Finding("odd-recording", "warning", recording.joints[j], evidence, advice, recording.name)]


def _late(recording: Recording, one: Motion, others: Sequence[Motion]) -> list[Finding]:
    usual = np.median([m.lag_s for m in others], axis=0)
    moves = np.isfinite(one.factor) & (one.correlation > UNLIKE)
    if not moves.any() or np.abs(usual[moves]).max() > LATE_S:
        return []
    off = one.lag_s[moves] - usual[moves]
    if abs(float(np.median(off))) < LATE_S or np.ptp(np.sign(off)) != 0:
        return []
    evidence = (
        f"'{recording.name}': the velocity comes {1e3 * abs(np.median(off)):.0f} ms "
        f"{'later' if np.median(off) > 0 else 'earlier'} after the position than in the others"
    )
    advice = "derive the velocity from the position at import, or leave it out"
    return [Finding("odd-recording", "warning", None, evidence, advice, recording.name)]
