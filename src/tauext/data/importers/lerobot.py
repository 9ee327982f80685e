"""LeRobot dataset folders of version 3: one raw recording an episode."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.dataset as ds

from tauext.data.importers.raw import RawRecording, RawSignals
from tauext.errors import RecordingError
from tauext.plain_file import json_of, read_text

INFO = "meta/info.json"
VERSION = "v3.0"


def open_lerobot(path: Path) -> list[RawRecording]:
    """Every episode of a LeRobot v3 dataset as a raw recording; element `name` of a feature is `feature[name]`.

    Times are those of the feature `t_ns` where there is one (tauext writes it), else frame_index / fps: LeRobot's own
    `timestamp` is that in single precision.

    Raises:
        RecordingError: another version, a file missing or damaged.
    """
    try:
        info = json_of(read_text(path / INFO))
        version, fps, features = info["codebase_version"], float(info["fps"]), info["features"]
        [feature["dtype"] for feature in features.values()]  # each has one
        if not 0 < fps <= 1e6:
            raise ValueError(f"fps = {fps:g} must be above 0")
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise RecordingError(f"{path / INFO}: cannot be read as LeRobot's ({type(error).__name__}: {error})") from error
    if not str(version).startswith("v3"):
        raise RecordingError(
            f"{path}: a LeRobot dataset of version {version}; {VERSION} is read: convert it with LeRobot's own script"
        )
    files = sorted((path / "data").glob("chunk-*/file-*.parquet"))
    if not files:
        raise RecordingError(f"{path}: it holds no data/chunk-*/file-*.parquet")
    try:
        table = ds.dataset(files)
        episodes = ds.dataset(sorted((path / "meta/episodes").glob("chunk-*/file-*.parquet")))
        numbers = episodes.to_table(columns=["episode_index", "length"]).to_pydict()
    except (pa.ArrowException, OSError, KeyError, ValueError) as error:
        cause = " ".join(str(error).split())
        raise RecordingError(f"{path}: its episodes cannot be read ({cause}); copy it again") from error
    if not all(isinstance(n, int) for column in numbers.values() for n in column):
        raise RecordingError(f"{path}: an episode has no number or no length; copy it again")
    if not numbers["length"]:
        raise RecordingError(f"{path}: it holds no episode")
    listed = sorted(zip(numbers["episode_index"], numbers["length"], strict=True))
    return [_episode(path, table, number, length, fps, features) for number, length in listed]


def _episode(path: Path, table: ds.Dataset, number: int, length: int, fps: float, features: dict) -> RawRecording:
    numeric = [
        n for n, f in features.items() if n in table.schema.names and str(f["dtype"]).startswith(("float", "int"))
    ]

    def blocks() -> Iterator[RawSignals]:
        try:
            rows = table.to_table(columns=numeric, filter=ds.field("episode_index") == number).sort_by("frame_index")
        except (pa.ArrowException, OSError, ValueError, KeyError) as error:
            cause = " ".join(str(error).split())
            raise RecordingError(f"{path}: episode {number} cannot be read ({cause}); copy it again") from error
        if len(rows) != length:
            raise RecordingError(f"{path}: episode {number} has {len(rows)} frames, its metadata says {length}")
        try:
            yield signals(rows)
        except (pa.ArrowException, ValueError, KeyError, TypeError) as error:
            cause = " ".join(str(error).split())
            raise RecordingError(f"{path}: episode {number} cannot be read ({cause}); copy it again") from error

    def signals(rows: pa.Table) -> RawSignals:
        columns: dict[str, np.ndarray] = {}
        for name in numeric:
            column = rows.column(name).combine_chunks()
            if not hasattr(column.type, "value_type"):
                columns[name] = column.to_numpy(zero_copy_only=False).astype(np.float64)
                continue
            values = column.flatten().to_numpy(zero_copy_only=False).reshape(length, -1).astype(np.float64)
            names = _element_names(features[name], values.shape[1])
            columns |= {f"{name}[{element}]": values[:, k] for k, element in enumerate(names)}
        if "t_ns" in rows.column_names:
            t_ns = rows.column("t_ns").to_numpy().astype(np.int64)
        else:
            t_ns = np.round(columns["frame_index"] * (1e9 / fps)).astype(np.int64)
        return RawSignals("", tuple(columns), t_ns, np.column_stack(list(columns.values())))

    return RawRecording(f"{path.name}-episode-{number:03d}", path, "LeRobot v3 dataset", blocks)


def _element_names(feature: dict, count: int) -> list[str]:
    names = feature.get("names")
    if isinstance(names, dict):  # some datasets: {"motors": [...]}
        names = next(iter(names.values()), None)
    return (
        [str(n) for n in names] if isinstance(names, list) and len(names) == count else [str(k) for k in range(count)]
    )
