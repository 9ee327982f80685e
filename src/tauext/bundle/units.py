"""Units of torques and estimates in words, and how sensitive a bundle is in typical motions."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from tauext import _core

# --- Units of torques in words: what a bundle answers in need not be newton metres.


if TYPE_CHECKING:
    from tauext._core import Bundle

SEVERAL = "unit of the joint"
"""Where joints answer in different units, a heading over all of them is this."""


def short(unit: str) -> str:
    """The unit as printed after a number: `Nm` for `N m`, others unchanged."""
    return unit.replace("N m", "Nm")


def of_all(units: Sequence[str]) -> str:
    """The unit that all joints share, [N m] where none is stated, or that each has its own."""
    different = set(units) or {"N m"}
    return short(different.pop()) if len(different) == 1 else SEVERAL


def left_out(bundle: Bundle) -> tuple[str, ...]:
    """Names of the joints that do not answer in N m, which loads and forces leave out."""
    return not_in_newtons([link.joint_name for link in bundle.links], bundle.estimate_units)


def not_in_newtons(joints: Sequence[str], units: Sequence[str]) -> tuple[str, ...]:
    """Joints whose answers are in none of N m, N and W."""
    return tuple(joint for joint, unit in zip(joints, units, strict=True) if unit not in ("N m", "N", "W"))


def not_monitored(bundle: Bundle) -> list[str]:
    """Names of the joints that cannot raise an alarm, since they never moved in training."""
    return [link.joint_name for link, monitored in zip(bundle.links, bundle.monitored, strict=True) if not monitored]


def own_shares(bundle: Bundle) -> list[float]:
    """Relative standard error of each joint's torque constant beside the common factor."""
    settings = bundle.wrench_settings
    return [settings.own_share(joint) for joint in range(bundle.joints)]


def largest_share(bundle: Bundle) -> float:
    """Relative standard error of the least known torque constant among joints in N m, with the common factor."""
    known = [own for own, newtons in zip(own_shares(bundle), bundle.in_newtons, strict=True) if newtons]
    return math.hypot(bundle.wrench_settings.common_share, max(known, default=0.0))


# --- How sure a bundle with an error scale is, in typical motions, for `tauext show`.


Situation = dict[str, dict[str, float]]
"""`limit` and `standard error` of each joint, in its estimate unit."""


def situations(bundle: _core.Bundle) -> dict[str, Situation]:
    """Collision limit and standard error of each monitored joint after each motion, all joints moving alike; none where
    limits are constants.

    Both are the core's own, of speeds as in each motion.
    """
    if not bundle.error_scale.follows:
        return {}
    names = [link.joint_name for link in bundle.links]
    found = {}
    for name, (dq, near) in motions(bundle).items():
        level = bundle.near_stiction_limit_nm if near else bundle.sliding_limit_nm
        scale, sigma_nm = _core.errors_after(bundle, dq, near)
        watched = [j for j, monitored in enumerate(bundle.monitored) if monitored]
        found[name] = {
            "limit": {names[j]: scale[j] * level[j] for j in watched},
            "standard error": {names[j]: sigma_nm[j] for j in watched},
        }
    return found


def motions(bundle: _core.Bundle) -> dict[str, tuple[list[float], bool]]:
    """Speeds of each motion, a sample period apart, [rad/s], and whether it ends near stiction.

    The motion before goes on for 3 s, so that all filters have settled; a stop or a change of speed is 50 ms old.
    """
    period_s = 1e-9 * bundle.observer.sample_period_ns
    before, soon = (max(1, round(length_s / period_s)) for length_s in (3.0, 0.05))
    speed, speeding_up, edge = 0.5, 2.0, bundle.near_stiction_rad_s  # [rad/s], [rad/s2]
    creeping = 0.01 if 0.01 < edge or edge == 0 else edge / 2
    sliding, change = [speed] * before, speeding_up * period_s
    faster = [speed + change * k for k in range(1, soon + 1)]
    braking = [speed - change * k for k in range(math.ceil(speed / change))]
    return {
        "standing": ([0.0] * before, True),
        "just after it stopped": (sliding + braking + [0.0] * soon, True),
        f"creeping at {creeping:g} rad/s": ([creeping] * before, True),
        f"sliding steadily at {speed:g} rad/s": (sliding, False),
        f"speeding up by {speeding_up:g} rad/s2": (sliding + faster, False),
    }


def sentences(found: Mapping[str, Situation], units: Mapping[str, str]) -> dict[str, str]:
    """Where each monitored joint is least sure, and where it is surest."""
    sentences = {}
    for joint in next(iter(found.values()))["limit"]:
        by_limit = sorted(found, key=lambda name: found[name]["limit"][joint])
        words = [f"{name}: {certainty(found[name], joint, units[joint])}" for name in (by_limit[-1], by_limit[0])]
        sentences[joint] = f"least sure {words[0]}; surest {words[1]}"
    return sentences


def certainty(situation: Situation, joint: str, unit: str) -> str:
    """`threshold 4.1 Nm, standard error 0.9 Nm`."""
    return ", ".join(f"{in_terms(what)} {of_joints[joint]:.2g} {short(unit)}" for what, of_joints in situation.items())


TERMS = {
    "budget": "target false alarm rate",
    "drift": "adaptive bias",
    "limit": "threshold",
    "limits": "thresholds",
}
"""Terms of the field by their names in code, where keys are printed; docs/words.md has them all."""


def in_terms(key: str) -> str:
    """An identifier in words: `contact thresholds sliding` of contact_limits_sliding; a drive's torque limit is one."""
    words = key.split("_")
    return " ".join(words if "torque" in words else (TERMS.get(word, word) for word in words))
