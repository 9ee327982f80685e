"""Shapes of parts of links: capsules, or surfaces that are to become some."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

AROUND = 16
"""Points around a primitive."""


@dataclass(frozen=True)
class Shape:
    """A capsule (a sphere where both ends are one), or points of a surface in its place; [m]."""

    radius_m: float
    start: np.ndarray
    end: np.ndarray
    points: np.ndarray | None = None
    """(n, 3) of the surface; None: it is that capsule."""
    areas: np.ndarray | None = None
    """(n,) that each stands for, [m^2]."""

    def moved(self, rotation: np.ndarray, place: np.ndarray) -> Shape:
        """Turned, then shifted."""
        points = None if self.points is None else self.points @ rotation.T + place
        return replace(self, start=rotation @ self.start + place, end=rotation @ self.end + place, points=points)


def surface(points: np.ndarray, areas: np.ndarray) -> Shape:
    """That has no capsule of its own."""
    return Shape(0.0, np.zeros(3), np.zeros(3), np.asarray(points, dtype=float), np.asarray(areas, dtype=float))


def cylinder(radius: float, half_m: float) -> Shape:
    """Along z; one that is wider than long is a surface."""
    if half_m >= radius:
        end = np.array([0, 0, half_m - radius])
        return Shape(float(radius), -end, end)
    turned = 2 * np.pi * (np.arange(AROUND) + 0.5) / AROUND
    ring = np.column_stack([np.cos(turned), np.sin(turned)])
    points, areas = [], []
    for z in (-half_m / 2, half_m / 2):
        points.append(np.column_stack([radius * ring, np.full(AROUND, z)]))
        areas.append(np.full(AROUND, 2 * np.pi * radius * half_m / AROUND))
    for z in (-half_m, half_m):
        for share in (0.35, 0.8):  # rings that halve the disc
            points.append(np.column_stack([share * radius * ring, np.full(AROUND, z)]))
            areas.append(np.full(AROUND, np.pi * radius**2 / 2 / AROUND))
    return surface(np.concatenate(points), np.concatenate(areas))


def box(half_m: np.ndarray) -> Shape:
    """A grid on each side."""
    grid = (np.arange(AROUND // 2) + 0.5) / (AROUND // 2) * 2 - 1
    u, v = (one.ravel() for one in np.meshgrid(grid, grid))
    points, areas = [], []
    for axis in range(3):
        a, b = (axis + 1) % 3, (axis + 2) % 3
        for sign in (-1.0, 1.0):
            side = np.empty((len(u), 3))
            side[:, axis], side[:, a], side[:, b] = sign * half_m[axis], u * half_m[a], v * half_m[b]
            points.append(side)
            areas.append(np.full(len(u), 4 * half_m[a] * half_m[b] / len(u)))
    return surface(np.concatenate(points), np.concatenate(areas))


def ellipsoid(half_m: np.ndarray) -> Shape:
    """Points of an even sphere, stretched; each for the area that it is stretched to."""
    count = 4 * AROUND**2 // 4
    z = 1 - (2 * np.arange(count) + 1) / count
    turned = np.pi * (1 + 5**0.5) * np.arange(count)
    even = np.column_stack([np.sqrt(1 - z**2) * np.cos(turned), np.sqrt(1 - z**2) * np.sin(turned), z])
    stretched = np.prod(half_m) * np.linalg.norm(even / half_m, axis=1)
    return surface(even * half_m, 4 * np.pi / count * stretched)


def mesh(vertices: np.ndarray, faces: np.ndarray) -> Shape:
    """Middles of its triangles."""
    corners = np.asarray(vertices, dtype=float)[np.asarray(faces)]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    return surface(corners.mean(axis=1), areas)
