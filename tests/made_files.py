"""One log of an arm, written in every format that import reads."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from made_recordings import message, motion
from scipy.io import savemat

BAGS = ("ros1", "sqlite3", "mcap")
TABLES = ("csv", "parquet")
ARRAYS = ("hdf5", "matlab5", "matlab73")
LEROBOT = ("lerobot2.1", "lerobot3")
FORMATS = (*BAGS, *TABLES, *ARRAYS, *LEROBOT)
NAMED = (*BAGS, *TABLES, *LEROBOT)
"""Formats that name the joints."""
JOINTS = ("shoulder", "elbow", "wrist")


@dataclass(frozen=True)
class Log:
    """Rows of a log, as it is written: stamps [ns], and arrays (samples, joints)."""

    t_ns: np.ndarray
    q: np.ndarray
    dq: np.ndarray
    tau: np.ndarray
    names: tuple[str, ...] = JOINTS
    log_ns: np.ndarray | None = None
    """Log times of a bag; None: the stamps."""
    timestamp_s: np.ndarray | None = None
    """LeRobot's column; None: the stamps."""
    titles: tuple[str, str, str, str] = ("time", "q_{joint}", "dq_{joint}", "tau_{joint}")
    """Columns of a table, with {joint} or {number}."""
    more: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Further columns of a table."""
    time_factor: float = 1e-9
    """Unit of the column of times, for stamps in ns."""
    one_state: bool = False
    """Whether LeRobot's state has all signals: `shoulder.pos`, `shoulder.vel`, `shoulder.torque`."""
    goal_first: float = 0.0
    """Goals of LeRobot are positions, and this."""

    def rows(self, keep) -> Log:
        """These rows, in this order."""
        parts = {name: getattr(self, name)[keep] for name in ("t_ns", "q", "dq", "tau")}
        parts["more"] = {name: values[keep] for name, values in self.more.items()}
        log_ns = self.log_ns[keep] if self.log_ns is not None else None
        return replace(self, log_ns=log_ns, **parts)  # type: ignore[arg-type]


def clean_log(samples: int = 600, rate_hz: float = 50.0) -> Log:
    """A log without any fault."""
    t_ns, q, dq, tau = motion(samples, rate_hz)
    return Log(t_ns - 10**18, q, dq, tau)


def arm_text(
    kind: str, joints=JOINTS, names=(), robot: str = "", time: str = "", q: str = "", dq: str | None = None
) -> str:
    """An arm.toml for the log in this format."""
    if kind in BAGS:
        columns, clock = ("position", "velocity", "effort"), ""
    elif kind in LEROBOT:
        columns, clock = ("observation.state", "observation.velocity", "observation.effort"), ""
    else:
        named = kind in TABLES
        columns = ("q_{joint}", "dq_{joint}", "tau_{joint}") if named else ("q", "dq", "tau")
        clock = 'column = "time"'
    velocity = columns[1] if dq is None else dq
    return (
        f"[robot]\njoints = {json.dumps(joints)}\n{f'names = {json.dumps(names)}' if names else ''}\n{robot}\n"
        f'[time]\n{time or clock}\n[signals.q]\ncolumns = "{columns[0]}"\n{q}\n[signals.dq]\ncolumns = "{velocity}"\n'
        f'[signals.tau]\ncolumns = "{columns[2]}"\n'
    )


def write(kind: str, folder: Path, log: Log) -> Path:
    """Write the log; returns what to import."""
    folder.mkdir(parents=True, exist_ok=True)
    if kind in BAGS:
        return _write_bag(kind, folder / "log", log)
    arrays = {"q": log.q, "dq": log.dq, "tau": log.tau}
    time_s = log.t_ns * log.time_factor
    if kind in TABLES:
        columns = {log.titles[0]: time_s}
        for title, values in zip(log.titles[1:], arrays.values(), strict=True):
            for k, name in enumerate(log.names):
                columns[title.replace("{joint}", name).replace("{number}", str(k + 1))] = values[:, k]
        columns |= log.more
        if kind == "parquet":
            pq.write_table(pa.table(columns), path := folder / "log.parquet")
            return path
        path = folder / "log.csv"
        lines = [",".join(columns)]
        lines += [
            ",".join("" if np.isnan(x) else repr(float(x)) for x in row) for row in zip(*columns.values(), strict=True)
        ]
        path.write_text("\n".join(lines) + "\n")
        return path
    if kind == "hdf5":
        path = folder / "log.h5"
        with h5py.File(path, "w") as file:
            for name, values in (arrays | {"time": time_s}).items():
                file[name] = values
        return path
    if kind == "matlab5":
        savemat(path := folder / "log.mat", arrays | {"time": time_s[:, None]})
        return path
    if kind == "matlab73":
        return _write_matlab73(folder / "log.mat", arrays | {"time": time_s[:, None]})
    return _write_lerobot(kind, folder / "log", log, arrays)


def _write_bag(kind: str, path: Path, log: Log) -> Path:
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    ros1, kind_of = kind == "ros1", "sensor_msgs/msg/JointState"
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
    path = path.with_suffix(".bag") if ros1 else path
    log_ns = log.t_ns if log.log_ns is None else log.log_ns
    with Writer1(path) if ros1 else Writer(path, version=9, storage_plugin=plugin) as writer:
        connection = writer.add_connection("/joint_states", kind_of, typestore=store)
        serialize = store.serialize_ros1 if ros1 else store.serialize_cdr
        for at, stamp, *rows in zip(log_ns, log.t_ns, log.q, log.dq, log.tau, strict=True):
            content = message(store, int(stamp), log.names, *rows, ros1=ros1)
            writer.write(connection, int(at) + 10**15, serialize(content, kind_of))
    return path


def _write_matlab73(path: Path, arrays: dict[str, np.ndarray]) -> Path:
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in arrays.items():
            file[name] = values.T  # MATLAB stores columns first
            file[name].attrs["MATLAB_class"] = np.bytes_("double")
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, made for a test".ljust(116) + b"\0" * 8 + b"\x00\x02IM")
    return path


def _write_lerobot(kind: str, folder: Path, log: Log, arrays: dict[str, np.ndarray]) -> Path:
    features = {"q": "observation.state", "dq": "observation.velocity", "tau": "observation.effort"}
    elements = {feature: list(log.names) for feature in features.values()}
    if log.one_state:
        goal = log.q + log.goal_first
        arrays = {"q": np.stack([log.q, log.dq, log.tau], axis=2).reshape(len(log.q), -1), "goal": goal}
        features = {"q": "observation.state", "goal": "action"}
        kinds = {"observation.state": ("pos", "vel", "torque"), "action": ("pos",)}
        elements = {f: [f"{name}.{kind}" for name in log.names for kind in of] for f, of in kinds.items()}
    frames = np.arange(len(log.q))
    times = log.t_ns * 1e-9 if log.timestamp_s is None else log.timestamp_s
    scalars = {"timestamp": times.astype(np.float32), "frame_index": frames, "episode_index": 0 * frames}
    table = {features[a]: pa.array(v.tolist(), pa.list_(pa.float64(), v.shape[1])) for a, v in arrays.items()}
    version = "v2.1" if kind == "lerobot2.1" else "v3.0"
    data = "data/chunk-000/episode_000000.parquet" if version == "v2.1" else "data/chunk-000/file-000.parquet"
    (folder / data).parent.mkdir(parents=True)
    pq.write_table(pa.table(table | {n: pa.array(v) for n, v in scalars.items()}), folder / data)
    described = {f: {"dtype": "float64", "shape": [len(of)], "names": of} for f, of in elements.items()}
    described |= {name: {"dtype": str(v.dtype), "shape": [1], "names": None} for name, v in scalars.items()}
    info = {"codebase_version": version, "fps": 50, "features": described, "chunks_size": 1000, "total_episodes": 1}
    (folder / "meta").mkdir()
    (folder / "meta/info.json").write_text(json.dumps(info))
    episode = {"episode_index": 0, "length": len(frames), "tasks": ["move"]}
    if version == "v2.1":
        (folder / "meta/episodes.jsonl").write_text(json.dumps(episode) + "\n")
    else:
        path = folder / "meta/episodes/chunk-000/file-000.parquet"
        path.parent.mkdir(parents=True)
        pq.write_table(pa.Table.from_pylist([episode]), path)
    return folder
