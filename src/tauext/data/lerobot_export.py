"""Recordings as a LeRobot v3 dataset folder: an episode each."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from tauext.data.recording import Recording

FEATURES = {"observation.state": "q", "observation.velocity": "dq", "observation.effort": "tau", "action": "q_des"}
FILES_A_CHUNK = 1000


def export_lerobot(recordings: Iterable[Recording], folder: Path) -> int:
    """Write meta/ and data/ of a LeRobot v3 dataset; returns the number of episodes.

    `observation.state`, `observation.velocity` and `observation.effort` hold q, dq and tau in float64, `action` the
    commanded position where all recordings have it, `contact` the label. LeRobot wants `timestamp` = frame / fps; the
    true stamps are in `t_ns`, from which tauext reads them back.
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
    """Count, sum, sum of squares, least and largest of every column so far."""
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
    # LeRobot finds a task by the index that pandas keeps in this entry.
    kinds = [{"name": n, "field_name": n, "pandas_type": k, "numpy_type": t, "metadata": None}
             for n, k, t in (("task_index", "int64", "int64"), ("task", "unicode", "object"))]  # fmt: skip
    pandas = {"index_columns": ["task"], "column_indexes": [], "columns": kinds, "pandas_version": "2.0.0"}
    pq.write_table(tasks.replace_schema_metadata({"pandas": json.dumps(pandas)}), meta / "tasks.parquet")
    (meta / "stats.json").write_text(json.dumps(stats, indent=1) + "\n")
    (meta / "info.json").write_text(json.dumps(info, indent=1) + "\n")
