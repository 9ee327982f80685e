"""Shapes of links: capsules fitted to the robot file's collision geometry."""

from __future__ import annotations

import json
import os
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np
from scipy.spatial import ConvexHull

from tauext._core import Capsule, Tree
from tauext.errors import RobotError
from tauext.files.plain_file import FORMAT
from tauext.files.provenance import write_json
from tauext.robot.mesh_files import MeshFinder, MeshFolders, MissingMeshError
from tauext.robot.mesh_triangles import triangles_of
from tauext.robot.read import compiled, placed_bodies
from tauext.robot.urdf import numbers_of, origin_of
from tauext.robot.write import PAYLOAD
from tauext.robot.xml_file import XmlFile, read_xml

SHAPES_FILE = "robot.shapes.json"
"""Beside the robot file of a dataset: shapes of its links."""
Ends = tuple[list[float], list[float], float]
"""Both ends of a capsule and its radius, [m]; a sphere where both ends are one."""

# --- Capsules of a shape, in the axes of its body.


def geom_capsules(model: mujoco.MjModel, geom: int) -> list[Ends]:
    """Capsules of a geom; empty for planes, height fields and others that are no link."""
    kinds, size = mujoco.mjtGeom, model.geom_size[geom]
    kind = kinds(model.geom_type[geom])
    axes, middle = _rotation(model.geom_quat[geom]), model.geom_pos[geom]
    reach = {kinds.mjGEOM_SPHERE: 0.0, kinds.mjGEOM_CAPSULE: size[1], kinds.mjGEOM_CYLINDER: size[1] - size[0]}
    if reach.get(kind, -1.0) >= 0:
        end = reach[kind] * axes[:, 2]
        return [((middle - end).tolist(), (middle + end).tolist(), float(size[0]))]
    if kind == kinds.mjGEOM_MESH:
        number = model.geom_dataid[geom]
        mesh = model.mesh(number)
        vertices = model.mesh_vert[mesh.vertadr[0] :][: mesh.vertnum[0]]
        corners = vertices[model.mesh_face[mesh.faceadr[0] :][: mesh.facenum[0]]] @ axes.T + middle
        axes = axes @ _rotation(model.mesh_quat[number]).T  # the file's; MuJoCo keeps meshes along their principal axes
    elif kind in (kinds.mjGEOM_CYLINDER, kinds.mjGEOM_BOX, kinds.mjGEOM_ELLIPSOID):
        corners = primitive_triangles(kind, size) @ axes.T + middle
    else:
        return []
    return mesh_capsules(corners, axes)


def mesh_capsules(corners: np.ndarray, axes: np.ndarray) -> list[Ends]:
    """Capsules of triangles (n, 3, 3), whose first box is along the columns of axes (3, 3)."""
    return split(near_points(drawn_points(corners)), axes)


def _rotation(quaternion: np.ndarray) -> np.ndarray:
    flat = np.empty(9)
    mujoco.mju_quat2Mat(flat, quaternion)
    return flat.reshape(3, 3)


def even_directions(count: int) -> np.ndarray:
    """Unit vectors (count, 3), spread evenly over the sphere by the golden angle."""
    z = 1 - (2 * np.arange(count) + 1) / count
    turned, flat = np.pi * (1 + 5**0.5) * np.arange(count), np.sqrt(1 - z**2)
    return np.column_stack([flat * np.cos(turned), flat * np.sin(turned), z])


def primitive_triangles(kind: int, size: np.ndarray, count: int = 1000) -> np.ndarray:
    """Triangles (n, 3, 3) of a box, cylinder or ellipsoid about the origin: an even sphere, stretched onto it."""
    points = even_directions(count)
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        points /= np.abs(points).max(axis=1, keepdims=True)
    elif kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        flat, z = np.linalg.norm(points[:, :2], axis=1), np.abs(points[:, 2])
        points, size = points / np.maximum(flat, z)[:, None], size[[0, 0, 1]]
    return (points * size)[ConvexHull(points).simplices]


def drawn_points(corners: np.ndarray, count: int = 600) -> np.ndarray:
    """Points (count, 3) drawn evenly, with a fixed seed, from the surface of triangles (n, 3, 3)."""
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    areas[~np.isfinite(areas)] = 0.0
    if not areas.any():
        raise ValueError("has no surface")
    rng = np.random.default_rng(0)
    drawn = corners[rng.choice(len(corners), count, p=areas / areas.sum())]
    return np.asarray(np.einsum("nk,nkx->nx", rng.dirichlet((1, 1, 1), count), drawn))


def near_points(points: np.ndarray, share: float = 0.97, beyond: float = 1.25) -> np.ndarray:
    """The points of a surface (n, 3) without the few that are far from all others, as triangles to a stray vertex are.

    Args:
        share, beyond: a point is far if it is this many times as far from the median point as this share of all points.
    """
    away = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    return points[away <= beyond * np.quantile(away, share)]


def split(
    points: np.ndarray, axes: np.ndarray, most: int = 2, good_share: float = 0.15, good_m: float = 0.01
) -> list[Ends]:
    """One capsule of these points (n, 3), or those of two parts, cut across the longest side, where one fits badly.

    Args:
        axes: (3, 3), columns along which the first box of the points is aligned.
        most: cuts in succession; 2 gives four capsules at most.
        good_share, good_m: a capsule fits if the RMS distance of the points from its surface is below this share of its
            radius, or below this length: places of touches are less accurate than that.
    """
    one, rms = fitted(points, axes)
    if rms <= max(good_share * one[2], good_m) or not most:
        return [one]
    along = axes[:, int(np.ptp(points @ axes, axis=0).argmax())]
    at = points @ along
    best, parts = rms**2 * len(points), [points]
    for share in (0.25, 0.5, 0.75):
        first = at < at.min() + share * np.ptp(at)
        cut = [points[first], points[~first]]
        if min(map(len, cut)) >= 8 and (left := sum(len(part) * fitted(part, axes)[1] ** 2 for part in cut)) < best:
            best, parts = left, cut
    return [one] if len(parts) == 1 else [end for part in parts for end in split(part, axes, most - 1)]


def fitted(points: np.ndarray, axes: np.ndarray, margin: float = 0.1) -> tuple[Ends, float]:
    """The capsule in the box of the points, and the RMS distance of the points from its surface.

    The box is along `axes`, or along the points' principal axes where that fits better. The capsule runs along the
    longest side, as thick as the mean of the other two. It shrinks towards the points' mean until it leaves their
    convex hull by no more than the margin.

    Args:
        margin: share of the diagonal of the box along `axes`. More lets flat shapes be thicker than they are.
    """
    most = margin * float(np.linalg.norm(np.ptp(points @ axes, axis=0)))
    directions, centre = even_directions(400), points.mean(axis=0)
    allowed = (directions @ (points - centre).T).max(axis=1) + most
    found: list[tuple[float, Ends]] = []
    for frame in (axes, np.linalg.eigh(np.cov(points.T))[1]):
        at = points @ frame
        half, middle = np.ptp(at, axis=0) / 2, (at.min(axis=0) + at.max(axis=0)) / 2
        least, between, longest = np.sort(half)
        radius = min((least + between) / 2, least + most)
        reach = np.where(np.arange(3) == half.argmax(), longest - radius, 0.0)
        ends = np.stack([middle - reach, middle + reach]) @ frame.T - centre
        taken = (ends @ directions.T).max(axis=0) + radius
        share = min(1.0, float((allowed / np.maximum(taken, 1e-9)).min()))
        (start, end), radius = centre + share * ends, max(share * radius, 1e-3)  # a bundle has no thinner ones
        way = end - start
        along = np.clip((points - start) @ way / max(float(way @ way), 1e-12), 0, 1)
        off = np.linalg.norm(points - start - along[:, None] * way, axis=1) - radius
        found.append((float(np.sqrt(np.mean(off**2))), (start.tolist(), end.tolist(), float(radius))))
    rms, best = min(found, key=lambda one: one[0])
    return best, rms


def body_geoms(model: mujoco.MjModel, body: int) -> list[int]:
    """A body's colliding geoms; all visible ones where none collides."""
    geoms = list(range(model.body_geomadr[body], model.body_geomadr[body] + model.body_geomnum[body]))
    return [geom for geom in geoms if model.geom_contype[geom] or model.geom_conaffinity[geom]] or geoms


# --- Shapes of a URDF's links.


@dataclass(frozen=True)
class LostShapes:
    """Shapes of a URDF that could not be read."""

    links: dict[str, list[str]] = field(default_factory=dict)
    """Links by the reason."""
    packages: list[str] = field(default_factory=list)
    """Packages of missing meshes; "": a mesh that is no package's."""

    def only(self, links: Collection[str]) -> LostShapes:
        """The lost shapes of these links."""
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
        remedy = "; give their folder with --meshes FOLDER (import, train)" if self.packages else ""
        if package := next(filter(None, self.packages), ""):
            remedy += f", or put package {package} beside the robot file"
        return [f"shapes of {', '.join(self.names())} could not be read: {first}{more}{remedy}"]


def urdf_capsules(
    file: XmlFile, bodies: Collection[str], meshes: MeshFinder
) -> tuple[dict[str, list[Ends]], LostShapes]:
    """Capsules by link, of its collision elements, else of its visual ones, and the shapes that could not be read."""
    found: dict[str, list[Ends]] = {}
    lost = LostShapes()
    for link in file.root.findall("link"):
        name = link.get("name", "")
        for element in link.findall("collision") or link.findall("visual") if name in bodies else ():
            try:
                capsules = _element_capsules(file, element, meshes)
                found.setdefault(name, []).extend(capsules)
            except (OSError, ValueError, RobotError) as error:
                lost.links.setdefault(" ".join(str(error).split()), []).append(name)
                if isinstance(error, MissingMeshError):
                    lost.packages.append(error.package)
    return found, lost


def _element_capsules(file: XmlFile, element: ElementTree.Element, meshes: MeshFinder) -> list[Ends]:
    """Capsules of a collision or visual element; none if it has no shape."""
    geometry = element.find("geometry")
    if geometry is None or not len(geometry):
        return []
    shape, kinds, what = geometry[0], mujoco.mjtGeom, f"<{element.tag}>"
    position, quaternion = origin_of(file, element, what)
    if shape.tag == "mesh":
        path, axes = meshes.find(shape.get("filename", "")), _rotation(quaternion / np.linalg.norm(quaternion))
        scale = numbers_of(file, shape, "scale", path.name, 3, [1.0] * 3)
        corners = triangles_of(path) * scale @ axes.T + position
        try:
            return mesh_capsules(corners, axes)
        except ValueError as error:
            raise ValueError(f"{path.name} {error}") from error
    spec = mujoco.MjSpec()
    geom = spec.worldbody.add_geom(pos=position, quat=quaternion, contype=0, conaffinity=0)
    match shape.tag:
        case "sphere":
            geom.type, geom.size[0] = kinds.mjGEOM_SPHERE, numbers_of(file, shape, "radius", what)[0]
        case "cylinder" | "capsule":
            geom.type = kinds.mjGEOM_CYLINDER if shape.tag == "cylinder" else kinds.mjGEOM_CAPSULE
            geom.size[0] = numbers_of(file, shape, "radius", what)[0]
            geom.size[1] = numbers_of(file, shape, "length", what)[0] / 2
        case "box":
            geom.type, geom.size = kinds.mjGEOM_BOX, np.array(numbers_of(file, shape, "size", what, 3)) / 2
        case _:
            return []
    try:
        return geom_capsules(spec.compile(), 0)
    except (ValueError, mujoco.FatalError) as error:
        raise ValueError(f"{what} is no {shape.tag} that can be read") from error


# --- Capsules of links.


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


def body_capsules(path: str | os.PathLike[str], given: MeshFolders = MeshFolders()) -> BodyCapsules:
    """The shapes of a robot file's links: each body's collision geometry, else its visual one.

    Cylinders become capsules of the same length; spheres and capsules stay unchanged. Boxes, ellipsoids and meshes
    become one to four capsules. Missing mesh files are listed.

    Args:
        given: folders of a URDF's meshes, which are searched first.

    Raises:
        RobotError: the file cannot be read.
    """
    return _body_capsules(Path(path), given)[0]


def far_shapes(model: mujoco.MjModel, bodies: dict[str, list[Ends]], beyond_m: float = 1.0) -> LostShapes:
    """Bodies whose capsules end farther from their origin than all joints' distances and this length together.

    No link reaches that far: its mesh is in another unit or damaged, or its shape was kept by a version that fitted it
    wrongly. Bodies that no joint moves may be of any size.
    """
    slides = model.jnt_range[model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE]
    most = float(np.linalg.norm(model.body_pos, axis=1).sum() + np.abs(slides).sum()) + beyond_m
    moving = {model.body(k).name for k in range(model.nbody) if model.body_weldid[k]}
    reach = {name: max((end_m(one) for one in ends), default=0.0) for name, ends in bodies.items() if name in moving}
    far = {name: reached for name, reached in reach.items() if not reached <= most}
    why = f"a shape reaches {max(far.values(), default=0):.3g} m: a mesh in mm needs scale = 0.001"
    return LostShapes({why: list(far)} if far else {})


def end_m(capsule: Ends) -> float:
    """Distance of a capsule's farthest point from the origin, [m]."""
    start, end, radius = capsule
    return float(max(np.linalg.norm(start), np.linalg.norm(end))) + radius


def _body_capsules(path: Path, given: MeshFolders) -> tuple[BodyCapsules, LostShapes]:
    model, file, meshes = compiled(path), read_xml(path), MeshFinder(path, given)
    names = [name for body in range(1, model.nbody) if (name := model.body(body).name) and name != PAYLOAD]
    if file.root.tag == "robot":
        bodies, lost = urdf_capsules(file, names, meshes)
        lost.links.update(far_shapes(model, bodies).links)
        return BodyCapsules(bodies, lost.sentences(), lost.names(), meshes.elsewhere), lost
    geoms = {name: body_geoms(model, model.body(name).id) for name in names}
    bodies = {
        name: [one for geom in held for one in geom_capsules(model, geom)] for name, held in geoms.items() if held
    }
    listed = [(body.get("name", ""), len(body.findall("geom"))) for body in file.root.iter("body")]
    left = f"shapes are left out, since a mesh, a texture or a name is missing in {path.name}"
    incomplete = [name for name, count in listed if name and name in names and model.body(name).geomnum[0] < count]
    notes, far = [left] * (model.ngeom < sum(count for _, count in listed)), far_shapes(model, bodies)
    return BodyCapsules(bodies, [*notes, *far.sentences()], [*incomplete, *far.names()]), LostShapes()


def write_shapes(source: Path, folder: Path, given: MeshFolders = MeshFolders()) -> BodyCapsules:
    """Write the shapes of a robot file beside the dataset's copy of it, and return them.

    Raises:
        RobotError: the file cannot be read.
    """
    shapes = body_capsules(source, given)
    keys = ("start_m", "end_m", "radius_m")
    listed = {name: [dict(zip(keys, one, strict=True)) for one in ends] for name, ends in shapes.bodies.items()}
    content = {"format": FORMAT, "bodies": listed, "notes": shapes.notes, "lost": shapes.lost}
    write_json(content, folder / SHAPES_FILE)
    return shapes


def read_shapes(path: Path) -> BodyCapsules:
    """Read the file that write_shapes() wrote."""
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


def shapes_of(path: Path, given: MeshFolders = MeshFolders()) -> BodyCapsules:
    """The shapes that write_shapes() wrote beside a robot file, else those of the file.

    What could not be read for that file is tried again: its meshes may be in the given folders, or installed since.
    """
    beside = path.with_name(SHAPES_FILE)
    if not beside.is_file():
        return body_capsules(path, given)
    kept = read_shapes(beside)
    if (far := far_shapes(compiled(path), kept.bodies)).links:
        again = [f"{sentence}, or import the data again" for sentence in far.sentences()]
        kept = replace(kept, notes=kept.notes + again, lost=kept.lost + far.names())
    if not (kept.notes or given) or read_xml(path).root.tag != "robot":
        return kept
    fresh, lost = _body_capsules(path, given)
    read = {name: ends for name, ends in fresh.bodies.items() if name not in fresh.lost}
    left = lost.only([name for name in fresh.lost if name not in kept.bodies or name in kept.lost])
    return BodyCapsules(kept.bodies | read, left.sentences(), left.names(), fresh.packages)


def link_capsules(
    path: str | os.PathLike[str], tree: Tree, given: MeshFolders = MeshFolders()
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
        largest = sorted(found[link], key=area_m2, reverse=True)[:8]  # more would slow the ranking, and not improve it
        capsules += [one for one in found[link] if one in largest]
    return capsules, shapes.notes


def area_m2(capsule: Capsule) -> float:
    length = float(np.linalg.norm(np.subtract(capsule.end, capsule.start)))
    return 2 * np.pi * capsule.radius_m * (length + 2 * capsule.radius_m)
