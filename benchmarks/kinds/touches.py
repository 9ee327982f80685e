"""A touch on the simulated arm: where, along which line, and what it shows in the joints."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np
from unseen.simulation import LINK_RADIUS_M, RATE_HZ

from kinds.causes import Cause
from tauext import _core

WORLD = -1


@dataclass(frozen=True)
class Place:
    """A point on the surface of a link; of the world: nothing."""

    link: int
    share: float = 0.0
    """Of the way from the link's joint to the next."""

    def of(self, tree: _core.Tree) -> np.ndarray:
        """In the link's frame, [m]; the last link is 12 cm long."""
        further = [link.translation for link in tree.links if link.parent == self.link]
        return self.share * np.array(further[0] if further else (0.0, 0.0, 0.12)) + [LINK_RADIUS_M, 0, 0]


class Touch:
    """What `simulate` calls a grip: from start_s on, one cause between a link and the world, or between two links.

    Between two links it lies along the line between their points, wherever that turns.

    Args:
        direction: of the force on the link, in the world, from its velocity when the touch begins.
    """

    def __init__(
        self,
        tree: _core.Tree,
        place: Place,
        other: Place,
        cause: Cause,
        start_s: float,
        samples: int,
        direction: Callable[[np.ndarray], np.ndarray],
    ) -> None:
        self.cause, self.start = cause, round(start_s * RATE_HZ)
        self.sides = [(place.link, place.of(tree)), (other.link, other.of(tree) if other.link >= 0 else np.zeros(3))]
        self.direction = direction
        self.along = np.zeros(3)
        self.first_m = 0.0
        self.force_n = np.zeros(samples)
        self.tau_ext = np.zeros((samples, tree.size))

    def __call__(self, model: mujoco.MjModel, data: mujoco.MjData, k: int) -> np.ndarray:
        if k < self.start:
            return np.zeros(model.nv)
        mujoco.mj_kinematics(model, data)  # of this step, not of the one before
        mujoco.mj_comPos(model, data)
        (point, jacobian), (other, other_jacobian) = (self._side(model, data, *side) for side in self.sides)
        apart, jacobian = point - other, jacobian - other_jacobian
        if self.sides[1][0] != WORLD:
            self.along = apart / np.linalg.norm(apart)
        elif k == self.start:
            self.along = self.direction(jacobian @ data.qvel)
        if k == self.start:
            self.first_m = float(self.along @ apart)
        v = float(self.along @ jacobian @ data.qvel)
        dt = 1 / RATE_HZ
        force = self.cause.force_n((k - self.start) * dt, float(self.along @ apart) - self.first_m, v, dt)
        self.force_n[k], self.tau_ext[k] = force, force * (self.along @ jacobian)
        return self.tau_ext[k]

    @staticmethod
    def _side(model: mujoco.MjModel, data: mujoco.MjData, link: int, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        jacobian = np.zeros((3, model.nv))
        if link == WORLD:
            return np.zeros(3), jacobian
        body = link + 1
        point = data.xpos[body] + data.xmat[body].reshape(3, 3) @ at
        mujoco.mj_jac(model, data, jacobian, None, point, body)
        return point, jacobian
