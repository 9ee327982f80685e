"""Frames of the robot file at which forces can be told: every link or body that a joint in use moves."""

from __future__ import annotations

import os
from pathlib import Path

import mujoco
import numpy as np

from tauext._core import Tree, WrenchFrame
from tauext.robot.joint_choice import choose_joints
from tauext.robot.load import compiled
from tauext.robot.tree_from_mujoco import carriers, frame_of_joint
from tauext.robot.write import PAYLOAD


def wrench_frames(path: str | os.PathLike[str], tree: Tree) -> list[WrenchFrame]:
    """Links (URDF) or bodies (MJCF) that a joint in use moves, as seen from the core's frames of their links.

    Args:
        path: URDF or MJCF that the tree is of.
        tree: says which joints are in use.
    """
    path = Path(path)
    model = compiled(path, keep_fixed=True)
    choice = choose_joints(model, [link.joint_name for link in tree.links], {}, str(path))
    data = mujoco.MjData(model)
    data.qpos[:] = choice.qpos
    mujoco.mj_kinematics(model, data)
    frames = []
    for body, link in enumerate(carriers(model, choice.joint_ids)):
        name = model.body(body).name
        if link < 0 or not name or name == PAYLOAD:
            continue
        axes, origin = frame_of_joint(data, choice.joint_ids[link])
        turned = axes.T @ np.array(data.xmat[body]).reshape(3, 3)
        place = axes.T @ (np.array(data.xpos[body]) - origin)
        frames.append(WrenchFrame(name, link, turned.ravel().tolist(), place.tolist()))
    return frames
