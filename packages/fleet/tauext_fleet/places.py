"""Where something named in FLEET.toml lies: every path of the file is resolved here."""

from __future__ import annotations

import glob
from collections.abc import Sequence
from fnmatch import fnmatchcase
from itertools import islice
from pathlib import Path, PurePosixPath

from tauext.errors import ConfigError
from tauext.files.places import Place, StoredPlace
from tauext.files.places import place_of as any_place

WILD = "*?["
MOST_FOUND = 100_000
"""Files and folders that one pattern may fit: more is likely a mistake such as `/**`, which takes hours to list."""


def place_of(text: str, base: Place) -> Place:
    """The absolute place; a relative one counts from the folder of FLEET.toml."""
    return any_place(text, base).absolute()


def places_of(pattern: str, base: Place) -> list[Place]:
    """All places that a pattern with *, ? or ** fits, by name; without these it is one place, there or not.

    In a URL ? begins its query, and fits nothing.

    Raises:
        ConfigError: more than MOST_FOUND fit.
    """
    if not any(sign in (pattern.partition("?")[0] if "://" in pattern else pattern) for sign in WILD):
        return [place_of(pattern, base)]
    place = place_of(pattern, base)
    if isinstance(place, StoredPlace):
        return stored_places(place)
    assert isinstance(base, Path)
    found = list(islice(glob.iglob(pattern, root_dir=base, recursive=True), MOST_FOUND + 1))
    if len(found) > MOST_FOUND:
        raise ConfigError(f"'{pattern}' fits more than {MOST_FOUND:,} files and folders; name a folder below")
    return [place_of(one, base) for one in sorted(found)]


def stored_places(pattern: StoredPlace) -> list[Place]:
    """Files of a store, and folders with files in them, that a pattern fits."""
    parts = PurePosixPath(pattern.key).parts
    plain = next(k for k, part in enumerate(parts) if any(sign in part for sign in WILD))
    folder = StoredPlace(pattern.server, "/".join(parts[:plain]))
    there: dict[StoredPlace, None] = {}
    for file in folder.rglob("*"):
        there[file] = None
        above = file.parent
        while above.key and above != folder and above not in there:
            there[above], above = None, above.parent
    return sorted(place for place in there if fits(place.relative_to(folder).parts, parts[plain:]))


def fits(parts: Sequence[str], patterns: Sequence[str]) -> bool:
    """Whether names of folders and a file fit patterns, where ** is any number of folders."""
    if not patterns:
        return not parts
    first, *rest = patterns
    if first == "**":
        return any(fits(parts[k:], rest) for k in range(len(parts) + 1)) if rest else bool(parts)
    return bool(parts) and fnmatchcase(parts[0], first) and fits(parts[1:], rest)


def files_in(place: Place) -> list[Place]:
    """A file itself; of a folder, which may be a ROS 2 bag, all files in it, by name."""
    if not place.is_dir():
        return [place]
    return sorted(path for path in place.rglob("*") if path.is_file())


def below(file: Place, folder: Place) -> str:
    """Its name from the folder on."""
    if isinstance(file, StoredPlace) and isinstance(folder, StoredPlace):
        return file.relative_to(folder).as_posix()
    assert isinstance(file, Path) and isinstance(folder, Path)
    return file.relative_to(folder).as_posix()


def text_of_place(place: Place | None) -> str:
    """For another process."""
    return place.url if isinstance(place, StoredPlace) else str(place)
