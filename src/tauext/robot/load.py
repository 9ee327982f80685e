"""Load a robot file: read it, choose the joints, make the tree."""

import hashlib
import math
import os
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from xml.etree import ElementTree

import mujoco

from tauext._core import Tree
from tauext.errors import RobotError
from tauext.files.room import in_words
from tauext.robot.constraints import check_constraints
from tauext.robot.joint_choice import choose_joints
from tauext.robot.tree_from_mujoco import LEAST, make_tree
from tauext.robot.urdf import read_urdf

MOST_JOINTS = 1000
"""Of a robot file: a humanoid with its hands has a hundred; a chain of ten thousand takes MuJoCo gigabytes."""


def load_tree(
    path: str | os.PathLike[str],
    joints: Sequence[str] | None = None,
    locked: Mapping[str, float] | None = None,
    gravity: Sequence[float] | None = None,
) -> Tree:
    """Read a URDF or MJCF file into the tree of its moving joints.

    Links, masses, inertia and rotor inertia are read (`armature` of joints and actuators, a motor's times its gear
    squared); friction, springs, limits, contacts and gravity compensation are not part of a tree. Of a URDF, `visual`
    and `collision` are dropped before anything is read, so missing meshes are no obstacle.

    q = 0 of the tree is q = 0 of the file, and link i of the tree belongs to joints[i], in whatever order they are
    asked for: a link need not come after its parent. What a locked joint carries becomes part of the link before it.

    Args:
        path: URDF or MJCF file.
        joints: joints in use, in the order of the recordings' columns; None: every joint that is not in `locked`,
            depth first from the base.
        locked: position at which joints that are not in use are held, [rad or m]; one that is not named is held at
            the file's own rest position: 0, or `ref` in MJCF.
        gravity: acceleration of free fall in the base frame (3,), [m/s^2]; None: the file's, (0, 0, -9.81) if it says
            nothing.

    Raises:
        RobotError: the file is missing, cannot be read or is no fixed-base tree of hinges and slides; a link that moves
            has no mass; a number makes no sense; a joint is unknown, named twice, both used and locked, or follows
            another one.
    """
    path = Path(path)
    model = compiled(path)
    choice = choose_joints(model, joints, locked or {}, str(path))
    check_constraints(model, choice.joint_ids, str(path))
    return make_tree(model, choice.joint_ids, choice.qpos, _gravity(model, gravity), str(path))


def movable_joints(path: str | os.PathLike[str]) -> list[str]:
    """Joints that a robot file lets choose from, depth first: named hinges and slides that follow no other joint.

    Raises:
        RobotError: the file is missing or cannot be read.
    """
    model = compiled(Path(path))
    coupled = model.eq_type[: model.neq] == mujoco.mjtEq.mjEQ_JOINT
    followers = set(model.eq_obj1id[: model.neq][coupled].tolist())
    plain = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
    joints = [j for j in range(model.njnt) if int(model.jnt_type[j]) in plain and j not in followers]
    return [model.joint(j).name for j in joints if model.joint(j).name]


def robot_sha256(path: str | os.PathLike[str]) -> str:
    """SHA-256 of a robot file's bytes, hexadecimal: by it a recording tells its robot. Includes are not followed.

    Raises:
        RobotError: the file cannot be read.
    """
    try:
        return hashlib.sha256(Path(path).read_bytes()).hexdigest()
    except OSError as error:
        raise RobotError(f"{path}: cannot be read: {error.strerror}") from error


def compiled(path: Path, keep_fixed: bool = False) -> mujoco.MjModel:
    """The robot file as MuJoCo understands it.

    Args:
        keep_fixed: links that are fixed to others stay bodies of their own, where MuJoCo would make one of them.

    Raises:
        RobotError: the file is missing or cannot be read.
    """
    if not path.is_file():
        raise RobotError(f"{path}: no such file; a robot is a URDF or MJCF file")
    with no_mujoco_warnings():
        return _read(path, keep_fixed)


@contextmanager
def no_mujoco_warnings() -> Iterator[None]:
    """MuJoCo would print them and write a file in the current folder; what matters of them is checked and refused."""
    mujoco.set_mju_user_warning(lambda text: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(None)


def _read(path: Path, keep_fixed: bool) -> mujoco.MjModel:
    try:
        root, joints = _root_tag(path)
        if joints > MOST_JOINTS:
            raise RobotError(
                f"{path}: has {joints} joints, whose mass matrix alone needs {in_words(8.0 * joints**2)} of memory; at "
                f"most {MOST_JOINTS} are read, of which 32 may be in use"
            )
        if root == "robot":
            spec = read_urdf(path)
        elif root == "mujoco":
            spec = mujoco.MjSpec.from_file(str(path))
        else:
            raise RobotError(f"{path}: its root element is <{root}>; a URDF has <robot>, an MJCF <mujoco>")
        _refuse_negative_mass(spec, path)
        spec.compiler.fusestatic = spec.compiler.fusestatic and not keep_fixed
        # MuJoCo refuses a moving body without mass even where its joint is locked; make_tree knows better.
        spec.compiler.boundmass = max(spec.compiler.boundmass, LEAST)
        spec.compiler.boundinertia = max(spec.compiler.boundinertia, LEAST)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return spec.compile()
    except RecursionError as error:
        raise RobotError(f"{path}: its elements are nested too deeply") from error
    except ElementTree.ParseError as error:
        raise RobotError(f"{path}: not readable as XML: {error}") from error
    except (ValueError, OSError, mujoco.FatalError) as error:
        raise RobotError(f"{path}: MuJoCo cannot read it: {' '.join(str(error).split())}") from error


def _refuse_negative_mass(spec: mujoco.MjSpec, path: Path) -> None:
    """The least mass and inertia that MuJoCo is told below would hide it."""
    for body in spec.bodies:
        if body.explicitinertial and not (body.mass >= 0 and (body.inertia >= 0).all()):
            raise RobotError(
                f"{path}: link {body.name!r}: mass = {body.mass} kg and inertia {body.inertia.tolist()} must be >= 0"
            )


def _root_tag(path: Path) -> tuple[str, int]:
    """Name of the root element, and how many joints stand in the file, read without keeping it."""
    root, joints = "", 0
    with path.open("rb") as file:
        for _, element in ElementTree.iterparse(file, events=("start",)):
            root = root or element.tag
            joints += element.tag in ("joint", "freejoint")
            if (named := element.get("file")) and (beside := path.parent / named).exists() and not beside.is_file():
                raise RobotError(f"{path}: <{element.tag} file={named!r}> names no file but a folder, pipe or device")
            element.clear()
    if not root:
        raise ElementTree.ParseError("no element found")
    return root, joints


def _gravity(model: mujoco.MjModel, asked: Sequence[float] | None) -> list[float]:
    if asked is None:
        off = model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY
        return [0.0, 0.0, 0.0] if off else model.opt.gravity.tolist()
    values = [float(value) for value in asked]
    if len(values) != 3 or not all(math.isfinite(value) for value in values):
        raise RobotError(f"gravity = {values} must be three finite numbers, e.g. (0, 0, -9.81) m/s^2")
    return values
