"""Largest torques of the drives according to the robot file."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np

from tauext.errors import RobotError
from tauext.robot.read import compiled, drives_of
from tauext.robot.xml_file import XmlFile, read_xml


def torque_limits(path: str | os.PathLike[str], joints: Sequence[str]) -> np.ndarray:
    """Largest torque of each joint's drive (n,), [N m or N]; infinite where the file states none.

    URDF: `effort` of the joint's limit; 0 means none. MJCF: the lesser of the joint's `actuatorfrcrange` and the
    `forcerange` of its motor times the gear.

    Args:
        path: a file that `tauext.robot.read.load_tree` reads.
        joints: names of moving joints, in the order of the recordings' columns.

    Raises:
        RobotError: an effort is no number >= 0, an MJCF lacks one of the joints, or the file cannot be read.
    """
    path = Path(path)
    file = read_xml(path)
    if file.root.tag == "robot":
        return np.array([_effort(file, joint) for joint in joints])
    model = compiled(path)
    known = [model.joint(joint).name for joint in range(model.njnt)]
    for joint in joints:
        if joint not in known:
            raise RobotError(f"{path}: joint {joint!r} must be one of {', '.join(known)}")
    return np.array([_drive_limit(model, known.index(joint)) for joint in joints])


def _effort(file: XmlFile, name: str) -> float:
    for joint in file.root.findall("joint"):
        limit = joint.find("limit")
        if joint.get("name") != name or limit is None or limit.get("effort") is None:
            continue
        text = limit.get("effort", "")
        try:
            effort = float(text)
        except ValueError:
            effort = np.nan
        if not effort >= 0:
            raise file.error(limit, f"joint {name!r}: effort = {text!r} must be a number >= 0")
        return effort or np.inf
    return np.inf


def _drive_limit(model: mujoco.MjModel, joint: int) -> float:
    limits = [float(np.abs(model.jnt_actfrcrange[joint]).max())] if model.jnt_actfrclimited[joint] else []
    for drive in np.flatnonzero(drives_of(model, joint) & model.actuator_forcelimited.astype(bool)):
        limits.append(float(np.abs(model.actuator_forcerange[drive] * model.actuator_gear[drive, 0]).max()))
    return min(limits, default=0.0) or np.inf
