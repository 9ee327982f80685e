"""Settings of the wrapping robot."""

from dataclasses import dataclass
from pathlib import Path

from lerobot.robots import RobotConfig

from lerobot_robot_tauext.config_wrapping import WrappingConfig

REACTIONS = ("none", "hold", "stop")


@RobotConfig.register_subclass("tauext")
@dataclass(kw_only=True)
class TauextConfig(WrappingConfig):
    """`--robot.type=tauext --robot.robot='{type: so101_follower, ...}' --robot.bundle=FILE --robot.arm=arm.toml`."""

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
        if self.on_collision not in REACTIONS:
            raise ValueError(f"on_collision = {self.on_collision!r} must be one of {', '.join(REACTIONS)}")
        if not self.resume_within > 0:
            raise ValueError(f"resume_within = {self.resume_within} must be > 0")
