"""A twin as USD: a layer over the user's own stage, or a stage of rigid bodies and joints made of a URDF or MJCF."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from tauext import _core
from tauext.errors import RobotError
from tauext.files.atomic_write import atomic_write
from tauext.plugins import optional_library
from tauext.robot.read import placed_bodies
from tauext_twin.model_file import Inertial, JointChange

DEGREE = math.pi / 180


def write_usd(
    robot: Path, out: Path, tree: _core.Tree, changes: Sequence[JointChange], note: str, own: Path | None = None
) -> None:
    """Write a stage in which each joint has `physxJoint:armature` and `physxJoint:jointFriction`, its drive a damping
    [N m s/deg], and each body its mass.

    Args:
        own: the user's stage, which becomes a sublayer and stays as it is; its links have the robot file's frames.

    Raises:
        ConfigError: usd-core is not installed.
        RobotError: the stage cannot be written, or the user's has no such joint.
    """
    usd = optional_library("pxr.Usd", "tauext twin --out *.usd", "usd-core")
    physics = optional_library("pxr.UsdPhysics", "tauext twin --out *.usd", "usd-core")
    made = out.with_name(f".{out.stem}.part{out.suffix}")  # USD chooses the format by the ending
    try:
        with atomic_write(out) as part:
            stage = usd.Stage.CreateNew(str(made))
            stage.SetMetadata("comment", note)
            if own is None:
                _fill(stage, physics, robot, tree, changes)
            else:
                _over(stage, physics, own, os.path.relpath(own, out.parent), tree, changes)
            stage.GetRootLayer().Save()
            made.replace(part)
    except RuntimeError as error:  # pxr.Tf.ErrorException
        raise RobotError(f"{out}: cannot be written as USD: {str(error).splitlines()[0]}") from error
    finally:
        made.unlink(missing_ok=True)


def _over(stage: Any, physics: Any, own: Path, path: str, tree: _core.Tree, changes: Sequence[JointChange]) -> None:
    """Opinions of the root layer over the user's prims, found by the names of joints."""
    from pxr import Usd

    below = Usd.Stage.Open(str(own))
    stage.GetRootLayer().subLayerPaths.append(path)
    if below.GetDefaultPrim():
        stage.GetRootLayer().defaultPrim = below.GetDefaultPrim().GetName()
    joints = {prim.GetName(): prim for prim in below.Traverse() if prim.IsA(physics.Joint)}
    for j, change in enumerate(changes):
        if change.joint not in joints:
            raise RobotError(
                f"{own}: no joint '{change.joint}'; its joints are {', '.join(joints) or 'none'} (--names)"
            )
        prim = stage.OverridePrim(joints[change.joint].GetPath())
        _set_joint(prim, physics, change, tree.links[j].type == _core.JointType.revolute)
        bodies = physics.Joint(joints[change.joint]).GetBody1Rel().GetTargets()
        if change.inertial is not None and bodies:
            _set_mass(physics.MassAPI.Apply(stage.OverridePrim(bodies[0])), change.inertial)


def _set_joint(prim: Any, physics: Any, change: JointChange, hinge: bool) -> None:
    from pxr import Sdf

    prim.AddAppliedSchema("PhysxJointAPI")
    for name, value in (("armature", change.armature), ("jointFriction", change.frictionloss)):
        if value is not None:
            prim.CreateAttribute(f"physxJoint:{name}", Sdf.ValueTypeNames.Float).Set(float(value))
    if change.damping is not None:
        drive = physics.DriveAPI.Apply(prim, "angular" if hinge else "linear")
        drive.CreateDampingAttr(float(change.damping * (DEGREE if hinge else 1.0)))


def _set_mass(mass: Any, new: Inertial) -> None:
    from pxr import Gf

    mass.CreateMassAttr(new.mass)
    mass.CreateCenterOfMassAttr(Gf.Vec3f(*new.com))
    mass.CreateDiagonalInertiaAttr(Gf.Vec3f(*new.inertia))
    mass.CreatePrincipalAxesAttr(Gf.Quatf(*new.axes))


def _fill(stage: Any, physics: Any, robot: Path, tree: _core.Tree, changes: Sequence[JointChange]) -> None:
    from pxr import Gf, Tf, UsdGeom

    model, joints, placed = placed_bodies(robot, tree)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    physics.SetStageKilogramsPerUnit(stage, 1.0)
    root = UsdGeom.Xform.Define(stage, "/" + Tf.MakeValidIdentifier(robot.stem))
    stage.SetDefaultPrim(root.GetPrim())
    physics.ArticulationRootAPI.Apply(root.GetPrim())
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    of_body = {change.inertial.body: change.inertial for change in changes if change.inertial is not None}

    paths = {}
    for body in [0, *(one.number for one in placed)]:
        name = model.body(body).name or f"body{body}"
        prim = UsdGeom.Xform.Define(stage, root.GetPath().AppendChild(Tf.MakeValidIdentifier(name)))
        paths[body] = prim.GetPath()
        prim.AddTranslateOp().Set(Gf.Vec3d(*data.xpos[body].tolist()))
        prim.AddOrientOp().Set(Gf.Quatf(*data.xquat[body].tolist()))
        if body == 0:
            continue
        physics.RigidBodyAPI.Apply(prim.GetPrim())
        arrays = (model.body_ipos[body], model.body_inertia[body], model.body_iquat[body])
        given = Inertial(name, float(model.body_mass[body]), *(tuple(one.tolist()) for one in arrays))
        _set_mass(physics.MassAPI.Apply(prim.GetPrim()), of_body.get(name, given))
    for j, (joint, change) in enumerate(zip(joints, changes, strict=True)):
        body, hinge = int(model.jnt_bodyid[joint]), tree.links[j].type == _core.JointType.revolute
        path = root.GetPath().AppendChild(Tf.MakeValidIdentifier(change.joint))
        path = path if not stage.GetPrimAtPath(path) else path.GetParentPath().AppendChild(f"{path.name}_joint")
        made = (physics.RevoluteJoint if hinge else physics.PrismaticJoint).Define(stage, path)
        parent = int(model.body_parentid[body])
        while parent not in paths:
            parent = int(model.body_parentid[parent])
        made.CreateBody0Rel().SetTargets([paths[parent]])
        made.CreateBody1Rel().SetTargets([paths[body]])
        made.CreateAxisAttr("Z")
        turn = np.empty(4)
        mujoco.mju_quatZ2Vec(turn, model.jnt_axis[joint])  # the joint's axis is the z of its frames
        above, own, along = (
            Rotation.from_quat(q, scalar_first=True) for q in (data.xquat[parent], data.xquat[body], turn)
        )
        anchor = above.inv().apply(data.xanchor[joint] - data.xpos[parent])
        local = (above.inv() * own * along).as_quat(scalar_first=True)
        made.CreateLocalPos0Attr(Gf.Vec3f(*anchor.tolist()))
        made.CreateLocalRot0Attr(Gf.Quatf(*local.tolist()))
        made.CreateLocalPos1Attr(Gf.Vec3f(*model.jnt_pos[joint].tolist()))
        made.CreateLocalRot1Attr(Gf.Quatf(*turn.tolist()))
        if model.jnt_limited[joint]:
            low, high = model.jnt_range[joint] / (DEGREE if hinge else 1.0)
            made.CreateLowerLimitAttr(float(low))
            made.CreateUpperLimitAttr(float(high))
        _set_joint(made.GetPrim(), physics, change, hinge)
