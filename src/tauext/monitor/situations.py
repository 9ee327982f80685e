"""How sure a bundle with an error scale is, in motions that everybody knows: `tauext show` says it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tauext import _core
from tauext.data.units import short

SPEED_RAD_S = 0.5
"""Of a joint that slides ..."""
SPEEDING_UP_RAD_S2 = 2.0
"""... and of one that speeds up, or stops."""
SOON_S = 0.05
"""After a stop, or since it began to speed up."""
CREEPING_RAD_S = 0.01
"""Where the bundle's near-stiction speed is not above it, half of that."""
BEFORE_S = 3.0
"""The motion before goes on for so long, so that all filters have settled."""

Situation = dict[str, dict[str, float]]
"""`limit` and `standard error` of each joint, in its estimate unit."""


def situations(bundle: _core.Bundle) -> dict[str, Situation]:
    """Collision limit and standard error after each motion, all joints moving alike; none without an error scale.

    Both are the core's own, of speeds as in each motion.
    """
    if not bundle.error_scale.on:
        return {}
    names = [link.joint_name for link in bundle.links]
    found = {}
    for name, (dq, near) in motions(bundle).items():
        level = bundle.near_stiction_limit_nm if near else bundle.sliding_limit_nm
        times, sigma = last_errors(bundle, dq, near)
        found[name] = {
            "limit": dict(zip(names, (times * level).tolist(), strict=True)),
            "standard error": dict(zip(names, sigma.tolist(), strict=True)),
        }
    return found


def motions(bundle: _core.Bundle) -> dict[str, tuple[np.ndarray, bool]]:
    """Speeds of each motion, (samples,) [rad/s], and whether it ends near stiction."""
    period_s = 1e-9 * bundle.observer.sample_period_ns
    before, soon = (max(1, round(length_s / period_s)) for length_s in (BEFORE_S, SOON_S))
    edge = bundle.near_stiction_rad_s
    creeping = CREEPING_RAD_S if CREEPING_RAD_S < edge or edge == 0 else edge / 2
    sliding = np.full(before, SPEED_RAD_S)
    faster = SPEEDING_UP_RAD_S2 * period_s * np.arange(1, soon + 1)
    braking = np.arange(SPEED_RAD_S, 0, -SPEEDING_UP_RAD_S2 * period_s)
    return {
        "standing": (np.zeros(before), True),
        "just after it stopped": (np.concatenate([sliding, braking, np.zeros(soon)]), True),
        f"creeping at {creeping:g} rad/s": (np.full(before, creeping), True),
        f"sliding steadily at {SPEED_RAD_S:g} rad/s": (sliding, False),
        f"speeding up by {SPEEDING_UP_RAD_S2:g} rad/s2": (np.concatenate([sliding, SPEED_RAD_S + faster]), False),
    }


def last_errors(bundle: _core.Bundle, dq: np.ndarray, near: bool) -> tuple[np.ndarray, np.ndarray]:
    """What a motion in which every joint has these speeds multiplies limits by, and the standard error: 2 x (joints,).

    near: it is near stiction at its end, which alone counts.
    """
    n, count = bundle.joints, len(dq)
    t_ns = np.arange(count, dtype=np.int64) * bundle.observer.sample_period_ns
    region = np.full((count, n), near, dtype=np.uint8)
    entered, restarted = np.ones(count, dtype=np.uint8), np.zeros(count, dtype=np.uint8)
    speeds = np.repeat(dq[:, None], n, axis=1)
    said = _core.motion_errors(bundle, t_ns, speeds, region, entered, restarted, np.array([count - 1]))
    return said["scale"][0], said["sigma_nm"][0]


def sentences(found: Mapping[str, Situation], units: Mapping[str, str]) -> dict[str, str]:
    """Where each joint is least sure, and where it is surest."""
    told = {}
    for joint, unit in units.items():
        by_limit = sorted(found, key=lambda name: found[name]["limit"][joint])
        words = [f"{name}: {certainty(found[name], joint, unit)}" for name in (by_limit[-1], by_limit[0])]
        told[joint] = f"least sure {words[0]}; surest {words[1]}"
    return told


def certainty(situation: Situation, joint: str, unit: str) -> str:
    """`limit 4.1 Nm, standard error 0.9 Nm`."""
    return ", ".join(f"{what} {of_joints[joint]:.2g} {short(unit)}" for what, of_joints in situation.items())
