"""Capsules whose surface is as near as can be to a given one."""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from tauext.robot.shapes import Shape

MOST_POINTS = 600
"""Of a mesh; more do not move a capsule."""
GOOD_SHARE, GOOD_M = 0.15, 0.01
"""A capsule is good enough whose surface is, root mean square, so near to the given one: as a share of its radius, or
1 cm, which is less than a place is known to."""
MOST_SPLITS = 2
"""One shape becomes four capsules at most."""
LEAST_RADIUS_M = 1e-3


def as_capsules(shape: Shape) -> list[tuple[np.ndarray, np.ndarray, float]]:
    """Both ends and the radius of each, [m]."""
    if shape.points is None:
        return [(shape.start, shape.end, shape.radius_m)]
    assert shape.areas is not None
    points, areas = thinned(shape.points, shape.areas)
    return split(points, areas, MOST_SPLITS) if len(points) else []


def thinned(points: np.ndarray, areas: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Drawn by their areas, always the same way; degenerate triangles left out."""
    sound = np.isfinite(points).all(axis=1) & (areas > 0)
    points, areas = points[sound], areas[sound]
    if len(points) <= MOST_POINTS:
        return points, areas
    drawn = np.random.default_rng(0).choice(len(points), MOST_POINTS, p=areas / areas.sum())
    return points[drawn], np.full(MOST_POINTS, areas.sum() / MOST_POINTS)


def split(points: np.ndarray, areas: np.ndarray, most: int) -> list[tuple[np.ndarray, np.ndarray, float]]:
    """One capsule, or those of both halves where it is bad."""
    start, end, radius, rms = fitted(points, areas)
    if rms <= max(GOOD_SHARE * radius, GOOD_M) or most == 0 or len(points) < 24:
        return [(start, end, radius)]
    first = halves(points, areas)
    if min(first.sum(), (~first).sum()) < 8:
        return [(start, end, radius)]
    return split(points[first], areas[first], most - 1) + split(points[~first], areas[~first], most - 1)


def halves(points: np.ndarray, areas: np.ndarray) -> np.ndarray:
    """Which points are of the first of two groups around middles of their own."""
    along = main_axis(points, areas)
    at = (points - np.average(points, axis=0, weights=areas)) @ along
    first = at > np.median(at)
    for _ in range(20):
        middles = [np.average(points[part], axis=0, weights=areas[part]) for part in (first, ~first)]
        nearer = np.linalg.norm(points - middles[0], axis=1) < np.linalg.norm(points - middles[1], axis=1)
        if (nearer == first).all() or nearer.all() or not nearer.any():
            break
        first = nearer
    return first


def main_axis(points: np.ndarray, areas: np.ndarray) -> np.ndarray:
    off = points - np.average(points, axis=0, weights=areas)
    return np.linalg.eigh((off * areas[:, None]).T @ off)[1][:, -1]


def fitted(points: np.ndarray, areas: np.ndarray) -> tuple[np.ndarray, np.ndarray, float, float]:
    """By least squares of the distance of the points from the capsule's surface; the last is its root mean square."""
    middle, along = np.average(points, axis=0, weights=areas), main_axis(points, areas)
    at = (points - middle) @ along
    across = np.linalg.norm(points - middle - at[:, None] * along, axis=1)
    radius = float(np.average(across, weights=areas))
    reach = max(float(np.quantile(np.abs(at), 0.98)) - radius, 0.05 * radius)
    weights = np.sqrt(areas / areas.sum())

    def distance(x: np.ndarray) -> np.ndarray:
        start, way = x[:3], x[3:6] - x[:3]
        share = np.clip((points - start) @ way / max(float(way @ way), 1e-12), 0, 1)
        return weights * (np.linalg.norm(points - start - share[:, None] * way, axis=1) - x[6])

    found = least_squares(distance, np.r_[middle - reach * along, middle + reach * along, radius], max_nfev=60)
    start, end, radius = found.x[:3], found.x[3:6], max(abs(float(found.x[6])), LEAST_RADIUS_M)
    return start, end, radius, float(np.sqrt(2 * found.cost))
