"""What a stage depends on, by names that a person knows: contents of files, settings, and tasks before it."""

from __future__ import annotations

from collections.abc import Iterator

from tauext.data.dataset import ROBOT_FILES, load_dataset
from tauext.data.description_file import load_arm
from tauext.data.split import SETS
from tauext.files.named_files import SHAPES_FILE, named_files
from tauext.files.place import Place
from tauext.fleet.contents import Contents
from tauext.fleet.fleet_file import Arm
from tauext.fleet.places import below, files_in


def files_of(arm: Arm) -> Iterator[Place]:
    """All files that anything of this arm depends on."""
    yield from source_files(arm).values()
    for name in ("dataset", "calibration"):
        folder = getattr(arm, name)
        yield from dataset_files(folder, name).values() if folder else ()
    yield from robot_files(arm.robot).values()
    yield from like_files(arm).values()


def source_files(arm: Arm) -> dict[str, Place]:
    """What an import reads: sources, description, and the robot file that this names."""
    if arm.description is None:
        return {}
    found = {"arm.toml": arm.description} | robot_files(load_arm(arm.description).model)
    for source in arm.sources:
        for file in files_in(source):
            name = source.name if file == source else f"{source.name}/{below(file, source)}"
            found[f"source {name}" if f"source {name}" not in found else f"source {file}"] = file
    return found


def dataset_files(folder: Place, what: str) -> dict[str, Place]:
    """Split, robot file and recordings of a dataset, each once."""
    dataset = load_dataset(folder)
    there = [folder / name for name in ("split.json", *ROBOT_FILES, SHAPES_FILE) if (folder / name).is_file()]
    recordings = [file for set_name in SETS for file in dataset.files(set_name)]
    return {f"{what} {file.name}": file for file in [*there, *recordings]}


def like_files(arm: Arm) -> dict[str, Place]:
    """The fleet prior that its training begins with."""
    return {} if arm.like is None else {"train.like": arm.like}


def robot_files(robot: Place | None) -> dict[str, Place]:
    """A robot file, and meshes and includes that it names and that are there; MuJoCo reads masses off them."""
    found: dict[str, Place] = {}
    for file in () if robot is None else named_files(robot):
        found[f"robot file {file.name}" if f"robot file {file.name}" not in found else f"robot file {file}"] = file
    return found


def digests(files: dict[str, Place], contents: Contents) -> dict[str, str]:
    """The same names with the files' contents."""
    return {name: contents.digest(path) for name, path in files.items()}
