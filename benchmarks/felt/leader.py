"""The leader: motors that give the torque they are told, moved by a hand that is a spring, a damper and a mass."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from felt.arm import STEP_S, Arm
from felt.follower import TICK_STEPS
from felt.servo import Servo, counted


@dataclass(frozen=True)
class Hand:
    """How a person holds the leader: the hand is drawn to where the person wants it."""

    name: str
    n_per_m: float
    n_s_per_m: float
    kg: float


HANDS = (Hand("two fingers", 50.0, 2.0, 0.1), Hand("loose", 150.0, 6.0, 0.3), Hand("firm", 400.0, 20.0, 0.5))
"""From a light hold to a firm one: a relaxed human arm has some 100 to 400 N/m at the hand."""


@dataclass(frozen=True)
class Gears:
    """What the leader's gears take."""

    name: str
    servo: Servo


GEARS = (
    Gears("STS3215", Servo()),
    Gears("light", replace(Servo(), coulomb_nm=0.01, motor_share=0.0, load_share=0.0, viscous_nm_s_rad=0.004)),
)
"""Those of an SO-101's servo, and some that hardly rub, which are the harder case."""


class Leader:
    """Its weight is carried by the hand: there is no gravity."""

    def __init__(self, gears: Gears, hand: Hand):
        self.arm, self.hand = Arm(gears.servo, gravity=0.0, hand_kg=hand.kg, led=True), hand
        self._wanted = self.arm.tip

    @property
    def q(self) -> np.ndarray:
        """By its encoders, [rad]."""
        return counted(self.arm.q)

    def tick(self, wanted: np.ndarray, torque_nm: np.ndarray) -> None:
        """20 ms in which the person's wish goes on to `wanted`, (3,), [m], and the motors hold the torque."""
        way = (wanted - self._wanted) / TICK_STEPS
        speed = way / STEP_S
        for _ in range(TICK_STEPS):
            self._wanted = self._wanted + way
            arm, hand = self.arm, self.hand
            velocity = arm.jacobian() @ arm.dq
            force = hand.n_per_m * (self._wanted - arm.tip) + hand.n_s_per_m * (speed - velocity)
            arm.step(torque_nm, force)
