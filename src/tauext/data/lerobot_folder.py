"""LeRobot dataset folders, v3.0 (lerobot 0.4 and later) and v2.1 (0.3): what they are, and rows of an episode."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.parquet as pq

from tauext.errors import RecordingError
from tauext.files.plain_file import json_of, read_text

INFO = "meta/info.json"
MOST_ELEMENTS = 10_000
"""Of one feature: a state of more is none of a robot."""
VERSIONS = ("v3.0", "v2.1")
EPISODES_V2 = "meta/episodes.jsonl"
STATE, ACTION = "observation.state", "action"
GOAL = "goal"
"""Columns `goal[NAME]`: what the servos were following while the state of the same row was measured."""


@dataclass(frozen=True)
class LerobotFolder:
    """A dataset folder whose info and list of episodes were read."""

    path: Path
    info: dict[str, Any]
    lengths: dict[int, int]
    """Frames of each episode, by its number."""

    @property
    def version(self) -> str:
        """v3.0 or v2.1."""
        return next(v for v in VERSIONS if str(self.info["codebase_version"]).startswith(v.split(".")[0]))

    @property
    def fps(self) -> float:
        """Frames a second."""
        return float(self.info["fps"])

    @property
    def features(self) -> dict[str, dict]:
        """As LeRobot describes them: dtype, shape, names."""
        return self.info["features"]

    def data_files(self) -> list[Path]:
        """Parquet files of frames, in their order."""
        pattern = "chunk-*/file-*.parquet" if self.version == "v3.0" else "chunk-*/episode_*.parquet"
        return sorted((self.path / "data").glob(pattern))

    def numeric(self, columns: list[str]) -> list[str]:
        """Features that hold numbers and are in the files."""
        return [n for n, f in self.features.items() if n in columns and str(f["dtype"]).startswith(("float", "int"))]

    def names(self, feature: str, count: int) -> list[str]:
        """Of the elements of a feature; their indices where it gives none.

        Raises:
            RecordingError: more elements than MOST_ELEMENTS.
        """
        if count > MOST_ELEMENTS:
            raise RecordingError(
                f"{self.path / INFO}: {feature} has {count:,} elements; no more than {MOST_ELEMENTS:,} are read"
            )
        names: Any = self.features[feature].get("names")
        if isinstance(names, dict):  # some datasets: {"motors": [...]}
            names = next(iter(names.values()), None)
        fits = isinstance(names, list) and len(names) == count
        return [str(n) for n in names] if fits else [str(k) for k in range(count)]


def open_folder(path: Path) -> LerobotFolder:
    """Read what a LeRobot dataset folder says of itself.

    Raises:
        RecordingError: another version, a file missing or damaged, no episode.
    """
    try:
        info = json_of(read_text(path / INFO))
        version, fps, features = info["codebase_version"], float(info["fps"]), info["features"]
        [feature["dtype"] for feature in features.values()]  # each has one
        if not 0 < fps <= 1e6:
            raise ValueError(f"fps = {fps:g} must be above 0")
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise RecordingError(f"{path / INFO}: cannot be read as LeRobot's ({type(error).__name__}: {error})") from error
    if not re.match(r"v3\.|v2\.1$", str(version)):
        raise RecordingError(
            f"{path}: a LeRobot dataset of version {version}; {' and '.join(VERSIONS)} are read: convert it with "
            "LeRobot's own script"
        )
    folder = LerobotFolder(path, info, {})
    if not folder.data_files():
        held = "data/chunk-*/file-*.parquet" if folder.version == "v3.0" else "data/chunk-*/episode_*.parquet"
        raise RecordingError(f"{path}: it holds no {held}")
    with readable(path, "its episodes"):
        listed = list(_listed(folder))
    if not all(isinstance(n, int) for pair in listed for n in pair):
        raise RecordingError(f"{path}: an episode has no number or no length; copy it again")
    if not listed:
        raise RecordingError(f"{path}: it holds no episode")
    return LerobotFolder(path, info, dict(sorted(listed)))


def _listed(folder: LerobotFolder) -> Iterator[tuple[int, int]]:
    if folder.version == "v3.0":
        files = sorted((folder.path / "meta/episodes").glob("chunk-*/file-*.parquet"))
        numbers = ds.dataset(files).to_table(columns=["episode_index", "length"]).to_pydict()
        yield from zip(numbers["episode_index"], numbers["length"], strict=True)
        return
    for line in read_text(folder.path / EPISODES_V2).splitlines():
        if line.strip():
            episode = json_of(line)
            yield episode["episode_index"], episode["length"]


@contextmanager
def readable(path: Path, what: str) -> Iterator[None]:
    """RecordingError in place of whatever damaged files make of reading them."""
    try:
        yield
    except (pa.ArrowException, OSError, LookupError, ValueError, TypeError, AttributeError) as error:
        cause = " ".join(f"{error}".split()) or type(error).__name__
        raise RecordingError(f"{path}: {what} cannot be read ({cause}); copy it again") from error


def episode_rows(folder: LerobotFolder, number: int) -> pa.Table:
    """The numeric columns of an episode, in the order of its frames.

    Raises:
        RecordingError: damaged, or not as many rows as the episode's length.
    """
    with readable(folder.path, f"episode {number}"):
        if folder.version == "v3.0":
            table = ds.dataset(folder.data_files())
            rows = table.to_table(
                columns=folder.numeric(table.schema.names), filter=ds.field("episode_index") == number
            ).sort_by("frame_index")
        else:
            size = int(folder.info.get("chunks_size", 1000))
            file = pq.ParquetFile(folder.path / f"data/chunk-{number // size:03d}/episode_{number:06d}.parquet")
            rows = file.read(columns=folder.numeric(file.schema_arrow.names)).sort_by("frame_index")
    if len(rows) != folder.lengths[number]:
        raise RecordingError(
            f"{folder.path}: episode {number} has {len(rows)} frames, its metadata says {folder.lengths[number]}"
        )
    return rows


def columns_of(folder: LerobotFolder, rows: pa.Table) -> dict[str, np.ndarray]:
    """Every number of an episode by its name, `feature[element]`, as float64; with the goals, `goal[element]`.

    A goal is the state's element NAME.goal for NAME.pos where it was recorded, else the action of the frame before:
    what an action commands is followed once the next state is measured. In the first frame it is the state itself.
    """
    columns: dict[str, np.ndarray] = {}
    for name in rows.column_names:
        column = rows.column(name).combine_chunks()
        if not hasattr(column.type, "value_type"):
            columns[name] = column.to_numpy(zero_copy_only=False).astype(np.float64)
            continue
        values = column.flatten().to_numpy(zero_copy_only=False).reshape(len(rows), -1).astype(np.float64)
        names = folder.names(name, values.shape[1])
        columns |= {f"{name}[{element}]": values[:, k] for k, element in enumerate(names)}
    goals = {}
    for name, action in columns.items():
        if not name.startswith(f"{ACTION}["):
            continue
        element = name.removeprefix(f"{ACTION}[")[:-1]
        recorded = columns.get(f"{STATE}[{element.removesuffix('.pos')}.goal]")
        first = columns.get(f"{STATE}[{element}]", action)[:1]
        goals[f"{GOAL}[{element}]"] = np.r_[first, action[:-1]] if recorded is None else recorded
    return columns | goals


def frame_stamps(frames: np.ndarray, fps: float) -> np.ndarray:
    """Times of frames, frame_index / fps, as int64 [ns]: LeRobot's own `timestamp` is that in single precision."""
    return np.round(np.asarray(frames, dtype=np.float64) * (1e9 / fps)).astype(np.int64)
