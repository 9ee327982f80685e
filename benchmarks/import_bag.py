"""How long an hour of a ROS 2 bag takes to import, and how much memory: writes the bag, imports it, prints both.

    python benchmarks/import_bag.py [--hours 1] [--rate-hz 100] [--joints 7] [--storage sqlite3|mcap|ros1] [--slow]

--slow decodes every message by rosbags instead of all at once, to see what the bulk view is worth.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

ARM = """
[robot]
joints = [JOINTS]
[signals]
q.columns = "position"
dq.columns = "velocity"
tau.columns = "effort"
"""


def write_bag(path: Path, samples: int, rate_hz: float, joints: list[str], storage: str) -> None:
    """A bag of JointState messages with sines and noise in all joints."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    from tauext.data.importers.ros import ARRAYS, layout_of

    ros1 = storage == "ros1"
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    types = store.types
    time_type, header_type = types["builtin_interfaces/msg/Time"], types["std_msgs/msg/Header"]
    state_type = types["sensor_msgs/msg/JointState"]
    rng = np.random.default_rng(0)
    kind = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    with Writer1(path) if ros1 else Writer(path, version=9, storage_plugin=kind) as writer:
        connection = writer.add_connection("/joint_states", state_type.__msgtype__, typestore=store)
        header = {"stamp": time_type(sec=1, nanosec=1), "frame_id": ""} | ({"seq": 0} if ros1 else {})
        arrays = dict.fromkeys(ARRAYS, np.zeros(len(joints)))
        first = state_type(header=header_type(**header), name=joints, **arrays)
        raw = bytes((store.serialize_ros1 if ros1 else store.serialize_cdr)(first, state_type.__msgtype__))
        layout = layout_of(raw, cdr=not ros1)
        # Serializing each message would take longer than what is measured: later ones differ in stamp and values only.
        for begin in range(0, samples, 10_000):
            k = np.arange(begin, min(begin + 10_000, samples))
            t_ns = 10**18 + np.round(k * 1e9 / rate_hz).astype(np.int64)
            rows = np.tile(np.frombuffer(raw, np.uint8), (len(k), 1))
            stamps = np.stack([t_ns // 10**9, t_ns % 10**9], axis=1).astype("<u4")
            rows[:, layout.stamp : layout.stamp + 8] = stamps.view(np.uint8)
            for place, part in enumerate(layout.arrays.values()):
                values = np.sin(k[:, None] / rate_hz + place + np.arange(len(joints)))
                values += 1e-3 * rng.standard_normal(values.shape)
                rows[:, part] = values.astype("<f8").view(np.uint8)
            for stamp_ns, row in zip(t_ns.tolist(), rows, strict=True):
                writer.write(connection, stamp_ns, row.tobytes())


def import_once(bag: Path, arm: Path, out: Path, slow: bool) -> None:
    """Import in this process and print time and peak memory."""
    started = time.monotonic()
    if slow:
        from tauext.data.importers import ros

        ros.layout_of = lambda *_: None
    from tauext.cli import main

    code = main(["import", "--source", str(bag), "--arm", str(arm), "--out", str(out)])
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    how = "message by message" if slow else "in bulk"
    wall_s, cpu_s = time.monotonic() - started, time.process_time()
    print(f"import {how}: {wall_s:.2f} s ({cpu_s:.2f} s of processor time), peak memory {peak_mb:.0f} MB", flush=True)
    sys.exit(code)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--hours", type=float, default=1.0)
    parser.add_argument("--rate-hz", type=float, default=100.0)
    parser.add_argument("--joints", type=int, default=7)
    parser.add_argument("--storage", choices=("sqlite3", "mcap", "ros1"), default="sqlite3")
    parser.add_argument("--slow", action="store_true")
    parser.add_argument("--import-only", nargs=3, metavar=("BAG", "ARM", "OUT"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.import_only:
        bag, arm, out = map(Path, options.import_only)
        import_once(bag, arm, out, options.slow)
    joints = [f"joint{k + 1}" for k in range(options.joints)]
    samples = round(options.hours * 3600 * options.rate_hz)
    with tempfile.TemporaryDirectory() as folder:
        bag, arm = Path(folder, "hour.bag" if options.storage == "ros1" else "hour"), Path(folder, "arm.toml")
        write_bag(bag, samples, options.rate_hz, joints, options.storage)
        arm.write_text(ARM.replace("JOINTS", ", ".join(f'"{joint}"' for joint in joints)))
        print(f"{samples} messages of {options.joints} joints at {options.rate_hz:g} Hz, {options.storage}", flush=True)
        # A process of its own, so that writing the bag does not count.
        command = [sys.executable, __file__, "--import-only", str(bag), str(arm), str(Path(folder, "out"))]
        subprocess.run(command + ["--slow"] * options.slow, check=True)


if __name__ == "__main__":
    main()
