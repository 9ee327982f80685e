"""LeRobot dataset folders: reading, and export of recordings as episodes of v3."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.parquet as pq

from tauext.data.importers.parquet import floats_of, is_list, rows_of_lists
from tauext.data.importers.raw import Importer, RawRecording, RawSignals, short_list
from tauext.data.recording import Recording
from tauext.errors import RecordingError
from tauext.files.plain_file import json_of, read_text

# --- LeRobot dataset folders, v3.0 (lerobot 0.4 and later), v2.1 and v2.0 (before): metadata and rows of an episode.


INFO = "meta/info.json"
MOST_ELEMENTS = 10_000
"""Most elements of a feature; no robot's state has more."""
VERSIONS = ("v3.0", "v2.1", "v2.0")
FRAME, TIMESTAMP, OWN_STAMPS = "frame_index", "timestamp", "t_ns"
STATE, ACTION = "observation.state", "action"


@dataclass(frozen=True)
class LerobotFolder:
    """A dataset folder with its info and list of episodes."""

    path: Path
    info: dict[str, Any]
    lengths: dict[int, int]
    """Frames of each episode, by its number."""

    @property
    def version(self) -> str:
        """Version of the format, v3.0 or v2.1; v2.0 has the files of v2.1 but other statistics."""
        return next(v for v in VERSIONS if str(self.info["codebase_version"]).startswith(v.split(".")[0]))

    @property
    def fps(self) -> float:
        """Frames a second."""
        return float(self.info["fps"])

    @property
    def features(self) -> dict[str, dict]:
        """Features in LeRobot's description: dtype, shape, names."""
        return self.info["features"]

    def data_files(self) -> list[Path]:
        """Parquet files of frames, in their order."""
        pattern = "chunk-*/file-*.parquet" if self.version == "v3.0" else "chunk-*/episode_*.parquet"
        return sorted((self.path / "data").glob(pattern))

    def numeric(self, columns: list[str]) -> list[str]:
        """Numeric features among these columns."""
        kinds = ("float", "int", "uint", "bool")
        return [n for n, f in self.features.items() if n in columns and str(f["dtype"]).startswith(kinds)]

    def names(self, feature: str, count: int) -> list[str]:
        """Names of a feature's elements; their indices if it has none.

        Raises:
            RecordingError: more elements than MOST_ELEMENTS.
        """
        if count > MOST_ELEMENTS:
            raise RecordingError(
                f"{self.path / INFO}: {feature} has {count:,} elements; no more than {MOST_ELEMENTS:,} are read"
            )
        names = _names(self.features[feature].get("names"))
        fits = len(names) == len(set(names)) == count
        return names if fits else [str(k) for k in range(count)]


def _names(names: Any) -> list[str]:
    """Names in a list, in lists by kind such as {"motors": [...]}, or in {name: index}."""
    if isinstance(names, dict) and names and all(isinstance(index, int) for index in names.values()):
        return [str(name) for name in sorted(names, key=lambda name: names[name])]
    if isinstance(names, dict | list):
        parts = list(names.values()) if isinstance(names, dict) else names
        return [name for part in parts for name in (_names(part) if isinstance(part, dict | list) else [str(part)])]
    return []


def open_folder(path: Path) -> LerobotFolder:
    """Read the metadata of a LeRobot dataset folder.

    Raises:
        RecordingError: unsupported version, a file is missing or damaged, or no episode.
    """
    try:
        info = json_of(read_text(path / INFO))
        version, fps, features = info["codebase_version"], float(info["fps"]), info["features"]
        [feature["dtype"] for feature in features.values()]  # each has one
        if not 0 < fps <= 1e6:
            raise ValueError(f"fps = {fps:g} must be above 0")
    except FileNotFoundError as error:
        raise RecordingError(f"{path}: is not a LeRobot dataset: it has no {INFO}") from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise RecordingError(f"{path / INFO}: cannot be read as LeRobot's ({type(error).__name__}: {error})") from error
    if not re.match(r"v3\.|v2\.[01]$", str(version)):
        raise RecordingError(
            f"{path}: a LeRobot dataset of version {version}; {', '.join(VERSIONS)} are read: convert it with "
            "LeRobot's own script"
        )
    folder = LerobotFolder(path, info, {})
    if not folder.data_files():
        held = "data/chunk-*/file-*.parquet" if folder.version == "v3.0" else "data/chunk-*/episode_*.parquet"
        raise RecordingError(f"{path}: it has no {held}")
    with readable(path, "its episodes"):
        listed = list(_listed(folder))
    if not all(isinstance(n, int) for pair in listed for n in pair):
        raise RecordingError(f"{path}: an episode has no number or no length; copy it again")
    if not listed:
        raise RecordingError(f"{path}: it has no episode")
    return LerobotFolder(path, info, dict(sorted(listed)))


def _listed(folder: LerobotFolder) -> Iterator[tuple[int, int]]:
    if folder.version == "v3.0":
        files = sorted((folder.path / "meta/episodes").glob("chunk-*/file-*.parquet"))
        numbers = ds.dataset(files).to_table(columns=["episode_index", "length"]).to_pydict()
        yield from zip(numbers["episode_index"], numbers["length"], strict=True)
        return
    for line in read_text(folder.path / "meta/episodes.jsonl").splitlines():
        if line.strip():
            episode = json_of(line)
            yield episode["episode_index"], episode["length"]


@contextmanager
def readable(path: Path, what: str) -> Iterator[None]:
    """Convert errors on damaged files to RecordingError."""
    try:
        yield
    except (pa.ArrowException, OSError) as error:
        raise RecordingError(f"{path}: {what} cannot be read: truncated or damaged; copy it again") from error
    except LookupError as error:
        lacking = error.args[0] if error.args else "a part"
        raise RecordingError(f"{path}: {what} cannot be read: it lacks {lacking!r}; copy it again") from error
    except (ValueError, TypeError, AttributeError) as error:
        cause = " ".join(f"{error}".split()) or type(error).__name__
        raise RecordingError(f"{path}: {what} cannot be read ({cause}); copy it again") from error


@dataclass(frozen=True)
class Frames:
    """Data files of each episode, with the number of frames in them, and the files that cannot be read."""

    files: dict[int, list[Path]]
    counts: Counter[int]
    broken: list[Path]


def frames_of(folder: LerobotFolder) -> Frames:
    """Find the frames of every episode by reading its number alone."""
    files: dict[int, list[Path]] = {}
    counts, broken = Counter[int](), []
    for path in folder.data_files():
        try:
            numbers = pq.read_table(path, columns=["episode_index"]).column(0).to_numpy()
        except (pa.ArrowException, OSError, LookupError):
            broken.append(path)
            continue
        held = dict(zip(*(part.tolist() for part in np.unique(numbers, return_counts=True)), strict=True))
        counts.update(held)
        for number in held:
            files.setdefault(number, []).append(path)
    return Frames(files, counts, broken)


def episode_rows(folder: LerobotFolder, number: int, files: list[Path] | None = None) -> pa.Table:
    """The numeric columns of an episode, in the order of its frames.

    Args:
        files: data files that hold frames of it; None: those of the folder, by their names.

    Raises:
        RecordingError: damaged, or the number of rows differs from the episode's length.
    """
    with readable(folder.path, f"episode {number}"):
        if files is None and folder.version != "v3.0":
            files = sorted((folder.path / "data").glob(f"chunk-*/episode_{number:06d}.parquet"))
            if not files:
                raise RecordingError(f"{folder.path}: episode {number} has no data file; copy the folder again")
        table = ds.dataset(files or folder.data_files())
        rows = table.to_table(columns=folder.numeric(table.schema.names), filter=ds.field("episode_index") == number)
        if FRAME in rows.column_names:
            rows = rows.sort_by(FRAME)
    if len(rows) != folder.lengths[number]:
        raise RecordingError(
            f"{folder.path}: episode {number} has {len(rows)} frames, its metadata lists {folder.lengths[number]}"
        )
    return rows


def columns_of(folder: LerobotFolder, rows: pa.Table, counts: Counter[str] | None = None) -> dict[str, np.ndarray]:
    """Columns of an episode by name, `feature[element]`, as float64, and the goals, `goal[element]`.

    The goal of NAME.pos is the state's element NAME.goal if recorded, else the action of the frame before: an action
    takes effect by the next measured state. In the first frame the goal is the state itself.
    """
    columns: dict[str, np.ndarray] = {}
    for name in rows.column_names:
        column = rows.column(name).combine_chunks()
        if not is_list(column.type):
            columns[name] = floats_of(column)
            continue
        values, odd = rows_of_lists(column)
        if odd and counts is not None:
            counts[f"lists of '{name}' without {values.shape[1]} elements are missing values"] += odd
        names = folder.names(name, values.shape[1])
        columns |= {f"{name}[{element}]": values[:, k] for k, element in enumerate(names)}
    goals = {}
    for name, action in columns.items():
        if not name.startswith(f"{ACTION}["):
            continue
        element = name.removeprefix(f"{ACTION}[")[:-1]
        recorded = columns.get(f"{STATE}[{element.removesuffix('.pos')}.goal]")
        first = columns.get(f"{STATE}[{element}]", action)[:1]
        goals[f"goal[{element}]"] = np.r_[first, action[:-1]] if recorded is None else recorded
    return columns | goals


def frame_stamps(frames: np.ndarray, fps: float) -> np.ndarray:
    """Times of frames, frame_index / fps, as int64 [ns]; LeRobot's own `timestamp` has single precision."""
    return np.round(np.asarray(frames, dtype=np.float64) * (1e9 / fps)).astype(np.int64)


def open_lerobot(path: Path) -> list[RawRecording]:
    """Open every episode of a LeRobot dataset as a raw recording; a feature's element `name` is `feature[name]`.

    Times are those of the feature `t_ns` if present (tauext writes it), else frame_index / fps, with the feature
    `timestamp` as the second clock. For `goal[name]` see columns_of(). An episode whose frames are damaged or are not
    as many as its metadata lists is left out, and the notes list it.

    Raises:
        RecordingError: unsupported version, a file is missing or damaged, or no episode is left.
    """
    folder = open_folder(path)
    frames = frames_of(folder)
    good = [number for number, length in folder.lengths.items() if frames.counts[number] == length]
    notes = []
    if bad := [number for number in folder.lengths if number not in good]:
        held, length = frames.counts[bad[0]], folder.lengths[bad[0]]
        why = f"episode {bad[0]} has {held} frames, its metadata lists {length}"
        if frames.broken:
            why += f"; {frames.broken[0].relative_to(path)} is truncated or damaged: copy it again"
        if not good:
            raise RecordingError(f"{path}: {why}")
        notes.append(f"episodes left out: {short_list(map(str, bad))}; {why}")
    raws = [raw_episode(folder, number, frames.files[number]) for number in good]
    raws[0].notes.extend(notes)
    return raws


def raw_episode(folder: LerobotFolder, number: int, files: list[Path] | None = None) -> RawRecording:
    """Open one episode; its frames are read when its blocks are requested.

    Args:
        files: data files that hold frames of it; None: those of the folder, by their names.
    """
    counts = Counter[str]()

    def blocks() -> Iterator[RawSignals]:
        rows = episode_rows(folder, number, files)
        other_ns = None
        with readable(folder.path, f"episode {number}"):
            columns = columns_of(folder, rows, counts)
            if OWN_STAMPS in rows.column_names:
                t_ns = rows.column(OWN_STAMPS).to_numpy().astype(np.int64)
            else:
                frames = columns.get(FRAME, np.arange(len(rows)))
                if not (np.abs(frames) < 1e9).all():
                    raise RecordingError(
                        f"{folder.path}: episode {number} has frames without a valid {FRAME}; copy it again"
                    )
                t_ns = frame_stamps(frames, folder.fps)
                other_ns = _second_clock(columns.get(TIMESTAMP, columns.get(f"{TIMESTAMP}[0]")))
            signals = RawSignals("", tuple(columns), t_ns, np.column_stack(list(columns.values())), other_ns)
        yield signals

    own = OWN_STAMPS in folder.features
    name = f"{folder.path.name}-episode-{number:03d}"
    kind = f"LeRobot {folder.version.split('.')[0]} dataset"
    clocks = (OWN_STAMPS, "") if own else ("fps", TIMESTAMP if TIMESTAMP in folder.features else "")
    return RawRecording(name, folder.path, kind, blocks, counts=counts, clocks=clocks, row_word=("frame", 0))


def _second_clock(timestamps: np.ndarray | None) -> np.ndarray | None:
    """Stamps [ns] of timestamps [s]; None where they are missing, stand still or exceed an int64."""
    if timestamps is None or not (np.abs(timestamps) < 9e9).all() or np.ptp(timestamps) <= 0:
        return None
    return np.round((timestamps - timestamps[0]) * 1e9).astype(np.int64) + round(float(timestamps[0]) * 1e9)


# --- Export of recordings as episodes of a LeRobot v3 dataset folder.


FEATURES = {"observation.state": "q", "observation.velocity": "dq", "observation.effort": "tau", "action": "q_des"}
FILES_A_CHUNK = 1000


def export_lerobot(recordings: Iterable[Recording], folder: Path) -> int:
    """Write meta/ and data/ of a LeRobot v3 dataset; returns the number of episodes.

    `observation.state`, `observation.velocity` and `observation.effort` are q, dq and tau in float64; `action` is the
    commanded position if all recordings have it, `contact` the label. LeRobot requires `timestamp` = frame / fps;
    tauext reads the true stamps from `t_ns`.
    """
    episodes: list[dict] = []
    sums: dict[str, list[np.ndarray]] = {}
    frames, first, held = 0, None, {}
    for number, recording in enumerate(recordings):
        if first is None:
            first, held = recording, {f: s for f, s in FEATURES.items() if getattr(recording, s) is not None}
        chunk, file = divmod(number, FILES_A_CHUNK)
        columns = {feature: getattr(recording, signal) for feature, signal in held.items()}
        if recording.contact is not None:
            columns["contact"] = recording.contact.astype(np.int64)
        frame = np.arange(recording.samples)
        columns["timestamp"] = (frame / recording.rate_hz).astype(np.float32)
        columns |= {"t_ns": recording.t_ns, "frame_index": frame}
        columns |= {"episode_index": np.full(recording.samples, number), "index": frames + frame}
        columns["task_index"] = np.full(recording.samples, number)
        path = folder / f"data/chunk-{chunk:03d}/file-{file:03d}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.table({name: _column(values) for name, values in columns.items()}), path)
        _add(sums, columns)
        episodes.append(
            {
                "episode_index": number,
                "tasks": [recording.name],
                "length": recording.samples,
                "data/chunk_index": chunk,
                "data/file_index": file,
                "dataset_from_index": frames,
                "dataset_to_index": frames + recording.samples,
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
            }
        )
        frames += recording.samples
    if first is not None:
        _write_meta(folder, first, held, episodes, frames, sums)
    return len(episodes)


def _column(values: np.ndarray) -> pa.Array:
    if values.ndim == 1:
        return pa.array(values)
    return pa.FixedSizeListArray.from_arrays(pa.array(np.ascontiguousarray(values).ravel()), values.shape[1])


def _add(sums: dict[str, list[np.ndarray]], columns: dict[str, np.ndarray]) -> None:
    """Update count, sum, sum of squares, least and largest of every column."""
    for name, values in columns.items():
        values = values.reshape(len(values), -1).astype(np.float64)
        now = [np.array([len(values)]), values.sum(0), (values**2).sum(0), values.min(0), values.max(0)]
        if name in sums:
            n, s, q, low, high = sums[name]
            now = [n + now[0], s + now[1], q + now[2], np.minimum(low, now[3]), np.maximum(high, now[4])]
        sums[name] = now


def _write_meta(
    folder: Path, first: Recording, held: dict, episodes: list[dict], frames: int, sums: dict[str, list[np.ndarray]]
) -> None:
    scalars = {"timestamp": "float32", "t_ns": "int64", "frame_index": "int64", "episode_index": "int64"}
    scalars |= {"index": "int64", "task_index": "int64"} | ({"contact": "int64"} if "contact" in sums else {})
    features: dict[str, dict] = {
        f: {"dtype": "float64", "shape": [len(first.joints)], "names": list(first.joints)} for f in held
    }
    features |= {name: {"dtype": kind, "shape": [1], "names": None} for name, kind in scalars.items()}
    fps = int(first.rate_hz) if first.rate_hz == int(first.rate_hz) else first.rate_hz
    info = {
        "codebase_version": "v3.0",
        "robot_type": None,
        "total_episodes": len(episodes),
        "total_frames": frames,
        "total_tasks": len(episodes),
        "chunks_size": FILES_A_CHUNK,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 500,
        "fps": fps,
        "splits": {"train": f"0:{len(episodes)}"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": None,
        "features": features,
    }
    stats = {}
    for name, (count, total, squares, low, high) in sums.items():
        mean = total / count
        std = np.sqrt(np.maximum(squares / count - mean**2, 0.0))
        named = {"min": low, "max": high, "mean": mean, "std": std, "count": count}
        stats[name] = {key: value.tolist() for key, value in named.items()}
    meta = folder / "meta"
    (meta / "episodes/chunk-000").mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.Table.from_pylist(episodes), meta / "episodes/chunk-000/file-000.parquet")
    tasks = pa.table({"task_index": np.arange(len(episodes)), "task": [e["tasks"][0] for e in episodes]})
    # LeRobot finds a task by the pandas index in this entry.
    kinds = [{"name": n, "field_name": n, "pandas_type": k, "numpy_type": t, "metadata": None}
             for n, k, t in (("task_index", "int64", "int64"), ("task", "unicode", "object"))]  # fmt: skip
    pandas = {"index_columns": ["task"], "column_indexes": [], "columns": kinds, "pandas_version": "2.0.0"}
    pq.write_table(tasks.replace_schema_metadata({"pandas": json.dumps(pandas)}), meta / "tasks.parquet")
    (meta / "stats.json").write_text(json.dumps(stats, indent=1) + "\n")
    (meta / "info.json").write_text(json.dumps(info, indent=1) + "\n")


IMPORTER = Importer(
    "LeRobot folder",
    lambda path, _: (path / INFO).is_file(),
    lambda path, _: open_lerobot(path),
    export_lerobot,
)
