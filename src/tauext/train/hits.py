"""Where links are hit: forces in every direction at the ends of links, in usual poses."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tauext import _core
from tauext.errors import BundleError, ConfigError


@dataclass(frozen=True)
class Point:
    """Where a force acts: a point of a frame of the bundle, [m] along the frame's own axes."""

    name: str
    frame: str
    point_m: tuple[float, ...] = (0.0, 0.0, 0.0)


def points(bundle: _core.Bundle, frames: Sequence[str] = ()) -> list[Point]:
    """The end of each link, the load's frame, and the requested frames.

    The end of a link is the origin of the joint that it carries, of several the farthest; that of a last link is the
    load's frame if it is fixed there, else the link's own origin.

    Raises:
        BundleError: the bundle cannot estimate forces.
        ConfigError: there is no such frame.
    """
    model = _core.WrenchModel(bundle)
    if model.refused:
        raise BundleError(f"{bundle.name}: the minimum detectable force is not known: {model.refused}")
    known = [frame.name for frame in model.frames]
    for name in frames:
        if name not in known:
            raise ConfigError(f"frame = '{name}' must be one of {', '.join(known)}")
    load = bundle.load_settings
    links, found = bundle.links, []
    for k, link in enumerate(links):
        ends = [other for other in links if other.parent == k]
        if ends:
            end = max(ends, key=lambda other: sum(x * x for x in other.translation))
            name = f"link of {link.joint_name}, at {end.joint_name}"
            found.append(Point(name, link.joint_name, tuple(end.translation)))
        elif load.link != k:
            found.append(Point(f"link of {link.joint_name}, at its origin", link.joint_name))
    if load.link >= 0:
        found.append(Point(f"load's frame {load.frame}", links[load.link].joint_name, tuple(load.translation)))
    return found + [Point(f"frame {name}", name) for name in dict.fromkeys(frames)]


def even_ways(count: int = 100) -> np.ndarray:
    """Unit vectors, even on half a sphere: a Fibonacci lattice, (count, 3).

    The other half is the same by symmetry. Each of 100 represents a cone of 8 degrees.
    """
    k = np.arange(count) + 0.5
    z, turn = k / count, np.pi * (1 + np.sqrt(5)) * k
    flat = np.sqrt(1 - z**2)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1)


def kept_poses(bundle: _core.Bundle) -> np.ndarray:
    """Poses of the training's motion from the bundle's provenance, (poses, joints); (0, joints): it keeps none.

    Raises:
        BundleError: they are damaged.
    """
    try:
        kept = json.loads(bundle.provenance or "{}").get("wrench", {}).get("poses")
        q = np.array(kept or np.zeros((0, bundle.joints)), dtype=float)
        if q.ndim != 2 or q.shape[1] != bundle.joints or not np.isfinite(q).all():
            raise ValueError(f"poses of the shape {q.shape} where (poses, {bundle.joints}) belong")
    except (TypeError, ValueError, AttributeError) as error:
        raise BundleError(f"{bundle.name}: its provenance is damaged ({type(error).__name__}: {error})") from error
    return q


def torques(bundle: _core.Bundle, q: np.ndarray, point: Point, ways: int = 100) -> np.ndarray:
    """Torques of a newton in so many directions at a point, in 16 of these poses, (poses, ways, joints), [N m].

    A joint whose estimates are not in N m has none.
    """
    model, few = _core.WrenchModel(bundle), q[:: max(1, len(q) // 16)].tolist()
    lever = np.array([model.columns(point.frame, one, list(point.point_m))[:3].T for one in few])
    return (lever @ even_ways(ways).T).transpose(0, 2, 1) * np.array(bundle.in_newtons)


def hits(bundle: _core.Bundle, poses: Sequence[Sequence[float]] | None) -> np.ndarray:
    """Torques of a newton in any direction at the end of each link, in usual poses, (hits, joints), [N m].

    A joint whose estimates are not in N m feels hits of its own instead, and so does every joint where no forces can be
    estimated.

    Args:
        poses: (poses, joints); None: those that the bundle keeps.
    """
    alone, known = np.eye(bundle.joints), np.array(bundle.in_newtons)
    felt = [torques for _, torques in hits_of_points(bundle, poses)]
    if not felt:
        return alone
    found = np.concatenate(felt)
    found = found[np.abs(found).max(axis=1) > LEAST_LEVER_M]
    return np.concatenate([found, np.repeat(alone[~known], len(felt[0]), axis=0)]) if len(found) else alone


LEAST_LEVER_M = 1e-3
"""No joint feels a force with a smaller lever."""


def hits_of_points(bundle: _core.Bundle, poses: Sequence[Sequence[float]] | None) -> list[tuple[Point, np.ndarray]]:
    """Torques of a newton in any direction at the end of each link, (hits, joints), 0 where the estimates are not in
    N m; none where no forces can be estimated or no poses are kept.

    Args:
        poses: see hits.
    """
    q = kept_poses(bundle) if poses is None else np.asarray(poses, dtype=float)
    if _core.WrenchModel(bundle).refused or not len(q):
        return []
    return [(point, torques(bundle, q, point).reshape(-1, bundle.joints)) for point in points(bundle)]


def end_and_forearm(ends: Sequence[Point]) -> list[int]:
    """Indices of the arm's end, and of the forearm's end: of the two longest links the farther from the base.

    Args:
        ends: see points(); one or more. The last is the arm's end, however far it lies from its joint.
    """
    longest = sorted(range(len(ends) - 1), key=lambda k: -float(np.linalg.norm(ends[k].point_m)))[:2]
    return [len(ends) - 1, *sorted(longest)[-1:]]


def noticed_pushes_n(bundle: _core.Bundle, poses: Sequence[Sequence[float]] | None) -> dict[str, float]:
    """Median push that exceeds a joint's limit of usual sliding motion, at the ends of the arm and its forearm, [N].

    A place that no monitored joint feels is left out.

    Args:
        poses: see hits.
    """
    felt = hits_of_points(bundle, poses)
    if not felt:
        return {}
    limits, found = np.array(bundle.sliding_limit_nm), dict[str, float]()
    for k in end_and_forearm([point for point, _ in felt]):
        place = "end of the arm" if k == len(felt) - 1 else felt[k][0].name
        torques_nm = np.abs(felt[k][1])
        torques_nm = torques_nm[torques_nm.max(axis=1) > LEAST_LEVER_M]
        if len(torques_nm) and np.isfinite(limits).any():
            with np.errstate(divide="ignore"):
                push_n = float(np.median((limits / torques_nm).min(axis=1)))
            if np.isfinite(push_n):
                found[place] = push_n
    return found
