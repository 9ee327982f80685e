"""Whether the arm moves enough, and long enough, for what is to be learned from it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tauext.check.finding import Finding
from tauext.check.motion import Stretch
from tauext.data.recording import Recording

STANDING_RAD = 0.05
LEAST_RANGE_RAD = 0.2
LEAST_SPEED_RAD_S = 0.1
MOVING_RAD_S = 0.02
LEAST_SHARE = 0.05
SEARCH_S = 30.0
"""Of motion, below which order, axes and delay of torque are not judged: of dozens of arrangements one will fit."""
FRICTION_MIN, NETWORK_MIN = 1.0, 10.0
"""Minutes of motion: for a friction fit, five to ten reversals a joint at several speeds; for a network, see
docs/method/training.md."""


def excitation_findings(recordings: Sequence[Recording], stretches: Sequence[Stretch]) -> list[Finding]:
    joints = recordings[0].joints
    ranges = np.max([np.ptp(r.q, axis=0) for r in recordings], axis=0)
    minutes = sum(r.duration_s for r in recordings) / 60
    if ranges.max() < STANDING_RAD:
        evidence = f"the widest range of a joint is {ranges.max():.3g} rad in {minutes:.2g} minutes"
        advice = "an arm at rest gives the plain observer and its limits at this pose, no friction fit and no network"
        return [Finding("never-moves", "warning", None, evidence, advice)]
    found = []
    if stretches:
        dq = np.concatenate([s.dq for s in stretches])
        seconds = np.concatenate([np.full(len(s.dq), 1 / s.rate_hz) for s in stretches])
        for j, joint in enumerate(joints):
            found += _joint(joint, float(ranges[j]), dq[:, j], seconds)
    return found + _length(moving_s(stretches) / 60, minutes)


def moving_s(stretches: Sequence[Stretch]) -> float:
    """Time in which some joint moves, [s]."""
    return sum(float((np.abs(s.dq) > MOVING_RAD_S).any(axis=1).sum()) / s.rate_hz for s in stretches)


def _joint(joint: str, travelled_rad: float, dq: np.ndarray, seconds: np.ndarray) -> list[Finding]:
    forward, backward = float(seconds[dq > MOVING_RAD_S].sum()), float(seconds[dq < -MOVING_RAD_S].sum())
    speed, share = float(np.percentile(np.abs(dq), 99)), (forward + backward) / float(seconds.sum())
    one_way = min(forward, backward) < 0.05 * max(forward, backward)
    if travelled_rad >= LEAST_RANGE_RAD and speed >= LEAST_SPEED_RAD_S and share >= LEAST_SHARE and not one_way:
        return []
    evidence = (
        f"range {travelled_rad:.3g} rad, speed up to {speed:.3g} rad/s, "
        f"{forward:.3g} s forward and {backward:.3g} s back"
    )
    advice = (
        f"move it by at least {LEAST_RANGE_RAD:g} rad, both ways, at speeds from {LEAST_SPEED_RAD_S:g} rad/s to what "
        "the work needs: its friction, and what it weighs, cannot be learned from this"
    )
    return [Finding("excitation-low", "warning", joint, evidence, advice)]


def _length(moving_min: float, minutes: float) -> list[Finding]:
    if moving_min >= NETWORK_MIN:
        return []
    evidence = f"{moving_min:.2g} minutes of motion in {minutes:.2g} minutes"
    advice = (
        f"a friction fit needs {FRICTION_MIN:g} minute of varied motion, a network {NETWORK_MIN:g}; limits promise at "
        f"most one false alarm in a third of the time they were found on, here {minutes / 3:.2g} minutes"
    )
    if moving_min * 60 < SEARCH_S:
        advice += f"; order, axes and delay of the torque were not judged: that needs {SEARCH_S:g} s of motion"
    return [Finding("too-short", "warning" if moving_min < FRICTION_MIN else "note", None, evidence, advice)]
