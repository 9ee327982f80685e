"""Shapes of links: capsules fitted to the robot file's collision geometry."""

from __future__ import annotations

import json
import os
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np
from scipy.optimize import least_squares

from tauext._core import Capsule, Tree
from tauext.errors import RobotError
from tauext.files.plain_file import FORMAT
from tauext.files.provenance import write_json
from tauext.robot.mesh_files import MeshFinder, MeshFolders, MissingMeshError
from tauext.robot.read import compiled, placed_bodies
from tauext.robot.write import PAYLOAD
from tauext.robot.xml_file import XmlFile, read_xml

SHAPES_FILE = "robot.shapes.json"
"""Beside the robot file of a dataset: shapes of its links."""

# --- Shapes of parts of links: capsules, or surface points to fit capsules to.


AROUND = 16
"""Points around a primitive."""


@dataclass(frozen=True)
class Shape:
    """A capsule (a sphere where both ends are one), or points of a surface in its place; [m]."""

    radius_m: float
    start: np.ndarray
    end: np.ndarray
    points: np.ndarray | None = None
    """(n, 3) of the surface; None: it is that capsule."""
    areas: np.ndarray | None = None
    """(n,) area of each point, [m^2]."""

    def moved(self, rotation: np.ndarray, place: np.ndarray) -> Shape:
        """The shape rotated, then shifted."""
        points = None if self.points is None else self.points @ rotation.T + place
        return replace(self, start=rotation @ self.start + place, end=rotation @ self.end + place, points=points)


def surface(points: np.ndarray, areas: np.ndarray) -> Shape:
    """Shape of surface points, to be fitted by capsules."""
    return Shape(0.0, np.zeros(3), np.zeros(3), np.asarray(points, dtype=float), np.asarray(areas, dtype=float))


def cylinder(radius: float, half_m: float) -> Shape:
    """Capsule along z, or surface points where the cylinder is wider than long."""
    if half_m >= radius:
        end = np.array([0, 0, half_m - radius])
        return Shape(float(radius), -end, end)
    turned = 2 * np.pi * (np.arange(AROUND) + 0.5) / AROUND
    ring = np.column_stack([np.cos(turned), np.sin(turned)])
    points, areas = [], []
    for z in (-half_m / 2, half_m / 2):
        points.append(np.column_stack([radius * ring, np.full(AROUND, z)]))
        areas.append(np.full(AROUND, 2 * np.pi * radius * half_m / AROUND))
    for z in (-half_m, half_m):
        for share in (0.35, 0.8):  # rings that halve the disc
            points.append(np.column_stack([share * radius * ring, np.full(AROUND, z)]))
            areas.append(np.full(AROUND, np.pi * radius**2 / 2 / AROUND))
    return surface(np.concatenate(points), np.concatenate(areas))


def box(half_m: np.ndarray) -> Shape:
    """Surface points of a box: a grid on each side."""
    grid = (np.arange(AROUND // 2) + 0.5) / (AROUND // 2) * 2 - 1
    u, v = (one.ravel() for one in np.meshgrid(grid, grid))
    points, areas = [], []
    for axis in range(3):
        a, b = (axis + 1) % 3, (axis + 2) % 3
        for sign in (-1.0, 1.0):
            side = np.empty((len(u), 3))
            side[:, axis], side[:, a], side[:, b] = sign * half_m[axis], u * half_m[a], v * half_m[b]
            points.append(side)
            areas.append(np.full(len(u), 4 * half_m[a] * half_m[b] / len(u)))
    return surface(np.concatenate(points), np.concatenate(areas))


def ellipsoid(half_m: np.ndarray) -> Shape:
    """Surface points of an ellipsoid: an even sphere's, stretched with their areas."""
    count = 4 * AROUND**2 // 4
    z = 1 - (2 * np.arange(count) + 1) / count
    turned = np.pi * (1 + 5**0.5) * np.arange(count)
    even = np.column_stack([np.sqrt(1 - z**2) * np.cos(turned), np.sqrt(1 - z**2) * np.sin(turned), z])
    stretched = np.prod(half_m) * np.linalg.norm(even / half_m, axis=1)
    return surface(even * half_m, 4 * np.pi / count * stretched)


def mesh(vertices: np.ndarray, faces: np.ndarray) -> Shape:
    """Surface points of a mesh: centres of its triangles."""
    corners = np.asarray(vertices, dtype=float)[np.asarray(faces)]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    return surface(corners.mean(axis=1), areas)


# --- Shapes of a URDF's links; MuJoCo reads the meshes.


@dataclass(frozen=True)
class LostShapes:
    """Shapes of a URDF that could not be read."""

    links: dict[str, list[str]]
    """Links by the reason."""
    packages: list[str]
    """Packages of missing meshes; "": a mesh that is no package's."""

    def only(self, links: Collection[str]) -> LostShapes:
        """Those of these links."""
        kept = {why: [one for one in some if one in links] for why, some in self.links.items()}
        return replace(self, links={why: some for why, some in kept.items() if some})

    def names(self) -> list[str]:
        """The links, each once."""
        return list(dict.fromkeys(link for links in self.links.values() for link in links))

    def sentences(self) -> list[str]:
        """One sentence with the remedy, or none."""
        if not self.links:
            return []
        first = next(iter(self.links))
        more = f" and {len(self.links) - 1} more" if len(self.links) > 1 else ""
        remedy = ""
        if self.packages:
            package = next(filter(None, self.packages), "")
            remedy = "; give their folder with --meshes FOLDER (import, train)"
            if package:
                remedy += f", or put package {package} beside the robot file"
        return [f"shapes of {', '.join(self.names())} could not be read: {first}{more}{remedy}"]


def urdf_shapes(file: XmlFile, bodies: list[str], meshes: MeshFinder) -> tuple[list[tuple[int, Shape]], LostShapes]:
    """Body index and shape in the body's axes, and the shapes that could not be read.

    A link's collision elements are used, else its visual ones.
    """
    numbers, found = {name: number for number, name in enumerate(bodies)}, []
    lost = LostShapes({}, [])
    for link in file.root.findall("link"):
        body = numbers.get(link.get("name", ""), -1)
        for element in link.findall("collision") or link.findall("visual") if body >= 0 else ():
            geometry = element.find("geometry")
            if geometry is None or not len(geometry):
                continue
            try:
                shape = _shape(geometry[0], meshes)
                if shape is not None:
                    found.append((body, shape.moved(*_origin(element.find("origin")))))
            except (OSError, ValueError) as error:
                lost.links.setdefault(" ".join(str(error).split()), []).append(link.get("name", ""))
                if isinstance(error, MissingMeshError):
                    lost.packages.append(error.package)
    return found, lost


def _shape(geometry: ElementTree.Element, meshes: MeshFinder) -> Shape | None:
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
            return _mesh(meshes.find(geometry.get("filename", "")), scale)
        case _:
            return None


def _numbers(element: ElementTree.Element, key: str, count: int) -> np.ndarray:
    values = np.array((element.get(key) or "").split(), dtype=float)
    if len(values) != count or not np.isfinite(values).all():
        raise ValueError(f"{element.tag} {key} = {element.get(key)!r} must be {count} finite number{'s' * (count > 1)}")
    return values


def _origin(origin: ElementTree.Element | None) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (fixed-axis roll, pitch, yaw) and position of an origin element."""
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


def _mesh(file: Path, scale: np.ndarray) -> Shape:
    """Shape of a mesh file's triangles, in the file's own axes."""
    spec = mujoco.MjSpec()
    spec.add_mesh(name="one", file=str(file), inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="one")
    try:
        model = spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        raise ValueError(f"{file.name} is no mesh that can be read") from error
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, model.mesh_quat[0])  # MuJoCo keeps meshes along their principal axes
    vertices = model.mesh_vert @ turn.reshape(3, 3).T + model.mesh_pos[0]
    return mesh(vertices * scale, model.mesh_face)


# --- Capsules fitted to surface points.


MOST_POINTS = 600
"""Most points of a mesh that are used; more do not change the capsule."""
GOOD_SHARE, GOOD_M = 0.15, 0.01
"""A capsule is accepted if its RMS distance from the surface is below this share of its radius, or below 1 cm. Contact
places are less accurate than that."""
MOST_SPLITS = 2
"""One shape becomes four capsules at most."""
LEAST_RADIUS_M = 1e-3


def as_capsules(shape: Shape) -> list[tuple[np.ndarray, np.ndarray, float]]:
    """Both ends and the radius of each, [m]."""
    if shape.points is None:
        return [(shape.start, shape.end, shape.radius_m)]
    assert shape.areas is not None
    points, areas = thinned(shape.points, shape.areas)
    return split(points, areas, MOST_SPLITS) if len(points) else []


def thinned(points: np.ndarray, areas: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Draw points with probability by area and a fixed seed; degenerate triangles are left out."""
    sound = np.isfinite(points).all(axis=1) & (areas > 0)
    points, areas = points[sound], areas[sound]
    if len(points) <= MOST_POINTS:
        return points, areas
    drawn = np.random.default_rng(0).choice(len(points), MOST_POINTS, p=areas / areas.sum())
    return points[drawn], np.full(MOST_POINTS, areas.sum() / MOST_POINTS)


def split(points: np.ndarray, areas: np.ndarray, most: int) -> list[tuple[np.ndarray, np.ndarray, float]]:
    """One capsule, or those of both halves where one fits badly."""
    start, end, radius, rms = fitted(points, areas)
    if rms <= max(GOOD_SHARE * radius, GOOD_M) or most == 0 or len(points) < 24:
        return [(start, end, radius)]
    first = halves(points, areas)
    if min(first.sum(), (~first).sum()) < 8:
        return [(start, end, radius)]
    return split(points[first], areas[first], most - 1) + split(points[~first], areas[~first], most - 1)


def halves(points: np.ndarray, areas: np.ndarray) -> np.ndarray:
    """Points of the first of two clusters, (n,) bool."""
    along = main_axis(points, areas)
    at = (points - np.average(points, axis=0, weights=areas)) @ along
    first = at > np.median(at)
    for _ in range(20):
        middles = [np.average(points[part], axis=0, weights=areas[part]) for part in (first, ~first)]
        nearer = np.linalg.norm(points - middles[0], axis=1) < np.linalg.norm(points - middles[1], axis=1)
        if (nearer == first).all() or nearer.all() or not nearer.any():
            break
        first = nearer
    return first


def main_axis(points: np.ndarray, areas: np.ndarray) -> np.ndarray:
    off = points - np.average(points, axis=0, weights=areas)
    return np.linalg.eigh((off * areas[:, None]).T @ off)[1][:, -1]


def fitted(points: np.ndarray, areas: np.ndarray) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Fit a capsule by least squares of the points' distance from its surface; last returned is the root mean
    square."""
    middle, along = np.average(points, axis=0, weights=areas), main_axis(points, areas)
    at = (points - middle) @ along
    across = np.linalg.norm(points - middle - at[:, None] * along, axis=1)
    radius = float(np.average(across, weights=areas))
    reach = max(float(np.quantile(np.abs(at), 0.98)) - radius, 0.05 * radius)
    weights = np.sqrt(areas / areas.sum())

    def distance(x: np.ndarray) -> np.ndarray:
        start, way = x[:3], x[3:6] - x[:3]
        share = np.clip((points - start) @ way / max(float(way @ way), 1e-12), 0, 1)
        return weights * (np.linalg.norm(points - start - share[:, None] * way, axis=1) - x[6])

    found = least_squares(distance, np.r_[middle - reach * along, middle + reach * along, radius], max_nfev=60)
    start, end, radius = found.x[:3], found.x[3:6], max(abs(float(found.x[6])), LEAST_RADIUS_M)
    return start, end, radius, float(np.sqrt(2 * found.cost))


# --- Capsules of links.


MOST_A_LINK = 8
"""Largest number of capsules: more would slow the ranking without improving it, so the largest are kept."""


NO_FOLDERS = MeshFolders()
Ends = tuple[list[float], list[float], float]
"""Both ends of a capsule and its radius, [m]."""


@dataclass(frozen=True)
class BodyCapsules:
    bodies: dict[str, list[Ends]]
    """Capsules by name of body or link, in its axes."""
    notes: list[str]
    """Shapes that could not be read, one sentence each."""
    lost: list[str] = field(default_factory=list)
    """Bodies or links with a shape that could not be read."""
    packages: dict[str, Path] = field(default_factory=dict)
    """Packages whose meshes are from installed robot descriptions, and their folders."""


def body_capsules(path: str | os.PathLike[str], given: MeshFolders = NO_FOLDERS) -> BodyCapsules:
    """The shapes of a robot file's links: each body's collision geometry, else its visual one.

    Cylinders become capsules of the same length; spheres and capsules stay unchanged. Boxes, ellipsoids and meshes
    become one to four capsules, fitted by least squares to the surface. Missing mesh files are listed.

    Args:
        given: folders of a URDF's meshes, which are searched first.

    Raises:
        RobotError: the file cannot be read.
    """
    return _body_capsules(Path(path), given)[0]


def _body_capsules(path: Path, given: MeshFolders) -> tuple[BodyCapsules, LostShapes]:
    model, file, meshes = compiled(path), read_xml(path), MeshFinder(path, given)
    placed: Iterable[tuple[int, Shape]]
    lost = LostShapes({}, [])
    names = [model.body(body).name for body in range(model.nbody)]
    if file.root.tag == "robot":
        placed, lost = urdf_shapes(file, names, meshes)
        notes, incomplete = lost.sentences(), lost.names()
    else:
        placed = mjcf_shapes(model)
        listed = [(body.get("name", ""), len(body.findall("geom"))) for body in file.root.iter("body")]
        left = f"shapes are left out, since a mesh, a texture or a name is missing in {path.name}"
        notes = [left] if model.ngeom < sum(count for _, count in listed) else []
        incomplete = [name for name, count in listed if name and name in names and model.body(name).geomnum[0] < count]
    bodies: dict[str, list[Ends]] = {}
    for body, shape in placed:
        name = model.body(body).name
        if name and name != PAYLOAD:
            ends = [(start.tolist(), end.tolist(), float(radius)) for start, end, radius in as_capsules(shape)]
            bodies.setdefault(name, []).extend(ends)
    return BodyCapsules(bodies, notes, incomplete, meshes.elsewhere), lost


def write_shapes(source: Path, folder: Path, given: MeshFolders = NO_FOLDERS) -> BodyCapsules:
    """Write the shapes of a robot file beside the dataset's copy of it, and return them.

    Raises:
        RobotError: the file cannot be read.
    """
    shapes = body_capsules(source, given)
    listed = {
        name: [{"start_m": start, "end_m": end, "radius_m": radius} for start, end, radius in ends]
        for name, ends in shapes.bodies.items()
    }
    content = {"format": FORMAT, "bodies": listed, "notes": shapes.notes, "lost": shapes.lost}
    write_json(content, folder / SHAPES_FILE)
    return shapes


def read_shapes(path: Path) -> BodyCapsules:
    """Read the file that write_shapes() wrote.

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
        notes, lost = ([str(one) for one in kept.get(key, [])] for key in ("notes", "lost"))
        return BodyCapsules(bodies, notes, lost)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise RobotError(
            f"{path}: not a file of shapes ({type(error).__name__}: {error}); import the data again"
        ) from error


def shapes_of(path: Path, given: MeshFolders = NO_FOLDERS) -> BodyCapsules:
    """The shapes that write_shapes() wrote beside a robot file, else those of the file.

    What could not be read for that file is tried again: its meshes may be in the given folders, or installed since.

    Raises:
        RobotError: a file cannot be read.
    """
    beside = path.with_name(SHAPES_FILE)
    if not beside.is_file():
        return body_capsules(path, given)
    kept = read_shapes(beside)
    if not (kept.notes or given) or read_xml(path).root.tag != "robot":
        return kept
    fresh, lost = _body_capsules(path, given)
    read = {name: ends for name, ends in fresh.bodies.items() if name not in fresh.lost}
    left = lost.only([name for name in fresh.lost if name not in kept.bodies or name in kept.lost])
    return BodyCapsules(kept.bodies | read, left.sentences(), left.names(), fresh.packages)


def link_capsules(
    path: str | os.PathLike[str], tree: Tree, given: MeshFolders = NO_FOLDERS
) -> tuple[list[Capsule], list[str]]:
    """Capsules of the moving links, in the core's link frames, and sentences about shapes that could not be read.

    A link with a shape that could not be read has no capsules: those of the others, as of fingers, would be taken for
    the whole link.

    Args:
        path: URDF or MJCF of the tree; shapes beside it from write_shapes() take precedence.
        tree: defines which joints are in use.
        given: folders of a URDF's meshes, which are searched first.

    Raises:
        RobotError: a file cannot be read.
    """
    path = Path(path)
    shapes = shapes_of(path, given)
    found: dict[int, list[Capsule]] = {}
    incomplete: set[int] = set()
    for body in placed_bodies(path, tree)[2]:
        if body.name in shapes.lost:
            incomplete.add(body.link)
        for start, end, radius in shapes.bodies.get(body.name, []):
            ends = [(body.translation + body.rotation @ np.array(one)).tolist() for one in (start, end)]
            found.setdefault(body.link, []).append(Capsule(body.link, ends[0], ends[1], radius))
    capsules = []
    for link in sorted(found.keys() - incomplete):
        largest = sorted(found[link], key=area_m2, reverse=True)[:MOST_A_LINK]
        capsules += [one for one in found[link] if one in largest]
    return capsules, shapes.notes


def area_m2(capsule: Capsule) -> float:
    length = float(np.linalg.norm(np.subtract(capsule.end, capsule.start)))
    return 2 * np.pi * capsule.radius_m * (length + 2 * capsule.radius_m)


def mjcf_shapes(model: mujoco.MjModel) -> Iterator[tuple[int, Shape]]:
    """Body index and colliding shapes in the body's axes; all visible shapes where none collide."""
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
    """Shape of a geom in its own axes; None: planes, height fields and others that are no link."""
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
