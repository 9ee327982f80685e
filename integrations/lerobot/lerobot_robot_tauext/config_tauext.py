"""Settings of the wrapping robot."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import draccus
from lerobot.robots import RobotConfig

REACTIONS = ("none", "hold", "stop")


@RobotConfig.register_subclass("tauext")
@dataclass(kw_only=True)
class TauextConfig(RobotConfig):
    """`--robot.type=tauext --robot.robot='{type: so101_follower, ...}' --robot.bundle=FILE --robot.arm=arm.toml`."""

    robot: dict[str, Any] = field(default_factory=dict)
    """The wrapped arm: its LeRobot type and options, or its RobotConfig. A dictionary, since LeRobot's parser recurses
    without end into a robot type that contains a robot."""
    bundle: Path
    """Bundle written by `tauext train`. Its rate must equal the loop's (`--dataset.fps`)."""
    arm: Path
    """The arm.toml with which the bundle's recordings were imported."""
    on_collision: str = "none"
    """none; hold: send the present position as goal until the commanded goal returns to it; stop: the same, and end the
    program."""
    resume_within: float = 5.0
    """A hold ends once every commanded goal is this close to the held position, in the robot's units."""
    episodes_begin_anew: bool = True
    """True: the monitor restarts with every recorded episode, so that `tauext label` reproduces the labels. It has no
    estimate in the first half to whole second of each. False: it continues."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.robot:
            raise ValueError("robot is missing: name the arm with --robot.robot='{type: so101_follower, port: ...}'")
        if self.on_collision not in REACTIONS:
            raise ValueError(f"on_collision = {self.on_collision!r} must be one of {', '.join(REACTIONS)}")
        if not self.resume_within > 0:
            raise ValueError(f"resume_within = {self.resume_within} must be > 0")

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
