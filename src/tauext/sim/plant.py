"""The simulated arm, one sample at a time: drives and a push in, what the instruments say out."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from tauext import _core
from tauext.sim.arms import DemoArm
from tauext.sim.sensors import encoder, low_pass

STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS


@dataclass(frozen=True)
class Sample:
    """What one sample measured, and what is true; arrays (joints,)."""

    t_ns: int
    q: np.ndarray
    dq: np.ndarray
    tau: np.ndarray
    tau_ext: np.ndarray
    """True external torque J^T f of a push, [N m]."""
    tau_held: np.ndarray
    """The same of a weight in the hand: what a monitor sees that was not told of it, [N m]."""


class Plant:
    """An arm in MuJoCo at its sample rate, measured as tauext.sim.sensors.measure would measure it."""

    def __init__(self, arm: DemoArm, seed: int = 0):
        self.arm = arm
        self.model = arm.model
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
        self._weight: _core.Load | None = None

    @property
    def time_s(self) -> float:
        """Simulated, [s]."""
        return self._tick / self.arm.rate_hz

    @property
    def gravity_nm(self) -> np.ndarray:
        """Torque that holds the arm against gravity and its own motion, (joints,), [N m]."""
        return self.data.qfrc_bias.copy()

    def set_friction(self, factor: float) -> None:
        """Go on with so many times the arm's own friction; the bristles stay bent as they are."""
        self._friction = factor
        self._change()

    def hold(self, held: _core.Load | None) -> None:
        """Go on with this in the hand, at the hand's own speed; None: with nothing."""
        self._weight = held
        self._change()

    def _change(self) -> None:
        state = np.empty(mujoco.mj_stateSize(self.model, STATE))
        mujoco.mj_getState(self.model, self.data, state, STATE)
        self.model = self.arm.changed_model(self._friction, self._weight)
        self.data = mujoco.MjData(self.model)
        mujoco.mj_setState(self.model, self.data, state, STATE)
        mujoco.mj_forward(self.model, self.data)

    def step(
        self,
        q_des: np.ndarray,
        dq_des: np.ndarray,
        force_n: np.ndarray | None = None,
        point_m: np.ndarray | None = None,
        joint: int = 0,
    ) -> Sample:
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
        tau_ext = data.qfrc_applied.copy()
        mujoco.mj_step(self.model, data)
        if self._q_before is not None:  # low_pass over two samples is one step of the drive's filter
            difference = (q - self._q_before) * arm.rate_hz
            self._dq = low_pass(np.stack([self._dq, difference]), arm.sensors.velocity_cutoff_rad_s, 1.0 / arm.rate_hz)[
                1
            ]
        self._q_before = q
        tau = data.sensordata[: 3 * self._n : 3] + self._rng.standard_normal(self._n) * arm.sensors.torque_noise_nm
        t_ns = round(self._tick * 1e9 / arm.rate_hz)
        self._tick += 1
        return Sample(t_ns, q, self._dq, tau, tau_ext, self._held_nm())

    def _held_nm(self) -> np.ndarray:
        """What the weight does to the joints, by gravity and inertia: the wrench from hand to weight, turned round."""
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

    def jacobian(self, point_m: np.ndarray, joint: int) -> np.ndarray:
        """Jacobian (3, joints) of a point of the link that a joint carries: tau = J^T f."""
        jacobian = np.zeros((3, self.model.nv))
        mujoco.mj_jac(self.model, self.data, jacobian, None, point_m, joint + 1)
        return jacobian
