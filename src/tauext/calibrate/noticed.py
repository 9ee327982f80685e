r"""What force on the arm is noticed: the least that puts a joint over its limit, by pose, point and direction.

.. math:: F(q, p, d) = \min_j \frac{\text{limit}_j}{|(J_p(q)^\top d)_j|}

The force stays: the observer answers one that steps up with 1 - exp(-K0 t), and an alarm comes after its hold time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tauext._core import Bundle, WrenchModel
from tauext.errors import ConfigError

POSES = 64
"""Kept of a training: quantiles of 64 poses are those of a thousand to some percent."""
DIRECTIONS = 64
"""Of half a sphere, 14 degrees apart."""
BLIND_N = 1000.0
"""A force that needs more than this to be noticed is not."""
AXES = ("x", "y", "z")
LEVELS = ("contact", "collision")
REGIONS = ("in motion", "at rest")


@dataclass(frozen=True)
class Noticed:
    """Of a force at one point and level, over all poses; NaN where the arm is blind in more than half of them, [N]."""

    level: str
    region: str
    median_n: float
    """Over poses and directions."""
    by_axis_n: dict[str, tuple[float, float]]
    """Along the base's x, y and z: median and worst pose."""
    worst_n: tuple[float, float]
    """In the direction that is worst in each pose: median and worst pose; inf: blind there."""
    blind_share: float
    """Of the poses, in which some direction is not noticed up to BLIND_N."""


@dataclass(frozen=True)
class NoticedAt:
    """A point of the arm."""

    where: str
    frame: str
    point_m: tuple[float, float, float]
    """In the frame's axes."""
    forces: tuple[Noticed, ...]
    """Of each level and region."""


def spread_poses(q: Sequence[np.ndarray]) -> np.ndarray:
    """POSES rows or fewer, evenly in time over these recordings' positions."""
    rows = np.concatenate([np.asarray(one) for one in q])
    return rows[np.unique(np.linspace(0, len(rows) - 1, min(POSES, len(rows))).round().astype(int))]


def noticed_forces(bundle: Bundle, poses: ArrayLike, frames: Sequence[str] = ()) -> list[NoticedAt]:
    """Of each link's far end, of the load's frame and of the frames asked for.

    Limits are those of usual motion and of rest; unusual motion has higher ones.

    Args:
        poses: (poses, joints), [rad].

    Raises:
        ConfigError: the bundle tells no forces, there is no such frame, or a pose is not finite or of another arm.
    """
    model = WrenchModel(bundle)
    if model.refused:
        raise ConfigError(f"what force is noticed is not known: {model.refused}")
    poses = np.asarray(poses, dtype=float)
    if poses.ndim != 2 or poses.shape[1] != bundle.joints or not len(poses) or not np.isfinite(poses).all():
        raise ConfigError(f"poses of shape {poses.shape} must be finite, (poses, {bundle.joints})")
    known = {frame.name for frame in model.frames}
    for frame in frames:
        if frame not in known:
            raise ConfigError(f"frame {frame!r} must be one of {', '.join(one.name for one in model.frames)}")
    limits = limits_of(bundle)
    directions = half_sphere(DIRECTIONS)
    found = []
    for where, frame, point in points_of(bundle, frames):
        columns = np.array(
            [model.columns(frame, pose.tolist(), list(point))[:3] for pose in poses]
        )  # (poses, 3, joints)
        told = []
        for (level, region), limit in limits.items():
            with np.errstate(divide="ignore"):
                by_axis = 1 / (np.abs(columns) / limit).max(axis=2)
                by_direction = 1 / (np.abs(np.einsum("di,pij->pdj", directions, columns)) / limit).max(axis=2)
            told.append(summary(level, region, by_axis, by_direction))
        found.append(NoticedAt(where, frame, point, tuple(told)))
    return found


def summary(level: str, region: str, by_axis: np.ndarray, by_direction: np.ndarray) -> Noticed:
    """Args: by_axis: (poses, 3); by_direction: (poses, directions), [N]."""
    by_axis, by_direction = (np.where(one <= BLIND_N, one, np.inf) for one in (by_axis, by_direction))
    worst = np.maximum(by_direction.max(axis=1), by_axis.max(axis=1))
    return Noticed(
        level,
        region,
        middle(by_direction),
        {axis: (middle(column), float(column.max())) for axis, column in zip(AXES, by_axis.T, strict=True)},
        (middle(worst), float(worst.max())),
        float(np.mean(np.isinf(worst))),
    )


def middle(values: np.ndarray) -> float:
    """The median, which may be infinite."""
    ordered = np.sort(values, axis=None)
    return float(ordered[len(ordered) // 2])


def limits_of(bundle: Bundle) -> dict[tuple[str, str], np.ndarray]:
    """A joint: by level and region."""
    lists = {
        ("contact", "in motion"): bundle.contact_sliding_limit_nm,
        ("contact", "at rest"): bundle.contact_near_stiction_limit_nm,
        ("collision", "in motion"): bundle.sliding_limit_nm,
        ("collision", "at rest"): bundle.near_stiction_limit_nm,
    }
    return {key: np.array(values) for key, values in lists.items()}


def points_of(bundle: Bundle, frames: Sequence[str]) -> list[tuple[str, str, tuple[float, float, float]]]:
    """Where, in which frame, and the point there: links' ends at the next joints, the load's frame, and frames."""
    found: list[tuple[str, str, tuple[float, float, float]]] = []
    for number, link in enumerate(bundle.links):
        for other in bundle.links:
            if other.parent == number:
                x, y, z = other.translation
                found.append((f"link of {link.joint_name}, at {other.joint_name}", link.joint_name, (x, y, z)))
    load = bundle.load_settings
    last = bundle.links[-1].joint_name
    named = [load.frame] if load.link >= 0 else [last]
    return found + [(name, name, (0.0, 0.0, 0.0)) for name in dict.fromkeys([*named, *frames])]


def half_sphere(count: int) -> np.ndarray:
    """Unit vectors evenly over the upper half of a sphere, (count, 3): a force and its opposite are noticed alike."""
    z = (np.arange(count) + 0.5) / count
    turned = np.pi * (1 + 5**0.5) * np.arange(count)
    across = np.sqrt(1 - z**2)
    return np.column_stack([across * np.cos(turned), across * np.sin(turned), z])


def facts_of(found: Sequence[NoticedAt]) -> list[dict]:
    """As plain JSON; null: not noticed."""

    def number(value: float) -> float | None:
        return value if np.isfinite(value) else None

    return [
        {
            "where": at.where,
            "frame": at.frame,
            "point_m": list(at.point_m),
            "forces": [
                {
                    "level": one.level,
                    "region": one.region,
                    "median_n": number(one.median_n),
                    "by_axis_n": {axis: [number(v) for v in values] for axis, values in one.by_axis_n.items()},
                    "worst_direction_n": [number(value) for value in one.worst_n],
                    "blind_share": one.blind_share,
                }
                for one in at.forces
            ],
        }
        for at in found
    ]
