"""LeRobot finds this package by its name: `--robot.type=tauext` wraps another robot."""

from lerobot_robot_tauext.config_tauext import TauextConfig
from lerobot_robot_tauext.reactions import CollisionStop
from lerobot_robot_tauext.tauext_robot import Tauext

__all__ = ["CollisionStop", "Tauext", "TauextConfig"]
