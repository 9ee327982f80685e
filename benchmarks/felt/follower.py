"""The follower: servos hold the goals they are sent; what it reports 50 times a second."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from felt.arm import STEP_S, Arm, Wall
from felt.servo import Servo, counted

TICK_S = 0.02
TICK_STEPS = round(TICK_S / STEP_S)


@dataclass(frozen=True)
class Report:
    """What the follower says at a tick: (joints,) each."""

    q: np.ndarray
    """By its encoders, [rad]."""
    goal: np.ndarray
    """That it followed since the last tick, [rad]."""
    outside_nm: np.ndarray
    """The truth, [N m]: torque of the wall."""


class Follower:
    """An SO-101-like arm under position control, perhaps before a wall."""

    def __init__(self, servo: Servo, wall: Wall | None):
        self.arm, self.wall, self._servo = Arm(servo), wall, servo
        self._goal = counted(self.arm.q)

    def tick(self, goal: np.ndarray) -> Report:
        """20 ms under this goal; the answer is of their end."""
        self._goal = counted(goal)
        felt = np.zeros(3)
        for _ in range(TICK_STEPS):
            arm = self.arm
            duty = self._servo.duty(self._goal - counted(arm.q))
            arm.step(self._servo.torque(duty, arm.dq), self.wall.force(arm) if self.wall else None)
            felt += arm.outside_nm
        return Report(counted(self.arm.q), self._goal.copy(), felt / TICK_STEPS)
