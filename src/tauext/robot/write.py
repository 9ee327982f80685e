"""Write a dataset's robot file: the arm's own, with the given payload, rotor inertia and gravity."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

from tauext.errors import RobotError
from tauext.files.atomic_write import atomic_write
from tauext.robot.compile import xml_as_given
from tauext.robot.read import read_robot
from tauext.robot.xml_file import read_xml

NO_MODEL = "no_model"
"""Name of a placeholder robot."""
PAYLOAD = "tauext_payload"
"""Name of the link that a payload becomes."""


@dataclass(frozen=True)
class Payload:
    """Rigid load of a link."""

    link: str
    mass_kg: float
    com_m: Sequence[float]
    """Centre of mass in the link's frame, [m]."""
    inertia_kg_m2: Sequence[float]
    """Inertia about the centre of mass along the link's axes: xx, yy, zz, xy, xz, yz."""


def write_robot(
    source: Path,
    folder: Path,
    rotor_inertia: Mapping[str, tuple[float, float]],
    payload: Payload | None = None,
    gravity: Sequence[float] | None = None,
) -> Path:
    """Copy a URDF or MJCF into a folder as robot.urdf or robot.xml with the given changes; returns its path.

    Without changes a URDF is copied byte for byte. An MJCF is rewritten from MuJoCo's model without shapes and meshes,
    whose files would be missing.

    Args:
        rotor_inertia: joint: motor inertia [kg m^2] and gear ratio; it replaces the file's value of that joint.
        gravity: acceleration of free fall in the base frame, [m/s^2].

    Raises:
        RobotError: the file cannot be read, or has no such joint or link.
    """
    root = read_xml(source).root
    if root.tag == "robot":
        if not (rotor_inertia or payload or gravity):
            return _write(folder / "robot.urdf", source.read_bytes())
        _change_urdf(root, source, rotor_inertia, payload, gravity)
        return _write(folder / "robot.urdf", _urdf(root))
    return _write(folder / "robot.xml", _changed_mjcf(source, rotor_inertia, payload, gravity).encode())


def write_placeholder(joints: Sequence[str], folder: Path) -> Path:
    """Write a robot.urdf for an arm without a model: these joints in series with massless links; returns its path.

    Its momentum and gravity are zero up to rounding; its axes and lengths are arbitrary.
    """
    mass_kg = 1e-9  # a moving link must have a mass
    root = ElementTree.Element("robot", name=NO_MODEL)
    root.append(ElementTree.Comment(" no model was given: axes and lengths are made up, masses nil "))
    ElementTree.SubElement(root, "link", name="base")
    parent = "base"
    for joint in joints:
        link = ElementTree.SubElement(root, "link", name=f"{joint}_link")
        _inertial(link, (0, 0, 0), mass_kg, (mass_kg,) * 3 + (0, 0, 0))
        element = ElementTree.SubElement(root, "joint", name=joint, type="continuous")
        ElementTree.SubElement(element, "parent", link=parent)
        ElementTree.SubElement(element, "child", link=f"{joint}_link")
        ElementTree.SubElement(element, "axis", xyz="0 0 1")
        parent = f"{joint}_link"
    return _write(folder / "robot.urdf", _urdf(root))


def _urdf(root: ElementTree.Element) -> bytes:
    ElementTree.indent(root)
    return bytes(ElementTree.tostring(root, encoding="utf-8", xml_declaration=True))


def is_placeholder(path: Path) -> bool:
    """Whether write_placeholder() wrote this robot file, that is, there is no model; False if unreadable."""
    try:
        return read_xml(path).root.get("name") == NO_MODEL
    except RobotError:
        return False


def _change_urdf(
    root: ElementTree.Element,
    source: Path,
    rotor_inertia: Mapping[str, tuple[float, float]],
    payload: Payload | None,
    gravity: Sequence[float] | None,
) -> None:
    joints = [joint.get("name", "") for joint in root.findall("joint")]
    for joint, (inertia, gear) in rotor_inertia.items():
        _require(source, "joint", joint, joints)
        for transmission in root.findall("transmission"):
            if [j.get("name") for j in transmission.findall("joint")] == [joint]:
                for actuator in transmission.findall("actuator"):
                    for old in [c for c in actuator if c.tag.rpartition(":")[2] == "rotor_inertia"]:
                        actuator.remove(old)
        transmission = ElementTree.SubElement(root, "transmission", name=f"tauext_{joint}")
        ElementTree.SubElement(transmission, "joint", name=joint)
        actuator = ElementTree.SubElement(transmission, "actuator", name=f"tauext_{joint}")
        ElementTree.SubElement(actuator, "rotor_inertia").text = repr(inertia)
        ElementTree.SubElement(actuator, "gear_ratio").text = repr(gear)
    if payload:
        _require(source, "link", payload.link, [link.get("name", "") for link in root.findall("link")])
        carried = ElementTree.SubElement(root, "link", name=PAYLOAD)
        _inertial(carried, payload.com_m, payload.mass_kg, payload.inertia_kg_m2)
        fixed = ElementTree.SubElement(root, "joint", name=PAYLOAD, type="fixed")
        ElementTree.SubElement(fixed, "parent", link=payload.link)
        ElementTree.SubElement(fixed, "child", link=PAYLOAD)
    if gravity:
        extension = root.find("mujoco")
        extension = ElementTree.SubElement(root, "mujoco") if extension is None else extension
        option = extension.find("option")
        option = ElementTree.SubElement(extension, "option") if option is None else option
        option.set("gravity", " ".join(map(repr, gravity)))


def _inertial(link: ElementTree.Element, com: Sequence[float], mass: float, inertia: Sequence[float]) -> None:
    inertial = ElementTree.SubElement(link, "inertial")
    ElementTree.SubElement(inertial, "origin", xyz=" ".join(map(repr, com)), rpy="0 0 0")
    ElementTree.SubElement(inertial, "mass", value=repr(mass))
    xx, yy, zz, xy, xz, yz = map(repr, inertia)
    ElementTree.SubElement(inertial, "inertia", ixx=xx, iyy=yy, izz=zz, ixy=xy, ixz=xz, iyz=yz)


def _changed_mjcf(
    source: Path,
    rotor_inertia: Mapping[str, tuple[float, float]],
    payload: Payload | None,
    gravity: Sequence[float] | None,
) -> str:
    spec, model = read_robot(source)
    for body in spec.bodies[1:]:  # keep a mass that was computed from shapes
        row = body.id
        body.mass, body.ipos, body.iquat = model.body_mass[row], model.body_ipos[row], model.body_iquat[row]
        body.inertia, body.fullinertia = model.body_inertia[row], [float("nan")] + [0.0] * 5
        body.explicitinertial = True
    shapes = (spec.pairs, spec.excludes, spec.sensors, spec.geoms, spec.skins, spec.meshes, spec.hfields)
    for part in (*shapes, spec.materials, spec.textures):
        for one in list(part):
            spec.delete(one)
    joints = {joint.name: joint for joint in spec.joints}
    for name, (inertia, gear) in rotor_inertia.items():
        _require(source, "joint", name, list(joints))
        joints[name].armature = inertia * gear**2
        for actuator in spec.actuators:
            if actuator.target == name:
                actuator.armature = 0.0
    if payload:
        bodies = {body.name: body for body in spec.bodies}
        _require(source, "link", payload.link, list(bodies))
        carried = bodies[payload.link].add_body(name=PAYLOAD, mass=payload.mass_kg, ipos=list(payload.com_m))
        carried.fullinertia = list(payload.inertia_kg_m2)
        carried.explicitinertial = True
    if gravity:
        spec.option.gravity = list(gravity)
    return xml_as_given(spec)


def _require(source: Path, kind: str, name: str, there: list[str]) -> None:
    if name not in there:
        near = difflib.get_close_matches(name, there, 3, 0.3)
        hint = f"similar: {', '.join(near)}" if near else f"its {kind}s are {', '.join(there)}"
        raise RobotError(f"{source}: no {kind} {name!r}; {hint}")


def _write(path: Path, content: bytes) -> Path:
    with atomic_write(path) as part:
        part.write_bytes(content)
    return path
