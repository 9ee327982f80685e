"""Settings of a robot that is wrapped."""

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
    """The arm itself, as LeRobot knows it: its type and its own options, or its RobotConfig. A dictionary, since
    LeRobot's parser follows a type into itself without end, whatever robot is asked for."""
    bundle: Path
    """Trained by `tauext train`; its rate must be that of the loop (`--dataset.fps`)."""
    arm: Path
    """The arm.toml that the bundle's recordings were imported with."""
    on_collision: str = "none"
    """none; hold: send the present position as goal until the commanded goal comes back to it; stop: the same, and end
    the program."""
    resume_within: float = 5.0
    """A hold ends once every commanded goal is so near to the held position, in the robot's own units."""
    episodes_begin_anew: bool = True
    """The monitor restarts with every recorded episode, so that the dataset gives the same answers again; it knows
    nothing for the first half to whole second then. False: it goes on."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.robot:
            raise ValueError("robot is missing: the arm itself, --robot.robot='{type: so101_follower, port: ...}'")
        if self.on_collision not in REACTIONS:
            raise ValueError(f"on_collision = {self.on_collision!r} must be one of {', '.join(REACTIONS)}")
        if not self.resume_within > 0:
            raise ValueError(f"resume_within = {self.resume_within} must be > 0")

    @property
    def wrapped(self) -> RobotConfig:
        """The arm's own configuration.

        Raises:
            ValueError: it is none of LeRobot's: no such type, an option that it does not have.
        """
        if isinstance(self.robot, RobotConfig):
            return self.robot
        try:
            return draccus.decode(RobotConfig, dict(self.robot))
        except draccus.utils.DecodingError as error:
            raise ValueError(f"robot = {self.robot}: is no robot of LeRobot's: {error}") from error
