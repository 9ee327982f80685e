"""Small bags of JointState messages, written by rosbags, for the tests of importers."""

from __future__ import annotations

from pathlib import Path

import numpy as np

JOINTS = ("base", "Wrist 1", "tip")


def motion(samples: int = 400, rate_hz: float = 100.0, joints: int = 3) -> tuple[np.ndarray, ...]:
    """Stamps [ns], q, dq and tau of a smooth motion; no two rows are equal."""
    t_ns = 10**18 + np.round(np.arange(samples) * 1e9 / rate_hz).astype(np.int64)
    time_s = np.arange(samples)[:, None] / rate_hz
    phase = np.arange(joints)
    return t_ns, np.sin(time_s + phase), np.cos(time_s + phase), 3 * np.sin(2 * time_s + phase) + 0.1 * time_s


def message(store, stamp_ns: int, names, q, dq, tau, ros1: bool = False, frame: str = ""):
    """One JointState message."""
    stamp = store.types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    extra = {"seq": 1} if ros1 else {}
    header = store.types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame, **extra)
    arrays = {"position": q, "velocity": dq, "effort": tau}
    arrays = {name: np.asarray(values, np.float64) for name, values in arrays.items()}
    return store.types["sensor_msgs/msg/JointState"](header=header, name=list(names), **arrays)


def write_bag(
    path: Path, kind: str, topics: dict[str, list], others: dict[str, tuple[str, list]] | None = None
) -> Path:
    """Write a bag; returns what to import.

    Args:
        kind: ros1, sqlite3 or mcap.
        topics: topic: rows of log time, stamp, names, q, dq, tau.
        others: topic: type and rows of log time and a function from the type store to a message.
    """
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    ros1 = kind == "ros1"
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
    path = path.with_suffix(".bag") if ros1 else path
    with Writer1(path) if ros1 else Writer(path, version=9, storage_plugin=plugin) as writer:

        def write(topic: str, msgtype: str, rows) -> None:
            connection = writer.add_connection(topic, msgtype, typestore=store)
            for log_ns, content in rows:
                raw = (store.serialize_ros1 if ros1 else store.serialize_cdr)(content, msgtype)
                writer.write(connection, int(log_ns), raw)

        for topic, rows in topics.items():
            write(topic, "sensor_msgs/msg/JointState", ((log, message(store, *rest, ros1=ros1)) for log, *rest in rows))
        for topic, (msgtype, rows) in (others or {}).items():
            write(topic, msgtype, ((log, make(store)) for log, make in rows))
    return path


def joint_rows(names=JOINTS, samples: int = 400, log_after_ns: int = 2_000_000) -> list:
    """Rows for write_bag: a motion, logged 2 ms after its stamps."""
    t_ns, q, dq, tau = motion(samples, joints=len(names))
    return [(t + log_after_ns, int(t), names, *rows) for t, *rows in zip(t_ns, q, dq, tau, strict=True)]
