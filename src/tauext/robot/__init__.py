"""Robot files to kinematic trees: load a URDF or MJCF, perturb the model, leave it out."""

from tauext.robot.capsules import body_capsules, link_capsules, write_shapes
from tauext.robot.frames import wrench_frames
from tauext.robot.load import load_tree, movable_joints, robot_sha256
from tauext.robot.load_frame import LoadFrame, load_frame
from tauext.robot.model_case import chosen_case, estimated_model
from tauext.robot.perturb import empty, perturbed
from tauext.robot.torque_limits import torque_limits
from tauext.robot.write import Payload, is_placeholder, write_placeholder, write_robot

__all__ = [
    "LoadFrame",
    "Payload",
    "body_capsules",
    "chosen_case",
    "empty",
    "estimated_model",
    "is_placeholder",
    "link_capsules",
    "load_frame",
    "load_tree",
    "movable_joints",
    "perturbed",
    "robot_sha256",
    "torque_limits",
    "wrench_frames",
    "write_placeholder",
    "write_robot",
    "write_shapes",
]
