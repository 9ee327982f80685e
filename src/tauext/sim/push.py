"""The push of a pointer on a link, and the force that the estimate makes of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tauext.sim.plant import Plant

LEAST_LEVER = 0.1
"""A direction of force whose lever is smaller than this share of the largest is not told from noise."""


@dataclass
class Drag:
    """A point of a link that a pointer pulls towards itself."""

    joint: int
    """That carries the link."""
    local_m: np.ndarray
    """The grabbed point in the link's frame (3,)."""
    target_m: np.ndarray
    """The pointer in the base frame (3,)."""

    @classmethod
    def grab(cls, plant: Plant, joint: int, point_m: np.ndarray) -> Drag:
        """Take hold of a point, in the base frame; it does not pull yet."""
        origin, rotation = plant.body_pose(joint)
        return cls(joint, rotation.T @ (point_m - origin), np.array(point_m, float))

    def point_m(self, plant: Plant) -> np.ndarray:
        """Where the grabbed point is now, (3,)."""
        origin, rotation = plant.body_pose(self.joint)
        return origin + rotation @ self.local_m

    def force_n(self, plant: Plant) -> tuple[np.ndarray, np.ndarray]:
        """Force k (pointer - point) - d v on the link, at most the arm's largest, and where it acts, (3,) each."""
        push, point = plant.arm.push, self.point_m(plant)
        velocity = plant.jacobian(point, self.joint) @ plant.data.qvel
        force = push.stiffness_n_m * (self.target_m - point) - push.damping_n_s_m * velocity
        return force * min(1.0, push.largest_n / max(float(np.linalg.norm(force)), 1e-9)), point


def estimated_force(tau_ext: np.ndarray, jacobian: np.ndarray) -> tuple[np.ndarray, int]:
    """Force (3,), [N], at a known point from joint torques, and how many of its directions they show, 0 to 3.

    f = pinv(J^T) tau_ext. Directions along which a force turns no joint, or hardly any, are left out: of a push on
    the first link only the part across it is seen.

    Args:
        tau_ext: (joints,), [N m]; of the joints between base and link alone the rest is noise.
        jacobian: of the point, (3, joints).
    """
    left, levers, right = np.linalg.svd(jacobian, full_matrices=False)
    seen = levers > LEAST_LEVER * max(levers[0], 1e-9)
    weights = np.where(seen, 1.0 / np.maximum(levers, 1e-9), 0.0)
    return left @ (weights * (right @ tau_ext)), int(seen.sum())
