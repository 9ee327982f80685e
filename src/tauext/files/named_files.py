"""Files that a robot file names: meshes and includes, which MuJoCo reads masses off."""

from __future__ import annotations

import re
from collections.abc import Iterator

from tauext.files.place import Place

NAMED_FILE = re.compile(r"""\b(?:file|filename)\s*=\s*["']([^"']+)["']""")
NAMED_FOLDER = re.compile(r"""\b(?:meshdir|assetdir)\s*=\s*["']([^"']+)["']""")
SHAPES_FILE = "robot.shapes.json"
"""Beside the robot file of a dataset: what its links look like."""
ROBOT_SUFFIXES = (".xml", ".urdf", ".mjcf")


def named_files(robot: Place) -> Iterator[Place]:
    """The robot file itself, its shapes, and what it names and is there, and what that names, each once."""
    shapes = robot.with_name(SHAPES_FILE)
    waiting: list[Place] = [robot, *([shapes] if shapes.is_file() else [])]
    seen: set[Place] = set(waiting)
    while waiting:
        file: Place = waiting.pop()
        yield file
        text: str = file.read_bytes().decode("utf-8", "replace") if file.suffix.lower() in ROBOT_SUFFIXES else ""
        folders = [file.parent, *(file.parent / name for name in NAMED_FOLDER.findall(text))]
        named = [folder / name for name in NAMED_FILE.findall(text) for folder in folders]
        found = [place for place in dict.fromkeys(named) if place not in seen and place.is_file()]
        seen.update(found)
        waiting += reversed(found)
