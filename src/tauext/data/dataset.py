"""A dataset folder: robot file, split, recordings loaded when asked for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from tauext.data.recording import Recording
from tauext.data.recording_file import load_recording
from tauext.data.split import Split, load_split
from tauext.data.stretches import ahead, stretches
from tauext.errors import ConfigError
from tauext.files.fetching import local_robot
from tauext.files.place import Place, place_of

ROBOT_FILES = ("robot.xml", "robot.urdf")


@dataclass(frozen=True)
class Dataset:
    """A folder of recordings, and which of them serves for what."""

    folder: Place
    """Where the recordings and the robot file lie."""
    split: Split
    """Names of the recordings' files, by the set that they belong to."""

    def recordings(self, set_name: str) -> list[Recording]:
        """All recordings of `train`, `validation`, `test`, `collisions` or `calibration`, in order."""
        return list(ahead(self.loaders(set_name)))

    def training(self) -> list[Recording]:
        """The training recordings; raise ConfigError where there are none."""
        if not self.split.train:
            raise ConfigError(f"{self.folder}: split.json lists no training recording; one is enough")
        return self.recordings("train")

    def files(self, set_name: str) -> list[Place]:
        """Their files."""
        return [self.folder / name for name in getattr(self.split, set_name)]

    def loaders(self, set_name: str) -> list[Callable[[], Recording]]:
        """The same, each loaded when called."""
        return [partial(load_recording, file) for file in self.files(set_name)]

    def stretches(self, set_name: str) -> list[Callable[[], Recording]]:
        """The same for limits: in stretches where a recording is long, without signals that limits do not need."""
        return stretches(self.files(set_name))

    def robot_file(self, given: Place | None) -> Path:
        """The robot file given, or the one in the folder; of a store, a copy of it and of what it names."""
        if given is not None:
            if not given.is_file():
                raise ConfigError(f"{given}: there is no such robot file; give a URDF or MJCF")
            return local_robot(given)
        for name in ROBOT_FILES:
            if (self.folder / name).is_file():
                return local_robot(self.folder / name)
        raise ConfigError(f"{self.folder}: it holds no {' or '.join(ROBOT_FILES)}; give one with --robot")


def load_dataset(folder: Place | str) -> Dataset:
    """The dataset in a folder that `tauext simulate` or `tauext import` made; no recording is read yet.

    Raises:
        ConfigError: there is no such folder, or its split.json cannot be used.
    """
    folder = place_of(folder)
    if not folder.is_dir():
        raise ConfigError(f"{folder}: there is no such dataset folder; `tauext simulate --out {folder}` makes one")
    return Dataset(folder, load_split(folder))
