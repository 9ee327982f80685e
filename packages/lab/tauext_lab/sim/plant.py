"""A simulated arm sample by sample, and the motion that it is commanded."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass

import mujoco
import numpy as np

from tauext import _core
from tauext_lab.sim.arms import GearedArm
from tauext_lab.sim.config import changed_friction
from tauext_lab.sim.rig import LOAD_HELD_S, draw_move, encoder, low_pass, quintic, set_load

# --- The simulated arm, one sample at a time: drives and a push in, measurements out.


STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS


@dataclass(frozen=True)
class PlantSample:
    """Measured and true values of one sample; arrays (joints,)."""

    t_ns: int
    q: np.ndarray
    dq: np.ndarray
    tau: np.ndarray
    tau_ext: np.ndarray
    """True external torque J^T f of a push, [N m]."""
    tau_held: np.ndarray
    """Torque of a weight in the hand: external torque for a monitor without this load, [N m]."""


class Plant:
    """An arm in MuJoCo at its sample rate, measured as tauext_lab.sim.rig.measure would measure it."""

    def __init__(self, arm: GearedArm, seed: int = 0):
        self.arm = arm
        self.model = copy(arm.model)  # its friction changes
        self.data = mujoco.MjData(self.model)
        self.data.qpos[:] = arm.home
        mujoco.mj_forward(self.model, self.data)
        self._rng = np.random.default_rng(seed)
        self._n = len(arm.joints)
        self._tick = 0
        self._q_before: np.ndarray | None = None
        self._dq = np.zeros(self._n)
        self._controls = np.empty((self._n, 2))
        self._friction = 1.0
        self._joints = arm.friction
        self._load_nm = np.zeros(self._n)
        self._load_sum, self._load_samples = np.zeros(self._n), round(LOAD_HELD_S * arm.rate_hz)
        self._weight: _core.Load | None = None

    @property
    def time_s(self) -> float:
        """Simulated, [s]."""
        return self._tick / self.arm.rate_hz

    def set_friction(self, factor: float) -> None:
        """Go on with so many times the arm's own friction; the bristles stay bent as they are."""
        self._friction, self._joints = factor, changed_friction(self.arm.friction, factor)
        self.model.actuator_damping[self._n : 2 * self._n] = [joint.viscous_nm_s_rad for joint in self._joints]
        set_load(self.model, self._joints, self._load_nm)

    def hold(self, held: _core.Load | None) -> None:
        """Go on with this in the hand, at the hand's own speed; None: with nothing."""
        self._weight = held
        state = np.empty(mujoco.mj_stateSize(self.model, STATE))
        mujoco.mj_getState(self.model, self.data, state, STATE)
        self.model = self.arm.changed_model(self._friction, self._weight)
        self.data = mujoco.MjData(self.model)
        set_load(self.model, self._joints, self._load_nm)
        mujoco.mj_setState(self.model, self.data, state, STATE)
        mujoco.mj_forward(self.model, self.data)

    def step(
        self,
        q_des: np.ndarray,
        dq_des: np.ndarray,
        force_n: np.ndarray | None = None,
        point_m: np.ndarray | None = None,
        joint: int = 0,
    ) -> PlantSample:
        """One sample period under these setpoints, (joints,), [rad], [rad/s].

        Args:
            force_n: on the link that `joint` carries, in the base frame (3,), [N]; None: nothing touches the arm.
            point_m: where it acts, in the base frame (3,), [m].
        """
        arm, data = self.arm, self.data
        q = encoder(data.qpos, arm.sensors.encoder_counts)
        self._controls[:, 0], self._controls[:, 1] = q_des, dq_des
        data.ctrl[:] = self._controls.ravel()
        data.qfrc_applied[:] = 0.0
        if force_n is not None:
            mujoco.mj_applyFT(self.model, data, force_n, np.zeros(3), point_m, joint + 1, data.qfrc_applied)
        tau_ext, before = data.qfrc_applied.copy(), data.qvel.copy()
        mujoco.mj_step(self.model, data)
        self._follow_load(before)
        if self._q_before is not None:  # low_pass over two samples is one step of the drive's filter
            difference = (q - self._q_before) * arm.rate_hz
            self._dq = low_pass(np.stack([self._dq, difference]), arm.sensors.velocity_cutoff_rad_s, 1.0 / arm.rate_hz)[
                1
            ]
        self._q_before = q
        tau = data.sensordata[: 3 * self._n : 3] + self._rng.standard_normal(self._n) * arm.sensors.torque_noise_nm
        t_ns = round(self._tick * 1e9 / arm.rate_hz)
        self._tick += 1
        return PlantSample(t_ns, q, self._dq, tau, tau_ext, self._held_nm())

    def _follow_load(self, dq_before: np.ndarray) -> None:
        """After a step: friction that depends on the load follows its mean, as in tauext_lab.sim.rig.roll_out."""
        drive, bristles = (self.data.sensordata[k : 3 * self._n : 3] for k in range(2))
        viscous = self.model.actuator_damping[self._n : 2 * self._n] * self.data.qvel
        rotor = self.arm.rotor_inertia_kg_m2 * (self.data.qvel - dq_before) * self.arm.rate_hz
        self._load_sum += drive + bristles - viscous - rotor
        if (self._tick + 1) % self._load_samples == 0:
            self._load_nm, self._load_sum = self._load_sum / self._load_samples, np.zeros(self._n)
            set_load(self.model, self._joints, self._load_nm)

    def _held_nm(self) -> np.ndarray:
        """Torque of the weight on the joints, by gravity and inertia: the wrench from hand to weight, turned round."""
        torque = np.zeros(self._n)
        if self._weight is not None:
            mujoco.mj_rnePostConstraint(self.model, self.data)
            wrench = -self.data.cfrc_int[self._n + 1]  # torque, force; about the centre of mass of the whole arm
            about = self.data.subtree_com[1]
            mujoco.mj_applyFT(self.model, self.data, wrench[3:], wrench[:3], about, self._n, torque)
        return torque

    def body_pose(self, joint: int) -> tuple[np.ndarray, np.ndarray]:
        """Position (3,) and rotation (3, 3) to the base frame of the link that a joint carries."""
        return self.data.xpos[joint + 1].copy(), self.data.xmat[joint + 1].reshape(3, 3).copy()


# --- The motion that an arm is commanded.


STOP_S = 0.2
"""Whatever comes next, the setpoint's speed dies away in so long, at constant deceleration: at once would jerk the arm,
and raise an alarm of its own."""


class Mover:
    """Setpoints of one arm, sample by sample: moves around its home until stop(), and again after resume()."""

    def __init__(self, arm: GearedArm, seed: int = 0):
        self.q_des, self.dq_des = np.array(arm.home), np.zeros(len(arm.joints))
        self._motion, self._home = arm.motion, np.array(arm.home)
        self._rng = np.random.default_rng(seed)
        self._period_s = 1.0 / arm.rate_hz
        self._stopped = False
        self._plan(*draw_move(arm.motion, np.zeros(len(arm.home)), self._rng))

    def step(self) -> tuple[np.ndarray, np.ndarray]:
        """Setpoints of the next sample, (joints,), [rad], [rad/s]."""
        self._time_s += self._period_s
        done, rate = quintic(np.asarray(self._time_s / self._duration_s))
        since_s = min(self._time_s + self._pause_s, STOP_S)
        self.q_des = self._start + self._travel * done + self._speed * (since_s - 0.5 * since_s**2 / STOP_S)
        self.dq_des = self._travel * rate / self._duration_s + self._speed * (1.0 - since_s / STOP_S)
        if not self._stopped and self._time_s >= self._duration_s:
            self._plan(*draw_move(self._motion, self.q_des - self._home, self._rng))
        return self.q_des, self.dq_des

    def stop(self) -> None:
        """Come to rest and hold still until resume()."""
        self._stopped = True
        self._plan(0.0, 0.0 * self.q_des, STOP_S)

    def resume(self) -> None:
        """Go on with moves from the setpoint, which holds the arm's weight: the measured pose would let it sag."""
        self._stopped = False
        rests_at = self.q_des + 0.5 * STOP_S * self.dq_des
        _, travel, duration_s = draw_move(self._motion, rests_at - self._home, self._rng)
        self._plan(0.0, travel, duration_s)

    def _plan(self, pause_s: float, travel: np.ndarray, duration_s: float) -> None:
        """Restart from here: the remaining speed decays, and after the pause the travel begins."""
        self._start, self._speed, self._travel = self.q_des, self.dq_des, travel
        self._duration_s, self._pause_s, self._time_s = duration_s, pause_s, -pause_s
