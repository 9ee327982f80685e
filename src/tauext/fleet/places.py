"""Where something named in FLEET.toml lies: every path of the file passes here, and nothing else opens one."""

from __future__ import annotations

import glob
from pathlib import Path

WILD = "*?["


def place_of(text: str, base: Path) -> Path:
    """The absolute place; a relative one counts from the folder of FLEET.toml."""
    return (base / text).absolute()


def places_of(pattern: str, base: Path) -> list[Path]:
    """All places that a pattern with *, ? or ** fits, by name; without these it is one place, there or not."""
    if not any(sign in pattern for sign in WILD):
        return [place_of(pattern, base)]
    return [place_of(found, base) for found in sorted(glob.glob(pattern, root_dir=base, recursive=True))]


def files_in(place: Path) -> list[Path]:
    """A file itself; of a folder, which may be a ROS 2 bag, all files in it, by name."""
    if not place.is_dir():
        return [place]
    return sorted(path for path in place.rglob("*") if path.is_file())
