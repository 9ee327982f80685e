"""A URDF of a bundle's links, so that a viewer draws the arm: shapes as capsules, else bars from joint to joint.

The last link's bar goes to the frames on it.
"""

from __future__ import annotations

from collections.abc import Sequence
from xml.etree import ElementTree

import numpy as np

from tauext._core import Capsule, JointType, Link, WrenchFrame


def viewer_urdf(
    links: Sequence[Link], capsules: Sequence[Capsule], frames: Sequence[WrenchFrame], base: str, bar_m: float = 0.015
) -> str:
    """URDF whose links have the names of their joints and the frames of the core, in kg, m and rad.

    It is for drawing: masses are left out.

    Args:
        base: name of the link that nothing moves.
        bar_m: radius of the bar of a link without a shape, [m].
    """
    root = ElementTree.Element("robot", name="arm")
    material = ElementTree.SubElement(root, "material", name="link")
    ElementTree.SubElement(material, "color", rgba="0.62 0.66 0.70 1")
    shapes: list[list[Capsule]] = [[] for _ in range(len(links) + 1)]
    for one in capsules:
        shapes[one.link].append(one)
    for number, name in [(-1, base), *enumerate(link.joint_name for link in links)]:
        element = ElementTree.SubElement(root, "link", name=name)
        ends = [link.translation for link in links if link.parent == number]
        ends = ends or [frame.translation for frame in frames if frame.link == number]
        for one in shapes[number] or [Capsule(number, [0, 0, 0], end, bar_m) for end in ends]:
            _draw(element, one)
    for link in links:
        kind = "prismatic" if link.type == JointType.prismatic else "continuous"
        joint = ElementTree.SubElement(root, "joint", name=link.joint_name, type=kind)
        ElementTree.SubElement(joint, "parent", link=base if link.parent < 0 else links[link.parent].joint_name)
        ElementTree.SubElement(joint, "child", link=link.joint_name)
        _origin(joint, np.asarray(link.translation), np.reshape(link.rotation, (3, 3)))
        ElementTree.SubElement(joint, "axis", xyz="0 0 1")
        if kind == "prismatic":  # readers expect limits, and a bundle has none
            ElementTree.SubElement(joint, "limit", lower="-100", upper="100", effort="0", velocity="0")
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True)


def _draw(link: ElementTree.Element, capsule: Capsule) -> None:
    """A cylinder and a sphere at each end: URDF has no capsules."""
    start, end = np.asarray(capsule.start), np.asarray(capsule.end)
    length, radius = float(np.linalg.norm(end - start)), f"{capsule.radius_m:.6g}"
    ends = [start] if length < 1e-6 else [start, end]
    for point in ends:
        ElementTree.SubElement(_visual(link, point, np.eye(3)), "sphere", radius=radius)
    if len(ends) == 2:
        geometry = _visual(link, (start + end) / 2, _along((end - start) / length))
        ElementTree.SubElement(geometry, "cylinder", radius=radius, length=f"{length:.6g}")


def _visual(link: ElementTree.Element, point: np.ndarray, rotation: np.ndarray) -> ElementTree.Element:
    visual = ElementTree.SubElement(link, "visual")
    _origin(visual, point, rotation)
    geometry = ElementTree.SubElement(visual, "geometry")
    ElementTree.SubElement(visual, "material", name="link")
    return geometry


def _origin(element: ElementTree.Element, point: np.ndarray, rotation: np.ndarray) -> None:
    xyz, rpy = (" ".join(f"{value + 0.0:.9g}" for value in part) for part in (point, roll_pitch_yaw(rotation)))
    ElementTree.SubElement(element, "origin", xyz=xyz, rpy=rpy)


def _along(z: np.ndarray) -> np.ndarray:
    """A rotation whose third column is this unit vector."""
    x = np.cross(np.eye(3)[int(np.argmin(np.abs(z)))], z)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def roll_pitch_yaw(rotation: np.ndarray) -> tuple[float, float, float]:
    """Angles of URDF: R = Rz(yaw) Ry(pitch) Rx(roll), [rad]."""
    flat = float(np.hypot(rotation[0, 0], rotation[1, 0]))
    pitch = float(np.arctan2(-rotation[2, 0], flat))
    if flat > 1e-9:
        roll = float(np.arctan2(rotation[2, 1], rotation[2, 2]))
        return roll, pitch, float(np.arctan2(rotation[1, 0], rotation[0, 0]))
    return float(np.arctan2(-rotation[1, 2], rotation[1, 1])), pitch, 0.0  # only the sum of roll and yaw is known
