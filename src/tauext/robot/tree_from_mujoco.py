"""Turn a compiled MuJoCo model into a tree: one link per joint in use, everything rigidly attached fused into it."""

from collections.abc import Sequence

import mujoco
import numpy as np

from tauext._core import CoreError, JointType, Link, Tree
from tauext.errors import RobotError

LEAST = 2e-15
"""Mass [kg] and inertia [kg m^2] at or below this count as none; MuJoCo's own least mass of a moving body is 1e-15."""


def carriers(model: mujoco.MjModel, joint_ids: Sequence[int]) -> list[int]:
    """For each body of the model, the joint in use that carries it, as position in `joint_ids`; -1: it never moves."""
    place = {joint: i for i, joint in enumerate(joint_ids)}
    carrier = [-1] * model.nbody
    for body in range(1, model.nbody):
        carrier[body] = carrier[model.body_parentid[body]]
        for joint in _joints_of(model, body):
            carrier[body] = place.get(joint, carrier[body])
    return carrier


def make_tree(
    model: mujoco.MjModel, joint_ids: Sequence[int], qpos: np.ndarray, gravity: Sequence[float], where: str
) -> Tree:
    """The tree whose q = 0 is the pose `qpos`, in which joints in use stand at 0 and the others where they are locked.

    All is read off that one pose in the base frame: MuJoCo has then dealt with joint offsets, reference positions and
    several joints on one body.

    Raises:
        RobotError: a link that moves has no mass, or a number of it makes no sense.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    carrier = carriers(model, joint_ids)
    parents = [_parent(model, joint, joint_ids, carrier) for joint in joint_ids]
    frames, origins = zip(*(frame_of_joint(data, joint) for joint in joint_ids), strict=True)
    links = []
    for i, joint in enumerate(joint_ids):
        parent = parents[i]
        base_frame, base_origin = (frames[parent], origins[parent]) if parent >= 0 else (np.eye(3), np.zeros(3))
        link = Link()
        link.joint_name = model.joint(joint).name
        link.parent = parent
        hinge = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE
        link.type = JointType.revolute if hinge else JointType.prismatic
        link.rotation = (base_frame.T @ frames[i]).ravel().tolist()
        link.translation = (base_frame.T @ (origins[i] - base_origin)).tolist()
        link.rotor_inertia = _rotor_inertia(model, joint)
        carried = [body for body in range(model.nbody) if carrier[body] == i]
        body = int(model.jnt_bodyid[joint])
        _set_inertia(link, model, data, carried, frames[i], origins[i])
        # A body of several joints hangs on the last one; the links before it are rightly empty.
        if link.mass == 0 and carrier[body] == i:
            raise RobotError(
                f"{where}: joint {link.joint_name!r} moves link {model.body(body).name!r}, which has no mass; "
                "every moving link needs one, its own or of a link fixed to it"
            )
        links.append(link)
    try:
        return Tree(links, list(gravity))
    except CoreError as error:
        raise RobotError(f"{where}: {error}") from error


def frame_of_joint(data: mujoco.MjData, joint: int) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and origin, in the base, of the link's frame that this joint moves, at the pose of `data`."""
    return _frame_along(np.array(data.xaxis[joint])), np.array(data.xanchor[joint])


def _joints_of(model: mujoco.MjModel, body: int) -> range:
    first = int(model.body_jntadr[body])
    return range(first, first + int(model.body_jntnum[body]))


def _parent(model: mujoco.MjModel, joint: int, joint_ids: Sequence[int], carrier: list[int]) -> int:
    """The joint in use that carries this one: an earlier one of the same body, or that of the parent body."""
    body = int(model.jnt_bodyid[joint])
    before = [other for other in _joints_of(model, body) if other < joint and other in joint_ids]
    return list(joint_ids).index(before[-1]) if before else carrier[model.body_parentid[body]]


def _frame_along(axis: np.ndarray) -> np.ndarray:
    """Rotation with `axis` as its z; turning it about that axis would be as good."""
    z = axis / np.linalg.norm(axis)
    x = np.eye(3)[np.argmin(np.abs(z))]
    x = x - (x @ z) * z
    x = x / np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def _rotor_inertia(model: mujoco.MjModel, joint: int) -> float:
    """The joint's armature, plus that of each actuator on it times its gear squared."""
    at_joint = [int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)]
    drives = np.isin(model.actuator_trntype, at_joint) & (model.actuator_trnid[:, 0] == joint)
    motors = model.actuator_armature[drives] * model.actuator_gear[drives, 0] ** 2
    return float(model.dof_armature[model.jnt_dofadr[joint]] + motors.sum())


def _set_inertia(
    link: Link,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    bodies: list[int],
    frame: np.ndarray,
    origin: np.ndarray,
) -> None:
    """Mass, centre of mass and inertia of the bodies together, in the link's frame."""
    masses = np.where(model.body_mass[bodies] > LEAST, model.body_mass[bodies], 0.0)
    link.mass = float(masses.sum())
    if link.mass == 0:
        return
    com = masses @ data.xipos[bodies] / link.mass
    inertia = np.zeros((3, 3))
    for body, mass in zip(bodies, masses, strict=True):
        axes = data.ximat[body].reshape(3, 3)
        principal = np.where(model.body_inertia[body] > LEAST, model.body_inertia[body], 0.0)
        arm = data.xipos[body] - com
        inertia += (axes * principal) @ axes.T + mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    inertia = frame.T @ inertia @ frame
    link.com = (frame.T @ (com - origin)).tolist()
    link.inertia = [float(inertia[k]) for k in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
