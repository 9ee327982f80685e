"""Settings of the guarding robot."""

import math
from dataclasses import dataclass
from pathlib import Path

from lerobot.robots import RobotConfig

from lerobot_robot_tauext.config_wrapping import WrappingConfig

REACTIONS = ("report", "limit", "open")


@RobotConfig.register_subclass("tauext_guard")
@dataclass(kw_only=True)
class TauextGuardConfig(WrappingConfig):
    """`--robot.type=tauext_guard --robot.guard=DIR --robot.on_stall=limit --robot.robot='{type: ..., ...}'`."""

    guard: Path
    """Folder that `tauext guard` made."""
    on_stall: str = "report"
    """report: log it, and write nothing. limit: keep the joint's goal so close to its position that it pushes with a
    usual torque. open: the same, and open the gripper."""
    on_grip: str = "report"
    """The same, where the gripper grips harder than declared. limit: keep the declared grip. open: open it."""
    open_at: float = 100.0
    """Goal that opens the gripper, in the robot's units."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("on_stall", "on_grip"):
            if getattr(self, name) not in REACTIONS:
                raise ValueError(f"{name} = {getattr(self, name)!r} must be one of {', '.join(REACTIONS)}")
        if not math.isfinite(self.open_at):
            raise ValueError(f"open_at = {self.open_at} must be a finite number")
