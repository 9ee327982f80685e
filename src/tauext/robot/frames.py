"""Frames of the robot file at which forces are reported and loads are attached."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import mujoco

from tauext._core import Tree, WrenchFrame
from tauext.errors import RobotError
from tauext.robot.read import PlacedBody, placed_bodies
from tauext.robot.write import PAYLOAD

# --- Frames at which forces can be reported: every link or body that a joint in use moves.


def wrench_frames(path: str | os.PathLike[str], tree: Tree) -> list[WrenchFrame]:
    """Links (URDF) or bodies (MJCF) that a joint in use moves, placed in the core's link frames.

    Args:
        path: URDF or MJCF that the tree is of.
        tree: defines which joints are in use.
    """
    return [
        WrenchFrame(body.name, body.link, body.rotation.ravel().tolist(), body.translation.tolist())
        for body in placed_bodies(Path(path), tree)[2]
        if body.name and body.name != PAYLOAD
    ]


# --- The load frame: the last frame fixed behind the last joint in use.


def load_frame(path: str | os.PathLike[str], tree: Tree, name: str | None = None) -> PlacedBody:
    """The frame in which loads are specified.

    Args:
        path: URDF or MJCF that the tree is of.
        tree: defines which joints are in use.
        name: link (URDF) or body (MJCF) that a joint in use moves; None: the last one fixed to the arm's end link, else
            that link itself.

    Raises:
        RobotError: there is no such link, nothing moves it, or the arm has several ends and none is named.
    """
    path = Path(path)
    model, joint_ids, placed = placed_bodies(path, tree)
    if name and name not in (known := [body.name for body in placed if body.name]):
        raise RobotError(
            f"{path}: load frame {name!r} is no link that a joint in use moves; those are {', '.join(known)}"
        )
    number = None if name else _last_fixed(model, joint_ids, tree, path)
    return next(body for body in placed if (body.name == name if name else body.number == number))


def _last_fixed(model: mujoco.MjModel, joint_ids: Sequence[int], tree: Tree, path: Path) -> int:
    """Index of the last body in the chain of fixed links behind the last joint."""
    parents = {link.parent for link in tree.links}
    ends = [k for k in range(tree.size) if k not in parents]
    if len(ends) > 1:
        behind = ", ".join(tree.links[k].joint_name for k in ends)
        raise RobotError(f"{path}: the arm has {len(ends)} ends, behind {behind}: name the link that carries a load")
    body = int(model.jnt_bodyid[joint_ids[ends[0]]])
    usual_frames = ("tool0", "tcp", "end_effector", "ee_link", "flange")
    while True:
        fixed = [
            child
            for child in range(body + 1, model.nbody)
            if model.body_parentid[child] == body and not model.body_jntnum[child] and model.body(child).name != PAYLOAD
        ]
        if len(fixed) > 1:  # the search continues at the most usual name, or ends
            names = [model.body(child).name.lower() for child in fixed]
            fixed = [child for usual in usual_frames for child, name in zip(fixed, names, strict=True) if usual in name]
        if not fixed:
            return body
        body = fixed[0]
