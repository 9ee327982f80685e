"""mujoco.sysid on an arm's training recordings, by its own parameters, rollouts and optimiser."""

from __future__ import annotations

import contextlib
import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from scipy.signal import butter, sosfiltfilt
from tauext_twin.arm import Arm
from tauext_twin.held_out import MOVES_RAD_S, state_of, windows
from tauext_twin.model_file import Inertial, JointChange

from tauext.robot.compile import no_mujoco_warnings
from tauext.robot.read import placed_bodies, read_robot

WINDOW_S = 0.5
STEP_S = 0.004
"""Longest step of a simulation."""
MOST_ROWS, CUT_HZ = 500, 10.0
"""Of the fit to torques: samples, and zero-phase low-pass of motion and torque."""
COM_M = 0.15
"""A centre of mass stays so close to the file's; the toolbox's half a metre leads into minima that no arm can have."""
CAP_S = 600.0
SETTLED = 6
"""A fit ends where so many iterations together have lowered its mean squared residual by less than a thousandth."""
NEEDS = ("absl-py", "colorama", "imageio", "Jinja2", "plotly", "pyyaml", "tabulate")


@dataclass(frozen=True)
class Fit:
    """What mujoco.sysid found."""

    changes: list[JointChange]
    time_s: float
    capped: bool
    """Stopped at CAP_S; the best point until then counts."""
    windows: int
    error: tuple[float, float]
    """Root of the mean squared residual at its start and at its end, as a share of each signal's spread."""


class Ended(Exception):
    """The time is over, or the residual no longer falls."""


def toolbox() -> Any:
    """mujoco.sysid, or an end with one line where what it needs is missing."""
    from mujoco import sysid

    if not hasattr(sysid, "optimize"):  # its __init__ hides what is missing
        sys.exit(f"mujoco.sysid needs packages that are missing: pip install {' '.join(NEEDS)}")
    return sysid


def model_of(arm: Arm) -> mujoco.MjSpec:
    """The robot file with a motor and sensors of position and velocity at each joint in use, the others fixed."""
    spec, names = read_robot(arm.robot)[0], [link.joint_name for link in arm.setup.tree.links]
    for one in [*spec.actuators, *spec.sensors, *spec.equalities, *(j for j in spec.joints if j.name not in names)]:
        spec.delete(one)
    off = (mujoco.mjtDisableBit.mjDSBL_CONTACT, mujoco.mjtDisableBit.mjDSBL_LIMIT)
    spec.option.disableflags |= int(sum(map(int, off)))
    spec.option.gravity, spec.option.integrator = arm.setup.tree.gravity, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    for name in names:
        motor = spec.add_actuator(name=f"{name} motor", target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.set_to_motor()
    for kind in (mujoco.mjtSensor.mjSENS_JOINTPOS, mujoco.mjtSensor.mjSENS_JOINTVEL):
        for name in names:
            spec.add_sensor(name=f"{name} {kind.name}", type=kind, objtype=mujoco.mjtObj.mjOBJ_JOINT, objname=name)
    return spec


def parameters(arm: Arm, spec: mujoco.MjSpec, model: mujoco.MjModel, bodies: list[str]) -> Any:
    """Friction and armature of each joint, mass and centre of mass of its heaviest body.

    Frictions start at a twentieth of the torque and may be three times as large as all of it; armatures start at a
    tenth of the arm's inertia at the joint. Masses and centres of mass start as in the file, between a tenth and ten
    times the mass, and within COM_M.
    """
    sysid, found = toolbox(), toolbox().ParameterDict()
    torque = arm.units * np.sqrt(np.mean(np.concatenate([one.tau for one in arm.training]) ** 2, axis=0))
    speed = np.sqrt(np.mean(np.concatenate([one.dq for one in arm.training]) ** 2, axis=0))
    data, full = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, full)

    for j, link in enumerate(arm.setup.tree.links):
        inertia = float(np.diag(full).max())
        own = float(full[model.joint(link.joint_name).dofadr[0], model.joint(link.joint_name).dofadr[0]])
        damping = torque[j] / max(speed[j], 1e-3)
        for what, start, most in (
            ("damping", 0.05 * damping, 3 * damping),
            ("frictionloss", 0.05 * torque[j], 3 * torque[j]),
            ("armature", max(link.rotor_inertia, 0.1 * own), 10 * inertia),
        ):

            def put(spec: mujoco.MjSpec, one: Any, name: str = link.joint_name, what: str = what) -> None:
                value = float(one.value[0])
                setattr(spec.joint(name), what, [value, 0.0, 0.0] if what == "damping" else value)

            found.add(sysid.Parameter(f"{link.joint_name} {what}", start, 0.0, most, modifier=put))
    for body in bodies:
        found.add(sysid.body_inertia_param(spec, model, body, ipos_bound_off=np.array([-COM_M, COM_M])))
    return found


def fitted(arm: Arm, by: str) -> Fit:
    """The arm's parameters by mujoco.sysid.

    Args:
        by: "rollout": positions and velocities over windows, from recorded states with the recorded torques, come
            closest to the recorded ones; "torque": MuJoCo's inverse dynamics come closest to the recorded torques.
    """
    sysid, begun = toolbox(), time.monotonic()
    spec, (_, _, placed) = model_of(arm), placed_bodies(arm.robot, arm.setup.tree)
    rate = arm.training[0].rate_hz
    spec.option.timestep = 1 / (rate * max(1, round(1 / (rate * STEP_S))))
    model = spec.compile()
    heaviest = [
        max((b for b in placed if b.link == k), key=lambda b: float(model.body(b.name).mass[0])).name
        for k in range(arm.setup.tree.size)
    ]
    start, reached = parameters(arm, spec, model, heaviest), []
    best: tuple[float, np.ndarray] = (math.inf, np.empty(0))
    difference, chosen = {"rollout": rollouts, "torque": torques}[by](arm, spec, model)

    def residual(x: np.ndarray, params: Any) -> tuple[list[np.ndarray], None, None]:
        nonlocal best
        if time.monotonic() - begun > CAP_S or (len(reached) > SETTLED and reached[-SETTLED - 1] < 1.001 * best[0]):
            raise Ended
        found = difference(x.reshape(len(x), -1), params)
        if found.shape[1] == 1:
            best = min(best, (float(np.mean(found**2)), np.array(x).ravel()), key=lambda pair: pair[0])
        else:  # a Jacobian: a new iteration
            reached.append(best[0])
        return [found.ravel() if x.ndim == 1 else found], None, None

    with no_mujoco_warnings(), contextlib.suppress(Ended):
        low, high = start.get_bounds()
        sysid.optimize(start, residual, verbose=False, x_scale=0.1 * (high - low))
    time_s = time.monotonic() - begun
    found = start.copy()
    found.update_from_vector(best[1])
    changes = []
    for link, body in zip(arm.setup.tree.links, heaviest, strict=True):
        known = model.body(body)
        mass, *com = map(float, found[f"{body}_inertia"].value)
        inertial = Inertial(body, mass, tuple(com), tuple(known.inertia.tolist()), tuple(known.iquat.tolist()))
        values = [
            float(found[f"{link.joint_name} {what}"].value[0]) for what in ("damping", "frictionloss", "armature")
        ]
        changes.append(JointChange(link.joint_name, *values, inertial=inertial))
    return Fit(changes, time_s, time_s > CAP_S, chosen, (math.sqrt(reached[0]), math.sqrt(best[0])))


Difference = Callable[[np.ndarray, Any], np.ndarray]
"""Residuals of points (parameters, points) and a ParameterDict, (residuals, points)."""


def rollouts(arm: Arm, spec: mujoco.MjSpec, model: mujoco.MjModel) -> tuple[Difference, int]:
    """By the toolbox's rollouts of windows, each signal as a share of its spread in the training motion."""
    sysid, rate, (qpos, dofs) = toolbox(), arm.training[0].rate_hz, state_of(arm, model)
    steps = round(1 / (rate * model.opt.timestep))
    spread = np.concatenate([np.hstack([one.q - one.q.mean(axis=0), one.dq]) for one in arm.training])
    scale = np.maximum(np.sqrt(np.mean(spread**2, axis=0)), 1e-3)
    chosen, chunks = windows(arm.training, WINDOW_S), []
    for one, first, last in chosen:
        fine, at = np.arange((last - first) * steps + 1) / steps, np.arange(last - first + 1)
        torque = np.column_stack([np.interp(fine, at, tau) for tau in one.tau[first : last + 1].T])
        q, dq = np.array(model.qpos0), np.zeros(model.nv)
        q[qpos], dq[dofs] = one.q[first], one.dq[first]
        seen = np.hstack([one.q, one.dq])[first : last + 1]
        chunks.append(
            sysid.SystemTrajectory(
                model,
                sysid.TimeSeries(fine / rate, arm.units * torque),
                sysid.TimeSeries.from_names(at / rate, seen, model),
                sysid.create_initial_state(model, q, dq),
                None,
            )
        )

    def of_window(params: Any, predicted: Any, measured: Any, *_: Any, **__: Any) -> tuple[np.ndarray, Any, Any]:
        apart = (predicted.data[steps - 1 :: steps] - measured.data[1:]) / scale
        return np.clip(np.nan_to_num(apart, nan=1e3), -1e3, 1e3), predicted, predicted

    def difference(x: np.ndarray, params: Any) -> np.ndarray:
        found, _, _ = sysid.model_residual(
            x, params, lambda p: sysid.apply_param_modifiers(p, spec), chunks, of_window, resample_true=False
        )
        return np.asarray(found).T.reshape(x.shape[1], -1).T  # windows below one another

    return difference, len(chunks)


def torques(arm: Arm, spec: mujoco.MjSpec, model: mujoco.MjModel) -> tuple[Difference, int]:
    """By MuJoCo's inverse dynamics of the smoothed motion, as a share of each joint's torque, where the joint moves."""
    sysid, (qpos, dofs) = toolbox(), state_of(arm, model)
    rows = []
    for one in arm.training:
        low = butter(3, min(CUT_HZ, one.rate_hz / 6), fs=one.rate_hz, output="sos")
        q, tau = (sosfiltfilt(low, signal, axis=0) for signal in (one.q, one.tau))
        dq = np.gradient(q, 1 / one.rate_hz, axis=0)
        kept = slice(round(0.5 * one.rate_hz), -round(0.5 * one.rate_hz))
        rows.append(np.stack([q, dq, np.gradient(dq, 1 / one.rate_hz, axis=0), arm.units * tau])[:, kept])
    every = np.concatenate(rows, axis=1)
    q, dq, ddq, tau = every[:, np.unique(np.linspace(0, every.shape[1] - 1, MOST_ROWS).round().astype(int))]
    weight = (np.abs(dq) > MOVES_RAD_S) / np.sqrt(np.mean(tau**2, axis=0))
    data = mujoco.MjData(model)

    def difference(x: np.ndarray, params: Any) -> np.ndarray:
        out = np.zeros((x.shape[1], *tau.shape))
        for column, torque in zip(x.T, out, strict=True):
            params.update_from_vector(column)
            changed = sysid.apply_param_modifiers(params, spec)
            for k in range(len(tau)):
                data.qpos[qpos], data.qvel[dofs], data.qacc[dofs] = q[k], dq[k], ddq[k]
                mujoco.mj_inverse(changed, data)
                torque[k] = data.qfrc_inverse[dofs]
        return ((out - tau) * weight).reshape(x.shape[1], -1).T

    return difference, 0
