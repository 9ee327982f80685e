"""The true arm under its drive, at 1 kHz in MuJoCo: friction with memory, load and warmth; forces of contacts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from tauext import _core
from unseen.arms import TrueArm
from unseen.contacts import Contact

RATE_HZ = 1000
POSITION_PER_S, VELOCITY_PER_S, INTEGRAL_PER_S, FORGET_S = 20.0, 80.0, 8.0, 1.0
"""Gains of the drive's cascade; the integral forgets, so that a standing joint does not hunt."""
BRISTLE_DAMPING = 0.1
"""Of what would damp a stuck joint critically."""
VISCOUS_BEND_RAD_S = 2.0
LINK_RADIUS_M = 0.05

Grip = Callable[[mujoco.MjModel, mujoco.MjData, int], np.ndarray]
"""Changes what the arm carries before a step, and says the joint torques of what else holds it, (joints,)."""


@dataclass(frozen=True)
class Run:
    """True signals at 1 kHz, (samples, joints)."""

    q: np.ndarray
    motor_nm: np.ndarray
    friction_nm: np.ndarray
    tau_ext: np.ndarray


def hinge(body: mujoco.MjsBody, link: _core.Link) -> None:
    """A joint about z that carries its rotor."""
    body.add_joint(type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, 1], armature=link.rotor_inertia)


def build(tree: _core.Tree) -> mujoco.MjModel:
    """The tree as a MuJoCo model: one body and one hinge about z a link."""
    return specification(tree, RATE_HZ, hinge).compile()


def specification(
    tree: _core.Tree, rate_hz: float, join: Callable[[mujoco.MjsBody, _core.Link], None]
) -> mujoco.MjSpec:
    """The tree's links as bodies, each moved by what `join` gives it."""
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.gravity = 1 / rate_hz, list(tree.gravity)
    spec.compiler.balanceinertia = True  # masses off by 20 % may leave an inertia that no body has
    bodies: list = []
    for link in tree.links:
        parent = spec.worldbody if link.parent < 0 else bodies[link.parent]
        turn = np.zeros(4)
        mujoco.mju_mat2Quat(turn, np.array(link.rotation))
        body = parent.add_body(pos=link.translation, quat=turn, mass=link.mass, ipos=link.com)
        body.fullinertia, body.explicitinertial = link.inertia, True
        join(body, link)
        bodies.append(body)
    return spec


def simulate(
    arm: TrueArm,
    known: _core.Tree,
    setpoints: tuple[np.ndarray, np.ndarray, np.ndarray],
    torque_nm: Sequence[float],
    contacts: Sequence[Contact],
    warm_from_s: float,
    grip: Grip | None = None,
) -> Run:
    """Follow the setpoints at 1 kHz; the drive feeds forward what the known model says.

    Friction is LuGre's: dz/dt = v - sigma0 |v| z / g(v), tau_f = sigma0 z + sigma1 dz/dt + viscous; the bristle's
    equation is solved exactly over a step of constant v.

    Args:
        known: the maker's model; the drive adds the rotor inertias, which it does know.
        torque_nm: most of each drive.
        warm_from_s: how long the arm has run when the recording begins.
        grip: what happens at the flange; None: nothing.
    """
    model = build(arm.tree)
    data = mujoco.MjData(model)
    q_des, dq_des, ddq_des = setpoints
    n, dt = q_des.shape[1], 1 / RATE_HZ
    rotor = np.array([link.rotor_inertia for link in arm.tree.links])
    p, beta = known.momentum(q_des, dq_des)
    forward = np.gradient(p, dt, axis=0) + beta + rotor * ddq_des
    inertia = rotor + _mean_inertia(known, q_des)
    most = np.array(torque_nm, dtype=float)
    stiffness = arm.static_share * arm.coulomb_nm / arm.presliding_rad
    damping = 2 * BRISTLE_DAMPING * np.sqrt(stiffness * rotor)
    warm = 1 - arm.warm_drop * (1 - np.exp(-(warm_from_s + np.arange(len(q_des)) * dt) / arm.warm_s))[:, None]

    run = Run(*(np.zeros_like(q_des) for _ in range(4)))
    data.qpos[:] = q_des[0]
    bristle, integral, friction = np.zeros(n), np.zeros(n), np.zeros(n)
    steps = {round(c.start_s * RATE_HZ): c for c in contacts}
    touching: Contact | None = None
    direction: np.ndarray | None = None
    for k in range(len(q_des)):
        q, v = data.qpos, data.qvel
        error = dq_des[k] + POSITION_PER_S * (q_des[k] - q) - v
        integral += dt * (error - integral / FORGET_S)
        motor = forward[k] + inertia * VELOCITY_PER_S * (error + INTEGRAL_PER_S * integral)
        motor = np.minimum(np.maximum(motor, -most), most)

        sign = np.sign(v)
        sliding = warm[k] * arm.coulomb_nm * (1 + arm.asymmetry * sign) + arm.load_share * np.abs(motor - friction)
        g = sliding * (1 + (arm.static_share - 1) * np.exp(-((v / arm.stribeck_rad_s) ** 2)))
        steady = g * sign / stiffness
        moved = (steady - bristle) * -np.expm1(-stiffness * np.abs(v) * dt / g)
        bristle = bristle + moved
        viscous = warm[k] * arm.viscous_nm_s_rad * v / np.sqrt(1 + (v / VISCOUS_BEND_RAD_S) ** 2)
        ripple = arm.ripple_nm * np.sin(arm.ripple_cycles * q + arm.ripple_phase_rad)
        friction = stiffness * bristle + damping * moved / dt + viscous + ripple

        run.q[k], run.motor_nm[k], run.friction_nm[k] = q, motor, friction
        if k in steps:
            touching, direction = steps[k], None
        if touching is not None:
            body = touching.link + 1
            rotation = data.xmat[body].reshape(3, 3)
            point = data.xpos[body] + rotation @ touched_point(arm.tree, touching)
            jacobian = _jacobian(model, data, point, body)
            if direction is None:
                direction = _against_motion(touching, jacobian, v, rotation)
            force = touching.force_n(k * dt) * direction
            data.xfrc_applied[body, :3] = force
            data.xfrc_applied[body, 3:] = np.cross(point - data.xipos[body], force)
            run.tau_ext[k] = jacobian.T @ force
            if k * dt >= touching.end_s:
                data.xfrc_applied[:] = 0
                touching = None
        data.qfrc_applied[:] = motor - friction
        if grip is not None:
            data.qfrc_applied[:] += grip(model, data, k)
        mujoco.mj_step(model, data)
    if data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number or not np.isfinite(data.qpos).all():
        raise RuntimeError("the simulation diverged")
    return run


def _mean_inertia(tree: _core.Tree, q: np.ndarray) -> np.ndarray:
    """Mean of each joint's own inertia over the poses: p_i for dq = e_i."""
    poses = q[:: max(1, len(q) // 50)]
    return np.array(
        [tree.momentum(poses, np.tile(row, (len(poses), 1)))[0][:, i].mean() for i, row in enumerate(np.eye(tree.size))]
    )


def _reach(tree: _core.Tree, contact: Contact) -> np.ndarray:
    """Where on its link the contact is, in the link's frame, [m]; the last link is 12 cm long."""
    further = [link.translation for link in tree.links if link.parent == contact.link]
    return contact.share * np.array(further[0] if further else (0.0, 0.0, 0.12))


def touched_point(tree: _core.Tree, contact: Contact) -> np.ndarray:
    """In the link's axes, [m]."""
    return _reach(tree, contact) + [LINK_RADIUS_M, 0, 0] if contact.at_m is None else np.array(contact.at_m)


def _against_motion(contact: Contact, jacobian: np.ndarray, dq: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """The force's direction, kept for the whole contact: an obstacle that is run into pushes back."""
    velocity = jacobian @ dq
    speed = np.linalg.norm(velocity)
    if contact.kind == "impact" and speed > 0.1:
        return -velocity / speed
    direction = np.array(contact.direction)
    return rotation @ direction if contact.in_link else direction


def _jacobian(model: mujoco.MjModel, data: mujoco.MjData, point: np.ndarray, body: int) -> np.ndarray:
    jacobian = np.zeros((3, model.nv))
    mujoco.mj_jac(model, data, jacobian, None, point, body)
    return jacobian
