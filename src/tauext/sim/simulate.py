"""Setpoints in, true signals out: one open-loop rollout of a scene."""

from __future__ import annotations

from dataclasses import dataclass, fields

import mujoco
import numpy as np
from mujoco import rollout

from tauext.errors import ConfigError
from tauext.sim.config import Drivetrain

DIVERGED = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)


@dataclass(frozen=True)
class Truth:
    """True signals of one recording, each (samples, joints); sample k holds from t_k to t_{k+1}."""

    q: np.ndarray
    dq: np.ndarray
    ddq: np.ndarray
    """(dq_{k+1} - dq_k) / dt, the acceleration of the step that starts at sample k."""
    drive: np.ndarray
    """Torque of the drive, friction not subtracted."""
    friction: np.ndarray
    """Torque that friction and ripple take: positive against motion in the positive direction."""
    others: np.ndarray
    """Joint torque of every other actuator (pulses)."""
    touch: np.ndarray
    """Contact sensors, (samples, links, 10): found, force xyz, torque xyz, position xyz; no links without pads."""

    def after(self, samples: int) -> Truth:
        """The same without its first samples."""
        return Truth(**{f.name: getattr(self, f.name)[samples:] for f in fields(self)})


def roll_out(config: Drivetrain, model: mujoco.MjModel, q_start: np.ndarray, controls: np.ndarray) -> Truth:
    """Simulate a scene from rest at `q_start` (every position, pads included) under `controls` (samples, nu).

    Raises:
        ConfigError: the simulation diverged.
    """
    n = len(config.drives)
    data = mujoco.MjData(model)
    data.qpos[:] = q_start
    state = np.empty(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
    mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    with rollout.Rollout(nthread=0) as roller:
        states, sensors = roller.rollout(model, data, state[None], controls[None])
    if any(data.warning[kind].number for kind in DIVERGED):
        raise ConfigError(
            f"the simulation of {config.name} diverged; damping / rate_hz of drives and friction must stay well below "
            "the inertia that they move, and stiffness / rate_hz^2 too"
        )
    states = np.vstack([state, states[0]])
    q, dq = states[:, 1 : 1 + n], states[:, 1 + model.nq : 1 + model.nq + n]
    drive, bristles, actuators = (sensors[0, :, k : 3 * n : 3] for k in range(3))
    viscous = dq[:-1] * [friction.viscous_nm_s_rad for friction in config.friction]
    return Truth(
        q=q[:-1].copy(),
        dq=dq[:-1].copy(),
        ddq=np.diff(dq, axis=0) * config.rate_hz,
        drive=drive.copy(),
        friction=viscous - bristles,
        others=actuators - drive - bristles,
        touch=sensors[0, :, 3 * n :].reshape(len(controls), (sensors.shape[2] - 3 * n) // 10, 10).copy(),
    )
