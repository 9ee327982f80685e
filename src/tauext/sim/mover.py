"""What the arm is told to do: random moves, and what it does instead after a collision."""

from __future__ import annotations

from collections import deque
from typing import Literal, get_args

import numpy as np

from tauext.sim.arms import DemoArm
from tauext.sim.motions import draw_move, quintic

Reaction = Literal["stop", "retreat", "comply", "ignore"]
REACTIONS: tuple[Reaction, ...] = get_args(Reaction)
RETREAT_S = 0.4
"""A retreat goes back to where the arm was so long before the collision ..."""
RETREAT_TIME_S = 0.5
"""... and takes so long."""
TRAIL_EVERY_S = 0.02
STOP_S = 0.2
"""Whatever comes next, the setpoint's speed dies away in so long, at constant deceleration: at once would jerk the arm,
and raise an alarm of its own."""
COMPLY_DAMPING = 0.1
"""Share of the drive's damping that stays while the arm gives way."""


class Mover:
    """Setpoints of one arm, sample by sample: moves around its home until react() is called, and again after resume().

    comply: the drive's own PD inputs are used to give the torque that carries the arm's weight, with neither stiffness
    nor friction compensation, so that whoever pushes harder than the joints' friction moves it.
    """

    def __init__(self, arm: DemoArm, seed: int = 0):
        self.arm = arm
        self.doing: Literal["moving", "stop", "retreat", "comply"] = "moving"
        self.q_des, self.dq_des = np.array(arm.home), np.zeros(len(arm.joints))
        self._home = np.array(arm.home)
        self._stiffness = np.array([drive.stiffness_nm_rad for drive in arm.drives])
        self._damping = np.array([drive.damping_nm_s_rad for drive in arm.drives])
        self._rng = np.random.default_rng(seed)
        self._period_s = 1.0 / arm.rate_hz
        self._trail: deque[np.ndarray] = deque(maxlen=round(RETREAT_S / TRAIL_EVERY_S) + 1)
        self._ticks = 0
        self._plan(*draw_move(arm.motion, np.zeros(len(arm.home)), self._rng))

    def step(self, q: np.ndarray, dq: np.ndarray, gravity_nm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Setpoints of the next sample, (joints,), [rad], [rad/s].

        Args:
            q, dq: as measured.
            gravity_nm: what carries the arm's weight, as its controller knows it.
        """
        self._time_s += self._period_s
        if self.doing == "comply":
            self.q_des = q + gravity_nm / self._stiffness
            self.dq_des = (1.0 - COMPLY_DAMPING) * dq
        else:
            done, rate = quintic(np.asarray(self._time_s / self._duration_s))
            since_s = min(self._time_s + self._pause_s, STOP_S)
            self.q_des = self._start + self._travel * done + self._speed * (since_s - 0.5 * since_s**2 / STOP_S)
            self.dq_des = self._travel * rate / self._duration_s + self._speed * (1.0 - since_s / STOP_S)
            if self.doing == "moving" and self._time_s >= self._duration_s:
                self._plan(*draw_move(self.arm.motion, self.q_des - self._home, self._rng))
        if self.doing == "moving" and self._ticks % round(TRAIL_EVERY_S * self.arm.rate_hz) == 0:
            self._trail.append(self.q_des)
        self._ticks += 1
        return self.q_des, self.dq_des

    def react(self, reaction: Reaction) -> None:
        """Do this about a collision; resume() ends it."""
        if reaction == "ignore":
            return
        self.doing = reaction
        if reaction == "retreat" and self._trail:
            self._plan(0.0, self._trail[0] - self._rests_at(), RETREAT_TIME_S)
        else:
            self._plan(0.0, 0.0 * self.q_des, RETREAT_TIME_S)
        self._trail.clear()

    def rest(self) -> None:
        """Hold still where the arm is, until resume()."""
        self.react("stop")

    def resume(self) -> None:
        """Go on with moves from the setpoint, which holds the arm's weight: the measured pose would let it sag."""
        was, self.doing = self.doing, "moving"
        self._trail.clear()
        if was == "comply":
            self.dq_des = 0.0 * self.dq_des  # which followed the arm and is no setpoint's speed
        _, travel, duration_s = draw_move(self.arm.motion, self._rests_at() - self._home, self._rng)
        self._plan(0.0, travel, duration_s)

    def _rests_at(self) -> np.ndarray:
        """Where the setpoint comes to rest if nothing else moves it."""
        return self.q_des + 0.5 * STOP_S * self.dq_des

    def _plan(self, pause_s: float, travel: np.ndarray, duration_s: float) -> None:
        """From here: what is left of the speed dies away, and after the pause the travel begins."""
        self._start, self._speed, self._travel = self.q_des, self.dq_des, travel
        self._duration_s, self._pause_s, self._time_s = duration_s, pause_s, -pause_s
