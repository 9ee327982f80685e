"""Geometry of a planar arm: where its links are, and the joint torque of a force on one of them."""

import numpy as np

from tauext.sim.config import RigConfig


def link_frames(config: RigConfig, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Origins (samples, links, 2) as (x, z) in [m], and angles (samples, links) about +y in [rad], at positions q."""
    angle = np.cumsum(q, axis=1)
    along = np.stack([np.sin(angle), np.cos(angle)], axis=2)
    lengths = np.array([link.length_m for link in config.links])
    ends = np.cumsum(lengths[:, None] * along, axis=1)
    return ends - lengths[:, None] * along, angle


def to_world(vector: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Turn (x, z) vectors (samples, 2) by the angles (samples,) about +y."""
    c, s = np.cos(angle), np.sin(angle)
    x, z = vector[..., 0], vector[..., 1]
    return np.stack([c * x + s * z, c * z - s * x], axis=-1)


def force_torque(config: RigConfig, q: np.ndarray, link: int, force: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Joint torque J^T f, (samples, joints) in [N m], of a force on `link`; force and point as (x, z) in the world.

    tau_j is the moment about joint j, (p - o_j) x f along +y; joints beyond the touched link feel nothing.
    """
    origins, _ = link_frames(config, q)
    arm = point[:, None, :] - origins
    torque = arm[..., 1] * force[:, None, 0] - arm[..., 0] * force[:, None, 1]
    torque[:, link + 1 :] = 0.0
    return torque
