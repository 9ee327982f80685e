"""The arm that nobody described: axes and places of its joints, and links for them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tauext import _core

ASIDE_TIE = 0.1
"""Of the components of a unit vector: (0, 0, 1) is as far from x as from y, and rounding must not choose."""


@dataclass(frozen=True)
class Kinematics:
    """A serial arm of revolute joints at q = 0, in a frame with z up; only what moves the torques is determined.

    Turned about the vertical, or with an origin moved along its axis, the arm is the same.
    """

    axes: np.ndarray
    """(n, 3) unit vectors, by the right-hand rule."""
    origins: np.ndarray
    """(n, 3) a point on each axis, [m]; the first is 0."""

    def tree(self, joints: Sequence[str], gravity: Sequence[float]) -> _core.Tree:
        """Its links, without mass; each one's z axis is its joint's.

        Args:
            gravity: in the frame of the base, [m/s^2], not 0; up is against it.
        """
        upright = frame_of(-np.asarray(gravity) / np.linalg.norm(gravity))
        links, base_from_parent, parent_origin = [], np.eye(3), np.zeros(3)
        for k, (axis, origin) in enumerate(zip(self.axes @ upright.T, self.origins @ upright.T, strict=True)):
            base_from_link = frame_of(axis)
            link = _core.Link()
            link.joint_name, link.parent, link.type = joints[k], k - 1, _core.JointType.revolute
            link.rotation = (base_from_parent.T @ base_from_link).ravel().tolist()
            link.translation = (base_from_parent.T @ (origin - parent_origin)).tolist()
            links.append(link)
            base_from_parent, parent_origin = base_from_link, origin
        return _core.Tree(links, list(gravity))

    def moved(self, turns: np.ndarray, shifts: np.ndarray) -> Kinematics:
        """Axes turned by two small angles each, (n, 2), [rad], and each joint shifted across its axis against the one
        before it, (n, 2), [m]; those after it come along."""
        axes, steps = np.empty_like(self.axes), np.diff(self.origins, axis=0, prepend=np.zeros((1, 3)))
        for k, axis in enumerate(self.axes):
            frame = frame_of(axis)
            axes[k] = frame @ np.array([*turns[k], 1.0])
            steps[k] += frame[:, :2] @ shifts[k]
        return Kinematics(axes / np.linalg.norm(axes, axis=1, keepdims=True), np.cumsum(steps, axis=0))


def frame_of(axis: np.ndarray) -> np.ndarray:
    """A rotation whose third column is this unit vector, (3, 3)."""
    off = np.abs(axis)
    aside = np.eye(3)[np.flatnonzero(off <= off.min() + ASIDE_TIE)[0]]
    x = np.cross(aside, axis)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(axis, x), axis])
