"""Frames of the robot file: those at which forces are reported, and the one that carries the load."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import mujoco

from tauext._core import Tree, WrenchFrame
from tauext.errors import RobotError
from tauext.robot.load import PlacedBody, placed_bodies
from tauext.robot.write import PAYLOAD

# --- Frames of the robot file at which forces can be reported: every link or body that a joint in use moves.


def wrench_frames(path: str | os.PathLike[str], tree: Tree) -> list[WrenchFrame]:
    """Links (URDF) or bodies (MJCF) that a joint in use moves, as seen from the core's frames of their links.

    Args:
        path: URDF or MJCF that the tree is of.
        tree: defines which joints are in use.
    """
    return [
        WrenchFrame(body.name, body.link, body.rotation.ravel().tolist(), body.translation.tolist())
        for body in placed_bodies(Path(path), tree)[2]
        if body.name and body.name != PAYLOAD
    ]


# --- Where a robot file lets something be fixed to the arm: its last fixed frame behind the last joint in use.


USUAL_FRAMES = ("tool0", "tcp", "end_effector", "ee_link", "flange")
"""Where several links are fixed to one, the way goes on to a name with the first of these in it, or ends."""


def load_frame(path: str | os.PathLike[str], tree: Tree, name: str | None = None) -> PlacedBody:
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
    model, joint_ids, placed = placed_bodies(path, tree)
    if name and name not in (known := [body.name for body in placed if body.name]):
        raise RobotError(
            f"{path}: load frame {name!r} is no link that a joint in use moves; they are {', '.join(known)}"
        )
    number = None if name else _last_fixed(model, joint_ids, tree, path)
    return next(body for body in placed if (body.name == name if name else body.number == number))


def _last_fixed(model: mujoco.MjModel, joint_ids: Sequence[int], tree: Tree, path: Path) -> int:
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
