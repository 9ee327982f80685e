"""The smallest force on a link that exceeds a limit, by pose, point and direction."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np

from tauext import _core
from tauext.bundle.units import largest_share, left_out, situations
from tauext.errors import BundleError
from tauext.train.hits import Point, even_ways, kept_poses, points
from tauext_lab.evaluate.results import EveryWay, NoticedAt, NoticedForce, OverPoses

MOST_N = 1000.0
"""Directions that need a larger force are called blind: no touch that an arm survives is far beyond it
(WrenchModel::kLargestForce_n), and a lever behind such a number is a rounding of none."""
NINE_OF_TEN = 0.9
LEAST_LIMIT_NM = 1e-9
"""A limit of 0 is over at the first torque."""


def noticed_force(
    bundle: _core.Bundle, q: np.ndarray, limit_nm: np.ndarray, at: Sequence[Point]
) -> tuple[NoticedAt, ...]:
    """For each point: forces [N] in the median pose and the worst, along the base's axes and in the worst direction.

    None means blind: no joint notices MOST_N in that direction. Joints without answers in N m notice nothing
    here: their limits in N m are unknown.

    Args:
        q: poses, (poses, joints).
        limit_nm: of each joint at each pose, the same shape.
    """
    model, ways, in_newtons = _core.WrenchModel(bundle), even_ways(), np.array(bundle.in_newtons)
    rows = q.tolist()
    entries = []
    for point in at:
        lever = np.array([model.columns(point.frame, row, list(point.point_m))[:3].T for row in rows])
        per_limit = (lever / np.maximum(limit_nm, LEAST_LIMIT_NM)[:, :, None])[:, in_newtons]
        every = least_force(per_limit, ways)
        along = least_force(per_limit, np.eye(3))
        nine_of_ten = float(np.quantile(every, NINE_OF_TEN, method="higher"))
        every_way = EveryWay(known(float(np.median(every))), known(nine_of_ten))
        ways_n = (*along.T, worst_force(per_limit))
        entries.append(NoticedAt(point.name, point.frame, point.point_m, every_way, *map(over_poses, ways_n)))
    return tuple(entries)


def over_poses(force_n: np.ndarray) -> OverPoses:
    """Statistics of one force per pose."""
    median, worst = float(np.median(force_n)), float(force_n.max())
    return OverPoses(known(median), known(worst), float(np.isinf(force_n).mean()))


def known(force_n: float) -> float | None:
    return force_n if np.isfinite(force_n) else None


def least_force(per_limit: np.ndarray, ways: np.ndarray) -> np.ndarray:
    """F of the module's equation, [N], (poses, directions); infinite where blind.

    Args:
        per_limit: w_j, torque a newton over the limit, (poses, joints, 3).
        ways: unit vectors, (directions, 3).
    """
    most = np.abs(per_limit @ ways.T).max(axis=1)
    with np.errstate(divide="ignore"):
        return or_blind(1 / most)


def worst_force(per_limit: np.ndarray) -> np.ndarray:
    """The largest F over all directions, [N], (poses,); infinite where some direction is blind.

    By the corners of the polytope: each has three joints at their limits, and no other over.
    """
    poses, joints, _ = per_limit.shape
    worst = np.full(poses, np.inf)
    if joints < 3:
        return worst
    smallest = np.linalg.svd(per_limit, compute_uv=False)[:, 2]
    seen = smallest * MOST_N > 1  # F >= 1 / smallest, since the largest of |w_j . x| is at most their root of squares
    if not seen.any():
        return worst
    rows = per_limit[seen]
    three = rows[:, np.array(list(combinations(range(joints), 3)))]  # (poses, triples, 3, 3)
    a, b, c = three[:, :, 0], three[:, :, 1], three[:, :, 2]
    turned = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=-1)  # inverse times determinant
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = turned / np.einsum("ptx,ptx->pt", a, turned[..., 0])[..., None, None]
        signs = np.array([[1, 1, 1], [1, 1, -1], [1, -1, 1], [-1, 1, 1]])  # the others mirror these
        corners = np.einsum("ptxk,sk->ptsx", inverse, signs)
        over = np.abs(np.einsum("ptsx,pjx->ptsj", corners, rows)).max(axis=-1)
        size = np.where(over <= 1 + 1e-9, np.linalg.norm(corners, axis=-1), 0.0)
    largest = size.reshape(len(rows), -1).max(axis=1)
    worst[seen] = np.where(largest > 0, largest, np.inf)  # every corner vanished in rounding: no force is found
    return or_blind(worst)


def or_blind(force_n: np.ndarray) -> np.ndarray:
    blind: np.ndarray = np.where(force_n > MOST_N, np.inf, force_n)
    return blind


def noticed(
    bundle: _core.Bundle,
    q: np.ndarray,
    limits: Mapping[str, np.ndarray],
    error_share: float,
    frames: Sequence[str] = (),
) -> NoticedForce:
    """All noticed forces, and the delay until a lasting force is reported; filters come on top of the delay.

    Args:
        q: poses, (poses, joints), one at least.
        limits: by name, of each joint at each pose.
        error_share: standard error of the estimate over its limit, a usual one.

    Raises:
        BundleError, ConfigError: as points.
    """
    at, gain_per_s = points(bundle, frames), bundle.observer.gain_per_s
    hold_s = {"collision": bundle.hold_s, "contact": bundle.contact_hold_s}
    return NoticedForce(
        poses=len(q),
        limits={name: noticed_force(bundle, q, limit, at) for name, limit in limits.items()},
        error_share=math.hypot(error_share, largest_share(bundle)),
        left_out=left_out(bundle),
        gain_per_s=gain_per_s,
        hold_s=hold_s,
        twice_after_s={level: math.log(2) / gain_per_s + hold for level, hold in hold_s.items()},
    )


# --- The force noticed at a bundle's stored poses, with its limits in usual motion; needs no recording.


NO_POSES = (
    "it was trained before bundles kept poses of their motion, or on too little; give recordings of the arm's own "
    "with --data REC.parquet"
)


def noticed_in_usual_motion(bundle: _core.Bundle, frames: Sequence[str] = ()) -> NoticedForce:
    """The result of noticed() by level and region: all joints sliding, or all near stiction.

    Raises:
        BundleError: it keeps no poses, or none that can be used.
        BundleError, ConfigError: as points.
    """
    q = kept_poses(bundle)
    if not len(q):
        raise BundleError(f"{bundle.name}: it keeps no poses: {NO_POSES}")
    return noticed(bundle, q, usual_limits(bundle, len(q)), usual_error_share(bundle), frames)


def usual_limits(bundle: _core.Bundle, poses: int) -> dict[str, np.ndarray]:
    """Limits of the bundle in usual motion, by level and region, (poses, joints) each: all joints in that region."""
    levels = {
        "collision while sliding": bundle.sliding_limit_nm,
        "collision near stiction": bundle.near_stiction_limit_nm,
        "contact while sliding": bundle.contact_sliding_limit_nm,
        "contact near stiction": bundle.contact_near_stiction_limit_nm,
    }
    return {name: np.tile(np.asarray(limit), (poses, 1)) for name, limit in levels.items()}


def usual_error_share(bundle: _core.Bundle) -> float:
    """Standard error over limit, the median over joints and usual motions."""
    shares = [
        situation["standard error"][joint] / limit
        for situation in situations(bundle).values()
        for joint, limit in situation["limit"].items()
        if limit > 0
    ]
    return float(np.median(shares)) if shares else 0.0
