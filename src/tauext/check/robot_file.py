"""The robot file for the doctor: a tree where one can be had, and what is wrong with the file where not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tauext import _core
from tauext.check.finding import Finding
from tauext.check.model_file import model_findings, moving_joints, position_limits, read_xml
from tauext.data.recording import Recording
from tauext.errors import RobotError
from tauext.robot.load import load_tree, robot_sha256
from tauext.robot.torque_limits import torque_limits


@dataclass(frozen=True)
class RobotFile:
    """tree is None where the file cannot be used: findings say why."""

    tree: _core.Tree | None
    position_limits_rad: np.ndarray  # (joints, 2)
    torque_limits_nm: np.ndarray  # (joints,)
    findings: list[Finding]


def open_robot(path: Path, joints: Sequence[str], gravity: Sequence[float] | None = None) -> RobotFile:
    """Read a robot file for recordings of these joints.

    Where the file knows none of the names its joints are taken in the order of the file, as many as the recordings
    have, which is said: a driver that names joints its own way is no reason to stop, and a wrong order shows.

    Raises:
        RobotError: there is no such file.
    """
    if not path.is_file():
        raise RobotError(f"{path}: there is no such robot file; give a URDF or MJCF")
    root, names = read_xml(path), list(joints)
    found: list[Finding] = []
    none = RobotFile(None, np.tile([-np.inf, np.inf], (len(joints), 1)), np.full(len(joints), np.inf), found)
    known = moving_joints(root) if root is not None else _names(path, names)
    unknown = [name for name in names if name not in known]
    if unknown:
        told = f"{', '.join(unknown)} are not in {path.name}; its joints are {', '.join(known)}"
        if len(unknown) < len(names) or len(known) < len(names):
            advice = "name the joints as the robot file does, at import"
            found.append(Finding("joint-names", "fault", None, told, advice))
            return none
        names = known[: len(names)]
        advice = f"taken in the file's order: {', '.join(names)}; name them so at import"
        found.append(Finding("joint-names", "warning", None, told, advice))
    found += model_findings(root, names)
    try:
        tree = load_tree(path, names, gravity=gravity)
        return RobotFile(tree, position_limits(root, names), torque_limits(path, names), found)
    except RobotError as error:
        if not any(finding.severity == "fault" for finding in found):
            found.append(
                Finding("model-unusable", "fault", None, str(error), "mend the file, or check without --robot")
            )
        return none


def changed_findings(recordings: Sequence[Recording], path: Path) -> list[Finding]:
    """Recordings that name another robot file by its content; those that name none are left alone."""
    now = robot_sha256(path)
    others = [r for r in recordings if r.robot_sha256 and r.robot_sha256 != now]
    if not others:
        return []
    names = ", ".join(f"'{r.name}'" for r in others[:3]) + (f" and {len(others) - 3} more" if len(others) > 3 else "")
    evidence = (
        f"{len(others)} of {len(recordings)} recordings ({names}) were made with a file of SHA-256 "
        f"{others[0].robot_sha256[:12]}..., {path.name} has {now[:12]}..."
    )
    advice = "fine where you mended the model on purpose; else give the file that was there when it was recorded"
    return [
        Finding("robot-file-changed", "warning", None, evidence, advice, others[0].name if len(others) == 1 else None)
    ]


def _names(path: Path, otherwise: list[str]) -> list[str]:
    """Joints of an MJCF file, or those asked for where it cannot be read: loading then says why."""
    try:
        return [link.joint_name for link in load_tree(path).links]
    except RobotError:
        return otherwise
