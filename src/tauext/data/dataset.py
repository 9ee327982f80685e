"""A dataset folder: robot file, split, stretches, recordings loaded on demand."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TypeVar

import numpy as np

from tauext.config import checked
from tauext.data.recording import Recording
from tauext.data.recording_file import ROW_GROUP, describe, load_recording
from tauext.errors import ConfigError
from tauext.files.atomic_write import atomic_write
from tauext.files.kind import why_no_dataset
from tauext.files.plain_file import FORMAT, expect_format, read_json
from tauext.files.typed_table import read_table

# --- Split into sets of whole recordings, so that no window is in two sets.


FILE_NAME = "split.json"
T = TypeVar("T")


@dataclass(frozen=True)
class Split:
    """File names of a dataset's recordings, relative to its folder; each name belongs to one set.

    Each list may have any length; only split_recordings requires twenty recordings.

    Raises:
        ConfigError: a name occurs twice or is no plain file name.
    """

    train: tuple[str, ...]
    validation: tuple[str, ...] = ()
    """Empty: part of the training recordings validates."""
    test: tuple[str, ...] = ()
    collisions: tuple[str, ...] = ()
    calibration: tuple[str, ...] = ()
    """Free motion for limits only; none in datasets of the paper's kind."""

    def __post_init__(self) -> None:
        where: dict[str, str] = {}
        for set_name in SETS:
            names = tuple(getattr(self, set_name))
            object.__setattr__(self, set_name, names)
            for name in names:
                if not isinstance(name, str) or name in ("", "..") or Path(name).name != name:
                    raise ConfigError(f"split: {name!r} in '{set_name}' must be a file name without a folder")
                if name in where:
                    both = f"in '{where[name]}' and in '{set_name}'"
                    sets = f"twice in '{set_name}'" if where[name] == set_name else both
                    raise ConfigError(f"split: '{name}' is {sets}; a recording belongs to one set only")
                where[name] = set_name


SETS = tuple(field.name for field in fields(Split))


def split_recordings(
    names: Iterable[str],
    seed: int,
    fractions: tuple[float, float, float] = (0.7, 0.15, 0.15),
    minimum: int = 20,
    collisions: Iterable[str] = (),
) -> Split:
    """Draw training, validation and test recordings of free motion by seed; no set is empty.

    The result does not depend on the order of `names`; inside a set they are sorted.

    Args:
        names: file names of recordings of free motion.
        fractions: shares of train, validation and test, > 0, summing to 1; counts are rounded.
        minimum: fewer recordings are refused; below 20, one recording is more than a third of a 15 % set and dominates
            it.
        collisions: file names of recordings with contacts, all in that set.

    Raises:
        ConfigError: too few recordings, invalid fractions, or a name occurs twice.
    """
    names = sorted(names)
    if len(fractions) != 3 or min(fractions) <= 0 or abs(sum(fractions) - 1) > 1e-9:
        raise ConfigError(f"fractions = {fractions} must be three numbers > 0 (train, validation, test) that sum to 1")
    needed = max(3, minimum)
    if len(names) < needed:
        raise ConfigError(
            f"{len(names)} recordings of free motion are too few to split: at least {needed} are needed; "
            "record more, shorter ones"
        )
    validation, test = (max(1, round(share * len(names))) for share in fractions[1:])
    if validation + test >= len(names):
        raise ConfigError(f"fractions = {fractions} leave no training recording out of {len(names)}")
    order = np.random.default_rng(seed).permutation(len(names))
    sets = np.split(order, [validation, validation + test])
    drawn = [tuple(names[k] for k in sorted(one)) for one in sets]
    return Split(train=drawn[2], validation=drawn[0], test=drawn[1], collisions=tuple(collisions))


def save_split(split: Split, folder: Path | str) -> None:
    """Write `split.json` into a dataset folder, under a temporary name first."""
    path = Path(folder) / FILE_NAME
    with atomic_write(path) as part:
        part.write_text(json.dumps({"format": FORMAT} | asdict(split), indent=1) + "\n")


def load_split(folder: Path | str) -> Split:
    """Read a dataset folder's `split.json`; every file it lists exists.

    Raises:
        ConfigError: no such file, not JSON, another format, a set is missing or unknown, a name occurs twice, or a
            listed file is missing.
    """
    folder = Path(folder)
    path = folder / FILE_NAME
    content = read_json(path, "there is no such file; a dataset folder holds one beside its recordings")
    expect_format(content, path, "import or simulate the dataset again")
    split = read_table(Split, {key: value for key, value in content.items() if key != "format"}, f"{path}:")
    there = {path.name for path in folder.iterdir() if path.is_file()}
    for set_name in SETS:
        for name in getattr(split, set_name):
            if name not in there:
                raise ConfigError(f"{path}: '{name}' in '{set_name}' does not exist in {folder}")
    return split


# --- Recordings in stretches that fit into memory, with read-ahead.


FOR_LIMITS = ("temperature", "contact")
"""Optional signals that limits and the quick checks need."""


def stretches(files: Sequence[Path], signals: Collection[str] | None = FOR_LIMITS) -> list[Callable[[], Recording]]:
    """Loaders of the recordings in these files; one of more than ROW_GROUP samples is split into equal parts.

    Each part is a recording NAME-00, NAME-01, ..., as in an import; the chain warms up in each. Memory use does not
    grow with the length of a recording.

    Args:
        signals: optional signals to read; None: all.

    Raises:
        RecordingError: a file cannot be read or is no recording.
    """
    with ThreadPoolExecutor(8) as pool:
        samples = [head.samples for head in pool.map(describe, files)]
    loaders: list[Callable[[], Recording]] = []
    for file, count in zip(files, samples, strict=True):
        parts = max(1, -(-count // ROW_GROUP))
        if parts == 1:
            loaders.append(partial(load_recording, file, signals))
            continue
        rows = pairwise(count * k // parts for k in range(parts + 1))
        loaders += [partial(load_stretch, file, signals, first, end, k) for k, (first, end) in enumerate(rows)]
    return loaders


def load_stretch(file: Path, signals: Collection[str] | None, first: int, end: int, number: int) -> Recording:
    """Load samples first to end (exclusive) as a recording NAME-number; its provenance has the origin."""
    whole = load_recording(file, signals, (first, end))
    start_s = first / whole.rate_hz
    part = {"of": whole.name, "from_s": round(start_s, 6), "to_s": round(start_s + whole.duration_s, 6)}
    return replace(whole, name=f"{whole.name}-{number:02d}", provenance=whole.provenance | {"part": part})


def ahead(loaders: Sequence[Callable[[], T]]) -> Iterator[T]:
    """Load in order; while one recording is used, only the next one is read."""
    if not loaders:
        return
    with ThreadPoolExecutor(1) as pool:
        coming = pool.submit(loaders[0])
        for load in loaders[1:]:
            ready = coming.result()
            coming = pool.submit(load)
            yield ready
        yield coming.result()


# --- A dataset folder: robot file, split, recordings loaded on demand.


ROBOT_FILES = ("robot.xml", "robot.urdf")


@dataclass(frozen=True)
class Dataset:
    """A folder of recordings and their split into sets."""

    folder: Path
    """Folder of the recordings and the robot file."""
    split: Split
    """Names of the recordings' files, by set."""

    def recordings(self, set_name: str) -> list[Recording]:
        """All recordings of `train`, `validation`, `test`, `collisions` or `calibration`, in order."""
        return list(ahead(self.loaders(set_name)))

    def training(self) -> list[Recording]:
        """Training recordings; raises ConfigError if there are none."""
        if not self.split.train:
            raise ConfigError(f"{self.folder}: split.json lists no training recording; one is enough")
        return self.recordings("train")

    def files(self, set_name: str) -> list[Path]:
        """Files of the set's recordings."""
        return [self.folder / name for name in getattr(self.split, set_name)]

    def loaders(self, set_name: str) -> list[Callable[[], Recording]]:
        """Loaders of the set's recordings."""
        return [partial(load_recording, file) for file in self.files(set_name)]

    def stretches(self, set_name: str) -> list[Callable[[], Recording]]:
        """Loaders for limits: long recordings in stretches, without signals that limits do not need."""
        return stretches(self.files(set_name))

    def robot_file(self, given: Path | None) -> Path:
        """Path of the given robot file or the folder's."""
        if given is not None:
            if not given.is_file():
                raise ConfigError(f"{given}: there is no such robot file; give a URDF or MJCF")
            return given
        for name in ROBOT_FILES:
            if (self.folder / name).is_file():
                return self.folder / name
        raise ConfigError(f"{self.folder}: it has no {' or '.join(ROBOT_FILES)}; give one with --robot")


@checked
def load_dataset(folder: Path | str) -> Dataset:
    """The dataset in a folder that `tauext simulate` or `tauext import` made; no recording is read yet.

    Raises:
        ConfigError: there is no such folder, or its split.json cannot be used.
    """
    folder = Path(folder)
    if not (folder / FILE_NAME).is_file() and (reason := why_no_dataset(folder)):
        raise ConfigError(f"{folder}: {reason}")
    return Dataset(folder, load_split(folder))
