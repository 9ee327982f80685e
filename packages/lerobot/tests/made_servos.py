"""Simulated servos with play, and a motor of LeRobot's calibration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tauext.data.recording import Recording

STEP_S = 1e-3
COUNT_RAD = 2 * np.pi / 4096
STALL_NM, NO_LOAD_RAD_S = 1.9, 5.5  # of a small servo, at the joint
MOTOR_KG_M2, TOUCH_NM_RAD, TOUCH_NMS_RAD = 0.02, 600.0, 1.0


@dataclass(frozen=True)
class Servo:
    """One joint: its play and what loads it."""

    play_rad: float = 0.0
    encoder: str = "motor"
    """Before the play (motor) or behind it (link)."""
    motor_friction_nm: float = 0.04
    link_friction_nm: float = 0.1
    gravity_nm: float = 0.0
    """At a level link: what a position of zero asks for is nothing."""
    link_kg_m2: float = 0.005
    duty_per_rad: float = 2.8
    bend_rad: float = 0.0
    """Width of a presliding state (Dahl) of the link's friction; 0: it jumps."""


@dataclass(frozen=True)
class Driven:
    """What was simulated, (samples, joints) each."""

    t_s: np.ndarray
    goal: np.ndarray
    q: np.ndarray
    dq: np.ndarray
    duty: np.ndarray
    torque: np.ndarray


def drive(servos: list[Servo], seconds: float, rate_hz: float = 50.0, seed: int = 0, reach: float = 0.5) -> Driven:
    """Each servo follows moves and swings of its own at up to 1 rad/s."""
    n = len(servos)
    column = {
        name: np.array([getattr(s, name) for s in servos]) for name in Servo.__dataclass_fields__ if name != "encoder"
    }
    behind = np.array([s.encoder == "link" for s in servos])
    steps, every = round(seconds / STEP_S), round(1 / (rate_hz * STEP_S))
    goals = _goals(np.random.default_rng(seed), n, seconds, reach)
    half = column["play_rad"] / 2
    motor, link = goals[0].copy(), goals[0].copy()
    w_motor, w_link, bent = np.zeros(n), np.zeros(n), np.zeros(n)
    bends = column["bend_rad"] > 0
    width = np.where(bends, column["bend_rad"], 1.0)
    out = []
    for k in range(steps):
        seen = np.round(np.where(behind, link, motor) / COUNT_RAD) * COUNT_RAD
        duty = np.clip(column["duty_per_rad"] * (goals[k] - seen), -1, 1)
        torque = STALL_NM * (duty - w_motor / NO_LOAD_RAD_S)
        if k % every == 0:
            out.append((goals[k], seen, w_motor.copy() if not behind.all() else w_link.copy(), duty, torque))
        gap = motor - link
        deep = gap - np.clip(gap, -half, half)
        touch = np.where(deep != 0, TOUCH_NM_RAD * deep + TOUCH_NMS_RAD * (w_motor - w_link), 0.0)
        w_motor = _rubbed(w_motor + STEP_S * (torque - touch) / MOTOR_KG_M2,
                          STEP_S * column["motor_friction_nm"] / MOTOR_KG_M2)  # fmt: skip
        pull = touch - column["gravity_nm"] * np.sin(link)
        bent = np.clip(bent + STEP_S * w_link / width, -1, 1)
        w_link = (
            w_link + STEP_S * (pull - np.where(bends, column["link_friction_nm"] * bent, 0.0)) / column["link_kg_m2"]
        )
        w_link = _rubbed(
            w_link, np.where(bends, 0.02, 1.0) * STEP_S * column["link_friction_nm"] / column["link_kg_m2"]
        )
        motor, link = motor + STEP_S * w_motor, link + STEP_S * w_link
    goal, q, dq, duty, torque = (np.array(x) for x in zip(*out, strict=True))
    return Driven(np.arange(len(q)) / rate_hz, goal, q, dq, duty, torque)


def recorded(driven: Driven, tau: np.ndarray, goals: bool = True, name: str = "servos") -> Recording:
    """As a dataset holds it; tau is what the arm called its torque."""
    return Recording(
        name=name,
        joints=tuple(f"servo{j + 1}" for j in range(tau.shape[1])),
        t_ns=np.round(driven.t_s * 1e9).astype(np.int64),
        q=driven.q,
        dq=driven.dq,
        tau=tau,
        rate_hz=1 / (driven.t_s[1] - driven.t_s[0]),
        torque_timing="instant",
        source="made",
        robot_sha256="",
        q_des=driven.goal if goals else None,
    )


def _rubbed(speed: np.ndarray, most: np.ndarray) -> np.ndarray:
    """Coulomb friction over one step: what it cannot stop it slows."""
    return np.sign(speed) * np.maximum(np.abs(speed) - most, 0)


def _goals(rng: np.random.Generator, n: int, seconds: float, reach: float) -> np.ndarray:
    """Quintic moves between random places, and in between pauses."""
    steps, columns = round(seconds / STEP_S), []
    for _ in range(n):
        parts, here, length = [], 0.0, 0
        while length < steps:
            there = rng.uniform(-reach, reach)
            x = np.linspace(0, 1, max(400, round(abs(there - here) / rng.uniform(0.15, 0.6) / STEP_S)))
            parts += [here + (there - here) * (10 * x**3 - 15 * x**4 + 6 * x**5)]
            parts += [np.full(round(rng.uniform(0, 0.3) / STEP_S), there)]
            length, here = length + len(parts[-1]) + len(parts[-2]), there
        columns.append(np.concatenate(parts)[:steps])
    return np.stack(columns, axis=1)


ELBOW = {"id": 3, "drive_mode": 0, "homing_offset": -1470, "range_min": 871, "range_max": 3084}
"""A motor in a calibration file of LeRobot."""
