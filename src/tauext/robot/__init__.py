"""Robot files to kinematic trees: load a URDF or MJCF, perturb the model, leave it out."""

from tauext.robot.load import load, robot_sha256
from tauext.robot.perturb import empty, perturbed
from tauext.robot.torque_limits import torque_limits

__all__ = ["empty", "load", "perturbed", "robot_sha256", "torque_limits"]
