"""What sources find out about an arm before a bundle exists: names of its joints, and its sample period."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from pathlib import Path

from tauext.data.joint_names import GRIPPER, match_joints
from tauext.data.servo import servo_facts
from tauext.errors import AwayError, ConfigError
from tauext.monitor.source import SourceFacts
from tauext.robot.read import movable_joints

LEARNT_STEPS = 20
"""Steps between stamps from which a period is learnt."""


def joint_names(usual: Sequence[str], robot: Path | None, arm: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names of an arm's joints, whose number and order are known, and notes on what was assumed.

    The robot file's names are used: the usual ones, these behind a common prefix, or its only joints in their order.

    Args:
        usual: names in the order of the samples.
        arm: the source, for messages.

    Raises:
        ConfigError: the robot file has other joints.
        RobotError: the robot file is missing or cannot be read.
    """
    if robot is None:
        return tuple(usual), ()
    names = movable_joints(robot)
    prefixes = [name.removesuffix(usual[0]) for name in names if name.endswith(usual[0])]
    for prefix in sorted(prefixes, key=len):
        if all(prefix + name in names for name in usual):
            return tuple(prefix + name for name in usual), ()
    arms_own = [name for name in names if not GRIPPER.search(name)]
    if len(arms_own) != len(usual):
        raise ConfigError(
            f"{arm} has {len(usual)} joints, {robot.name} has {len(arms_own)}: {', '.join(arms_own) or 'none'}; "
            "give the robot file of this arm"
        )
    return tuple(arms_own), (f"joints are taken in the order of {robot.name}: {', '.join(arms_own)}",)


def chosen_joints(there: Sequence[str], robot: Path | None, arm: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Joints to use, of those whose names are known, and notes: the robot file's in its order, else all but grippers.

    Raises:
        ConfigError: the robot file has none of them, or both have joints that the other lacks.
        RobotError: the robot file is missing or cannot be read.
    """
    held: list[str] = []
    if robot is not None:
        movable = movable_joints(robot)
        chosen = [name for name in movable if name in there]
        if not chosen:
            raise ConfigError(
                f"{arm} has joints {', '.join(there)}, none of which {robot.name} has; "
                f"its joints are {', '.join(movable) or 'none'}"
            )
        held, unused = (
            [name for name in names if name not in chosen and not GRIPPER.search(name)] for names in (movable, there)
        )
        if held and unused:
            pairs = match_joints(movable, there).proposed
            perhaps = "".join(f"; perhaps '{other}' is '{name}'" for name, other in pairs.items())
            raise ConfigError(
                f"{robot.name}'s {', '.join(held)} and {arm}'s {', '.join(unused)} match no joint{perhaps}; give both "
                "the same name in the robot file"
            )
        if arms_own := [name for name in chosen if not GRIPPER.search(name)]:
            chosen = arms_own
    else:
        chosen = [name for name in there if not GRIPPER.search(name)] or list(there)
    left = [name for name in there if name not in chosen]
    notes = [f"left out: {', '.join(left)}"] * bool(left)
    notes += [f"not in the stream, held at the robot file's rest position: {', '.join(held)}"] * bool(held)
    return tuple(chosen), tuple(notes)


def mean_period_ns(steps_ns: Sequence[int]) -> int:
    """Mean step; a step of several medians counts as several, so lost samples and jitter do not matter."""
    median_ns = statistics.median(steps_ns)
    return round(sum(steps_ns) / max(1, sum(round(step / median_ns) for step in steps_ns)))


def nominal_period_ns(period_ns: float) -> int:
    """The period of the nominal rate that a measured one is within 1 % of, else the measured one."""
    rate_hz = 1e9 / period_ns
    usual_hz = (2000, 1000, 500, 400, 250, 240, 200, 125, 120, 100, 60, 50, 40, 30, 25, 20, 15, 10)
    nearest_hz = min(usual_hz, key=lambda hz: abs(hz / rate_hz - 1))
    return round(1e9 / nearest_hz if abs(nearest_hz / rate_hz - 1) <= 0.01 else period_ns)


def learnt_period_ns(stamps_ns: Sequence[int], arm: str) -> int:
    """Period of a stream from its stamps, of which the first ones may be uneven.

    Raises:
        AwayError: there are too few, or they do not rise.
    """
    steps = [b - a for a, b in zip(stamps_ns[:-1], stamps_ns[1:], strict=True) if b > a]
    if len(steps) < LEARNT_STEPS < len(stamps_ns):
        raise AwayError(
            f"{arm}: {len(stamps_ns)} samples came, and their time stamps rose {len(steps)} times: their clock stands "
            "still or goes back; restart the driver"
        )
    if len(steps) < LEARNT_STEPS:
        raise AwayError(
            f"{arm}: {len(steps) + bool(steps)} samples came; {LEARNT_STEPS + 1} are needed to learn the rate"
        )
    return nominal_period_ns(mean_period_ns(steps))


def why_another(known: SourceFacts, now: SourceFacts) -> str:
    """Why a source is another arm than the known one, or set up otherwise; empty: it is the same."""
    was, has = known.settings, now.settings
    if has.joints != was.joints:
        return f"it has joints {', '.join(has.joints)}, not {', '.join(was.joints)}"
    if abs(has.period_ns / was.period_ns - 1) > was.rate_tolerance:
        return f"it has {1e9 / has.period_ns:.4g} samples a second, not {1e9 / was.period_ns:.4g}"
    if has.torque_units != was.torque_units:
        return f"its torque is in {', '.join(has.torque_units)}, not {', '.join(was.torque_units)}"
    if has.torque_timing != was.torque_timing:
        return f"its torque is {has.torque_timing}, not {was.torque_timing}"
    facts = [None if one is None or not one.on else servo_facts(one) for one in (was.servo, has.servo)]
    if facts[0] != facts[1]:
        return "its servos are of another type, or are read otherwise"
    return ""
