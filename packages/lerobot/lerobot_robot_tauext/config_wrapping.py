"""Settings of robots that wrap another one."""

from dataclasses import dataclass, field
from typing import Any

import draccus
from lerobot.robots import RobotConfig


@dataclass(kw_only=True)
class WrappingConfig(RobotConfig):
    """The wrapped arm."""

    robot: dict[str, Any] = field(default_factory=dict)
    """The wrapped arm: its LeRobot type and options, or its RobotConfig. A dictionary, since LeRobot's parser recurses
    without end into a robot type that contains a robot."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.robot:
            raise ValueError("robot is missing: name the arm with --robot.robot='{type: so101_follower, port: ...}'")

    @property
    def wrapped(self) -> RobotConfig:
        """The wrapped arm's configuration.

        Raises:
            ValueError: LeRobot has no such type, or the type has no such option.
        """
        if isinstance(self.robot, RobotConfig):
            return self.robot
        try:
            return draccus.decode(RobotConfig, dict(self.robot))
        except draccus.utils.DecodingError as error:
            raise ValueError(f"robot = {self.robot}: is not a LeRobot robot: {error}") from error
