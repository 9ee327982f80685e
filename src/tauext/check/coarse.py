"""Steps in which signals count, and a velocity that its own positions tell better."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from tauext.check.finding import Finding
from tauext.config import ObserverConfig
from tauext.data.quantum import position_step, step_of
from tauext.data.recording import Recording
from tauext.data.servo import derives_velocity

ROUNDED = math.sqrt(12)
"""A step by the standard deviation of the error of what is rounded to it."""
LINE_S = 0.1
"""Of positions through which a straight line is drawn: what arms do takes longer."""
BETTER = 2.0
"""Times by which that line's speed must be the better one, before it is advised."""


def steps_of(recordings: Sequence[Recording], j: int) -> tuple[float | None, float | None]:
    """Steps of one joint's position, [rad], and velocity, [rad/s]; None where they are too fine to tell."""
    q, dq = (np.concatenate([getattr(r, name)[:, j] for r in recordings]) for name in ("q", "dq"))
    return position_step(q), step_of(dq)


def speed_error_rad_s(step_rad: float, rate_hz: float) -> float:
    """Standard deviation of the slope of a line through LINE_S of positions that are rounded to a step, [rad/s]."""
    n = max(3, round(LINE_S * rate_hz) + 1)
    return step_rad / ROUNDED * math.sqrt(12 / (n * (n * n - 1))) * rate_hz


def coarse_findings(recordings: Sequence[Recording]) -> list[Finding]:
    """Findings of velocities whose steps are wider than all speeds near stiction: a joint that creeps has none."""
    if any(map(derives_velocity, recordings)):
        return []  # derived already
    found = []
    for j, joint in enumerate(recordings[0].joints):
        position_rad, velocity_rad_s = steps_of(recordings, j)
        if velocity_rad_s is None or velocity_rad_s <= 2 * ObserverConfig.near_stiction_rad_s:
            continue
        rate_hz = recordings[0].rate_hz
        line_rad_s = speed_error_rad_s(position_rad or 0.0, rate_hz)
        if velocity_rad_s / ROUNDED < BETTER * line_rad_s:
            continue
        evidence = f"it counts in steps of {velocity_rad_s:.3g} rad/s: off by {velocity_rad_s / ROUNDED:.2g}"
        if position_rad is not None:
            evidence += (
                f", where {LINE_S:g} s of positions in steps of {position_rad:.3g} rad at {rate_hz:.0f} Hz tell it to "
                f"{line_rad_s:.1g}; one step of position in one sample is {position_rad * rate_hz:.3g} rad/s"
            )
        advice = (
            "leave the columns of [signals.dq] in arm.toml empty: the velocity is then derived from position; with "
            "[servo] over as many samples as its steps ask for"
        )
        found.append(Finding("coarse-velocity", "warning", joint, evidence, advice))
    return found
