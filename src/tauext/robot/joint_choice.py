"""Which joints of a robot file are in use, in which order, and where the others are held."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from tauext._core import MAX_JOINTS
from tauext.errors import RobotError

_KIND = {
    int(mujoco.mjtJoint.mjJNT_FREE): "a free joint (floating base)",
    int(mujoco.mjtJoint.mjJNT_BALL): "a ball joint",
}


@dataclass(frozen=True)
class JointChoice:
    """Joints in use, by their index in the model, and the pose: 0 for those in use, locked positions for the rest."""

    joint_ids: list[int]
    qpos: np.ndarray


def choose_joints(
    model: mujoco.MjModel, joints: Sequence[str] | None, locked: Mapping[str, float], where: str
) -> JointChoice:
    """Resolve names to joints; None takes every joint that is not locked.

    Raises:
        RobotError: see `tauext.robot.load.load_tree`; the message names `where`, the joint, and the joints that exist.
    """
    index = {model.joint(j).name: j for j in range(model.njnt) if model.joint(j).name}
    for name in [*(joints or ()), *locked]:
        if name not in index:
            raise RobotError(f"{where}: no joint {name!r}; its joints are {', '.join(index) or 'none'}")
    if joints is None:
        chosen = [j for j in range(model.njnt) if model.joint(j).name not in locked]
    else:
        for name in joints:
            if list(joints).count(name) > 1:
                raise RobotError(f"{where}: joint {name!r} is asked for twice; every joint stands once")
            if name in locked:
                raise RobotError(f"{where}: joint {name!r} is both in use and locked at {locked[name]}; choose one")
        chosen = [index[name] for name in joints]
    _check_chosen(model, chosen, where)

    qpos = np.array(model.qpos0)
    for name, position in locked.items():
        _check_locked(model, index[name], position, where)
        qpos[model.jnt_qposadr[index[name]]] = position
    qpos[model.jnt_qposadr[chosen]] = 0.0
    return JointChoice(chosen, qpos)


def _check_chosen(model: mujoco.MjModel, chosen: list[int], where: str) -> None:
    if not chosen:
        raise RobotError(f"{where}: no moving joint is left; a robot needs at least one that is not fixed or locked")
    for j in chosen:
        name, body = model.joint(j).name, model.body(model.jnt_bodyid[j]).name
        kind = _KIND.get(int(model.jnt_type[j]))
        if kind:
            raise RobotError(
                f"{where}: joint {name!r} of body {body!r} is {kind}; joints in use must be hinges or slides: "
                "name those in `joints`, and this one is held where the file has it"
            )
        if not name:
            raise RobotError(
                f"{where}: a joint of body {body!r} has no name; recordings name their joints: give it one in the file"
            )
    if len(chosen) > MAX_JOINTS:
        raise RobotError(f"{where}: {len(chosen)} joints in use, at most {MAX_JOINTS} can be: lock the others")


def _check_locked(model: mujoco.MjModel, joint: int, position: float, where: str) -> None:
    name, kind = model.joint(joint).name, _KIND.get(int(model.jnt_type[joint]))
    if kind:
        raise RobotError(f"{where}: joint {name!r} is {kind} and has no single position to be locked at")
    if not math.isfinite(position):
        raise RobotError(f"{where}: joint {name!r}: locked position {position} must be finite, [rad or m]")
