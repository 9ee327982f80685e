"""Read the triangles of a mesh file: STL, OBJ, COLLADA (.dae) and MuJoCo's .msh."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import numpy as np


def triangles_of(path: Path) -> np.ndarray:
    """Corners (n, 3, 3) of a mesh file's triangles, [m] where the file states its unit, else in the file's unit.

    Polygons become fans of triangles; all objects of a file count.

    Raises:
        OSError: the file cannot be read.
        ValueError: the file is no mesh of its format.
    """
    read = {".stl": _stl, ".obj": _obj, ".dae": _dae, ".msh": _msh}[path.suffix.lower()]
    try:
        corners = read(path.read_bytes())
    except (ArithmeticError, LookupError, TypeError, ValueError, RecursionError, ElementTree.ParseError) as error:
        raise ValueError(f"{path.name} is no mesh that can be read") from error
    sound = np.isfinite(corners).all(axis=(1, 2))
    if not sound.any():
        raise ValueError(f"{path.name} is no mesh that can be read")
    return corners[sound]


def _stl(data: bytes) -> np.ndarray:
    triangle = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")])
    count = int.from_bytes(data[80:84], "little")
    if len(data) >= 84 + count * triangle.itemsize and count:
        return np.frombuffer(data, triangle, count, 84)["corners"].astype(float)
    words = [line.split() for line in data.decode("ascii").splitlines()]
    return np.array([line[1:4] for line in words if line[:1] == ["vertex"]], dtype=float).reshape(-1, 3, 3)


def _obj(data: bytes) -> np.ndarray:
    points: list[list[str]] = []
    faces: list[list[int]] = []
    for line in data.decode("utf-8", "replace").splitlines():
        kind, *words = line.split() or [""]
        if kind == "v":
            points.append(words[:3])
        elif kind == "f":
            numbers = [int(word.split("/")[0]) for word in words]
            faces += _fan([number - 1 if number > 0 else len(points) + number for number in numbers])
    return np.array(points, dtype=float)[np.array(faces)]


def _msh(data: bytes) -> np.ndarray:
    vertices, *_, faces = np.frombuffer(data, "<i4", 4).tolist()
    if not faces:
        raise ValueError("has no faces")
    points = np.frombuffer(data, "<f4", 3 * vertices, 16).reshape(-1, 3).astype(float)
    return points[np.frombuffer(data[-12 * faces :], "<i4").reshape(-1, 3)]


def _fan(numbers: list[int]) -> list[list[int]]:
    return [[numbers[0], numbers[k], numbers[k + 1]] for k in range(1, len(numbers) - 1)]


# --- COLLADA.


def _dae(data: bytes) -> np.ndarray:
    """Triangles of the scene in metres. Its up axis is ignored, as ROS does: URDFs are written for that."""
    root = ElementTree.fromstring(data)
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]  # versions differ in their namespace
    unit = root.find("asset/unit")
    scale = float(unit.get("meter", "1")) if unit is not None else 1.0
    named = {element.get("id", ""): element for element in root.iter() if element.get("id")}
    meshes = {one.get("id", ""): _dae_mesh(one, named) for one in root.iterfind("library_geometries/geometry")}
    scenes = root.findall("library_visual_scenes/visual_scene")
    shown = root.find("scene/instance_visual_scene")
    if shown is not None:
        scenes = [named[shown.get("url", "")[1:]]]
    parts = [part for scene in scenes for node in scene.findall("node") for part in _dae_node(node, named, meshes)]
    return scale * np.concatenate(parts if scenes else list(meshes.values()))


def _dae_node(
    node: ElementTree.Element, named: dict[str, ElementTree.Element], meshes: dict[str, np.ndarray], depth: int = 50
) -> Iterator[np.ndarray]:
    """Triangles of a node and its children, in the axes of its parent."""
    if not depth:
        raise ValueError("nodes that contain themselves")
    place, found = np.eye(4), list[np.ndarray]()
    for child in node:
        numbers = np.array((child.text or "").split(), dtype=float) if child.tag in TRANSFORMS else np.empty(0)
        if child.tag in TRANSFORMS:
            place = place @ TRANSFORMS[child.tag](numbers)
        elif child.tag in ("lookat", "skew"):
            raise ValueError(f"<{child.tag}> is not read")
        elif child.tag == "node":
            found += _dae_node(child, named, meshes, depth - 1)
        elif child.tag == "instance_node":
            found += _dae_node(named[child.get("url", "")[1:]], named, meshes, depth - 1)
        elif child.tag == "instance_geometry":
            found.append(meshes[child.get("url", "")[1:]])
    yield from (corners @ place[:3, :3].T + place[:3, 3] for corners in found)


def _turned(numbers: np.ndarray) -> np.ndarray:
    """Rotation by an angle [deg] about an axis: Rodrigues' formula."""
    x, y, z = numbers[:3] / np.linalg.norm(numbers[:3])
    across, angle, place = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]), np.radians(numbers[3]), np.eye(4)
    place[:3, :3] += np.sin(angle) * across + (1 - np.cos(angle)) * across @ across
    return place


def _moved(numbers: np.ndarray) -> np.ndarray:
    place = np.eye(4)
    place[:3, 3] = numbers
    return place


TRANSFORMS = {
    "matrix": lambda numbers: numbers.reshape(4, 4),
    "rotate": _turned,
    "scale": lambda numbers: np.diag([*numbers, 1.0]),
    "translate": _moved,
}


def _dae_mesh(geometry: ElementTree.Element, named: dict[str, ElementTree.Element]) -> np.ndarray:
    """Triangles of a geometry, (n, 3, 3)."""
    parts = [np.empty((0, 3, 3))]
    for group in geometry.iterfind("mesh/*"):
        if group.tag not in ("triangles", "polylist", "polygons", "tristrips", "trifans"):
            continue
        inputs = group.findall("input")
        stride = 1 + max(int(one.get("offset", "0")) for one in inputs)
        vertex = next(one for one in inputs if one.get("semantic") == "VERTEX")
        ends = named[vertex.get("source", "")[1:]].findall("input")
        source = named[next(one for one in ends if one.get("semantic") == "POSITION").get("source", "")[1:]]
        points = np.array((source.findtext("float_array") or "").split(), dtype=float).reshape(-1, 3)
        for text in [one.text or "" for one in group.findall("p")]:
            corners = np.array(text.split(), dtype=int)[int(vertex.get("offset", "0")) :: stride]
            parts.append(points[_dae_faces(group, corners)].reshape(-1, 3, 3))
    return np.concatenate(parts)


def _dae_faces(group: ElementTree.Element, corners: np.ndarray) -> np.ndarray:
    """Triangles (n, 3) of a list of corners; without children of a face, the numbers are of points."""
    if group.tag == "triangles":
        return corners.reshape(-1, 3)
    if group.tag == "tristrips":
        return np.lib.stride_tricks.sliding_window_view(corners, 3)
    counts = [len(corners)]
    if group.tag == "polylist":
        counts = [int(one) for one in (group.findtext("vcount") or "").split()]
    faces = [_fan(one.tolist()) for one in np.split(corners, np.cumsum(counts)[:-1])]
    return np.array([triangle for face in faces for triangle in face], dtype=int).reshape(-1, 3)
