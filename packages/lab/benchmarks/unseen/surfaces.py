"""What the arms' links look like: cylinders, as people draw them in robot files, or meshes; and pushes on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from tauext import _core
from tauext.robot import mesh_triangles
from tauext.robot.mesh_files import MeshFinder
from tauext.robot.read import load_tree, placed_bodies


@dataclass(frozen=True)
class Cylinder:
    """Part of a link's surface: its side, and the far end of the arm's last one."""

    link: int
    start_m: tuple[float, float, float]
    end_m: tuple[float, float, float]
    """Of its axis, in the link's frame (origin on the joint's axis, z along it)."""
    radius_m: float
    closed: bool = False
    """Whether the disc at its end can be touched."""

    @property
    def area_m2(self) -> float:
        length = float(np.linalg.norm(np.subtract(self.end_m, self.start_m)))
        return 2 * np.pi * self.radius_m * length + self.closed * np.pi * self.radius_m**2

    def draw(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """A point, evenly over the surface, and the unit vector into the link there."""
        start, way = np.array(self.start_m), np.subtract(self.end_m, self.start_m)
        length = float(np.linalg.norm(way))
        axis = way / length
        across = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
        across /= np.linalg.norm(across)
        angle = rng.uniform(0, 2 * np.pi)
        out = np.cos(angle) * across + np.sin(angle) * np.cross(axis, across)
        if self.closed and rng.uniform() < np.pi * self.radius_m**2 / self.area_m2:
            return np.array(self.end_m) + np.sqrt(rng.uniform()) * self.radius_m * out, -axis
        return start + rng.uniform() * way + self.radius_m * out, -out

    def add_to(self, spec: mujoco.MjSpec, body: mujoco.MjsBody, turn: np.ndarray, shift: np.ndarray) -> None:
        """Add it to a body of MuJoCo, whose frame is reached by turn @ point + shift."""
        ends = np.array([self.start_m, self.end_m]) @ turn.T + shift
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_CYLINDER, fromto=ends.ravel(), size=[self.radius_m, 0, 0])


class Triangles:
    """The mesh of a link, in the link's frame."""

    def __init__(self, link: int, corners: np.ndarray):
        out = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        double = np.linalg.norm(out, axis=1)
        sound = double > 0
        self.link, self._corners, self._inwards = link, corners[sound], -out[sound] / double[sound, None]
        self._areas = np.cumsum(double[sound] / 2)

    @property
    def area_m2(self) -> float:
        return float(self._areas[-1])

    def draw(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        at = int(np.searchsorted(self._areas, rng.uniform() * self._areas[-1]))
        u, v = np.sort(rng.uniform(size=2))
        return np.array([u, v - u, 1 - v]) @ self._corners[at], self._inwards[at]

    def add_to(self, spec: mujoco.MjSpec, body: mujoco.MjsBody, turn: np.ndarray, shift: np.ndarray) -> None:
        """As of a cylinder."""
        corners = self._corners.reshape(-1, 3) @ turn.T + shift
        name = f"mesh {len(spec.meshes)}"
        spec.add_mesh(
            name=name,
            uservert=corners.ravel(),
            userface=np.arange(len(corners)),
            inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
        )
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name)


def meshes_of(model: Path, finder: MeshFinder) -> dict[str, np.ndarray]:
    """Triangles (n, 3, 3) of the links that are meshes alone, by link, in the links' axes.

    Raises:
        OSError, ValueError: a mesh is missing or cannot be read.
    """
    found = {}
    for link in ElementTree.parse(model).getroot().findall("link"):
        shapes = link.findall("collision") or link.findall("visual")
        meshes = [shape.find("geometry/mesh") for shape in shapes]
        parts = []
        for shape, mesh in zip(shapes, meshes, strict=True):
            if mesh is None:
                break
            origin = shape.find("origin")
            place = {} if origin is None else origin.attrib
            at, turned = (np.array(place.get(key, "0 0 0").split(), dtype=float) for key in ("xyz", "rpy"))
            scale = np.array(mesh.get("scale", "1 1 1").split(), dtype=float)
            corners = mesh_triangles.triangles_of(finder.find(mesh.get("filename", "")))
            parts.append(scale * corners @ Rotation.from_euler("xyz", turned).as_matrix().T + at)
        if parts and len(parts) == len(shapes):
            found[link.get("name", "")] = np.concatenate(parts)
    return found


def triangles_of(model: Path, joints: Sequence[str]) -> tuple[Triangles, ...]:
    """The meshes that a URDF's moving links collide as, found in the folders above the file."""
    meshes = meshes_of(model, MeshFinder(model))
    bodies = placed_bodies(model, load_tree(model, joints=list(joints)))[2]
    return tuple(
        Triangles(body.link, meshes[body.name] @ body.rotation.T + body.translation)
        for body in bodies
        if body.name in meshes
    )


def capsules_of(surface: tuple[Cylinder, ...]) -> list[_core.Capsule]:
    """Capsules that end where the cylinders end: what a bundle is told of such links."""
    found = []
    for one in surface:
        start, way = np.array(one.start_m, dtype=float), np.subtract(one.end_m, one.start_m)
        length = float(np.linalg.norm(way))
        cut = way / length * min(one.radius_m, length / 2)
        found.append(_core.Capsule(one.link, (start + cut).tolist(), (start + way - cut).tolist(), one.radius_m))
    return found


SURFACES: dict[str, tuple[Cylinder, ...]] = {
    "ur5": (
        Cylinder(0, (0, -0.06, 0), (0, 0.136, 0), 0.06),
        Cylinder(1, (0, 0, -0.06), (0, 0, 0.06), 0.06),
        Cylinder(1, (0.06, 0, 0), (0.365, 0, 0), 0.054),
        Cylinder(1, (0.425, 0, 0.06), (0.425, 0, -0.07), 0.06),
        Cylinder(2, (0, 0, -0.05), (0, 0, 0.05), 0.048),
        Cylinder(2, (0.05, 0, 0), (0.35, 0, 0), 0.04),
        Cylinder(2, (0.392, 0, -0.05), (0.392, 0, 0.045), 0.042),
        Cylinder(3, (0, 0, 0.04), (0, 0, 0.093), 0.042),
        Cylinder(3, (0, -0.05, 0.093), (0, 0.05, 0.093), 0.04),
        Cylinder(4, (0, 0, 0.04), (0, 0, 0.095), 0.042),
        Cylinder(4, (-0.05, 0, 0.095), (0.04, 0, 0.095), 0.04),
        Cylinder(5, (0, 0, 0.04), (0, 0, 0.14), 0.04, True),
    ),
    "panda": (
        Cylinder(0, (0, 0, -0.19), (0, 0, -0.06), 0.06),
        Cylinder(1, (0, 0, -0.06), (0, 0, 0.06), 0.06),
        Cylinder(1, (0, -0.06, 0), (0, -0.17, 0), 0.06),
        Cylinder(2, (0, 0, -0.146), (0, 0, -0.02), 0.055),
        Cylinder(2, (0, 0, 0), (0.05, 0, 0), 0.055),
        Cylinder(3, (0, 0, -0.06), (0, 0, 0.06), 0.06),
        Cylinder(3, (-0.082, 0.05, 0), (-0.082, 0.14, 0), 0.055),
        Cylinder(4, (0, 0, -0.244), (0, 0, -0.06), 0.05),
        Cylinder(5, (0, 0, -0.03), (0, 0, 0.06), 0.05),
        Cylinder(5, (0.03, 0, 0), (0.088, 0, 0), 0.048),
        Cylinder(6, (0, 0, 0.05), (0, 0, 0.12), 0.045),
        Cylinder(6, (0, -0.08, 0.14), (0, 0.08, 0.14), 0.03),
    ),
    "seven_axis": (
        Cylinder(0, (0, 0, -0.2), (0, 0, -0.06), 0.065),
        Cylinder(1, (0, 0, -0.065), (0, 0, 0.065), 0.065),
        Cylinder(1, (0, -0.06, 0), (0, -0.17, 0), 0.06),
        Cylinder(2, (0, 0, -0.15), (0, 0, -0.02), 0.055),
        Cylinder(2, (0, 0, 0), (0.05, 0, 0), 0.055),
        Cylinder(3, (0, 0, -0.06), (0, 0, 0.06), 0.06),
        Cylinder(3, (-0.08, 0.05, 0), (-0.08, 0.18, 0), 0.055),
        Cylinder(4, (0, 0, -0.2), (0, 0, -0.05), 0.05),
        Cylinder(5, (0, 0, -0.05), (0, 0, 0.05), 0.05),
        Cylinder(5, (0.03, 0, 0), (0.09, 0, 0), 0.045),
        Cylinder(6, (0, 0, 0.04), (0, 0, 0.16), 0.04, True),
    ),
    "kinova": (
        Cylinder(0, (0, 0, 0.06), (0, 0, -0.119), 0.045),
        Cylinder(1, (0, 0, -0.04), (0, 0, 0.05), 0.045),
        Cylinder(1, (-0.03, 0, 0), (-0.41, 0, 0), 0.04),
        Cylinder(2, (0, -0.03, 0), (0, -0.207, -0.011), 0.037),
        Cylinder(3, (0, 0, 0.02), (0, 0, -0.104), 0.033),
        Cylinder(4, (0, 0.02, 0), (0, -0.104, 0), 0.033),
        Cylinder(5, (0, 0, -0.03), (0, 0, -0.13), 0.045, True),
    ),
}
"""By the arm's name; sizes as such arms have them."""


def draw_touch(
    surface: Sequence[Cylinder | Triangles], link: int, widest_rad: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, float]:
    """On this link, evenly over its surface: point [m], direction, both in the link's axes, and the direction's angle
    from the normal, even over the cone, [rad]."""
    parts = [part for part in surface if part.link == link]
    areas = np.array([part.area_m2 for part in parts])
    point, inwards = parts[rng.choice(len(parts), p=areas / areas.sum())].draw(rng)
    direction = within_cone(inwards, widest_rad, rng)
    return point, direction, float(np.arccos(direction @ inwards))


def within_cone(axis: np.ndarray, half_angle_rad: float, rng: np.random.Generator) -> np.ndarray:
    """A direction, even over the cone."""
    cosine = rng.uniform(np.cos(half_angle_rad), 1)
    sideways = np.cross(axis, rng.standard_normal(3))
    sideways /= np.linalg.norm(sideways)
    return cosine * axis + np.sqrt(1 - cosine**2) * sideways
