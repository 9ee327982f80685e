"""Find the mesh files that a URDF names: in given folders, near the robot file, in installed robot descriptions."""

from __future__ import annotations

import importlib.util
import os
import posixpath
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from tauext.errors import ConfigError
from tauext.robot.xml_file import read_xml

READ_FORMATS = (".stl", ".obj", ".dae", ".msh")
"""Formats that mesh_triangles reads."""

# --- Folders that the user gives.


@dataclass(frozen=True)
class MeshFolders:
    """Folders given with --meshes: a package, its meshes, or what holds packages."""

    named: tuple[tuple[str, Path], ...] = ()
    """Package and folder; "": of any package."""

    def __bool__(self) -> bool:
        return bool(self.named)

    def __str__(self) -> str:
        return " ".join(f"{package}={folder}" if package else str(folder) for package, folder in self.named)

    def of(self, package: str) -> list[Path]:
        """The folders to search for files of this package; those of its name first."""
        return [folder for name in dict.fromkeys((package, "")) for other, folder in self.named if other == name]


def mesh_folders(words: Sequence[str]) -> MeshFolders:
    """Parse FOLDER and PACKAGE=FOLDER.

    Raises:
        ConfigError: there is no such folder.
    """
    named = []
    for word in words:
        package, equals, folder = word.partition("=")
        if not equals or Path(word).is_dir():
            package, folder = "", word
        if not folder or not Path(folder).expanduser().is_dir():
            raise ConfigError(f"--meshes {word}: there is no folder {folder!r}; give FOLDER or PACKAGE=FOLDER")
        named.append((package, Path(folder).expanduser().resolve()))
    return MeshFolders(tuple(sorted(named, key=lambda one: one[0])))


def expect_meshes(robot: Path, given: MeshFolders) -> None:
    """Refuse given folders that hold none of the meshes of a robot file, unless all of them are found without.

    Raises:
        ConfigError: names the folders, one of the meshes, and where it was searched for.
    """
    if not given:
        return
    root = read_xml(robot).root
    if root.tag != "robot":
        raise ConfigError(
            f"--meshes: {robot} is an MJCF, which names the folder of its meshes itself (meshdir); put them there"
        )
    shapes = [shape for link in root.findall("link") for shape in link.findall("collision") or link.findall("visual")]
    names = list(dict.fromkeys(mesh.get("filename", "") for shape in shapes for mesh in shape.iter("mesh")))
    if not names:
        raise ConfigError(f"--meshes: {robot} names no mesh; leave --meshes out")
    finder, missing = MeshFinder(robot, given), ""
    for name in names:
        try:
            finder.find(name)
        except (OSError, ValueError):
            missing = missing or name
        if finder.uses_given:
            return
    if missing:
        package, inside = _split(missing)
        tried = [str(path) for path in finder.in_given(package, _readable(inside)[0])]
        for folder in given.of(package):
            tried = [path.removeprefix(f"{folder}/") for path in tried]
        raise ConfigError(
            f"--meshes {given}: none of the {len(names)} meshes of {robot.name} is there; {missing} "
            + (f"was searched for as {', '.join(dict.fromkeys(tried))}" if tried else f"is of package {package}")
            + (f"; give the folder of package {package}, or one that holds it" if package else "; give its folder")
        )


# --- The search.


class MissingMeshError(ValueError):
    """A mesh file that is not found."""

    def __init__(self, text: str, package: str) -> None:
        super().__init__(text)
        self.package = package


class MeshFinder:
    """Finds the meshes of one robot file: in given folders, then near the robot file, then in installed descriptions.

    Args:
        most_packages, most_missing: further packages, and files after so many missing ones, are not searched for, which
            bounds the time for an absurd file.
    """

    def __init__(
        self, robot: Path, given: MeshFolders = MeshFolders(), most_packages: int = 20, most_missing: int = 500
    ) -> None:
        own = robot.parent.resolve()
        self._near = list(dict.fromkeys((robot.parent, own, *own.parents)))
        self._given, self._most, self._left = given, most_packages, most_missing
        self._packages: dict[str, tuple[list[Path], list[Path], list[Path]]] = {}
        self.uses_given = False
        """Whether a mesh was found in a given folder."""
        self.elsewhere: dict[str, Path] = {}
        """Packages that were found in installed descriptions, and their folders."""

    def find(self, name: str) -> Path:
        """Find a mesh file. For a format that cannot be read, a readable file of the same stem beside it or in
        ../collision is returned.

        Args:
            name: as the URDF names it.

        Raises:
            MissingMeshError: there is no such file.
            ValueError: there is one, of a format that cannot be read.
        """
        package, inside = _split(name)
        if self._left > 0 and inside:
            for readable in _readable(inside):
                if found := self._found(package, readable):
                    return found
            if Path(inside).suffix.lower() not in READ_FORMATS and self._found(package, inside):
                stem = Path(inside).stem
                raise ValueError(
                    f"{name}: meshes are read from {', '.join(READ_FORMATS)}; put {stem}.stl or {stem}.obj beside it "
                    "or in ../collision"
                )
        self._left -= 1
        raise MissingMeshError(f"there is no mesh file {name}", package)

    def _found(self, package: str, inside: str) -> Path | None:
        for file in self.in_given(package, inside):
            if file.is_file():
                self.uses_given = True
                return file
        _, near, installed = self._folders_of(package)
        for folder in (*near, *self._near) if package else self._near[:1]:
            if (file := folder / inside).is_file():
                return file
        for folder in installed:
            if (file := folder / inside).is_file():
                self.elsewhere[package] = folder
                return file
        return None

    def in_given(self, package: str, inside: str) -> Iterator[Path]:
        """Paths in the given folders at which a file may be: in the package, or by the end of its path."""
        parts = [part for part in Path(inside).parts if part not in ("..", os.sep)]
        for folder in self._given.of(package):
            if package:
                yield folder / package / inside
            yield from (folder.joinpath(*parts[k:]) for k in range(len(parts)))
        yield from (folder / inside for folder in self._folders_of(package)[0])

    def _folders_of(self, package: str) -> tuple[list[Path], list[Path], list[Path]]:
        """Folders of a package in given folders, near the robot file, and of installed descriptions."""
        if package not in self._packages and package and len(self._packages) < self._most:
            given = [one for folder in self._given.of(package) for one in packages_below(folder, package)]
            near = [one for folder in self._near for one in near_packages(folder, package)]
            self._packages[package] = given, near, list(dict.fromkeys(installed_packages(package)))
        return self._packages.get(package, ([], [], []))


def _split(name: str) -> tuple[str, str]:
    """Package of a mesh's name, and its path in the package; without a package, the path. A path out of the package
    becomes empty."""
    if not name.startswith("package://"):
        return "", name.removeprefix("file://")
    package, _, inside = name.removeprefix("package://").lstrip("/").partition("/")
    inside = posixpath.normpath(inside)
    if package in ("", ".", "..") or inside.startswith((".", "/")):
        return package, ""
    return package, inside


def _readable(inside: str) -> list[str]:
    """Paths that can be read in the place of this one."""
    path = Path(inside)
    own = [inside] if path.suffix.lower() in READ_FORMATS else []
    if own and path.suffix.lower() != ".dae":
        return own
    folders = dict.fromkeys((path.parent, path.parent.parent / "collision"))
    ends = [end for suffix in READ_FORMATS for end in (suffix, suffix.upper())]
    return own + [str(folder / f"{path.stem}{end}") for folder in folders for end in ends]


# --- Where packages lie.


def near_packages(folder: Path, package: str) -> Iterator[Path]:
    """Folders of this package in a folder or in its `src`, as ROS workspaces have them."""
    yield from _folders(folder / package)
    yield from packages_below(folder / "src", package, depth=2)


def installed_packages(package: str) -> Iterator[Path]:
    """Folders of this package where ROS, example_robot_data and robot_descriptions keep theirs."""
    for folder in _listed("ROS_PACKAGE_PATH"):
        if folder.name == package:
            yield from _folders(folder)
        yield from packages_below(folder, package)
    for folder in _listed("AMENT_PREFIX_PATH"):
        yield from _folders(folder / "share" / package)
    for folder in example_robot_data():
        yield from _folders(folder if package.replace("_", "-") == folder.name else folder / "robots" / package)
    cache = os.environ.get("ROBOT_DESCRIPTIONS_CACHE") or "~/.cache/robot_descriptions"
    yield from packages_below(Path(cache).expanduser(), package)


def _listed(variable: str) -> list[Path]:
    return [Path(one) for one in os.environ.get(variable, "").split(os.pathsep) if one]


def example_robot_data() -> Iterator[Path]:
    """Folders share/example-robot-data of the packages of that name; nothing is imported."""
    try:
        spec = importlib.util.find_spec("example_robot_data")
    except (ImportError, ValueError):
        spec = None
    prefixes = list(Path(spec.origin).resolve().parents)[:6] if spec is not None and spec.origin else []
    prefixes += [Path(folder) / "cmeel.prefix" for folder in sys.path if folder]  # where wheels of C++ projects lie
    for prefix in (*prefixes, Path(sys.prefix)):
        yield from _folders(prefix / "share" / "example-robot-data")


def packages_below(folder: Path, package: str, depth: int = 3, most_listed: int = 2000) -> Iterator[Path]:
    """Folders of this name, not in hidden folders.

    Args:
        depth: levels that are searched; ROS workspaces have packages in two.
        most_listed: folders after which the search ends.
    """
    waiting, listed = [folder], 0
    for level in range(depth):
        here, waiting = waiting, []
        for one in here:
            if listed >= most_listed:
                return
            listed += 1
            yield from _folders(one / package)
            if level == depth - 1:
                continue
            try:
                with os.scandir(one) as entries:
                    names = sorted(e.name for e in entries if e.is_dir() and e.name[0] != "." and e.name != package)
            except OSError:
                continue
            waiting += [one / name for name in names]


def _folders(folder: Path) -> Iterator[Path]:
    try:
        if folder.is_dir():
            yield folder
    except OSError:  # a name too long, or a folder that may not be read
        return
