"""Faults of the robot file: masses, inertias, frames, limits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tauext import _core
from tauext.check.finding import Finding, Severity
from tauext.data.importers.raw import short_list
from tauext.data.recording import Recording
from tauext.data.servo import torque_unit
from tauext.errors import RobotError
from tauext.robot.compile import LEAST
from tauext.robot.read import CarriedBody, carried_bodies, load_tree, movable_joints, robot_sha256
from tauext.robot.torque_limits import torque_limits
from tauext.robot.xml_file import read_xml

# --- Masses, inertias and limits, which loading accepts as the file gives them.


NEGLIGIBLE = 1e-3
"""Share of mass and inertia that a joint moves below which an impossible link changes nothing."""


def position_limits(path: Path, joints: Sequence[str]) -> np.ndarray:
    """Lower and upper limits of a URDF (joints, 2), [rad or m]; infinite where the file has none, and for an MJCF."""
    limits = np.tile([-math.inf, math.inf], (len(joints), 1))
    for joint in read_xml(path).root.findall("joint"):
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


def model_findings(bodies: Sequence[CarriedBody]) -> list[Finding]:
    """Findings on masses and inertias of the links that joints in use move.

    An impossible inertia is a fault, or a note if the link is negligible beside the others that its joint moves.
    """
    found = []
    for joint in dict.fromkeys(body.joint for body in bodies):
        carried = [body for body in bodies if body.joint == joint]
        for body in carried:
            if not 0 <= body.mass_kg < math.inf:
                evidence = f"link '{body.name}': mass = {body.mass_kg:g} kg"
                found.append(Finding("inertia-impossible", "fault", joint, evidence, "it must be > 0"))
            problem = _impossible(body.inertia_kg_m2) if body.mass_kg > LEAST else None
            if problem:
                negligible = _share(body, carried) <= NEGLIGIBLE
                nothing = f"; below {NEGLIGIBLE:.1%} of what the joint moves, it changes nothing" if negligible else ""
                evidence = f"link '{body.name}': {problem}{nothing}"
                advice = (
                    "correct the file: take it from the CAD model, about the centre of mass, in kg m^2 (not kg mm^2)"
                )
                severity: Severity = "note" if negligible else "fault"
                found.append(Finding("inertia-impossible", severity, joint, evidence, advice))
        if all(abs(body.mass_kg) <= LEAST for body in carried):
            evidence = f"link '{carried[0].name}' and links fixed to it have no mass"
            advice = "give it its mass, centre of mass and inertia"
            found.append(Finding("inertia-impossible", "fault", joint, evidence, advice))
    return found


def _share(body: CarriedBody, carried: Sequence[CarriedBody]) -> float:
    """Largest share of a body in mass and inertia of the bodies that are carried together."""
    mass = sum(max(one.mass_kg, 0.0) for one in carried)
    inertia = sum(float(np.abs(one.inertia_kg_m2).sum()) for one in carried)
    return max(body.mass_kg / mass, float(np.abs(body.inertia_kg_m2).sum()) / max(inertia, LEAST))


def _impossible(inertia: np.ndarray) -> str | None:
    if not np.isfinite(inertia).all():
        return "an inertia is not finite"
    principal = np.sort(inertia)
    values = ", ".join(f"{x:.3g}" for x in principal)
    if principal[0] <= LEAST:
        return f"principal inertias {values} kg m^2: not positive"
    # share by which a rounded principal inertia may exceed the sum of the others
    if principal[2] > (principal[0] + principal[1]) * (1 + 1e-3):
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
    names = list(joints)
    found: list[Finding] = []
    none = RobotFile(None, np.tile([-np.inf, np.inf], (len(joints), 1)), np.full(len(joints), np.inf), found)
    try:
        known = movable_joints(path)
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
        found += model_findings(carried_bodies(path, names))
        if any(finding.severity == "fault" for finding in found):  # what a wrong model does not explain is no finding
            return none
        tree = load_tree(path, names, gravity=gravity)
        return RobotFile(tree, position_limits(path, names), torque_limits(path, names), found)
    except RobotError as error:
        found.append(Finding("model-unusable", "fault", None, str(error), "correct the file, or check without --robot"))
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


# --- Positions and torques beyond the robot file's own limits.


POSITION_RAD = 0.05
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
            found.append(Finding("beyond-limit", "warning", joint, evidence, advice))
        over = tau > robot.torque_limits_nm[j] * (1 + 0.05)
        if over.sum() >= LEAST_ROWS:
            limit = robot.torque_limits_nm[j]
            evidence = f"torques up to {tau.max():.4g} {unit}, limit {limit:.4g} Nm; {over.mean():.1%} of the samples"
            advice = "another unit of the effort, or limits of another arm"
            found.append(Finding("beyond-limit", "warning", joint, evidence, advice))
    return found
