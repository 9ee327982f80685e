"""A simulated arm of three STS3215 servos, and its LeRobot datasets in both formats."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from tauext.data.servo_types import SERVO_TYPES

FPS = 30
MOTORS = ("shoulder", "elbow", "wrist")
MOTOR = SERVO_TYPES["sts3215-7.4v"]
RANGES = ((900, 3100), (800, 3000), (1000, 3300))
DUTY_PER_RAD = MOTOR.gain * MOTOR.duty_per_rad
STEPS = 12
INERTIA, COULOMB_NM = np.array([0.06, 0.04, 0.02]), np.array([0.20, 0.18, 0.15])

ARM = """
[robot]
joints = ["shoulder", "elbow", "wrist"]
[signals.q]
columns = "observation.state[{joint}.pos]"
unit = "UNIT"
[signals.q_des]
columns = "goal[{joint}.pos]"
unit = "UNIT"
[servo]
type = "sts3215-7.4v"
torque_from = "goal"
goal_delay_s = 0
"""


def calibration() -> dict:
    """As LeRobot writes it."""
    return {
        name: {"id": k + 1, "drive_mode": int(name == "elbow"), "homing_offset": 0, "range_min": low, "range_max": high}
        for k, (name, (low, high)) in enumerate(zip(MOTORS, RANGES, strict=True))
    }


class Units:
    """Values of LeRobot for counts of the servos, and back, as its Feetech bus has them."""

    def __init__(self, unit: str):
        self.unit = unit
        self.low, self.high = np.array(RANGES, dtype=float).T

    def of_counts(self, counts: np.ndarray) -> np.ndarray:
        if self.unit == "deg":
            return (counts - (self.low + self.high) / 2) * 360 / 4095
        normal = (np.clip(counts, self.low, self.high) - self.low) / (self.high - self.low) * 200 - 100
        return normal * np.array([1, -1, 1])

    def counts(self, values: np.ndarray) -> np.ndarray:
        if self.unit == "deg":
            return np.trunc(values * 4095 / 360 + (self.low + self.high) / 2)
        values = np.clip(values * np.array([1, -1, 1]), -100, 100)
        return np.trunc((values + 100) / 200 * (self.high - self.low) + self.low)


class ServoArm:
    """Arms of three joints that follow goals, (arms, 3): controller, motor, friction; a wall may stand in the way."""

    def __init__(self, unit: str = "deg", count: int = 1):
        self.units = Units(unit)
        self.q, self.dq, self.goal = np.zeros((3, count, 3))
        self.middle = (self.units.low + self.units.high) / 2
        self.wall: np.ndarray | None = None
        """The first joint's angle beyond which it is stopped."""

    def counts(self) -> np.ndarray:
        return np.round(self.q * 4096 / (2 * np.pi) + self.middle)

    def state(self) -> np.ndarray:
        """As LeRobot reports it."""
        return self.units.of_counts(self.counts())

    def send(self, action: np.ndarray) -> None:
        self.goal = (self.units.counts(action) - self.middle) * 2 * np.pi / 4096

    def run(self, seconds: float = 1 / FPS) -> None:
        dt = seconds / STEPS
        for _ in range(STEPS):
            duty = np.clip(DUTY_PER_RAD * (self.goal - self.q), -MOTOR.most_duty, MOTOR.most_duty)
            tau = MOTOR.nm_per_ampere * (MOTOR.volts * duty - MOTOR.back_emf_v_s * self.dq) / MOTOR.ohm
            if self.wall is not None:
                tau[:, 0] -= 40.0 * np.maximum(0.0, self.q[:, 0] - self.wall)
            free = self.dq + dt * tau / INERTIA
            slow = dt * COULOMB_NM / INERTIA
            self.dq = np.sign(free) * np.maximum(np.abs(free) - slow, 0.0)
            self.q = self.q + dt * self.dq


class Demonstration:
    """What a person commands: sums of slow sines, differing from episode to episode."""

    def __init__(self, seed: int, units: Units):
        rng = np.random.default_rng(seed)
        self._size, self._phase = rng.uniform(0.1, 0.3, (4, 3)), rng.uniform(0, 6.28, (4, 3))
        self._omega = rng.uniform(0.3, 2.5, (4, 3))
        self._units = units

    def action(self, t: float) -> np.ndarray:
        q = (self._size * np.sin(self._omega * t + self._phase)).sum(0)
        return self._units.of_counts(q * 4096 / (2 * np.pi) + (self._units.low + self._units.high) / 2)


def episodes(seeds: range, frames: int, unit: str = "deg", wall: bool = False) -> list[tuple[np.ndarray, np.ndarray]]:
    """state and action (frames, 3) float32 of each; with a wall, the first joint meets one halfway."""
    arm = ServoArm(unit, len(seeds))
    people = [Demonstration(seed, arm.units) for seed in seeds]
    arm.send(np.array([person.action(0.0) for person in people]))
    arm.q = arm.goal.copy()
    states, actions = [], []
    for k in range(frames):
        if wall and k == frames // 2:
            arm.wall = arm.q[:, 0] - 0.02
        states.append(arm.state().astype(np.float32))
        actions.append(np.array([person.action(k / FPS) for person in people]).astype(np.float32))
        arm.send(actions[-1].astype(np.float64))
        arm.run()
    together = zip(np.stack(states, axis=1), np.stack(actions, axis=1), strict=True)
    return [(np.ascontiguousarray(state), np.ascontiguousarray(action)) for state, action in together]


def six_joints(seeds: range, frames: int, wall: bool = False) -> list[tuple[np.ndarray, np.ndarray]]:
    """Episodes of an arm with the joints of an SO-101: those of two arms of three joints, side by side."""
    both = episodes(seeds, frames, wall=wall), episodes(range(seeds.start + 1000, seeds.stop + 1000), frames)
    return [tuple(np.hstack(pair) for pair in zip(*two, strict=True)) for two in zip(*both, strict=True)]


def write_dataset(
    folder: Path,
    episodes: list[tuple[np.ndarray, np.ndarray]],
    version: str,
    split_at: int = 2,
    motors: tuple[str, ...] = MOTORS,
) -> Path:
    """A dataset as lerobot writes it: v3.0 with several episodes a file, v2.1 with a file an episode; and a video."""
    (folder / "meta").mkdir(parents=True)
    names = [f"{name}.pos" for name in motors]
    width = len(motors)
    features = {
        name: {"dtype": "float32", "shape": [width], "names": names} for name in ("action", "observation.state")
    } | {
        name: {"dtype": kind, "shape": [1], "names": None}
        for name, kind in (("timestamp", "float32"), ("frame_index", "int64"), ("episode_index", "int64"),
                           ("index", "int64"), ("task_index", "int64"))
    }  # fmt: skip
    hf = {
        name: {"feature": {"dtype": "float32", "_type": "Value"}, "length": width, "_type": "Sequence"}
        if f["names"] else {"dtype": f["dtype"], "_type": "Value"}
        for name, f in features.items()
    }  # fmt: skip
    features["observation.images.top"] = {
        "dtype": "video",
        "shape": [4, 4, 3],
        "names": ["height", "width", "channels"],
    }
    tables, stats, first = [], [], 0
    for number, (state, action) in enumerate(episodes):
        frame = np.arange(len(state))
        fixed = {"action": action, "observation.state": state}
        columns = {k: pa.FixedSizeListArray.from_arrays(pa.array(v.ravel()), width) for k, v in fixed.items()}
        columns |= {"timestamp": pa.array((frame / FPS).astype(np.float32)), "frame_index": pa.array(frame)}
        columns |= {"episode_index": pa.array(np.full(len(frame), number)), "index": pa.array(first + frame)}
        columns["task_index"] = pa.array(np.zeros(len(frame), dtype=np.int64))
        tables.append(
            pa.table(columns).replace_schema_metadata({"huggingface": json.dumps({"info": {"features": hf}})})
        )
        stats.append({k: _stats(np.asarray(v).reshape(len(frame), -1)) for k, v in fixed.items()})
        stats[-1]["timestamp"] = _stats((frame / FPS).reshape(-1, 1))
        first += len(frame)
    total = {
        key: _stats(np.concatenate([e[k] for e in episodes])) for k, key in enumerate(("observation.state", "action"))
    }
    info = {"codebase_version": version, "robot_type": "so101_follower", "total_episodes": len(episodes),
            "total_frames": first, "total_tasks": 1, "chunks_size": 1000, "fps": FPS, "features": features}  # fmt: skip
    if version == "v3.0":
        _write_v3(folder, tables, stats, total, split_at)
        info["data_path"] = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
        video = folder / "videos/observation.images.top/chunk-000/file-000.mp4"
    else:
        _write_v2(folder, tables, stats)
        info["data_path"] = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
        video = folder / "videos/chunk-000/observation.images.top/episode_000000.mp4"
    (folder / "meta/info.json").write_text(json.dumps(info))
    video.parent.mkdir(parents=True)
    video.write_bytes(b"not really a video")
    return folder


def _stats(values: np.ndarray) -> dict[str, list]:
    named = {"min": values.min(0), "max": values.max(0), "mean": values.mean(0), "std": values.std(0)}
    return {key: value.tolist() for key, value in named.items()} | {"count": [len(values)]}


def _write_v3(folder: Path, tables: list[pa.Table], stats: list[dict], total: dict, split_at: int) -> None:
    (folder / "data/chunk-000").mkdir(parents=True)
    (folder / "meta/episodes/chunk-000").mkdir(parents=True)
    for file, part in enumerate((tables[:split_at], tables[split_at:])):
        if part:
            pq.write_table(pa.concat_tables(part), folder / f"data/chunk-000/file-{file:03d}.parquet")
    rows = []
    for number, table in enumerate(tables):
        row = {"episode_index": number, "tasks": ["follow"], "length": len(table), "data/chunk_index": 0,
               "data/file_index": int(number >= split_at)}  # fmt: skip
        row |= {f"stats/{name}/{key}": value for name, kinds in stats[number].items() for key, value in kinds.items()}
        rows.append(row)
    pq.write_table(pa.Table.from_pylist(rows), folder / "meta/episodes/chunk-000/file-000.parquet")
    (folder / "meta/stats.json").write_text(json.dumps(total))


def _write_v2(folder: Path, tables: list[pa.Table], stats: list[dict]) -> None:
    (folder / "data/chunk-000").mkdir(parents=True)
    for number, table in enumerate(tables):
        pq.write_table(table, folder / f"data/chunk-000/episode_{number:06d}.parquet")
    lines = [{"episode_index": k, "tasks": ["follow"], "length": len(table)} for k, table in enumerate(tables)]
    (folder / "meta/episodes.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    lines = [{"episode_index": k, "stats": one} for k, one in enumerate(stats)]
    (folder / "meta/episodes_stats.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    (folder / "meta/tasks.jsonl").write_text(json.dumps({"task_index": 0, "task": "follow"}) + "\n")
