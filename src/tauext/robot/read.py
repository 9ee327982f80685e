"""Load a robot file: read it, choose the joints, build the tree."""

from __future__ import annotations

import copy
import hashlib
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from tauext._core import MAX_JOINTS, CoreError, JointType, Link, Tree
from tauext.errors import RobotError
from tauext.files.preflight import in_words
from tauext.robot.compile import LEAST, compiled_as_given, no_mujoco_warnings, our_words, read_mjcf
from tauext.robot.inertial import point_inertia, six_of
from tauext.robot.urdf import urdf_spec
from tauext.robot.xml_file import read_xml

# --- Which joints of a robot file are in use, in which order, and where the others are held.


_SEVERAL_AXES = (int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL))


@dataclass(frozen=True)
class JointChoice:
    """Joints in use, by index in the model, and the pose: 0 for joints in use, locked positions for the rest."""

    joint_ids: list[int]
    qpos: np.ndarray


def choose_joints(
    model: mujoco.MjModel, joints: Sequence[str] | None, locked: Mapping[str, float], where: str
) -> JointChoice:
    """Resolve names to joints; None takes every joint that is not locked."""
    index = {model.joint(j).name: j for j in range(model.njnt) if model.joint(j).name}
    for name in [*(joints or ()), *locked]:
        if name not in index:
            raise RobotError(f"{where}: no joint {name!r}; its joints are {', '.join(index) or 'none'}")
    for name in joints or ():
        if list(joints or ()).count(name) > 1:
            raise RobotError(f"{where}: joint {name!r} is named twice; name every joint once")
        if name in locked:
            raise RobotError(f"{where}: joint {name!r} is both in use and locked at {locked[name]}; choose one")
    unlocked = [j for j in range(model.njnt) if model.joint(j).name not in locked]
    chosen = unlocked if joints is None else [index[name] for name in joints]
    _check_chosen(model, chosen, where)
    qpos = np.array(model.qpos0)
    for name, position in locked.items():
        if int(model.jnt_type[index[name]]) in _SEVERAL_AXES:
            raise RobotError(f"{where}: joint {name!r} has several axes, and no single position to be locked at")
        if not math.isfinite(position):
            raise RobotError(f"{where}: joint {name!r}: locked position {position} must be finite, [rad or m]")
        qpos[model.jnt_qposadr[index[name]]] = position
    qpos[model.jnt_qposadr[chosen]] = 0.0
    return JointChoice(chosen, qpos)


def _check_chosen(model: mujoco.MjModel, chosen: list[int], where: str) -> None:
    if not chosen:
        raise RobotError(f"{where}: no moving joint is left; a robot needs at least one that is not fixed or locked")
    for j in chosen:
        name, body = model.joint(j).name, model.body(model.jnt_bodyid[j]).name
        if int(model.jnt_type[j]) in _SEVERAL_AXES:
            raise RobotError(
                f"{where}: joint {name!r} of body {body!r} has several axes (floating, planar, free or ball); joints "
                "in use must be hinges or slides: name those in `joints`, and this one is held where the file has it"
            )
        if not name:
            raise RobotError(
                f"{where}: a joint of body {body!r} has no name; recordings name their joints: give it one in the file"
            )
    if len(chosen) > MAX_JOINTS:
        raise RobotError(f"{where}: {len(chosen)} joints in use, at most {MAX_JOINTS} can be: lock the others")


# --- Turn a compiled MuJoCo model into a tree: one link per joint in use, with everything rigidly attached.


def carriers(model: mujoco.MjModel, joint_ids: Sequence[int]) -> list[int]:
    """For each body, the joint in use that carries it, as an index into `joint_ids`; -1: it never moves."""
    order = {joint: i for i, joint in enumerate(joint_ids)}
    carrier = [-1] * model.nbody
    for body in range(1, model.nbody):
        carrier[body] = carrier[model.body_parentid[body]]
        for joint in _joints_of(model, body):
            carrier[body] = order.get(joint, carrier[body])
    return carrier


def make_tree(
    model: mujoco.MjModel, joint_ids: Sequence[int], qpos: np.ndarray, gravity: Sequence[float], where: str
) -> Tree:
    """Build the tree whose q = 0 is the pose `qpos`: joints in use at 0, the others where they are locked.

    All quantities are read in the base frame at that pose. MuJoCo has then resolved joint offsets, reference positions
    and several joints on one body.
    """
    data = posed(model, qpos)
    carrier = carriers(model, joint_ids)
    parents = [_parent(model, joint, joint_ids, carrier) for joint in joint_ids]
    frames, origins = zip(*(frame_of_joint(data, joint) for joint in joint_ids), strict=True)
    links = []
    for i, joint in enumerate(joint_ids):
        link, parent = Link(), parents[i]
        base_frame, base_origin = (frames[parent], origins[parent]) if parent >= 0 else (np.eye(3), np.zeros(3))
        link.joint_name, link.parent = model.joint(joint).name, parent
        hinge = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE
        link.type = JointType.revolute if hinge else JointType.prismatic
        link.rotation = (base_frame.T @ frames[i]).ravel().tolist()
        link.translation = (base_frame.T @ (origins[i] - base_origin)).tolist()
        link.rotor_inertia = _rotor_inertia(model, joint)
        carried = [body for body in range(model.nbody) if carrier[body] == i]
        _expect_numbers(model, carried, where)
        body = int(model.jnt_bodyid[joint])
        _set_inertia(link, model, data, carried, frames[i], origins[i])
        # A body with several joints belongs to the last one; the links before it are empty by design.
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


def _expect_numbers(model: mujoco.MjModel, bodies: list[int], where: str) -> None:
    """Refuse a negative mass and values that are not finite; an inertia that no body can have is left to `check`."""
    for body in bodies:
        mass, com, inertia = model.body_mass[body], model.body_ipos[body], model.body_inertia[body]
        if not (mass >= 0 and np.isfinite([mass, *com, *inertia]).all()):
            raise RobotError(
                f"{where}: link {model.body(body).name!r}: mass = {mass:g} kg must be >= 0, and mass, centre of mass "
                "and inertia must be finite"
            )


def frame_of_joint(data: mujoco.MjData, joint: int) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and origin, in the base, of the frame of the link that this joint moves, at the pose of `data`."""
    return _frame_along(np.array(data.xaxis[joint])), np.array(data.xanchor[joint])


@dataclass(frozen=True)
class PlacedBody:
    """A body of the model that a joint in use moves, placed in the core's frame of its link."""

    number: int
    name: str
    link: int
    rotation: np.ndarray
    """(3, 3), link from body."""
    translation: np.ndarray
    """(3,), [m]."""


def placed_bodies(path: Path, tree: Tree) -> tuple[mujoco.MjModel, list[int], list[PlacedBody]]:
    """A robot file's model, the model's indices of the tree's joints, and the bodies they move.

    Args:
        path: URDF or MJCF that the tree is of.
        tree: defines which joints are in use.
    """
    model = compiled(path)
    choice = choose_joints(model, [link.joint_name for link in tree.links], {}, str(path))
    data = posed(model, choice.qpos)
    found = []
    for body, link in enumerate(carriers(model, choice.joint_ids)):
        if link >= 0:
            axes, origin = frame_of_joint(data, choice.joint_ids[link])
            turned = axes.T @ np.array(data.xmat[body]).reshape(3, 3)
            position = axes.T @ (np.array(data.xpos[body]) - origin)
            found.append(PlacedBody(body, model.body(body).name, link, turned, position))
    return model, choice.joint_ids, found


@dataclass(frozen=True)
class CarriedBody:
    """A body that a joint in use moves, with mass and inertia as the file gives them, possible or not."""

    name: str
    joint: str
    mass_kg: float
    inertia_kg_m2: np.ndarray
    """(3,), principal."""


def carried_bodies(path: Path, joints: Sequence[str]) -> list[CarriedBody]:
    """Bodies that these joints move, each with the last joint before it; every other joint is held.

    Raises:
        RobotError: the file cannot be read, or lacks a joint.
    """
    model = compiled(path)
    choice = choose_joints(model, joints, {}, str(path))
    return [
        CarriedBody(model.body(body).name, joints[joint], float(model.body_mass[body]), model.body_inertia[body].copy())
        for body, joint in enumerate(carriers(model, choice.joint_ids))
        if joint >= 0
    ]


def posed(model: mujoco.MjModel, qpos: np.ndarray) -> mujoco.MjData:
    """MuJoCo's data at this pose."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    return data


def _joints_of(model: mujoco.MjModel, body: int) -> range:
    first = int(model.body_jntadr[body])
    return range(first, first + int(model.body_jntnum[body]))


def _parent(model: mujoco.MjModel, joint: int, joint_ids: Sequence[int], carrier: list[int]) -> int:
    """The joint in use that carries this one: an earlier one of the same body, or that of the parent body."""
    body = int(model.jnt_bodyid[joint])
    before = [other for other in _joints_of(model, body) if other < joint and other in joint_ids]
    return list(joint_ids).index(before[-1]) if before else carrier[model.body_parentid[body]]


def _frame_along(axis: np.ndarray) -> np.ndarray:
    """Rotation with `axis` as its z; the angle about that axis is arbitrary."""
    z = axis / np.linalg.norm(axis)
    x = np.eye(3)[np.argmin(np.abs(z))]
    x = x - (x @ z) * z
    x = x / np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def _rotor_inertia(model: mujoco.MjModel, joint: int) -> float:
    """The joint's armature, plus that of each actuator on it times its gear squared."""
    drives = drives_of(model, joint)
    motors = model.actuator_armature[drives] * model.actuator_gear[drives, 0] ** 2
    return float(model.dof_armature[model.jnt_dofadr[joint]] + motors.sum())


def drives_of(model: mujoco.MjModel, joint: int) -> np.ndarray:
    """Which actuators act on this joint, (actuators,) bool."""
    at_joint = [int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)]
    return np.asarray(np.isin(model.actuator_trntype, at_joint) & (model.actuator_trnid[:, 0] == joint))


def _set_inertia(
    link: Link, model: mujoco.MjModel, data: mujoco.MjData, bodies: list[int], frame: np.ndarray, origin: np.ndarray
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
        principal = np.where(np.abs(model.body_inertia[body]) > LEAST, model.body_inertia[body], 0.0)
        arm = data.xipos[body] - com
        inertia += (axes * principal) @ axes.T + point_inertia(mass, arm)
    inertia = frame.T @ inertia @ frame
    link.com = (frame.T @ (com - origin)).tolist()
    link.inertia = six_of(inertia).tolist()


# --- Constraints between joints, which a tree of independent joints cannot represent.


def check_constraints(model: mujoco.MjModel, joint_ids: list[int], where: str) -> None:
    """Refuse mimic joints in use, closed loops between moving links, and rotor inertia that acts through a tendon."""
    carrier = carriers(model, joint_ids)
    for k in range(model.neq):
        if not model.eq_active0[k]:
            continue
        if model.eq_type[k] == mujoco.mjtEq.mjEQ_JOINT:
            _check_mimic(model, k, joint_ids, where)
        elif model.eq_type[k] == mujoco.mjtEq.mjEQ_CONNECT or model.eq_type[k] == mujoco.mjtEq.mjEQ_WELD:
            _check_loop(model, k, carrier, where)
    for tendon in range(model.ntendon):
        _check_tendon(model, tendon, joint_ids, carrier, where)


def _check_mimic(model: mujoco.MjModel, k: int, joint_ids: list[int], where: str) -> None:
    follower, leader = int(model.eq_obj1id[k]), int(model.eq_obj2id[k])
    if follower not in joint_ids:
        return
    name = model.joint(follower).name
    what = f"follows {model.joint(leader).name!r} (mimic)" if leader >= 0 else "is fixed by an equality"
    raise RobotError(
        f"{where}: joint {name!r} {what} and is not independent: lock it, with locked={{{name!r}: position}} "
        "or by leaving it out of `joints`"
    )


def _check_loop(model: mujoco.MjModel, k: int, carrier: list[int], where: str) -> None:
    ends = [int(model.eq_obj1id[k]), int(model.eq_obj2id[k])]
    if model.eq_objtype[k] == mujoco.mjtObj.mjOBJ_SITE:
        ends = [int(model.site_bodyid[site]) for site in ends]
    if carrier[ends[0]] != carrier[ends[1]]:
        names = " and ".join(repr(model.body(body).name) for body in ends)
        raise RobotError(f"{where}: bodies {names} close a kinematic loop; a tree has none: lock the joints in it")


def _check_tendon(model: mujoco.MjModel, tendon: int, joint_ids: list[int], carrier: list[int], where: str) -> None:
    by_tendon = model.actuator_trntype == mujoco.mjtTrn.mjTRN_TENDON
    drives = by_tendon & (model.actuator_trnid[:, 0] == tendon)
    if model.tendon_armature[tendon] == 0 and not model.actuator_armature[drives].any():
        return
    first = model.tendon_adr[tendon]
    joints, links = set(), set()
    for wrap in range(first, first + model.tendon_num[tendon]):
        if model.wrap_type[wrap] == mujoco.mjtWrap.mjWRAP_JOINT:
            joints.add(int(model.wrap_objid[wrap]))
        elif model.wrap_type[wrap] == mujoco.mjtWrap.mjWRAP_SITE:
            links.add(carrier[model.site_bodyid[model.wrap_objid[wrap]]])
    if joints & set(joint_ids) or len(links) > 1:
        name = model.tendon(tendon).name
        raise RobotError(
            f"{where}: tendon {name!r} has armature and moves joints in use; rotor inertia must be given at a joint"
        )


# --- Load a robot file: read it, choose the joints, make the tree.


def load_tree(
    path: str | os.PathLike[str],
    joints: Sequence[str] | None = None,
    locked: Mapping[str, float] | None = None,
    gravity: Sequence[float] | None = None,
) -> Tree:
    """Read a URDF or MJCF file into the tree of its moving joints.

    Links, masses, inertia and rotor inertia are read (`armature` of joints and actuators, a motor's times its gear
    squared). Friction, springs, limits, contacts and gravity compensation are not part of a tree. A URDF's `visual` and
    `collision` elements are ignored, so meshes may be missing.

    q = 0 of the tree is q = 0 of the file. Link i of the tree belongs to joints[i], in any order: a link may precede
    its parent. Bodies behind a locked joint become part of the link before it.

    Args:
        path: URDF or MJCF file.
        joints: joints in use, in the order of the recordings' columns; None: every joint that is not in `locked`,
            depth first from the base.
        locked: positions at which joints not in use are held, [rad or m]; the others are held at the file's rest
            position: 0, or `ref` in MJCF.
        gravity: acceleration of free fall in the base frame (3,), [m/s^2]; None: the file's, else (0, 0, -9.81).

    Raises:
        RobotError: the file is missing, cannot be read or is no fixed-base tree of hinges and slides; a moving link has
            no mass; a number is invalid; a joint is unknown, named twice, both used and locked, or follows another one.
    """
    path = Path(path)
    model = compiled(path)
    choice = choose_joints(model, joints, locked or {}, str(path))
    check_constraints(model, choice.joint_ids, str(path))
    return make_tree(model, choice.joint_ids, choice.qpos, _gravity(model, gravity), str(path))


def tree_with_inertias(
    path: Path, joints: Sequence[str], gravity: Sequence[float] | None, principal: Mapping[str, np.ndarray]
) -> Tree:
    """As load_tree(), with other principal moments of inertia (3,), [kg m^2], by name of the link."""
    model = copy.copy(compiled(path))
    for name, moments in principal.items():
        model.body(name).inertia[:] = moments
    choice = choose_joints(model, joints, {}, str(path))
    return make_tree(model, choice.joint_ids, choice.qpos, _gravity(model, gravity), str(path))


def movable_joints(path: str | os.PathLike[str]) -> list[str]:
    """Names of the joints that can be in use, depth first: hinges and slides that follow no other joint.

    Raises:
        RobotError: the file is missing or cannot be read.
    """
    model = compiled(Path(path))
    coupled = model.eq_type[: model.neq] == mujoco.mjtEq.mjEQ_JOINT
    followers = set(model.eq_obj1id[: model.neq][coupled].tolist())
    joints = [j for j in range(model.njnt) if int(model.jnt_type[j]) not in _SEVERAL_AXES and j not in followers]
    return [model.joint(j).name for j in joints if model.joint(j).name]


def robot_sha256(path: str | os.PathLike[str]) -> str:
    """SHA-256 of a robot file's bytes, hexadecimal, which identifies a recording's robot; includes are not followed.

    Raises:
        RobotError: the file cannot be read.
    """
    try:
        return hashlib.sha256(Path(path).read_bytes()).hexdigest()
    except OSError as error:
        raise RobotError(f"{path}: cannot be read: {error.strerror}") from error


def compiled(path: Path) -> mujoco.MjModel:
    """Compile the robot file with MuJoCo, links that are fixed to others as bodies of their own.

    Raises:
        RobotError: the file is missing or cannot be read, or none of its links has a mass.
    """
    return read_robot(path)[1]


def read_robot(path: Path) -> tuple[mujoco.MjSpec, mujoco.MjModel]:
    """Return the specification beside what compiled() returns."""
    file = read_xml(path)
    joints = sum(element.tag in ("joint", "freejoint") for element in file.root.iter())
    if joints > 1000:  # a humanoid with hands has a hundred; ten thousand take MuJoCo gigabytes
        raise RobotError(
            f"{path}: has {joints} joints, whose mass matrix alone needs {in_words(8.0 * joints**2)} of memory; at "
            "most 1000 are read, of which 32 may be in use"
        )
    with no_mujoco_warnings(), our_words(file):
        if file.root.tag == "robot":
            spec = urdf_spec(file)
            model = compiled_as_given(spec)
        elif file.root.tag == "mujoco":
            spec, model = read_mjcf(file)
        else:
            raise RobotError(f"{path}: its root element is <{file.root.tag}>; a URDF has <robot>, an MJCF <mujoco>")
    if model.njnt and (np.abs(model.body_mass[1:]) <= LEAST).all():
        raise RobotError(
            f"{path}: none of its links has a mass, as in a description for display; give one with masses and "
            'inertias, or no robot file: leave --robot out, and `model = ""` in arm.toml'
        )
    return spec, model


def _gravity(model: mujoco.MjModel, asked: Sequence[float] | None) -> list[float]:
    if asked is None:
        off = model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY
        return [0.0, 0.0, 0.0] if off else model.opt.gravity.tolist()
    values = [float(value) for value in asked]
    if len(values) != 3 or not all(math.isfinite(value) for value in values):
        raise RobotError(f"gravity = {values} must be three finite numbers, e.g. (0, 0, -9.81) m/s^2")
    return values
