"""Where something of a fleet lies: a path, or a URL of an object store; what lies in a store is copied for its use."""

from __future__ import annotations

import glob
import hashlib
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from fnmatch import fnmatchcase
from itertools import islice
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Any

from tauext.data.description import load_arm
from tauext.errors import ConfigError, TauextError
from tauext.files import plain_file
from tauext.files.atomic_write import atomic_write
from tauext.files.checkpoint import cache_folder
from tauext.robot.capsules import SHAPES_FILE
from tauext_fleet.store import Stored

Location = Path | Stored


def located(text: str, base: Path = Path()) -> Location:
    """The absolute path, or the URL.

    Args:
        base: what a relative path counts from.
    """
    return Stored.of_url(text) if "://" in text else (base / text).absolute()


def text_of(location: Location | None) -> str:
    """For another process; located() reads it. An arm's dataset and bundle are there where this is called."""
    assert location is not None
    return location.url if isinstance(location, Stored) else str(location.absolute())


def read_text(location: Location) -> str:
    """The text of a file; OSError where there is none, ValueError where it is no UTF-8."""
    return location.read_bytes().decode() if isinstance(location, Stored) else plain_file.read_text(location)


def write_text(location: Location, text: str) -> None:
    """A file that appears whole or not at all, with its folder."""
    if isinstance(location, Stored):
        location.write_bytes(text.encode())
        return
    location.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(location) as part:
        part.write_text(text)


# --- Patterns.


WILD = "*?["
MOST_FOUND = 100_000
"""Files and folders that one pattern may fit: more is likely a mistake such as `/**`, which takes hours to list."""


def locations_of(pattern: str, base: Path) -> list[Location]:
    """All that a pattern with *, ? or ** fits, by name; without these it is one location, there or not.

    In a URL ? begins its query, and fits nothing.

    Raises:
        ConfigError: more than MOST_FOUND fit.
    """
    if not any(sign in (pattern.partition("?")[0] if "://" in pattern else pattern) for sign in WILD):
        return [located(pattern, base)]
    if "://" in pattern:
        return list(stored_like(Stored.of_url(pattern)))
    found = list(islice(glob.iglob(pattern, root_dir=base, recursive=True), MOST_FOUND + 1))
    if len(found) > MOST_FOUND:
        raise ConfigError(f"'{pattern}' fits more than {MOST_FOUND:,} files and folders; name a folder below")
    return [located(one, base) for one in sorted(found)]


def stored_like(pattern: Stored) -> list[Stored]:
    """Files of a store, and folders with files in them, that a pattern fits."""
    parts = PurePosixPath(pattern.key).parts
    plain = next(k for k, part in enumerate(parts) if any(sign in part for sign in WILD))
    folder = Stored(pattern.bucket, "/".join(parts[:plain]), pattern.query)
    files = map(PurePosixPath, folder.files())
    there = {name for file in files for name in (file, *file.parents)}
    return sorted(folder / str(name) for name in there if fits(name.parts, parts[plain:]))


def fits(parts: Sequence[str], patterns: Sequence[str]) -> bool:
    """Whether names of folders and a file fit patterns, where ** is any number of folders."""
    if not patterns:
        return not parts
    first, *rest = patterns
    if first == "**":
        return any(fits(parts[k:], rest) for k in range(len(parts) + 1)) if rest else bool(parts)
    return bool(parts) and fnmatchcase(parts[0], first) and fits(parts[1:], rest)


# --- Files that belong together.


NAMED_FILE = re.compile(r"""\b(?:file|filename)\s*=\s*["']([^"']+)["']""")
NAMED_FOLDER = re.compile(r"""\b(?:meshdir|assetdir)\s*=\s*["']([^"']+)["']""")
ROBOT_SUFFIXES = (".xml", ".urdf", ".mjcf")


def files_in(location: Location) -> dict[str, Location]:
    """All files of a folder, which may be a ROS 2 bag, by their paths from there; of a file, itself under ""."""
    if isinstance(location, Stored):
        return {name: location / name for name in sorted(location.files())}
    if not location.is_dir():
        return {"": location}
    return {path.relative_to(location).as_posix(): path for path in sorted(location.rglob("*")) if path.is_file()}


def named_files(robot: Location) -> Iterator[Location]:
    """The robot file itself, its shapes, and what it names and is there, and what that names, each once."""
    shapes = robot.with_name(SHAPES_FILE)
    waiting: list[Location] = [robot, *([shapes] if shapes.is_file() else [])]
    seen: set[Location] = set(waiting)
    while waiting:
        file: Location = waiting.pop()
        yield file
        text: str = file.read_bytes().decode("utf-8", "replace") if file.suffix.lower() in ROBOT_SUFFIXES else ""
        folders = [file.parent, *(file.parent / name for name in NAMED_FOLDER.findall(text))]
        named = [folder / name for name in NAMED_FILE.findall(text) for folder in folders]
        found = [one for one in dict.fromkeys(named) if one not in seen and one.is_file()]
        seen.update(found)
        waiting += reversed(found)


def model_of(description: Location) -> Location | None:
    """The robot file that an arm.toml names; None: it names none."""
    with local_copy(description) as path:
        model = load_arm(path).robot.model
    return description.parent / model if model else None


# --- Copies of what lies in a store.


def scratch(location: Location) -> Path:
    """Folder on this machine for the work on an output: downloads, and what is not uploaded yet. It may not exist."""
    where = f"{text_of(location)} {location.endpoint if isinstance(location, Stored) else ''}"
    return cache_folder() / "fleets" / hashlib.sha256(where.encode()).hexdigest()[:16]


@contextmanager
def local_copy(file: Location) -> Iterator[Path]:
    """The path of a file, or of a copy of a stored one, which goes at the end; errors name the URL."""
    if isinstance(file, Path):
        yield file
        return
    with TemporaryDirectory(prefix="tauext-") as folder:
        path = mirrored(file, Path(folder))
        file.download(path)
        try:
            yield path
        except TauextError as error:
            error.args = tuple(with_urls(str(one), Path(folder)) for one in error.args)
            raise


def mirrored(location: Stored, folder: Path) -> Path:
    """Its copy in a folder, where files of a bucket lie to one another as they do there."""
    return folder / location.bucket.replace("://", "/") / location.key


def with_urls(text: str, folder: Path) -> str:
    """The text with URLs instead of their copies in the folder."""
    return re.sub(rf"{re.escape(str(folder))}/(\w+)/", r"\1://", text)


INPUTS = ("description", "dataset", "bundle", "robot", "like")
"""Keys of a task's work that are locations, beside the list `sources`."""


def local_work(work: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """The work of a task with paths; what lies in a store is copied into the folder."""
    local: dict[str, Any] = {key: local_input(key, work[key], folder) for key in INPUTS if work.get(key)}
    if "sources" in work:
        local["sources"] = [local_input("sources", one, folder) for one in work["sources"]]
    return {**work, **local}


def local_input(key: str, text: str, folder: Path) -> str:
    """The path of one input; a bundle is copied with its folder, a description with the files that it names."""
    location = located(text)
    if isinstance(location, Path):
        return text
    path = mirrored(location, folder)
    for one in named_files(location) if key == "robot" else [location.parent if key == "bundle" else location]:
        download(one, folder)
    if key == "description":
        robot = load_arm(path).robot
        for name in filter(None, (robot.model, robot.calibration)):
            for one in named_files(location.parent / name):
                download(one, folder)
    return str(path)


def download(location: Location, folder: Path) -> None:
    assert isinstance(location, Stored)  # what a stored file names is stored
    location.download(mirrored(location, folder))
