"""Read a URDF into a MuJoCo specification: links, joints, inertia, rotor inertia; no shapes, no limits."""

from __future__ import annotations

import difflib
import math
from collections import Counter, defaultdict
from collections.abc import Iterable
from xml.etree import ElementTree

import mujoco
import numpy as np

from tauext.errors import RobotError
from tauext.robot.xml_file import XmlFile

MOVING = {
    "revolute": mujoco.mjtJoint.mjJNT_HINGE,
    "continuous": mujoco.mjtJoint.mjJNT_HINGE,
    "prismatic": mujoco.mjtJoint.mjJNT_SLIDE,
}
SEVERAL_AXES = ("floating", "planar", "spherical")
ATTRIBUTES = {
    "link": ("name",),
    "joint": ("name", "type"),
    "parent": ("link",),
    "child": ("link",),
    "origin": ("xyz", "rpy", "quat_xyzw"),
    "axis": ("xyz",),
    "mass": ("value",),
    "inertia": ("ixx", "iyy", "izz", "ixy", "ixz", "iyz"),
    "mimic": ("joint", "multiplier", "offset"),
}
"""Attributes that are read; a mistyped one would otherwise become a default without a word."""
ELEMENTS = {
    "link": ("inertial",),
    "joint": ("origin", "parent", "child", "axis", "mimic"),
    "inertial": ("origin", "mass", "inertia"),
}


def urdf_spec(file: XmlFile) -> mujoco.MjSpec:
    """The links and joints of a URDF as MuJoCo's bodies and joints.

    A joint of several axes (floating, planar) becomes a ball joint, which can be held but not used. Links without a
    parent are fixed to the world. The URDF standard has no rotor inertia; Drake's extension is supported: a
    transmission of one joint adds its actuator's `rotor_inertia` times the square of `gear_ratio`, or of the standard's
    `mechanicalReduction`.
    """
    _refuse_xacro(file)
    links, joints = _named(file, "link"), _named(file, "joint")
    behind = _tree(file, links, joints)
    spec = mujoco.MjSpec()
    _set_gravity(file, spec)
    children = {child for ends in behind.values() for _, child in ends}
    waiting, in_spec = [], {}
    for name in links:
        if name not in children:
            waiting.append((name, spec.worldbody if name == "world" else spec.worldbody.add_body(name=name)))
    while waiting:
        name, body = waiting.pop()
        if body is not spec.worldbody:
            _set_inertial(file, links[name], body)
        for joint, child in behind[name]:
            own = body.add_body(name="" if child == "world" else child)  # MuJoCo's own root has that name
            own.pos, own.quat = origin_of(file, joint, _called(joint))
            if (moved := _add_joint(file, joint, own)) is not None:
                in_spec[moved.name] = moved
            waiting.append((child, own))
    for joint in joints.values():
        _add_mimic(file, joint, spec, in_spec)
    for name, inertia in _rotor_inertias(file).items():
        if name in in_spec:
            in_spec[name].armature += inertia
    return spec


# --- Names and their tree.


Named = dict[str, ElementTree.Element]
Behind = dict[str, list[tuple[ElementTree.Element, str]]]


def _refuse_xacro(file: XmlFile) -> None:
    names = [element.get("name", "") for kind in ("link", "joint") for element in file.root.findall(kind)]
    if "${" in "".join(names) or any(str(element.tag).startswith("xacro:") for element in file.root.iter()):
        raise RobotError(f"{file.path}: is a xacro template; expand it first: xacro {file.path.name} > robot.urdf")


def _called(element: ElementTree.Element) -> str:
    return f"{element.tag} {element.get('name', '')!r}"


def _named(file: XmlFile, kind: str) -> Named:
    """The links or joints by name."""
    found: Named = {}
    elements = file.root.findall(kind)
    counts = Counter(element.get("name") for element in elements)
    for element in elements:
        _expect_spelling(file, element, _called(element))
        name = element.get("name")
        if not name:
            raise file.error(element, f"a {kind} has no name; every {kind} needs one")
        if counts[name] > 1:
            again = next(other for other in elements if other is not element and other.get("name") == name)
            raise file.error(
                again,
                f"{counts[name]} {kind}s are named {name!r}, the first in line {file.lines[element]}; every {kind} "
                "needs a name of its own",
            )
        found[name] = element
    return found


def _tree(file: XmlFile, links: Named, joints: Named) -> Behind:
    """Joints and child links behind each link, in the order of the file."""
    behind: Behind = defaultdict(list)
    above: Named = {}
    for joint in joints.values():
        who = _called(joint)
        if (kind := joint.get("type")) not in (types := (*MOVING, "fixed", *SEVERAL_AXES)):
            raise file.error(joint, f"{who}: type = {kind!r} must be one of {', '.join(types)}{_near(kind, types)}")
        ends = []
        for tag in ("parent", "child"):
            element = _child(file, joint, tag, who)
            if element is None:
                raise file.error(joint, f"{who}: has no <{tag} link=...>; every joint needs one")
            name = element.get("link")
            if name is None:
                raise file.error(element, f"{who}: <{tag}> has no link")
            if name not in links:
                raise file.error(element, f"{who}: its {tag} link {name!r} is not in the file{_near(name, links)}")
            ends.append(name)
        parent, child = ends
        if child in above:
            raise file.error(
                joint,
                f"link {child!r} is the child of joints {above[child].get('name')!r} and {joint.get('name')!r}; "
                "a link has one parent: a robot file is a tree without loops",
            )
        above[child] = joint
        behind[parent].append((joint, child))
    _expect_one_base(file, links, behind, above)
    return behind


def _expect_one_base(file: XmlFile, links: Named, behind: Behind, above: Named) -> None:
    """Refuse loops, and parts beside the robot unless they neither move nor have mass."""
    reached: set[str] = set()
    parts = []
    for base in (name for name in links if name not in above):
        part, waiting, counts = [], [base], False
        while waiting:
            name = waiting.pop()
            part.append(name)
            counts |= links[name].find("inertial") is not None
            for joint, child in behind[name]:
                counts |= joint.get("type") != "fixed"
                waiting.append(child)
        reached.update(part)
        if counts:
            parts.append(base)
    if len(parts) > 1:
        raise file.error(
            links[parts[1]],
            f"links {', '.join(map(repr, parts))} have no parent; a robot has one base: fix the others to it with a "
            "joint, or remove them",
        )
    if loop := [name for name in links if name not in reached]:
        raise file.error(
            above[loop[0]],
            f"links {', '.join(map(repr, loop[:5]))}{' ...' * (len(loop) > 5)} hang on each other and not on a base; "
            "a robot file is a tree without loops",
        )


# --- Spelling and numbers.


def _near(name: str | None, there: Iterable[str]) -> str:
    near = difflib.get_close_matches(name or "", list(there), 1, 0.6)
    return f"; did you mean {near[0]!r}?" if near else ""


def _mistyped(unknown: Iterable[str], known: Iterable[str], least: float) -> tuple[str, str] | None:
    """The first unknown word that is probably one of the known ones, and that one."""
    lowered = {name.lower(): name for name in known}
    for word in unknown:
        if near := difflib.get_close_matches(word.lower(), list(lowered), 1, least):
            return word, lowered[near[0]]
    return None


def _expect_spelling(file: XmlFile, element: ElementTree.Element, who: str) -> None:
    """Refuse what is probably a mistyped attribute or child; other unknown ones are ignored."""
    tag = element.tag
    known = ATTRIBUTES.get(tag, ())
    missing = [name for name in known if name not in element.attrib]
    unknown = [name for name in element.attrib if name not in known and ":" not in name]
    if found := _mistyped(unknown, missing, 0.6):
        raise file.error(element, f"{who}: <{tag}> has no attribute {found[0]!r}; did you mean {found[1]!r}?")
    if unknown and known and len(missing) == len(known):
        raise file.error(element, f"{who}: <{tag}> has no attribute {unknown[0]!r}; it has {', '.join(known)}")
    missing = [name for name in ELEMENTS.get(tag, ()) if element.find(name) is None]
    if found := _mistyped((child.tag for child in element), missing, 0.75):
        raise file.error(
            next(c for c in element if c.tag == found[0]), f"{who}: <{found[0]}> is unknown; did you mean <{found[1]}>?"
        )


def numbers_of(
    file: XmlFile,
    element: ElementTree.Element | None,
    key: str,
    who: str,
    count: int = 1,
    default: list[float] | None = None,
    finite: bool = True,
) -> list[float]:
    """The numbers of an attribute. Without a default, the attribute of an element must be there."""
    if element is None or (text := element.get(key)) is None:
        if default is None and element is not None:
            raise file.error(element, f"{who}: <{element.tag}> has no {key}")
        return default or [0.0] * count
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        values = []
    if len(values) == count and (not finite or all(map(math.isfinite, values))):
        return values
    rule = "a finite number" if count == 1 else f"{count} finite numbers, separated by blanks"
    hint = "; the file is a xacro template: expand it first" if "${" in text else ""
    hint = "; a comma is neither a decimal point nor a separator" if "," in text else hint
    raise file.error(element, f"{who}: <{element.tag} {key}={text!r}> must be {rule}{hint}")


def _child(file: XmlFile, of: ElementTree.Element, tag: str, who: str) -> ElementTree.Element | None:
    child = of.find(tag)
    if child is not None:
        _expect_spelling(file, child, who)
    return child


def origin_of(file: XmlFile, of: ElementTree.Element, who: str) -> tuple[list[float], np.ndarray]:
    """Position and quaternion of an element's origin."""
    origin = _child(file, of, "origin", who)
    position = numbers_of(file, origin, "xyz", who, 3, [0.0] * 3)
    if file.root.get("version", "1.0") not in ("1", "1.0") and origin is not None and origin.get("quat_xyzw"):
        x, y, z, w = numbers_of(file, origin, "quat_xyzw", who, 4)
        return position, np.array([w, x, y, z])
    turned = np.array([1.0, 0.0, 0.0, 0.0])
    for axis, angle in zip(np.eye(3), numbers_of(file, origin, "rpy", who, 3, [0.0] * 3), strict=True):
        about, before = np.empty(4), turned.copy()
        mujoco.mju_axisAngle2Quat(about, axis, angle)
        mujoco.mju_mulQuat(turned, about, before)
    return position, turned


# --- One link, one joint.


def _set_inertial(file: XmlFile, link: ElementTree.Element, body: mujoco.MjsBody) -> None:
    """Give a body the link's mass, centre of mass and inertia, whether or not a body can have them."""
    who = _called(link)
    inertial = _child(file, link, "inertial", who)
    if inertial is None:
        return
    mass = _child(file, inertial, "mass", who)
    if mass is None:
        raise file.error(inertial, f"{who}: <inertial> has no <mass>")
    inertia = _child(file, inertial, "inertia", who)
    keys = ATTRIBUTES["inertia"]
    six = [numbers_of(file, inertia, key, who, finite=False)[0] for key in keys[:3]]
    six += [numbers_of(file, inertia, key, who, 1, [0.0], finite=False)[0] for key in keys[3:]]
    body.explicitinertial = True
    body.mass = numbers_of(file, mass, "value", who, finite=False)[0]
    body.ipos, body.iquat = origin_of(file, inertial, who)
    if np.isfinite(six).all():
        body.fullinertia = six
    else:
        body.inertia = [math.nan] * 3


def _add_joint(file: XmlFile, joint: ElementTree.Element, body: mujoco.MjsBody) -> mujoco.MjsJoint | None:
    who, kind = _called(joint), joint.get("type", "")
    if kind == "fixed":
        return None
    if kind in SEVERAL_AXES:
        return body.add_joint(name=joint.get("name"), type=mujoco.mjtJoint.mjJNT_BALL)
    element = _child(file, joint, "axis", who)
    axis = [1.0, 0.0, 0.0] if element is None else numbers_of(file, element, "xyz", who, 3)
    if np.linalg.norm(axis) < 1e-9:
        assert element is not None
        raise file.error(element, f"{who}: <axis xyz={element.get('xyz')!r}> has no direction; give a unit vector")
    return body.add_joint(name=joint.get("name"), type=MOVING[kind], axis=axis)


def _add_mimic(
    file: XmlFile, joint: ElementTree.Element, spec: mujoco.MjSpec, in_spec: dict[str, mujoco.MjsJoint]
) -> None:
    """Make a joint that follows another one dependent; one that follows a fixed or unknown joint is held."""
    who, name = _called(joint), joint.get("name", "")
    mimic = _child(file, joint, "mimic", who)
    if mimic is None or name not in in_spec or joint.get("type") in SEVERAL_AXES:
        return
    factor = numbers_of(file, mimic, "multiplier", who, 1, [1.0])[0]
    offset = numbers_of(file, mimic, "offset", who, 1, [0.0])[0]
    leader = mimic.get("joint", "")
    equality = spec.add_equality(type=mujoco.mjtEq.mjEQ_JOINT, name1=name, objtype=mujoco.mjtObj.mjOBJ_JOINT)
    if leader in in_spec and leader != name:
        equality.name2 = leader
    equality.data[:2] = offset, factor


# --- Rotor inertia and gravity, of extensions.


def _rotor_inertias(file: XmlFile) -> dict[str, float]:
    found: dict[str, float] = {}
    for transmission in file.root.findall("transmission"):
        joints = [joint.get("name", "") for joint in transmission.findall("joint")]
        for actuator in transmission.findall("actuator"):
            given = {str(child.tag).rpartition(":")[2]: child for child in actuator}
            if "rotor_inertia" not in given:
                continue
            if len(joints) != 1:
                raise file.error(
                    transmission, f"rotor inertia in a transmission of {len(joints)} joints; it must be one"
                )
            inertia = _number(file, given["rotor_inertia"], joints[0], least=0.0)
            gear = given.get("gear_ratio", given.get("mechanicalReduction"))
            ratio = 1.0 if gear is None else _number(file, gear, joints[0])
            found[joints[0]] = found.get(joints[0], 0.0) + inertia * ratio**2
    return found


def _number(file: XmlFile, element: ElementTree.Element, joint: str, least: float = -math.inf) -> float:
    """Value of a transmission's element: its attribute `value`, else its text."""
    text = element.get("value", element.text)
    try:
        number = float(text or "")
    except ValueError:
        number = math.nan
    if math.isfinite(number) and number >= least:
        return number
    rule = "a finite number" if least < 0 else f"a finite number >= {least:g}"
    key = str(element.tag).rpartition(":")[2]
    raise file.error(element, f"joint {joint!r}: {key} = {text!r} in its transmission must be {rule}")


def _set_gravity(file: XmlFile, spec: mujoco.MjSpec) -> None:
    """Apply the gravity of MuJoCo's extension of URDF; the standard has none."""
    option = file.root.find("mujoco/option")
    if option is None:
        return
    spec.option.gravity = numbers_of(file, option, "gravity", "extension 'mujoco'", 3, list(spec.option.gravity))
    flag = option.find("flag")
    if flag is not None and flag.get("gravity") == "disable":
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_GRAVITY
