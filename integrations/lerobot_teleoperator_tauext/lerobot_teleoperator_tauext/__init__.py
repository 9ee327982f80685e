"""LeRobot leader with force feedback from the follower: teleoperator type tauext_leader."""

from lerobot_teleoperator_tauext.config_tauext_leader import TauextLeaderConfig
from lerobot_teleoperator_tauext.tauext_leader import TauextLeader

__all__ = ["TauextLeader", "TauextLeaderConfig"]
