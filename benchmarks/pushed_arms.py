"""What benchmarks of pushed arms share: free motion of a simulated arm, the training on it, and a hand that pulls."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np

from tauext.config import AlarmConfig, PriorConfig, TrainConfig
from tauext.data.recording import Recording
from tauext.sim.arms import GearedArm
from tauext.sim.collect import SETTLE_S
from tauext.sim.plant import Plant
from tauext.sim.rig import draw_motion, measure, roll_out

PRACTICE_S = 60.0
"""Length of a recording that a bundle is trained on."""


class Practice(NamedTuple):
    """How a bundle is trained."""

    recordings: int
    config: TrainConfig


def prior_recipe(ripples: int) -> TrainConfig:
    little_reserve = AlarmConfig(friction_reserve=0.1)
    return TrainConfig(recipe="prior", alarm=little_reserve, prior=PriorConfig(most_ripples=ripples))


PRACTICE = {"rig": Practice(8, prior_recipe(2)), "seven": Practice(6, prior_recipe(0))}
"""By arm; a search for ripples in seven joints would take longer than everything else."""


def practice_recording(arm: GearedArm, seconds: float, seed: int, number: int) -> Recording:
    """Recording `number` of the arm's free motion around its home; the same arguments give the same samples."""
    moving, measuring = (np.random.default_rng(s) for s in np.random.SeedSequence(seed, spawn_key=(number,)).spawn(2))
    settle, samples = round(SETTLE_S * arm.rate_hz), round(seconds * arm.rate_hz)
    q_des, dq_des = draw_motion(arm.motion, len(arm.joints), samples + settle, arm.rate_hz, moving)
    q_des += arm.home
    controls = np.stack([q_des, dq_des], axis=2).reshape(len(q_des), -1)
    truth = roll_out(arm, arm.model, q_des[0], controls).after(settle)
    measured = measure(arm, truth, np.zeros_like(truth.q), measuring)
    return Recording(
        name=f"practice-{number:03d}",
        joints=arm.joints,
        t_ns=np.arange(samples, dtype=np.int64) * round(1e9 / arm.rate_hz),
        **{signal: measured[signal] for signal in ("q", "dq", "tau")},
        rate_hz=float(arm.rate_hz),
        torque_timing="held",
        source=f"sim {arm.name}",
        robot_sha256=hashlib.sha256(arm.xml.encode()).hexdigest(),
        provenance={"seed": seed, "number": number},
    )


STIFFNESS_N_M, LARGEST_N = 250.0, 80.0
DAMPING_N_S_M = {"rig": 15.0, "seven": 10.0}


@dataclass
class Hand:
    """A point of a link that a spring pulls towards a target, as a person's arm would."""

    joint: int
    """Joint that carries the link."""
    local_m: np.ndarray
    """The grabbed point in the link's frame (3,)."""
    target_m: np.ndarray
    """In the base frame (3,)."""

    @classmethod
    def grab(cls, plant: Plant, joint: int, point_m: np.ndarray) -> Hand:
        """Take hold of a point, in the base frame; it does not pull yet."""
        origin, rotation = plant.body_pose(joint)
        return cls(joint, rotation.T @ (point_m - origin), np.array(point_m, float))

    def force_n(self, plant: Plant) -> tuple[np.ndarray, np.ndarray]:
        """Force on the link, at most LARGEST_N, and where it acts, (3,) each, in the base frame."""
        origin, rotation = plant.body_pose(self.joint)
        point = origin + rotation @ self.local_m
        jacobian = np.zeros((3, plant.model.nv))
        mujoco.mj_jac(plant.model, plant.data, jacobian, None, point, self.joint + 1)
        damping = DAMPING_N_S_M[plant.arm.name.split("-")[0]]
        force = STIFFNESS_N_M * (self.target_m - point) - damping * (jacobian @ plant.data.qvel)
        return force * min(1.0, LARGEST_N / max(float(np.linalg.norm(force)), 1e-9)), point
