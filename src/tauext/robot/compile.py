"""Compile with MuJoCo what its checks would refuse or change, and report what it refuses in our words."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np

from tauext.errors import RobotError
from tauext.robot.xml_file import XmlFile

LEAST = 2e-15
"""Mass [kg] and inertia [kg m^2] up to this count as zero; MuJoCo's least mass of a moving body is 1e-15."""


@contextmanager
def no_mujoco_warnings() -> Iterator[None]:
    """Suppress MuJoCo's warnings, which are printed and written to a file; relevant problems are checked separately."""
    mujoco.set_mju_user_warning(lambda text: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(None)


@contextmanager
def possible_inertias(spec: mujoco.MjSpec) -> Iterator[list[tuple[mujoco.MjsBody, float, np.ndarray]]]:
    """Give bodies whose inertia MuJoCo refuses another one meanwhile; yields these bodies, their mass and inertia.

    MuJoCo refuses impossible inertias, also where no joint in use moves them. Bodies without mass are allowed to stay.
    """
    spec.compiler.fusestatic = False
    spec.compiler.boundmass = max(spec.compiler.boundmass, LEAST)
    spec.compiler.boundinertia = max(spec.compiler.boundinertia, LEAST)
    given = []
    for body in spec.bodies[1:]:
        if not has_inertial(spec, body):
            continue
        full = np.isfinite(body.fullinertia[0])
        inertia, axes = principal_axes(body.fullinertia) if full else (np.array(body.inertia), None)
        low, middle, high = np.sort(inertia)
        possible = low + middle >= high or (spec.compiler.balanceinertia and low >= 0)
        if body.mass >= 0 and low >= (1e-12 if full else 0) and possible:  # MuJoCo reads six values from there on
            continue
        if axes is not None:
            turned = np.empty(4)
            mujoco.mju_mulQuat(turned, body.iquat, axes)
            body.iquat, body.fullinertia = turned, [np.nan, 0, 0, 0, 0, 0]
        given.append((body, body.mass, inertia))
        body.mass, body.inertia = 1.0, [1.0, 1.0, 1.0]
    try:
        yield given
    finally:
        for body, mass, inertia in given:
            body.mass, body.inertia = mass, inertia


def compiled_as_given(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compile with the masses and inertias that the file gives, also those that no body can have."""
    with possible_inertias(spec) as given, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = spec.compile()
    for body, mass, inertia in given:
        model.body_mass[body.id], model.body_inertia[body.id] = mass, inertia
    return model


def xml_as_given(spec: mujoco.MjSpec) -> str:
    """MJCF with the masses and inertias that the bodies have, also those that no body can have."""
    with possible_inertias(spec) as given:
        spec.compile()
        text = spec.to_xml()
    if given:
        root = ElementTree.fromstring(text)
        bodies = list(root.iter("body"))  # as MuJoCo numbers them
        for body, mass, inertia in given:
            element = bodies[body.id - 1].find("inertial")
            assert element is not None
            element.set("mass", repr(mass))
            element.set("diaginertia", " ".join(map(repr, inertia.tolist())))
        text = ElementTree.tostring(root, encoding="unicode")
    return text


def principal_axes(six: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """Principal inertias and the quaternion of their axes, of xx, yy, zz, xy, xz, yz."""
    xx, yy, zz, xy, xz, yz = six
    values, vectors, turn = np.empty(3), np.empty(9), np.empty(4)
    mujoco.mju_eig3(values, vectors, turn, np.array([xx, xy, xz, xy, yy, yz, xz, yz, zz]))
    return values, turn


def has_inertial(spec: mujoco.MjSpec, body: mujoco.MjsBody) -> bool:
    """Whether the body's inertia is given, and not computed from its shapes."""
    by_shapes = spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    return bool(body.explicitinertial) and not by_shapes


# --- MJCF, which MuJoCo reads itself.


def read_mjcf(file: XmlFile) -> tuple[mujoco.MjSpec, mujoco.MjModel]:
    """Read an MJCF. If its shapes or looks cannot be read, those that no inertia depends on are left out."""
    for element in file.root:
        if element.tag in ("body", "frame", "replicate"):  # MuJoCo reads none there, and reports nothing
            of = f" '{element.get('name')}'" if element.get("name") else ""
            raise file.error(element, f"<{element.tag}>{of} lies outside of <worldbody>; move it into <worldbody>")
    for element in file.root.iter():
        named = element.get("file")
        if named and (beside := file.path.parent / named).exists() and not beside.is_file():
            raise file.error(element, f"<{element.tag} file={named!r}> names no file but a folder, pipe or device")
    _expect_sizes(file)
    try:
        spec = _mjcf_spec(file)
        return spec, compiled_as_given(spec)
    except (ValueError, mujoco.FatalError) as error:
        if str(error).startswith("XML"):
            raise
        spec = _mjcf_spec(file)
        strip(spec)
        _expect_meshes(file, spec)
        return spec, compiled_as_given(spec)


MOST_COPIES, MOST_CELLS = 10_000, 1 << 26
"""Copies of a part, and cells of a picture or a height field: a thousandth is usual, and MuJoCo makes any number."""


def _expect_sizes(file: XmlFile) -> None:
    """Raise RobotError where an element makes far more than any robot has."""
    waiting = [(file.root, 1.0)]
    while waiting:
        element, copies = waiting.pop()
        copies *= math.prod(_numbers(element.get("count")))
        cells = math.prod(n for name in ("nrow", "ncol", "width", "height") for n in _numbers(element.get(name)))
        if copies > MOST_COPIES or cells > MOST_CELLS:
            what, most = (
                (f"{copies:.3g} copies", MOST_COPIES) if copies > MOST_COPIES else (f"{cells:.3g} cells", MOST_CELLS)
            )
            raise file.error(element, f"<{element.tag}> makes {what}; at most {most:,} are read")
        waiting += [(one, copies) for one in element]


def _numbers(text: str | None) -> list[float]:
    """Numbers above 1 in a text."""
    try:
        return [number for one in (text or "").split() if (number := float(one)) > 1]
    except ValueError:  # MuJoCo names it
        return []


def _mjcf_spec(file: XmlFile) -> mujoco.MjSpec:
    if file.path.suffix == ".xml":
        return mujoco.MjSpec.from_file(str(file.path))
    beside = {name: file.path.parent / name for one in file.root.iter("include") if (name := one.get("file"))}
    included = {name: path.read_bytes() for name, path in beside.items() if path.is_file()}
    spec = mujoco.MjSpec.from_string(file.path.read_text(encoding="utf-8-sig"), include=included)  # by any other name
    spec.modelfiledir = str(file.path.parent)
    return spec


def strip(spec: mujoco.MjSpec) -> None:
    """Remove sensors, key frames, limits, looks and the shapes on which no inertia depends."""
    for body in spec.bodies:
        still = not any(one.joints for one in _with_parents(body))
        for shape in list(body.geoms):
            if still or has_inertial(spec, body) or shape.mass == 0 or shape.density == 0:
                spec.delete(shape)
            else:
                shape.material = ""
    for joint in spec.joints:
        joint.limited = mujoco.mjtLimited.mjLIMITED_FALSE
    for one in (*spec.sites, *spec.tendons):
        one.material = ""
    for part in (spec.keys, spec.sensors, spec.pairs, spec.excludes, spec.skins, spec.materials, spec.textures):
        for one in list(part):
            spec.delete(one)
    used = {shape.meshname for shape in spec.geoms} | {shape.hfieldname for shape in spec.geoms}
    for asset in [*spec.meshes, *spec.hfields]:
        if _asset_name(asset) not in used:
            spec.delete(asset)


def _asset_name(asset: mujoco.MjsMesh | mujoco.MjsHField) -> str:
    return asset.name or Path(asset.file).stem


def _expect_meshes(file: XmlFile, spec: mujoco.MjSpec) -> None:
    """Refuse a missing mesh from which an inertia would follow."""
    folder = file.path.parent / spec.compiler.meshdir
    files = {_asset_name(mesh): Path(mesh.file) for mesh in spec.meshes if mesh.file}
    for body in spec.bodies:
        for shape in body.geoms:
            mesh = files.get(shape.meshname)
            if mesh is not None and not (folder / mesh).exists():
                raise RobotError(
                    f"{file.path}: body {body.name!r} has no <inertial>, and the mesh {str(mesh)!r} from which its "
                    "inertia would follow is missing: put the file there, or give the body an <inertial>"
                )


def _with_parents(body: mujoco.MjsBody) -> Iterator[mujoco.MjsBody]:
    while body is not None and body.name != "world":
        yield body
        body = body.parent


# --- What MuJoCo refuses, in our words.


@contextmanager
def our_words(file: XmlFile) -> Iterator[None]:
    """Convert MuJoCo's errors to a RobotError that names the file, the line and the rule."""
    try:
        yield
    except (ValueError, OSError, RuntimeError, mujoco.FatalError) as error:
        raise RobotError(in_our_words(file, str(error))) from error


OUR_WORDS = (
    (r"unrecognized attribute: '(.*?)'", "{element} has no attribute {0!r}"),
    (r"unrecognized element", "{element} is not allowed there"),
    (r"unique element '(.*?)' found", "<{0}> may stand there only once"),
    (r"required attribute missing: '(.*?)'", "{element} needs the attribute {0!r}"),
    (r"attribute '(.*?)' does not have enough data", "{element}: {0} has too few numbers"),
    (r"attribute '(.*?)' has too much data", "{element}: {0} has too many numbers"),
    (r"(?:bad format|problem reading|invalid number|number is too large).* attribute '(.*?)'",
     "{element}: {0} must be numbers"),
    (r"invalid keyword: '(.*?)'", "{element}: {0!r} is none of the words that MJCF defines there"),
    (r"repeated name '(.*?)' in (\w+)", "two elements <{1}> are named {0!r}; every one needs a name of its own"),
    (r"unknown default class name '(.*?)'", "{element} has the class {0!r}, which no <default> defines"),
    (r"opening file '(.*?)'", "the file {0!r} that it names cannot be opened; put it there"),
    (r"(\w+) '(.*?)' not found in (\w+)", "a {2} names the {0} {1!r}, which is not in the file"),
    (r"unknown (?:transmission target|element) '(.*?)'", "{element} names {0!r}, which is not in the file"),
    (r"axis too small in joint", "{element}: its axis has no direction; give a unit vector"),
    (r"mass and inertia of moving bodies", "{element} moves and has no mass"),
    (r"codec can't decode|ErrorID=15", "it must be UTF-8; save it in that encoding"),
    (r"ELEMENT_DEPTH", "its elements are nested too deeply"),
    (r"must be positive in (\w+)", "{element}: the size of a {0} must be > 0"),
)  # fmt: skip
"""Patterns of MuJoCo's messages, and the rule behind each."""


def in_our_words(file: XmlFile, message: str) -> str:
    """One line on what MuJoCo refuses: file, line, element and rule."""
    line = re.search(r"line (\d+)|Line number=(\d+)", message)
    kind, name = re.search(r"Element '(\w+)'", message), re.search(r"Element name '(.+?)'", message)
    element = f"<{kind[1]}>" if kind else repr(name[1]) if name else "the element"
    where = str(file.path)
    if line and next(file.root.iter("include"), None) is not None:
        where += " or a file that it includes"
    where += f", line {line[1] or line[2]}" if line else ""
    for pattern, words in OUR_WORDS:
        if found := re.search(pattern, message):
            return f"{where}: {words.format(*found.groups(), element=element)}"
    reference = "MuJoCo's XML reference" if file.root.tag == "mujoco" else "the URDF specification"
    return f"{where}: {element} is not valid; {reference} lists what is allowed there"
