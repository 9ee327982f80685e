"""A user's robot file with a twin's parameters: MJCF and URDF keep their text, comments and meshes."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.dom import minidom
from xml.parsers import expat

import mujoco
import numpy as np

from tauext import _core
from tauext.errors import RobotError
from tauext.files.atomic_write import atomic_write
from tauext.robot.read import placed_bodies, read_robot

KINDS = {".xml": "MJCF", ".mjcf": "MJCF", ".urdf": "URDF", ".usd": "USD", ".usda": "USD", ".usdc": "USD"}


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


@dataclass(frozen=True)
class Given:
    """A joint's parameters in the file as it came."""

    damping: float
    frictionloss: float
    armature: float
    motors: float
    """Part of the armature that belongs to actuators."""


def given_of(path: Path, tree: _core.Tree) -> list[Given]:
    """Each joint's parameters in a robot file; a URDF's from its `dynamics`."""
    model, joints, _ = placed_bodies(path, tree)
    dynamics = {}
    if KINDS.get(path.suffix) == "URDF":
        for joint in _document(path).getElementsByTagName("joint"):
            for one in _children(joint, "dynamics"):
                dynamics[joint.getAttribute("name")] = one
    found = []
    for joint, link in zip(joints, tree.links, strict=True):
        dof = int(model.jnt_dofadr[joint])
        one = dynamics.get(link.joint_name)
        loss = float(model.dof_frictionloss[dof] if one is None else one.getAttribute("friction") or 0)
        damping = float(np.ravel(model.dof_damping[dof])[0] if one is None else one.getAttribute("damping") or 0)
        motors = link.rotor_inertia - float(model.dof_armature[dof])
        found.append(Given(damping, loss, link.rotor_inertia, motors))
    return found


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


def write_model(robot: Path, out: Path, changes: Sequence[JointChange], note: str) -> None:
    """Write the robot file with these changes under another name, whole or not at all.

    A file of the same kind keeps its text, comments and meshes; relative paths are made to fit the new folder. From a
    URDF, an MJCF is made by MuJoCo.

    Args:
        note: comment at the head.

    Raises:
        RobotError: of another kind than can be written from this one; no such joint or body; an unreadable file.
    """
    kinds = expect_kinds(robot, out)
    if kinds == ("URDF", "URDF"):
        text = _changed_urdf(robot, out, changes, note)
    else:
        document = _expanded(robot) if kinds[0] == "MJCF" else _converted(robot, out)
        text = _changed_mjcf(document, robot, out, changes, note)
    with atomic_write(out) as part:
        part.write_text(text, encoding="utf-8")


def _document(path: Path) -> Node:
    try:
        return minidom.parseString(path.read_bytes())
    except (expat.ExpatError, ValueError, OSError) as error:
        raise RobotError(f"{path}: cannot be rewritten: {error}") from error


def _children(of: Node, tag: str) -> list[Node]:
    return [one for one in of.childNodes if one.nodeType == one.ELEMENT_NODE and one.tagName == tag]


def _child(of: Node, tag: str) -> Node:
    """The first child of this name, made where there is none, on a line of its own."""
    for one in _children(of, tag):
        return one
    document = of.ownerDocument
    before = of.firstChild
    lead = before.data if before is not None and before.nodeType == before.TEXT_NODE else "\n"
    made = document.createElement(tag)
    of.insertBefore(made, before)
    of.insertBefore(document.createTextNode(lead), made)
    return made


def _text(document: Node, note: str, source: Path | None) -> str:
    """The document below what the source has before its root, and the note as a comment."""
    head = '<?xml version="1.0"?>\n'
    if source is not None:
        begins, parser = [], expat.ParserCreate()
        parser.StartElementHandler = lambda *_: begins.append(parser.CurrentByteIndex)
        content = source.read_bytes()
        parser.Parse(content, True)
        head = content[: begins[0]].decode("utf-8", "replace")
    return f"{head}<!-- {note.replace('--', '- -')} -->\n{document.documentElement.toxml()}\n"


def _numbers(values: Sequence[float]) -> str:
    return " ".join(f"{value:.6g}" for value in values)


def _named(path: Path, elements: Iterator[Node] | list[Node], name: str, kind: str) -> Node:
    for one in elements:
        if one.getAttribute("name") == name:
            return one
    raise RobotError(f"{path}: no {kind} {name!r} to change")


# --- URDF.


def _changed_urdf(robot: Path, out: Path, changes: Sequence[JointChange], note: str) -> str:
    document = _document(robot)
    root = document.documentElement
    for change in changes:
        joint = _named(robot, _children(root, "joint"), change.joint, "joint")
        if change.damping is not None or change.frictionloss is not None:
            dynamics = _child(joint, "dynamics")
            for name, value in (("damping", change.damping), ("friction", change.frictionloss)):
                if value is not None:
                    dynamics.setAttribute(name, f"{value:.6g}")
        if change.armature is not None:  # URDF has no element for it
            comment = document.createComment(f" rotor inertia at the joint: {change.armature:.6g} kg m^2 ")
            joint.insertBefore(comment, joint.firstChild)
        if (new := change.inertial) is not None:
            inertial = _child(_named(robot, _children(root, "link"), new.body, "link"), "inertial")
            origin = _child(inertial, "origin")
            origin.setAttribute("xyz", _numbers(new.com))
            origin.setAttribute("rpy", "0 0 0")
            _child(inertial, "mass").setAttribute("value", f"{new.mass:.6g}")
            full, element = _full(new), _child(inertial, "inertia")
            for name, at in {
                "ixx": (0, 0),
                "iyy": (1, 1),
                "izz": (2, 2),
                "ixy": (0, 1),
                "ixz": (0, 2),
                "iyz": (1, 2),
            }.items():
                element.setAttribute(name, f"{full[at]:.6g}")
    for mesh in document.getElementsByTagName("mesh"):
        _keep_path(mesh, "filename", robot.parent, out.parent)
    return _text(document, note, robot)


def _full(new: Inertial) -> np.ndarray:
    """The inertia in the body's axes, (3, 3)."""
    turned = np.empty(9)
    mujoco.mju_quat2Mat(turned, np.array(new.axes))
    axes = turned.reshape(3, 3)
    return np.asarray((axes * np.array(new.inertia)) @ axes.T)


def _keep_path(element: Node, attribute: str, before: Path, after: Path) -> None:
    """Make a relative path of a file in one folder fit another folder; names with a scheme stay."""
    path = element.getAttribute(attribute)
    if path and "://" not in path and not os.path.isabs(path) and before.resolve() != after.resolve():
        element.setAttribute(attribute, os.path.relpath(before / path, after))


# --- MJCF.


def _expanded(robot: Path, root: Path | None = None) -> Node:
    """The document with the files it includes in their place, as MuJoCo reads them."""
    document, folder = _document(robot), (root or robot).parent
    for include in document.getElementsByTagName("include"):
        of = _expanded(folder / include.getAttribute("file"), root or robot).documentElement
        for one in list(of.childNodes):
            include.parentNode.insertBefore(document.importNode(one, True), include)
        include.parentNode.removeChild(include)
    return document


def _converted(robot: Path, out: Path) -> Node:
    """A URDF as an MJCF; without shapes where MuJoCo cannot read them."""
    try:
        spec = mujoco.MjSpec.from_file(str(robot))
        spec.compiler.fusestatic, spec.compiler.discardvisual = False, False
        spec.compile()
    except ValueError:
        spec, _ = read_robot(robot)
    return minidom.parseString(spec.to_xml().encode())


def _changed_mjcf(document: Node, robot: Path, out: Path, changes: Sequence[JointChange], note: str) -> str:
    joints, bodies = document.getElementsByTagName("joint"), document.getElementsByTagName("body")
    root = document.documentElement
    inertials = any(change.inertial is not None for change in changes)
    for compiler in document.getElementsByTagName("compiler"):
        if inertials and compiler.getAttribute("inertiafromgeom") == "true":
            compiler.setAttribute("inertiafromgeom", "auto")
    for change in changes:
        joint = _named(robot, joints, change.joint, "joint")
        for name in ("damping", "frictionloss", "armature"):
            if (value := getattr(change, name)) is not None:
                joint.setAttribute(name, f"{value:.6g}")
        if (new := change.inertial) is not None:
            inertial = _child(_named(robot, bodies, new.body, "body"), "inertial")
            for name in ("quat", "axisangle", "xyaxes", "zaxis", "euler", "fullinertia"):
                if inertial.hasAttribute(name):
                    inertial.removeAttribute(name)
            inertial.setAttribute("pos", _numbers(new.com))
            inertial.setAttribute("quat", _numbers(new.axes))
            inertial.setAttribute("mass", f"{new.mass:.6g}")
            inertial.setAttribute("diaginertia", _numbers(new.inertia))
        if change.drive is not None:
            _set_drive(document, root, change.joint, change.drive)
    before, after = robot.parent, out.parent
    if before.resolve() != after.resolve():
        folders = document.getElementsByTagName("compiler")
        kept = {one.getAttribute("meshdir") or one.getAttribute("assetdir") for one in folders}
        compiler = folders[0] if folders else _child(root, "compiler")
        compiler.setAttribute("meshdir", os.path.relpath(before / next(iter(kept - {""}), "."), after))
    return _text(document, note, robot if KINDS.get(robot.suffix) == "MJCF" else None)


def _set_drive(document: Node, root: Node, joint: str, drive: Drive) -> None:
    """An actuator `dcmotor` with the servo's gain in torque space; it replaces one that the joint has."""
    actuators = _child(root, "actuator")
    for one in list(actuators.childNodes):
        if one.nodeType == one.ELEMENT_NODE and one.getAttribute("joint") == joint:
            actuators.removeChild(one)
    motor = document.createElement("dcmotor")
    for name, value in {
        "name": joint,
        "joint": joint,
        "resistance": f"{drive.ohm:.6g}",
        "motorconst": _numbers((drive.nm_per_ampere, drive.nm_per_ampere)),
        "input": "pos",
        "controller": _numbers((drive.kp, 0, drive.kd, 0, 0, 0)),
        "saturation": _numbers((drive.most_nm, 0, 0)),
    }.items():
        motor.setAttribute(name, value)
    actuators.appendChild(motor)
    actuators.appendChild(document.createTextNode("\n"))
