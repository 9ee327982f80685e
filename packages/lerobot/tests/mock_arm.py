"""A LeRobot robot whose servos are simulated, and a teleoperator that plays a demonstration."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import lerobot_arm as arms
import numpy as np
from lerobot.robots import Robot, RobotConfig

NAMES = [f"{name}.pos" for name in arms.MOTORS]


@RobotConfig.register_subclass("mock_arm")
@dataclass(kw_only=True)
class MockArmConfig(RobotConfig):
    """`wall_at`: the tick at which a wall appears in front of the first joint; 0: none."""

    wall_at: int = 0
    max_relative_target: float | None = None


class Plug:
    """How a mock connects: nothing needs to be opened, calibrated or configured."""

    is_calibrated = True
    connected = False

    @property
    def is_connected(self) -> bool:
        return self.connected

    def connect(self, calibrate: bool = True) -> None:
        self.connected = True

    def calibrate(self) -> None:
        pass

    def configure(self) -> None:
        pass

    def disconnect(self) -> None:
        self.connected = False


class MockArm(Plug, Robot):
    """Positions in degrees; a tick of the clock passes with every action."""

    config_class = MockArmConfig
    name = "mock_arm"

    def __init__(self, config: MockArmConfig):
        super().__init__(config)
        self.config = config
        self.arm = arms.ServoArm("deg")
        self.ticks, self.sent = 0, []

    @cached_property
    def observation_features(self) -> dict:
        return dict.fromkeys(NAMES, float)

    @cached_property
    def action_features(self) -> dict:
        return dict.fromkeys(NAMES, float)

    def get_observation(self) -> dict:
        return dict(zip(NAMES, map(float, self.arm.state()[0]), strict=True))

    def send_action(self, action: dict) -> dict:
        self.sent.append(dict(action))
        self.ticks += 1
        if self.ticks == self.config.wall_at:
            self.arm.wall = self.arm.q[:, 0] - 0.02
        self.arm.send(np.array([[float(action[name]) for name in NAMES]]))
        self.arm.run()
        return dict(action)


class Player:
    """What a leader arm would give, a tick a call."""

    def __init__(self, seed: int):
        self._person, self._tick = arms.Demonstration(seed, arms.Units("deg")), 0

    def action(self) -> dict:
        self._tick += 1
        return dict(zip(NAMES, map(float, self._person.action(self._tick / arms.FPS)), strict=True))
