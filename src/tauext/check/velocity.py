"""Velocity against the derivative of position: unit, sign, delay, order."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tauext.check.finding import Finding
from tauext.check.motion import FIT_CUTOFF_HZ, Stretch, low_pass

LONGEST_LAG_S = 0.2
LATE_S = 0.010
"""A drive's velocity filter lags by 1 to 5 ms; from 10 ms, or a period and a quarter, prior and network suffer."""
FACTOR_OFF = 0.1
LEAST_CORRELATION = 0.9
LEAST_SPEED_RAD_S = 0.02
"""RMS, [rad/s]: below, noise is compared with noise."""
DEGREES = 180 / math.pi


@dataclass(frozen=True)
class VelocityFit:
    """One joint's recorded velocity as factor times the derivative of its position, so much later."""

    factor: float
    lag_s: float
    correlation: float


def compare(stretches: Sequence[Stretch], joint: int, of: int | None = None) -> VelocityFit | None:
    """Recorded velocity of `joint` against the derivative of position of joint `of`, itself if None.

    None: the joint does not move.
    """
    of = joint if of is None else of
    rate = float(np.median([s.rate_hz for s in stretches]))
    reach = max(2, math.ceil(LONGEST_LAG_S * rate))
    pairs = []
    for s in stretches:
        cutoff = min(FIT_CUTOFF_HZ, s.rate_hz / 6)
        true, said = low_pass(s.dq[:, of], cutoff, s.rate_hz), low_pass(s.dq_raw[:, joint], cutoff, s.rate_hz)
        if len(true) > 4 * reach:
            pairs.append((true, said))
    inner = np.concatenate([true[reach:-reach] for true, _ in pairs]) if pairs else np.zeros(1)
    power = float(inner @ inner)
    if power / len(inner) < LEAST_SPEED_RAD_S**2:
        return None

    def later(k: int) -> np.ndarray:
        return np.concatenate([said[reach + k : len(said) - reach + k] for _, said in pairs])

    stride = max(1, reach // 20)
    coarse = range(-reach, reach + 1, stride)
    products = [abs(inner @ later(k)) / max(float(np.linalg.norm(later(k))), 1e-12) for k in coarse]
    shift = coarse[int(np.argmax(products))]
    said = later(shift)
    factor = float(inner @ said / power)
    correlation = float(abs(inner @ said) / max(math.sqrt(power) * float(np.linalg.norm(said)), 1e-12))
    # what is left of the lag, to first order: said = factor (true - lag d(true)/dt)
    slope = np.concatenate([np.gradient(true)[reach:-reach] for true, _ in pairs])
    left = float((inner - said / factor) @ slope / (slope @ slope)) if factor else 0.0
    return VelocityFit(factor, float(shift + np.clip(left, -stride, stride)) / rate, correlation)


def velocity_findings(
    stretches: Sequence[Stretch], joints: Sequence[str]
) -> tuple[list[Finding], list[VelocityFit | None], np.ndarray]:
    """Findings, what was measured of each joint, and by what factor (joints,) positions are too large."""
    found, positions = [], np.ones(len(joints))
    fits = [compare(stretches, j) for j in range(len(joints))]
    for j, (joint, fit) in enumerate(zip(joints, fits, strict=True)):
        if fit is None:
            continue
        told = f"velocity = {fit.factor:.4g} times the derivative of position, correlation {fit.correlation:.3f}"
        size = abs(fit.factor)
        if fit.correlation < LEAST_CORRELATION:
            found.append(_unlike(stretches, joints, j, told))
        elif abs(size * DEGREES - 1) < FACTOR_OFF:
            positions[j] = DEGREES
            evidence = f"{told}: 1 / 57.3, so that positions are in degrees and velocities in rad/s"
            found.append(Finding("degrees", "fault", joint, evidence, "convert positions to radians at import"))
        elif fit.factor < 0:
            found.append(Finding("velocity-sign", "fault", joint, told, "negate the velocity at import"))
        elif abs(size - 1) > FACTOR_OFF:
            found.append(
                Finding("velocity-unit", "fault", joint, f"{told}{_guess(size)}", "convert it to rad/s at import")
            )
        rate = stretches[0].rate_hz
        late = fit.correlation >= LEAST_CORRELATION and abs(fit.lag_s) > max(LATE_S, 1.25 / rate)
        if late:
            way = "after" if fit.lag_s > 0 else "before"
            evidence = f"velocity comes {abs(fit.lag_s) * 1e3:.0f} ms {way} the derivative of position"
            advice = (
                "use a velocity of less filtering, or derive it from position (causally) at import and in the monitor"
            )
            found.append(Finding("velocity-delay", "warning", joint, evidence, advice))
    return found, fits, positions


def _unlike(stretches: Sequence[Stretch], joints: Sequence[str], j: int, told: str) -> Finding:
    others = [(compare(stretches, j, k), name) for k, name in enumerate(joints) if k != j]
    likely = [(fit.correlation, name) for fit, name in others if fit is not None]
    if likely and max(likely)[0] > LEAST_CORRELATION:
        correlation, name = max(likely)
        evidence = f"{told}, but {correlation:.3f} with that of '{name}'"
        return Finding("joint-order", "fault", joints[j], evidence, "map positions and velocities by name at import")
    advice = "it may be a commanded, a Cartesian or a stale velocity: derive it from position at import"
    return Finding("velocity-mismatch", "fault", joints[j], told, advice)


def _guess(size: float) -> str:
    known = (
        (DEGREES, "it is in deg/s"),
        (60 / (2 * math.pi), "it is in turns a minute"),
        (1 / (2 * math.pi), "in turns a second"),
    )
    for factor, what in known:
        if abs(size / factor - 1) < 0.05:
            return f": {what}"
    return ": motor side, perhaps" if size > 20 else ""
