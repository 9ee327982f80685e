"""What links look like: capsules as near as can be to the robot file's collision geometry."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from tauext._core import Capsule, Tree
from tauext.errors import RobotError
from tauext.files.named_files import SHAPES_FILE
from tauext.files.provenance import write_json
from tauext.robot.capsule_fit import as_capsules
from tauext.robot.joint_choice import choose_joints
from tauext.robot.load import compiled
from tauext.robot.shapes import Shape, box, cylinder, ellipsoid, mesh
from tauext.robot.tree_from_mujoco import carriers, frame_of_joint
from tauext.robot.urdf_shapes import is_urdf, urdf_shapes
from tauext.robot.write import PAYLOAD

MOST_A_LINK = 8
"""More would cost a ranking time and tell it nothing: the largest are kept."""


Ends = tuple[list[float], list[float], float]
"""Both ends of a capsule and its radius, [m]."""


@dataclass(frozen=True)
class BodyCapsules:
    bodies: dict[str, list[Ends]]
    """By the body's or link's name, in its axes."""
    notes: list[str]
    """What could not be read, in sentences."""


def body_capsules(path: str | os.PathLike[str]) -> BodyCapsules:
    """The shapes of a robot file's links: each body's collision geometry, else its visual one.

    Cylinders become capsules that end where they end, spheres and capsules stay what they are; boxes, ellipsoids and
    meshes get one to four capsules by least squares of their surface's distance. Mesh files that are missing are noted.

    Raises:
        RobotError: the file cannot be read.
    """
    path = Path(path)
    model = compiled(path, keep_fixed=True)
    placed, notes = _placed(path, model)
    bodies: dict[str, list[Ends]] = {}
    for body, shape in placed:
        name = model.body(body).name
        if name and name != PAYLOAD:
            ends = [(start.tolist(), end.tolist(), float(radius)) for start, end, radius in as_capsules(shape)]
            bodies.setdefault(name, []).extend(ends)
    return BodyCapsules(bodies, notes)


def write_shapes(source: Path, folder: Path) -> BodyCapsules:
    """Keep the shapes of a robot file beside the one that a dataset gets of it; returns them.

    Raises:
        RobotError: the file cannot be read.
    """
    shapes = body_capsules(source)
    listed = {
        name: [{"start_m": start, "end_m": end, "radius_m": radius} for start, end, radius in ends]
        for name, ends in shapes.bodies.items()
    }
    write_json({"format": 1, "bodies": listed, "notes": shapes.notes}, folder / SHAPES_FILE)
    return shapes


def read_shapes(path: Path) -> BodyCapsules:
    """What write_shapes() kept.

    Raises:
        RobotError: it is damaged.
    """
    try:
        kept = json.loads(path.read_text(encoding="utf-8"))
        bodies = {
            name: [
                ([float(x) for x in one["start_m"]], [float(x) for x in one["end_m"]], float(one["radius_m"]))
                for one in ends
            ]
            for name, ends in kept["bodies"].items()
        }
        return BodyCapsules(bodies, [str(note) for note in kept["notes"]])
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise RobotError(
            f"{path}: is no file of shapes ({type(error).__name__}: {error}); import the data anew"
        ) from error


def link_capsules(path: str | os.PathLike[str], tree: Tree) -> tuple[list[Capsule], list[str]]:
    """Capsules of the links that joints in use move, in the core's frames of these links; and what could not be read.

    Args:
        path: URDF or MJCF that the tree is of; shapes kept beside it by write_shapes() go before its own.
        tree: says which joints are in use.

    Raises:
        RobotError: a file cannot be read.
    """
    path = Path(path)
    kept = path.with_name(SHAPES_FILE)
    shapes = read_shapes(kept) if kept.is_file() else body_capsules(path)
    model = compiled(path, keep_fixed=True)
    choice = choose_joints(model, [link.joint_name for link in tree.links], {}, str(path))
    data = mujoco.MjData(model)
    data.qpos[:] = choice.qpos
    mujoco.mj_kinematics(model, data)
    carrier = carriers(model, choice.joint_ids)
    found: dict[int, list[Capsule]] = {}
    for body, link in enumerate(carrier):
        if link < 0:
            continue
        axes, origin = frame_of_joint(data, choice.joint_ids[link])
        turned = axes.T @ np.array(data.xmat[body]).reshape(3, 3)
        place = axes.T @ (np.array(data.xpos[body]) - origin)
        for start, end, radius in shapes.bodies.get(model.body(body).name, []):
            ends = [(place + turned @ np.array(one)).tolist() for one in (start, end)]
            found.setdefault(link, []).append(Capsule(link, ends[0], ends[1], radius))
    capsules = []
    for link in sorted(found):
        largest = sorted(found[link], key=area_m2, reverse=True)[:MOST_A_LINK]
        capsules += [one for one in found[link] if one in largest]
    return capsules, shapes.notes


def _placed(path: Path, model: mujoco.MjModel) -> tuple[Sequence[tuple[int, Shape]], list[str]]:
    if is_urdf(path):
        return urdf_shapes(path, [model.body(body).name for body in range(model.nbody)])
    return list(mjcf_shapes(model)), []


def area_m2(capsule: Capsule) -> float:
    length = float(np.linalg.norm(np.subtract(capsule.end, capsule.start)))
    return 2 * np.pi * capsule.radius_m * (length + 2 * capsule.radius_m)


def mjcf_shapes(model: mujoco.MjModel) -> Iterator[tuple[int, Shape]]:
    """Body and shape, in the body's axes, of what of it collides; of all it shows where nothing does."""
    for body in range(1, model.nbody):
        geoms = range(model.body_geomadr[body], model.body_geomadr[body] + model.body_geomnum[body])
        colliding = [geom for geom in geoms if model.geom_contype[geom] or model.geom_conaffinity[geom]]
        for geom in colliding or geoms:
            shape = of_geom(model, geom)
            if shape is not None:
                turn = np.empty(9)
                mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
                yield body, shape.moved(turn.reshape(3, 3), model.geom_pos[geom])


def of_geom(model: mujoco.MjModel, geom: int) -> Shape | None:
    """In the geom's axes; None: planes, height fields and others that no link is shaped as."""
    size, kinds = model.geom_size[geom], mujoco.mjtGeom
    match model.geom_type[geom]:
        case kinds.mjGEOM_SPHERE:
            return Shape(size[0], np.zeros(3), np.zeros(3))
        case kinds.mjGEOM_CAPSULE:
            return Shape(size[0], np.array([0, 0, -size[1]]), np.array([0, 0, size[1]]))
        case kinds.mjGEOM_CYLINDER:
            return cylinder(size[0], size[1])
        case kinds.mjGEOM_BOX:
            return box(size)
        case kinds.mjGEOM_ELLIPSOID:
            return ellipsoid(size)
        case kinds.mjGEOM_MESH:
            which = model.geom_dataid[geom]
            vertices = model.mesh_vert[model.mesh_vertadr[which] :][: model.mesh_vertnum[which]]
            faces = model.mesh_face[model.mesh_faceadr[which] :][: model.mesh_facenum[which]]
            return mesh(vertices, faces)
        case _:
            return None
