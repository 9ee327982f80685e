"""What a URDF says of masses, inertias, joints and their limits, read as text: before anything refuses to load it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from tauext.check.finding import Finding

MOVING = ("revolute", "continuous", "prismatic")
TRIANGLE = 1e-3
"""Share by which a principal inertia may exceed the sum of the others: files round."""


def read_xml(path: Path) -> ElementTree.Element | None:
    """Root of a URDF; None where the file is none, an MJCF for instance, which MuJoCo checks itself."""
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
    """(joints, 2) lower and upper limit, [rad or m]; infinite where the file has none."""
    limits = np.tile([-math.inf, math.inf], (len(joints), 1))
    for joint in [] if root is None else root.findall("joint"):
        limit = joint.find("limit")
        if joint.get("name") not in joints or joint.get("type") == "continuous" or limit is None:
            continue
        try:
            low, high = float(limit.get("lower", "0")), float(limit.get("upper", "0"))
        except ValueError:
            continue
        if high > low:  # both 0: none are stated
            limits[list(joints).index(joint.get("name", ""))] = low, high
    return limits


def model_findings(root: ElementTree.Element | None, joints: Sequence[str]) -> list[Finding]:
    """Masses and inertias of the links that these joints move."""
    if root is None:
        return []
    links = {link.get("name"): link for link in root.findall("link")}
    found = []
    for joint in root.findall("joint"):
        child = joint.find("child")
        if joint.get("name") not in joints or child is None:  # the tree says what is wrong with such a joint
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
            evidence = f"link '{name}' and what is fixed to it have no mass"
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
    told = ", ".join(f"{x:.3g}" for x in principal)
    if principal[0] <= 0:
        return f"principal inertias {told} kg m^2: not positive"
    if principal[2] > (principal[0] + principal[1]) * (1 + TRIANGLE):
        return f"principal inertias {told} kg m^2: the largest exceeds the sum of the others"
    return None
