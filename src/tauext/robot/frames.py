"""Frames of the robot file: those at which forces are reported, and the one that carries the load."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from tauext._core import Tree, WrenchFrame
from tauext.errors import RobotError
from tauext.robot.load import carriers, choose_joints, compiled, frame_of_joint
from tauext.robot.write import PAYLOAD

# --- Frames of the robot file at which forces can be reported: every link or body that a joint in use moves.


def wrench_frames(path: str | os.PathLike[str], tree: Tree) -> list[WrenchFrame]:
    """Links (URDF) or bodies (MJCF) that a joint in use moves, as seen from the core's frames of their links.

    Args:
        path: URDF or MJCF that the tree is of.
        tree: defines which joints are in use.
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


# --- Where a robot file lets something be fixed to the arm: its last fixed frame behind the last joint in use.


USUAL_FRAMES = ("tool0", "tcp", "end_effector", "ee_link", "flange")
"""Where several links are fixed to one, the way goes on to a name with the first of these in it, or ends."""


@dataclass(frozen=True)
class LoadFrame:
    """A frame of the robot file, as seen from the core's frame of the link that carries it."""

    name: str
    link: int
    rotation: np.ndarray
    """(3, 3), link from frame."""
    translation: np.ndarray
    """(3,), [m]."""


def load_frame(path: str | os.PathLike[str], tree: Tree, name: str | None = None) -> LoadFrame:
    """The frame that a load is given in.

    Args:
        path: URDF or MJCF that the tree is of.
        tree: defines which joints are in use.
        name: of a link (URDF) or body (MJCF) that a joint in use moves; None: the last one that is fixed to the link
            at the end of the arm, else that link itself.

    Raises:
        RobotError: there is no such link, nothing moves it, or the arm has several ends and none is named.
    """
    path = Path(path)
    model = compiled(path, keep_fixed=True)
    joints = [link.joint_name for link in tree.links]
    choice = choose_joints(model, joints, {}, str(path))
    carrier = carriers(model, choice.joint_ids)
    body = _named(model, carrier, name, path) if name else _last_fixed(model, carrier, choice.joint_ids, tree, path)
    data = mujoco.MjData(model)
    data.qpos[:] = choice.qpos
    mujoco.mj_kinematics(model, data)
    link = carrier[body]
    frame, origin = frame_of_joint(data, choice.joint_ids[link])
    turned = frame.T @ np.array(data.xmat[body]).reshape(3, 3)
    return LoadFrame(model.body(body).name, link, turned, frame.T @ (np.array(data.xpos[body]) - origin))


def _named(model: mujoco.MjModel, carrier: Sequence[int], name: str, path: Path) -> int:
    names = [model.body(body).name for body in range(model.nbody)]
    moved = [one for one, link in zip(names, carrier, strict=True) if link >= 0 and one]
    if name not in moved:
        known = ", ".join(moved)
        raise RobotError(f"{path}: load frame {name!r} is no link that a joint in use moves; they are {known}")
    return names.index(name)


def _last_fixed(model: mujoco.MjModel, carrier: Sequence[int], joint_ids: Sequence[int], tree: Tree, path: Path) -> int:
    """As far as one fixed link follows the other behind the last joint."""
    parents = {link.parent for link in tree.links}
    ends = [k for k in range(tree.size) if k not in parents]
    if len(ends) > 1:
        behind = ", ".join(tree.links[k].joint_name for k in ends)
        raise RobotError(f"{path}: the arm has {len(ends)} ends, behind {behind}: name the link that carries a load")
    body = int(model.jnt_bodyid[joint_ids[ends[0]]])
    while True:
        fixed = [
            child
            for child in range(body + 1, model.nbody)
            if model.body_parentid[child] == body and not model.body_jntnum[child] and model.body(child).name != PAYLOAD
        ]
        if len(fixed) > 1:
            names = [model.body(child).name.lower() for child in fixed]
            fixed = [child for usual in USUAL_FRAMES for child, name in zip(fixed, names, strict=True) if usual in name]
        if not fixed:
            return body
        body = fixed[0]
