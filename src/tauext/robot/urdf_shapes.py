"""Shapes of a URDF's links: placed as the file says, meshes read by MuJoCo where they are found."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np

from tauext.robot.shapes import Shape, box, cylinder, mesh

READ_FORMATS = (".stl", ".obj", ".msh")
PACKAGE = "package://"


def is_urdf(path: Path) -> bool:
    for _, element in ElementTree.iterparse(path, events=("start",)):
        return element.tag == "robot"
    return False


def urdf_shapes(path: Path, bodies: list[str]) -> tuple[list[tuple[int, Shape]], list[str]]:
    """Number of the body and its shape in the body's axes; and what could not be read.

    A link's collision elements, else its visual ones. `package://` is looked for in the file's folder and those above.
    """
    numbers, found = {name: number for number, name in enumerate(bodies)}, []
    lost: dict[str, list[str]] = {}
    for link in ElementTree.parse(path).getroot().iter("link"):
        body = numbers.get(link.get("name", ""), -1)
        for element in link.findall("collision") or link.findall("visual") if body >= 0 else ():
            geometry = element.find("geometry")
            if geometry is None or not len(geometry):
                continue
            try:
                shape = _shape(geometry[0], path)
                if shape is not None:
                    found.append((body, shape.moved(*_origin(element.find("origin")))))
            except (OSError, ValueError) as error:
                lost.setdefault(" ".join(str(error).split()), []).append(link.get("name", ""))
    if not lost:
        return found, []
    first = next(iter(lost))
    more = f" and {len(lost) - 1} more" if len(lost) > 1 else ""
    links = dict.fromkeys(link for links in lost.values() for link in links)
    return found, [f"shapes of {', '.join(links)} could not be read: {first}{more}"]


def _shape(geometry: ElementTree.Element, path: Path) -> Shape | None:
    match geometry.tag:
        case "sphere":
            return Shape(_numbers(geometry, "radius", 1)[0], np.zeros(3), np.zeros(3))
        case "cylinder":
            return cylinder(_numbers(geometry, "radius", 1)[0], _numbers(geometry, "length", 1)[0] / 2)
        case "capsule":
            end = np.array([0, 0, _numbers(geometry, "length", 1)[0] / 2])
            return Shape(_numbers(geometry, "radius", 1)[0], -end, end)
        case "box":
            return box(_numbers(geometry, "size", 3) / 2)
        case "mesh":
            scale = _numbers(geometry, "scale", 3) if geometry.get("scale") else np.ones(3)
            return _mesh(_found(geometry.get("filename", ""), path), scale)
        case _:
            return None


def _numbers(element: ElementTree.Element, key: str, count: int) -> np.ndarray:
    values = np.array((element.get(key) or "").split(), dtype=float)
    if len(values) != count or not np.isfinite(values).all():
        raise ValueError(f"{element.tag} {key} = {element.get(key)!r} must be {count} finite number{'s' * (count > 1)}")
    return values


def _origin(origin: ElementTree.Element | None) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and place: fixed-axis roll, pitch, yaw."""
    place, angles = (
        _numbers(origin, key, 3) if origin is not None and origin.get(key) else np.zeros(3) for key in ("xyz", "rpy")
    )
    (cr, cp, cy), (sr, sp, sy) = np.cos(angles), np.sin(angles)
    turn = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.array(turn), place


def _found(name: str, path: Path) -> Path:
    """The mesh file that a URDF names."""
    if Path(name).suffix.lower() not in READ_FORMATS:
        raise ValueError(f"{name}: meshes are read from {', '.join(READ_FORMATS)}")
    local = name.removeprefix("file://").removeprefix(PACKAGE)
    inside = "/".join(local.split("/")[1:]) if name.startswith(PACKAGE) else local
    for folder in (path.parent, *path.parent.resolve().parents):
        for candidate in (folder / local, folder / inside):
            if candidate.is_file():
                return candidate
        if not name.startswith(PACKAGE):
            break
    raise ValueError(f"there is no mesh file {name}")


def _mesh(file: Path, scale: np.ndarray) -> Shape:
    """Its triangles in the file's own axes."""
    spec = mujoco.MjSpec()
    spec.add_mesh(name="one", file=str(file), inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="one")
    try:
        model = spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        raise ValueError(f"{file.name}: {error}") from error
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, model.mesh_quat[0])  # MuJoCo keeps meshes along their principal axes
    vertices = model.mesh_vert @ turn.reshape(3, 3).T + model.mesh_pos[0]
    return mesh(vertices * scale, model.mesh_face)
