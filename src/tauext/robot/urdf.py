"""Read a URDF: without what is only seen or touched, with the rotor inertia that its transmissions state."""

import math
from collections import Counter
from pathlib import Path
from xml.etree import ElementTree

import mujoco

from tauext.errors import RobotError

_DROPPED = ("visual", "collision", "material", "limit", "safety_controller")


def read_urdf(path: Path) -> mujoco.MjSpec:
    """MuJoCo's reading of a URDF, after dropping what a tree has no use for: how it looks, what it hits, its limits.

    Rotor inertia has no place in the URDF standard; Drake's is understood: in a transmission of one joint,
    `rotor_inertia` times the square of `gear_ratio`, or of the standard's `mechanicalReduction`, of its actuator.

    Raises:
        RobotError: the file is a xacro template, a joint's or link's name stands twice, or a number cannot be read.
        ElementTree.ParseError, ValueError: the file is no XML, or no URDF to MuJoCo.
    """
    robot = ElementTree.parse(path).getroot()
    _refuse_xacro(robot, path)
    _refuse_repeated_names(robot, path)
    for parent in list(robot.iter()):
        for child in list(parent):
            if child.tag in _DROPPED:
                parent.remove(child)
    spec = mujoco.MjSpec.from_string(ElementTree.tostring(robot, encoding="unicode"))
    joints = {joint.name: joint for joint in spec.joints}
    for name, inertia in _rotor_inertia(robot, path).items():
        if name in joints:
            joints[name].armature += inertia
    return spec


def _refuse_xacro(robot: ElementTree.Element, path: Path) -> None:
    if any("xacro}" in str(element.tag) for element in robot.iter()):
        raise RobotError(f"{path}: is a xacro template; expand it first: xacro {path.name} > robot.urdf")


def _refuse_repeated_names(robot: ElementTree.Element, path: Path) -> None:
    """MuJoCo would silently drop the second name."""
    for kind in ("joint", "link"):
        for name, count in Counter(element.get("name") for element in robot.findall(kind)).items():
            if count > 1:
                raise RobotError(f"{path}: {count} {kind}s are named {name!r}; every {kind} needs a name of its own")


def _rotor_inertia(robot: ElementTree.Element, path: Path) -> dict[str, float]:
    found: dict[str, float] = {}
    for transmission in robot.findall("transmission"):
        joints = [joint.get("name", "") for joint in transmission.findall("joint")]
        for actuator in transmission.findall("actuator"):
            values = {_local(child.tag): child.get("value", child.text) for child in actuator}
            if "rotor_inertia" not in values:
                continue
            if len(joints) != 1:
                raise RobotError(f"{path}: rotor inertia in a transmission of {len(joints)} joints; it must have one")
            inertia = _number(values, "rotor_inertia", joints[0], path, least=0.0)
            gear = "gear_ratio" if "gear_ratio" in values else "mechanicalReduction"
            ratio = _number(values, gear, joints[0], path) if gear in values else 1.0
            found[joints[0]] = found.get(joints[0], 0.0) + inertia * ratio**2
    return found


def _local(tag: str) -> str:
    return tag.rpartition("}")[2]


def _number(values: dict[str, str | None], key: str, joint: str, path: Path, least: float = -math.inf) -> float:
    try:
        number = float(values[key] or "")
    except ValueError:
        number = math.nan
    if math.isfinite(number) and number >= least:
        return number
    rule = "a finite number" if least < 0 else f"a finite number >= {least:g}"
    raise RobotError(f"{path}: joint {joint!r}: {key} = {values[key]!r} in its transmission must be {rule}")
