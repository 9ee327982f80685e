"""The rig with friction of other families than the prior's: generalised Maxwell slip, and a belt.

No method was fixed on these arms. Links, motion, collisions and instruments are those of the rig.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import mujoco
import numpy as np

from tauext.errors import ConfigError
from tauext_lab.sim.config import FrictionConfig, RigConfig
from tauext_lab.sim.rig import DIVERGED, Kind, Truth, build_scene

Family = Literal["maxwell-slip", "belt"]


@dataclass(frozen=True)
class OtherRig(RigConfig):
    """The rig whose friction is of this family; `friction` is ignored."""

    family: Family = "maxwell-slip"


NO_FRICTION = FrictionConfig(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0)
SHARES = (0.3, 0.25, 0.2, 0.15, 0.1)
"""Of the sliding friction, by the elements of Maxwell slip; the k-th slips after k times the travel of the first."""


class MaxwellSlip:
    """Generalised Maxwell slip [AlBender2005]: elements in parallel that stick as springs and slip at a level each.

    A slipping element approaches its share of s(v): dF/dt = sgn(v) C (share - F / s(v)). Reversals are remembered.

    Args:
        sliding_nm: friction in sliding; static_nm: as sliding begins.
        first_rad: travel after which the first element slips.
        attraction_nm_s: C, how fast a slipping element approaches its level.
    """

    def __init__(
        self, sliding_nm: float, static_nm: float, stribeck_rad_s: float, first_rad: float, attraction_nm_s: float
    ):
        self._sliding, self._static, self._stribeck = sliding_nm, static_nm, stribeck_rad_s
        self._attraction = attraction_nm_s
        self._stiffness = [share * sliding_nm / ((k + 1) * first_rad) for k, share in enumerate(SHARES)]
        self._force, self._slips, self._forward = [0.0] * len(SHARES), [False] * len(SHARES), True

    def step(self, v: float, dt: float, factor: float = 1.0) -> float:
        """Friction after a step of speed v, [N m]. factor: on its sliding level."""
        sign = 1.0 if v >= 0 else -1.0
        if (v >= 0) != self._forward:
            self._forward, self._slips = v >= 0, [False] * len(SHARES)
        extra = (self._static - self._sliding) * math.exp(-((v / self._stribeck) ** 2))
        level = factor * (self._sliding + extra)
        for k, share in enumerate(SHARES):
            if self._slips[k]:
                self._force[k] += sign * self._attraction * dt * (share - sign * self._force[k] / level)
            else:
                self._force[k] += self._stiffness[k] * v * dt
                if sign * self._force[k] >= share * level:
                    self._force[k], self._slips[k] = sign * share * level, True
        return sum(self._force)


@dataclass(frozen=True)
class Belt:
    """A joint driven over a belt, with its encoder at the motor; all numbers on the joint's side."""

    stiffness_nm_rad: float
    damping_nm_s_rad: float
    hysteresis_nm: float
    """Of the belt as it stretches: a Maxwell slip of its stretch."""
    sliding_nm: float
    pose_share: float
    """Of the friction, by which it rises and falls with the pose ..."""
    pose_cycles: float
    """... so many times a turn: no whole number, as a belt's length is none of its pulley's circumference."""
    grease_nm: float
    """Friction at 1 rad/s that grows with the power 0.6 of the speed."""
    wave_nm: float
    """Torque wave of the belt's teeth ..."""
    wave_cycles: float
    wave_load_share: float
    """... which grows by this share for each N m that the belt transmits."""


BELTS = (
    Belt(6000.0, 6.0, 0.8, 4.5, 0.35, 1.7, 4.0, 0.5, 11.7, 0.03),
    Belt(2500.0, 2.0, 0.4, 2.5, 0.35, 2.3, 3.0, 0.3, 14.3, 0.05),
)
MAXWELL = ((4.5, 6.0, 0.03, 3e-4, 400.0), (3.0, 4.2, 0.03, 4e-4, 300.0))
"""Arguments of MaxwellSlip for each joint, and below its viscous friction, [N m s/rad]."""
VISCOUS = (3.2, 4.0)


def roll_out_other(config: OtherRig, kind: Kind, q_start: np.ndarray, controls: np.ndarray) -> Truth:
    """As rig.roll_out, with friction of this family, one step at a time; with a belt all signals are the motor's side.

    Raises:
        ConfigError: the simulation diverged.
    """
    n, dt = len(config.links), 1.0 / config.rate_hz
    is_belt = config.family == "belt"
    links = tuple(replace(one, rotor_inertia_kg_m2=0.0) for one in config.links) if is_belt else config.links
    model = build_scene(RigConfig(**_fields(config) | {"links": links, "friction": (NO_FRICTION,) * n}), kind)
    data = mujoco.MjData(model)
    data.qpos[:] = q_start
    signals, touch = np.zeros((6, len(controls), n)), np.zeros((len(controls), model.nsensordata - 3 * n))
    step = _belt_step(config, q_start) if is_belt else _maxwell_step(n)
    for k, control in enumerate(controls):
        data.ctrl[:] = control
        signals[:, k] = step(model, data, dt)
        touch[k] = data.sensordata[3 * n :]
    if any(data.warning[kind].number for kind in DIVERGED) or not np.isfinite(signals).all():
        raise ConfigError(f"the simulation of {config.name} with friction of family {config.family} diverged")
    q, dq, ddq, drive, friction, others = signals
    return Truth(q, dq, ddq, drive, friction, others, touch.reshape(len(controls), -1, 10))


def _fields(config: OtherRig) -> dict:
    return {name: getattr(config, name) for name in RigConfig.__dataclass_fields__}


Step = Callable[[mujoco.MjModel, mujoco.MjData, float], tuple]
"""Advances the scene; returns q, dq, ddq, drive, friction and other torques of the sample, each one a joint."""


def _maxwell_step(n: int) -> Step:
    elements = [MaxwellSlip(*numbers) for numbers in MAXWELL[:n]]

    def step(model: mujoco.MjModel, data: mujoco.MjData, dt: float) -> tuple:
        q, dq = data.qpos[:n].copy(), data.qvel[:n].copy()
        speeds = dq.tolist()
        friction = [one.step(v, dt) + c * v for one, v, c in zip(elements, speeds, VISCOUS, strict=False)]
        data.qfrc_applied[:n] = [-torque for torque in friction]
        mujoco.mj_step(model, data)
        drive = data.sensordata[: 3 * n : 3].copy()
        return q, dq, (data.qvel[:n] - dq) / dt, drive, friction, data.sensordata[2 : 3 * n : 3] - drive

    return step


def _belt_step(config: OtherRig, q_start: np.ndarray) -> Step:
    n = len(config.links)
    belts = BELTS[:n]
    theta, omega = q_start[:n].tolist(), [0.0] * n
    sticks = [MaxwellSlip(one.sliding_nm, one.sliding_nm, 0.05, 3e-4, 400.0) for one in belts]
    stretched = [MaxwellSlip(one.hysteresis_nm, one.hysteresis_nm, 0.05, 2e-4, 100.0) for one in belts]

    def step(model: mujoco.MjModel, data: mujoco.MjData, dt: float) -> tuple:
        q, dq, goals = data.qpos[:n].tolist(), data.qvel[:n].tolist(), data.ctrl[: 2 * n].tolist()
        before, speed, acceleration, drives, frictions = list(theta), list(omega), [], [], []
        for j, belt in enumerate(belts):
            stretch, rate = theta[j] - q[j], omega[j] - dq[j]
            carried = belt.stiffness_nm_rad * stretch + belt.damping_nm_s_rad * rate + stretched[j].step(rate, dt)
            pose = 1 + belt.pose_share * math.sin(belt.pose_cycles * theta[j] + j)
            friction = sticks[j].step(omega[j], dt, pose)
            friction += belt.grease_nm * math.copysign(abs(omega[j]) ** 0.6, omega[j])
            wave = belt.wave_nm * (1 + belt.wave_load_share * abs(carried))
            friction += wave * math.sin(belt.wave_cycles * theta[j])
            gains = config.drives[j]
            drive = gains.stiffness_nm_rad * (goals[2 * j] - theta[j])
            drive += gains.damping_nm_s_rad * (goals[2 * j + 1] - omega[j])
            acceleration.append((drive - friction - carried) / config.links[j].rotor_inertia_kg_m2)
            data.qfrc_applied[j] = carried
            data.ctrl[2 * j], data.ctrl[2 * j + 1] = q[j], dq[j]  # the drive acts on the motor, not on the link
            drives.append(drive)
            frictions.append(friction)
            omega[j] += dt * acceleration[j]
            theta[j] += dt * omega[j]
        mujoco.mj_step(model, data)
        return before, speed, acceleration, drives, frictions, data.sensordata[2 : 3 * n : 3].copy()

    return step
