"""A user's robot file with a twin's parameters: MJCF and URDF keep their text, comments and meshes."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.dom import minidom
from xml.parsers import expat

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from tauext import _core
from tauext.errors import RobotError
from tauext.files.atomic_write import atomic_write
from tauext.robot.inertial import six_of
from tauext.robot.read import placed_bodies, read_robot

KINDS = {".xml": "MJCF", ".mjcf": "MJCF", ".urdf": "URDF", ".usd": "USD", ".usda": "USD", ".usdc": "USD"}
SENSORS = ("jointpos", "jointvel", "jointactuatorfrc")
"""MuJoCo's sensors of a joint's position [rad], velocity [rad/s] and drive torque [N m]."""
SENSOR_PREFIX = "twin_"
Node = Any
"""A document of minidom, or an element of one."""


@dataclass(frozen=True)
class Drive:
    """Position drive of a servo, at the joint: torque = kp (goal - q) - kd dq within +-most_nm."""

    kp: float
    """[N m/rad]"""
    kd: float
    """Back-EMF, [N m s/rad]."""
    most_nm: float
    ohm: float
    nm_per_ampere: float


@dataclass(frozen=True)
class Inertial:
    """New inertial parameters of a body."""

    body: str
    mass: float
    com: tuple[float, ...]
    """In the body's own frame, [m]."""
    inertia: tuple[float, ...]
    """Principal moments, [kg m^2], ..."""
    axes: tuple[float, ...]
    """... about axes of this rotation in the body's frame, a quaternion w, x, y, z."""


@dataclass(frozen=True)
class JointChange:
    """What a file gets for a joint and the heaviest body that it moves; None stays as it is."""

    joint: str
    damping: float | None = None
    frictionloss: float | None = None
    armature: float | None = None
    inertial: Inertial | None = None
    drive: Drive | None = None
    noise: tuple[float, ...] = ()
    """Standard deviations of SENSORS, for an MJCF; of the first ones, or of none."""


def given_of(path: Path, tree: _core.Tree) -> np.ndarray:
    """Damping, frictionloss and armature of each joint in a robot file, a URDF's from its `dynamics`, and the part of
    the armature that belongs to actuators: (n, 4)."""
    model, joints, _ = placed_bodies(path, tree)
    dynamics = {}
    if KINDS.get(path.suffix) == "URDF":
        for joint in _document(path).getElementsByTagName("joint"):
            for one in _children(joint, "dynamics"):
                dynamics[joint.getAttribute("name")] = [
                    float(one.getAttribute(name) or 0) for name in ("damping", "friction")
                ]
    rows = []
    for dof, link in zip(model.jnt_dofadr[joints], tree.links, strict=True):
        in_model = [float(np.ravel(model.dof_damping[dof])[0]), float(model.dof_frictionloss[dof])]
        motors = link.rotor_inertia - float(model.dof_armature[dof])
        rows.append([*dynamics.get(link.joint_name, in_model), link.rotor_inertia, motors])
    return np.array(rows)


def body_change(path: Path, tree: _core.Tree, values: np.ndarray, changed: Sequence[bool]) -> list[JointChange]:
    """What the changed links' heaviest bodies get, so that each whole link has the mass and centre of mass of VALUES.

    Args:
        values: VALUES of each joint, (n, 8).
        changed: links whose inertial parameters differ from the file's.
    """
    model, _, placed = placed_bodies(path, tree)
    found = []
    for k, (link, row) in enumerate(zip(tree.links, values, strict=True)):
        own = [body for body in placed if body.link == k]
        if not (changed[k] and own):
            found.append(JointChange(link.joint_name))
            continue
        body = max(own, key=lambda one: float(model.body_mass[one.number]))
        mass, com = float(model.body_mass[body.number]), np.array(model.body_ipos[body.number])
        more = row[3] - link.mass
        moment = row[3] * row[4:7] - link.mass * np.array(link.com)  # change of the link's first moment
        new = max(mass + more, 0.1 * mass)
        shifted = (mass * com + body.rotation.T @ (moment - more * body.translation)) / new
        inertia = row[7] * np.array(model.body_inertia[body.number])
        numbers = (tuple(map(float, some)) for some in (shifted, inertia, model.body_iquat[body.number]))
        found.append(JointChange(link.joint_name, inertial=Inertial(body.name, new, *numbers)))
    return found


def expect_kinds(robot: Path, out: Path) -> tuple[str, str]:
    """The kinds of both files; raises RobotError where one cannot be written from the other."""
    kinds = KINDS.get(robot.suffix, "file of another kind"), KINDS.get(out.suffix, "file of another kind")
    if kinds[1] != "USD" and kinds not in (("URDF", "URDF"), ("MJCF", "MJCF"), ("URDF", "MJCF")):
        raise RobotError(
            f"{out}: {kinds[1]} cannot be written from {robot.name} ({kinds[0]}): MJCF (.xml) from MJCF or URDF, URDF "
            "from URDF, USD (.usd, .usda, .usdc) from any"
        )
    return kinds


def write_model(robot: Path, out: Path, changes: Sequence[JointChange], note: str) -> list[str]:
    """Write the robot file with these changes under another name, whole or not at all; returns the sensors it got.

    A file of the same kind keeps its text, comments and meshes; relative paths are made to fit the new folder. From a
    URDF, an MJCF is made by MuJoCo.

    Args:
        note: comment at the head.

    Raises:
        RobotError: of another kind than can be written from this one; no such joint or body; an unreadable file.
    """
    kinds, sensors = expect_kinds(robot, out), []
    if kinds[1] == "URDF":
        document = _document(robot)
        _change_urdf(document, robot, out, changes)
    else:
        document = _expanded(robot) if kinds[0] == "MJCF" else _converted(robot)
        _change_mjcf(document, robot, out, changes)
        sensors = _add_sensors(document, changes)
    document.insertBefore(document.createComment(f" {note.replace('--', '- -')} "), document.documentElement)
    with atomic_write(out) as part:
        lines = ['<?xml version="1.0"?>', *(one.toxml() for one in document.childNodes), ""]
        part.write_text("\n".join(lines), encoding="utf-8")
    return sensors


def _document(path: Path) -> Node:
    try:
        return minidom.parseString(path.read_bytes())
    except (expat.ExpatError, ValueError, OSError) as error:
        raise RobotError(f"{path}: cannot be rewritten: {error}") from error


def _expanded(robot: Path, root: Path | None = None) -> Node:
    """The document with the files it includes in their place, as MuJoCo reads them."""
    document, folder = _document(robot), (root or robot).parent
    for include in document.getElementsByTagName("include"):
        of = _expanded(folder / include.getAttribute("file"), root or robot).documentElement
        for one in list(of.childNodes):
            include.parentNode.insertBefore(document.importNode(one, True), include)
        include.parentNode.removeChild(include)
    return document


def _converted(robot: Path) -> Node:
    """A URDF as an MJCF; without shapes where MuJoCo cannot read them."""
    try:
        spec = mujoco.MjSpec.from_file(str(robot))
        spec.compiler.fusestatic, spec.compiler.discardvisual = False, False
        spec.compile()
    except ValueError:
        spec, _ = read_robot(robot)
    return minidom.parseString(spec.to_xml().encode())


def _children(of: Node, tag: str) -> list[Node]:
    return [one for one in of.childNodes if one.nodeName == tag]


def _child(of: Node, tag: str) -> Node:
    """The first child of this name, made where there is none, on a line of its own."""
    found = _children(of, tag)
    if not found:
        found = [of.insertBefore(of.ownerDocument.createElement(tag), of.firstChild)]
        of.insertBefore(of.ownerDocument.createTextNode("\n"), found[0])
    return found[0]


def _added(of: Node, tag: str) -> Node:
    """A new last child, on a line of its own."""
    made = of.appendChild(of.ownerDocument.createElement(tag))
    of.appendChild(of.ownerDocument.createTextNode("\n"))
    return made


def _named(path: Path, elements: Iterable[Node], name: str, kind: str) -> Node:
    for one in elements:
        if one.getAttribute("name") == name:
            return one
    raise RobotError(f"{path}: no {kind} {name!r} to change")


def _set(element: Node, **values: str | float | Sequence[float] | None) -> None:
    """Set attributes to a text, a number or several; None stays as it is."""
    for name, value in values.items():
        if value is not None:
            text = value if isinstance(value, str) else " ".join(f"{one:.6g}" for one in np.atleast_1d(value))
            element.setAttribute(name, text)


def _change_urdf(document: Node, robot: Path, out: Path, changes: Sequence[JointChange]) -> None:
    root = document.documentElement
    for change in changes:
        joint = _named(robot, _children(root, "joint"), change.joint, "joint")
        if change.damping is not None or change.frictionloss is not None:
            _set(_child(joint, "dynamics"), damping=change.damping, friction=change.frictionloss)
        if change.armature is not None:  # URDF has no element for it
            comment = document.createComment(f" rotor inertia at the joint: {change.armature:.6g} kg m^2 ")
            joint.insertBefore(comment, joint.firstChild)
        if (new := change.inertial) is not None:
            inertial = _child(_named(robot, _children(root, "link"), new.body, "link"), "inertial")
            axes = Rotation.from_quat(new.axes, scalar_first=True).as_matrix()
            six = six_of(axes @ np.diag(new.inertia) @ axes.T)
            _set(_child(inertial, "origin"), xyz=new.com, rpy="0 0 0")
            _set(_child(inertial, "mass"), value=new.mass)
            _set(
                _child(inertial, "inertia"),
                **dict(zip(("ixx", "iyy", "izz", "ixy", "ixz", "iyz"), six.tolist(), strict=True)),
            )
    for mesh in document.getElementsByTagName("mesh") if _moved(robot, out) else ():
        path = mesh.getAttribute("filename")
        if path and "://" not in path and not os.path.isabs(path):  # package:// stays
            _set(mesh, filename=os.path.relpath(robot.parent / path, out.parent))


def _moved(robot: Path, out: Path) -> bool:
    return robot.parent.resolve() != out.parent.resolve()


def _change_mjcf(document: Node, robot: Path, out: Path, changes: Sequence[JointChange]) -> None:
    joints, bodies = document.getElementsByTagName("joint"), document.getElementsByTagName("body")
    compilers = document.getElementsByTagName("compiler")
    for compiler in compilers if any(change.inertial is not None for change in changes) else ():
        if compiler.getAttribute("inertiafromgeom") == "true":
            _set(compiler, inertiafromgeom="auto")
    for change in changes:
        joint = _named(robot, joints, change.joint, "joint")
        _set(joint, damping=change.damping, frictionloss=change.frictionloss, armature=change.armature)
        if (new := change.inertial) is not None:
            inertial = _child(_named(robot, bodies, new.body, "body"), "inertial")
            for name in ("axisangle", "xyaxes", "zaxis", "euler", "fullinertia"):
                if inertial.hasAttribute(name):
                    inertial.removeAttribute(name)
            _set(inertial, pos=new.com, quat=new.axes, mass=new.mass, diaginertia=new.inertia)
        if change.drive is not None:
            _set_drive(document.documentElement, change.joint, change.drive)
    if _moved(robot, out):
        kept = [one.getAttribute("meshdir") or one.getAttribute("assetdir") for one in compilers]
        folder = robot.parent / next(filter(None, kept), ".")
        compiler = compilers[0] if compilers else _child(document.documentElement, "compiler")
        _set(compiler, meshdir=os.path.relpath(folder, out.parent))


def _set_drive(root: Node, joint: str, drive: Drive) -> None:
    """An actuator `dcmotor` with the servo's gain in torque space; it replaces one that the joint has."""
    actuators = _child(root, "actuator")
    for one in list(actuators.childNodes):
        if one.nodeType == one.ELEMENT_NODE and one.getAttribute("joint") == joint:
            actuators.removeChild(one)
    constant = (drive.nm_per_ampere, drive.nm_per_ampere)
    motor = _added(actuators, "dcmotor")
    _set(motor, name=joint, joint=joint, resistance=drive.ohm, motorconst=constant, input="pos")
    _set(motor, controller=(drive.kp, 0, drive.kd, 0, 0, 0), saturation=(drive.most_nm, 0, 0))


def _add_sensors(document: Node, changes: Sequence[JointChange]) -> list[str]:
    """SENSORS that the joints lack, behind the file's own, whose places in `sensordata` stay; returns their names."""
    wanted = [
        (kind, change.joint, deviation)
        for change in changes
        for kind, deviation in zip(SENSORS, change.noise, strict=False)
        if all(one.getAttribute("joint") != change.joint for one in document.getElementsByTagName(kind))
    ]
    section = _added(document.documentElement, "sensor") if wanted else None
    for kind, joint, deviation in wanted:
        _set(_added(section, kind), name=f"{SENSOR_PREFIX}{kind}_{joint}", joint=joint, noise=deviation)
    return [f"{SENSOR_PREFIX}{kind}_{joint}" for kind, joint, _ in wanted]
