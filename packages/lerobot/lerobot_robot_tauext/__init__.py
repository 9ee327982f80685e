"""What LeRobot finds: robot types tauext and tauext_guard wrap another robot, teleoperator type tauext_leader a leader.

LeRobot imports the module that has the name of an installed distribution, if this begins with lerobot_robot_.
"""

from lerobot_robot_tauext.config_tauext import TauextConfig
from lerobot_robot_tauext.config_tauext_guard import TauextGuardConfig
from lerobot_robot_tauext.config_tauext_leader import TauextLeaderConfig
from lerobot_robot_tauext.tauext_guard import TauextGuard
from lerobot_robot_tauext.tauext_leader import TauextLeader
from lerobot_robot_tauext.tauext_robot import CollisionStop, Tauext

__all__ = [
    "CollisionStop",
    "Tauext",
    "TauextConfig",
    "TauextGuard",
    "TauextGuardConfig",
    "TauextLeader",
    "TauextLeaderConfig",
]
