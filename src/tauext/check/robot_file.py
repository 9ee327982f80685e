"""Faults of the robot file: masses, inertias, frames, limits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from tauext import _core
from tauext.check.finding import Finding
from tauext.data.importers.raw import short_list
from tauext.data.recording import Recording
from tauext.data.servo import torque_unit
from tauext.errors import RobotError
from tauext.robot.load import load_tree, robot_sha256
from tauext.robot.torque_limits import torque_limits

# --- Masses, inertias, joints and limits in a URDF, read as XML, since loading may refuse it.


MOVING = ("revolute", "continuous", "prismatic")
TRIANGLE = 1e-3
"""Share by which a rounded principal inertia may exceed the sum of the others."""


def read_xml(path: Path) -> ElementTree.Element | None:
    """Root of a URDF; None for other files, such as an MJCF, which MuJoCo checks itself."""
    try:
        root = ElementTree.parse(path).getroot()
    except (OSError, ElementTree.ParseError):
        return None
    return root if root.tag == "robot" else None


def moving_joints(root: ElementTree.Element) -> list[str]:
    """Names of the independent joints, in the order of the file."""
    joints = [j for j in root.findall("joint") if j.get("type") in MOVING and j.find("mimic") is None]
    return [j.get("name", "") for j in joints]


def position_limits(root: ElementTree.Element | None, joints: Sequence[str]) -> np.ndarray:
    """Lower and upper limits (joints, 2), [rad or m]; infinite where the file has none."""
    limits = np.tile([-math.inf, math.inf], (len(joints), 1))
    for joint in [] if root is None else root.findall("joint"):
        limit = joint.find("limit")
        if joint.get("name") not in joints or joint.get("type") == "continuous" or limit is None:
            continue
        try:
            low, high = float(limit.get("lower", "0")), float(limit.get("upper", "0"))
        except ValueError:
            continue
        if high > low:  # both 0 means no limits
            limits[list(joints).index(joint.get("name", ""))] = low, high
    return limits


def model_findings(root: ElementTree.Element | None, joints: Sequence[str]) -> list[Finding]:
    """Findings on masses and inertias of the links that these joints move."""
    if root is None:
        return []
    links = {link.get("name"): link for link in root.findall("link")}
    found = []
    for joint in root.findall("joint"):
        child = joint.find("child")
        if joint.get("name") not in joints or child is None:  # load_tree reports such a joint
            continue
        name = child.get("link")
        carried = [name, *_fixed_to(root, name)]
        masses = {link: _mass(links[link]) for link in carried if link in links}
        for link, mass in masses.items():
            if mass < 0 or not math.isfinite(mass):
                evidence = f"link '{link}': mass = {mass:g} kg"
                found.append(Finding("mass-missing", "fault", joint.get("name"), evidence, "it must be > 0"))
            problem = _impossible(links[link]) if mass > 0 else None
            if problem:
                advice = (
                    "correct the file: take it from the CAD model, about the centre of mass, in kg m^2 (not kg mm^2)"
                )
                evidence = f"link '{link}': {problem}"
                found.append(Finding("inertia-impossible", "fault", joint.get("name"), evidence, advice))
        if sum(masses.values()) == 0:
            evidence = f"link '{name}' and links fixed to it have no mass"
            advice = "give it its mass, centre of mass and inertia"
            found.append(Finding("mass-missing", "fault", joint.get("name"), evidence, advice))
    return found


def _fixed_to(root: ElementTree.Element, link: str | None) -> list[str]:
    found = []
    for joint in root.findall("joint"):
        if joint.get("type") == "fixed" and joint.find("parent").get("link") == link:  # type: ignore[union-attr]
            child = joint.find("child").get("link", "")  # type: ignore[union-attr]
            found += [child, *_fixed_to(root, child)]
    return found


def _mass(link: ElementTree.Element) -> float:
    mass = link.find("inertial/mass")
    try:
        return float(mass.get("value", "0")) if mass is not None else 0.0
    except ValueError:
        return math.nan


def _impossible(link: ElementTree.Element) -> str | None:
    inertia = link.find("inertial/inertia")
    if inertia is None:
        return None
    try:
        xx, yy, zz, xy, xz, yz = (float(inertia.get(k, "0")) for k in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz"))
    except ValueError:
        return "an inertia is no number"
    if not np.isfinite([xx, yy, zz, xy, xz, yz]).all():
        return "an inertia is not finite"
    principal = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    values = ", ".join(f"{x:.3g}" for x in principal)
    if principal[0] <= 0:
        return f"principal inertias {values} kg m^2: not positive"
    if principal[2] > (principal[0] + principal[1]) * (1 + TRIANGLE):
        return f"principal inertias {values} kg m^2: the largest exceeds the sum of the others"
    return None


# --- The robot file: a tree where it can be loaded, else findings of its faults.


@dataclass(frozen=True)
class RobotFile:
    """A robot file; tree is None if the file cannot be used, and the findings state the reason."""

    tree: _core.Tree | None
    position_limits_rad: np.ndarray  # (joints, 2)
    torque_limits_nm: np.ndarray  # (joints,)
    findings: list[Finding]


def open_robot(path: Path, joints: Sequence[str], gravity: Sequence[float] | None = None) -> RobotFile:
    """Read a robot file for recordings of these joints.

    If the file has none of the names, its first joints are used in order, and a warning reports it. Drivers may use
    other names, and later checks detect a wrong order.

    Raises:
        RobotError: the file is missing."""
    if not path.is_file():
        raise RobotError(f"{path}: there is no such robot file; give a URDF or MJCF")
    root, names = read_xml(path), list(joints)
    found: list[Finding] = []
    none = RobotFile(None, np.tile([-np.inf, np.inf], (len(joints), 1)), np.full(len(joints), np.inf), found)
    known = moving_joints(root) if root is not None else _names(path, names)
    unknown = [name for name in names if name not in known]
    if unknown:
        evidence = f"{', '.join(unknown)} are not in {path.name}; its joints are {', '.join(known)}"
        if len(unknown) < len(names) or len(known) < len(names):
            advice = "name the joints as the robot file does, at import"
            found.append(Finding("joint-names", "fault", None, evidence, advice))
            return none
        names = known[: len(names)]
        advice = f"taken in the file's order: {', '.join(names)}; name them so at import"
        found.append(Finding("joint-names", "warning", None, evidence, advice))
    found += model_findings(root, names)
    try:
        tree = load_tree(path, names, gravity=gravity)
        return RobotFile(tree, position_limits(root, names), torque_limits(path, names), found)
    except RobotError as error:
        if not any(finding.severity == "fault" for finding in found):
            found.append(
                Finding("model-unusable", "fault", None, str(error), "correct the file, or check without --robot")
            )
        return none


def changed_findings(recordings: Sequence[Recording], path: Path) -> list[Finding]:
    """Finding of recordings made with another robot file, by SHA-256; recordings without one are ignored."""
    now = robot_sha256(path)
    others = [r for r in recordings if r.robot_sha256 and r.robot_sha256 != now]
    if not others:
        return []
    names = short_list((f"'{r.name}'" for r in others), 3)
    evidence = (
        f"{len(others)} of {len(recordings)} recordings ({names}) were made with a file of SHA-256 "
        f"{others[0].robot_sha256[:12]}..., {path.name} has {now[:12]}..."
    )
    advice = "expected if you corrected the model; else give the file that was there when it was recorded"
    return [
        Finding("robot-file-changed", "warning", None, evidence, advice, others[0].name if len(others) == 1 else None)
    ]


def _names(path: Path, otherwise: list[str]) -> list[str]:
    """Joints of an MJCF file, or `otherwise` if unreadable; loading then reports the reason."""
    try:
        return [link.joint_name for link in load_tree(path).links]
    except RobotError:
        return otherwise


# --- Positions and torques beyond the robot file's own limits.


POSITION_RAD = 0.05
TORQUE_SHARE = 0.05
LEAST_ROWS = 3


def limit_findings(recordings: Sequence[Recording], robot: RobotFile) -> list[Finding]:
    """Findings of values beyond a limit by 0.05 rad or 5 % in at least three rows."""
    found, unit = [], torque_unit(recordings)
    for j, joint in enumerate(recordings[0].joints):
        q = np.concatenate([r.q[:, j] for r in recordings])
        tau = np.abs(np.concatenate([r.tau[:, j] for r in recordings]))
        low, high = robot.position_limits_rad[j]
        outside = (q < low - POSITION_RAD) | (q > high + POSITION_RAD)
        if outside.sum() >= LEAST_ROWS:
            evidence = (
                f"positions from {q.min():.4g} to {q.max():.4g} rad, limits {low:.4g} to {high:.4g}; "
                f"{outside.mean():.1%} of the samples are outside"
            )
            advice = "a turn counted too many, another zero position, degrees, or limits of another arm"
            found.append(Finding("position-limit", "warning", joint, evidence, advice))
        over = tau > robot.torque_limits_nm[j] * (1 + TORQUE_SHARE)
        if over.sum() >= LEAST_ROWS:
            limit = robot.torque_limits_nm[j]
            evidence = f"torques up to {tau.max():.4g} {unit}, limit {limit:.4g} Nm; {over.mean():.1%} of the samples"
            advice = "another unit of the effort, or limits of another arm"
            found.append(Finding("effort-limit", "warning", joint, evidence, advice))
    return found
