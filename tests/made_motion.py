"""Free motion of an arm whose every torque is known: what the doctor is tried on, whole and broken."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tauext import _core
from tauext.data import Recording

ENCODER_RAD = 2 * np.pi / 2**20
VELOCITY_RAD_S = 300.0  # cut-off of the drives' velocity filters
NOISE = 0.01  # of the torque, as a share of its spread


@dataclass(frozen=True)
class Made:
    """Recordings of one arm, and the parts of their torques (samples, joints) [N m]."""

    recordings: list[Recording]
    gravity: list[np.ndarray]
    friction: list[np.ndarray]


def made_motion(
    tree: _core.Tree,
    minutes: float,
    rate_hz: float = 100.0,
    seed: int = 0,
    pieces: int = 4,
    ranges: np.ndarray | float = 1.5,
    still: int | None = None,
) -> Made:
    """Quintic moves between random poses, with friction of a tenth to a third of each joint's torque.

    Args:
        ranges: of the poses, rad to either side.
        still: joint that keeps its place.
    """
    rng = np.random.default_rng(seed)
    names = tuple(link.joint_name for link in tree.links)
    reach = np.full(tree.size, ranges, dtype=float)
    if still is not None:
        reach[still] = 0.02
    _, weight = tree.momentum(rng.uniform(-1, 1, (300, tree.size)) * 1.5, np.zeros((300, tree.size)))
    size = 0.2 * weight.std(axis=0) + 0.02 * weight.std(axis=0).max() + 0.3
    recordings, gravities, frictions = [], [], []
    for piece in range(pieces):
        fine = max(1, round(500 / rate_hz))
        q = _moves(rng, round(minutes * 60 * rate_hz / pieces) * fine, rate_hz * fine, reach)
        dq = np.gradient(q, 1 / (rate_hz * fine), axis=0)
        momentum, beta = tree.momentum(q, dq)
        torque = np.gradient(momentum, 1 / (rate_hz * fine), axis=0) + beta
        friction = size * (np.tanh(dq / 0.02) + 0.8 * dq)
        gravity = tree.momentum(q, np.zeros_like(q))[1]
        tau = torque + friction + NOISE * (torque + friction).std(axis=0) * rng.standard_normal(q.shape)
        encoder = np.round(q / ENCODER_RAD) * ENCODER_RAD
        velocity = _filtered(np.gradient(encoder, 1 / (rate_hz * fine), axis=0), VELOCITY_RAD_S / (rate_hz * fine))
        keep = slice(0, None, fine)
        recordings.append(
            Recording(
                name=f"free-{piece}",
                joints=names,
                t_ns=np.arange(len(q[keep]), dtype=np.int64) * round(1e9 / rate_hz),
                q=encoder[keep],
                dq=velocity[keep] + 1e-4 * rng.standard_normal(q[keep].shape),
                tau=tau[keep],
                contact=np.zeros(len(q[keep]), dtype=np.int8),
                rate_hz=rate_hz,
                torque_timing="instant",
                source="made",
                robot_sha256="",
                provenance={"contacts": "none"},
            )
        )
        gravities.append(gravity[keep]), frictions.append(friction[keep])
    return Made(recordings, gravities, frictions)


def _moves(rng: np.random.Generator, samples: int, rate_hz: float, reach: np.ndarray) -> np.ndarray:
    parts, length, here = [], 0, np.zeros(len(reach))
    while length < samples:
        there = rng.uniform(-reach, reach)
        seconds = max(0.5, float(np.abs(there - here).max()) / rng.uniform(0.4, 1.2))
        x = np.linspace(0, 1, round(seconds * rate_hz))[:, None]
        parts += [here + (there - here) * (10 * x**3 - 15 * x**4 + 6 * x**5)]
        parts += [np.repeat(there[None], round(rng.uniform(0, 0.3) * rate_hz), axis=0)]
        length, here = length + len(parts[-1]) + len(parts[-2]), there
    return np.concatenate(parts)[:samples]


def _filtered(x: np.ndarray, share: float) -> np.ndarray:
    from scipy.signal import lfilter

    a = np.exp(-share)
    return lfilter([1 - a], [1, -a], x, axis=0, zi=a * x[:1])[0]
