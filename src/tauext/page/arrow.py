"""Arrows and rods whose shape never changes: they are moved, turned and stretched."""

from __future__ import annotations

import numpy as np
import trimesh
import viser

SECTIONS = 24
HEAD_RADII, HEAD_LENGTHS = 2.4, 5.0
"""Of an arrow's head, in radii of its shaft."""
NOTHING = 1e-4
"""Scale of an arrow that is not shown, [m]. It stays in the scene all the same: a browser makes the program that draws
a thing when it first draws it, and without a GPU that takes it half a second, in the middle of a push."""

NEWTON_M = 0.004
"""Length of an arrow for each newton, [m]."""


class Rod:
    """A round bar from one point to another."""

    def __init__(
        self,
        scene: viser.SceneApi,
        name: str,
        color: tuple[int, int, int],
        radius_m: float,
        park_m: tuple,
        opacity: float | None = None,
    ):
        """
        Args:
            park_m: where it waits while it is not shown, inside of something opaque.
            opacity: of a faint one, 0 to 1.
        """
        self._opacity = opacity
        self._radius, self._park, self._shown = radius_m, park_m, False
        self._shaft = self._add(scene, f"{name}/shaft", trimesh.creation.cylinder(1.0, 1.0, SECTIONS), color)

    def show(self, start: np.ndarray, end: np.ndarray) -> None:
        """Reach from start to end, (3,) each."""
        self._shown = True
        self._reach(self._shaft, start, end, self._radius)

    def hide(self) -> None:
        if self._shown:
            self._shown = False
            for part in self._parts():
                part.position, part.scale = self._park, NOTHING

    def _parts(self) -> list[viser.MeshHandle]:
        return [self._shaft]

    def _add(self, scene: viser.SceneApi, name: str, mesh: trimesh.Trimesh, color: tuple) -> viser.MeshHandle:
        """The mesh, of length 1 along z from the origin on."""
        mesh.apply_translation([0.0, 0.0, -mesh.bounds[0, 2]])
        return scene.add_mesh_simple(
            name,
            mesh.vertices,
            mesh.faces,
            color=color,
            cast_shadow=False,
            scale=NOTHING,
            position=self._park,
            opacity=self._opacity,
        )

    @staticmethod
    def _reach(part: viser.MeshHandle, start: np.ndarray, end: np.ndarray, radius_m: float) -> None:
        length = float(np.linalg.norm(end - start))
        part.position, part.scale = start, (radius_m, radius_m, max(length, NOTHING))
        part.wxyz = turn_from_z((end - start) / max(length, 1e-12))


class Arrow(Rod):
    """A rod with a head at its end; one shorter than its head shrinks as a whole."""

    def __init__(
        self,
        scene: viser.SceneApi,
        name: str,
        color: tuple[int, int, int],
        radius_m: float,
        park_m: tuple,
        opacity: float | None = None,
    ):
        super().__init__(scene, name, color, radius_m, park_m, opacity)
        self._head = self._add(scene, f"{name}/head", trimesh.creation.cone(1.0, 1.0, SECTIONS), color)

    def show(self, start: np.ndarray, end: np.ndarray) -> None:
        self._shown = True
        length = float(np.linalg.norm(end - start))
        shrink = min(1.0, 0.5 * length / (HEAD_LENGTHS * self._radius))
        neck = end - (end - start) * (shrink * HEAD_LENGTHS * self._radius / max(length, 1e-12))
        self._reach(self._shaft, start, neck, shrink * self._radius)
        self._reach(self._head, neck, end, shrink * HEAD_RADII * self._radius)

    def _parts(self) -> list[viser.MeshHandle]:
        return [self._shaft, self._head]


def turn_from_z(direction: np.ndarray) -> np.ndarray:
    """Quaternion w, x, y, z of the shortest turn from z to a unit vector (3,); the zero vector turns nothing."""
    quaternion = np.array([1.0 + direction[2], -direction[1], direction[0], 0.0])
    length = np.linalg.norm(quaternion)
    return quaternion / length if length > 1e-6 else np.array([0.0, 1.0, 0.0, 0.0])
