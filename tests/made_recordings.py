"""Recordings: free motion of an arm whose every torque is known, and small bags of JointState messages."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tauext import _core
from tauext.data.recording import Recording

ENCODER_RAD = 2 * np.pi / 2**20
VELOCITY_RAD_S = 300.0  # cut-off of the drives' velocity filters
NOISE = 0.01  # of the torque, as a share of its spread
JOINT_STATES = """
[signals]
q.columns = "position"
dq.columns = "velocity"
tau.columns = "effort"
"""
"""Signals of an arm's description, as JointState messages hold them."""


@dataclass(frozen=True)
class Drive:
    """What arms differ in beside their links."""

    friction: float = 1.0
    """Times a tenth to a third of each joint's torque."""
    load: float = 0.0
    """Coulomb friction that gravity on the gear adds, Nm per Nm."""
    presliding_rad: float = 0.0
    """Travel in which friction turns round (Dahl), so that an arm at rest keeps its own; 0: by speed alone."""
    warming: float = 0.0
    """Share of the friction that is gone after WARM_S."""
    noise: float = NOISE
    """Of the torque, as a share of its spread."""
    velocity_filter_s: float = 1 / VELOCITY_RAD_S
    profile: str = "quintic"
    """quintic or trapezoid: speed over a move."""
    pause_s: float = 0.3
    """The longest between two moves."""
    nm_per_a: tuple[float, ...] | None = None
    """Torque constants at the joint: the effort is a current; None: a torque."""
    step: float = 0.0
    """Of the effort, [A or Nm]; 0: none."""


WARM_S = 600.0


@dataclass(frozen=True)
class Made:
    """Recordings of one arm, and the parts of their torques (samples, joints) [N m]."""

    recordings: list[Recording]
    gravity: list[np.ndarray]
    friction: list[np.ndarray]


def made_motion(
    tree: _core.Tree,
    minutes: float,
    rate_hz: float = 100.0,
    seed: int = 0,
    pieces: int = 4,
    ranges: np.ndarray | float = 1.5,
    still: int | None = None,
    drive: Drive = Drive(),
) -> Made:
    """Moves between random poses, with friction of a tenth to a third of each joint's torque.

    Args:
        ranges: of the poses, rad to either side.
        still: joint that keeps its place.
    """
    rng = np.random.default_rng(seed)
    names = tuple(link.joint_name for link in tree.links)
    reach = np.full(tree.size, ranges, dtype=float)
    if still is not None:
        reach[still] = 0.02
    _, weight = tree.momentum(rng.uniform(-1, 1, (300, tree.size)) * 1.5, np.zeros((300, tree.size)))
    size = 0.2 * weight.std(axis=0) + 0.02 * weight.std(axis=0).max() + 0.3
    recordings, gravities, frictions = [], [], []
    for piece in range(pieces):
        fine = max(1, round(500 / rate_hz))
        q = _moves(rng, round(minutes * 60 * rate_hz / pieces) * fine, rate_hz * fine, reach, drive)
        dq = np.gradient(q, 1 / (rate_hz * fine), axis=0)
        momentum, beta = tree.momentum(q, dq)
        torque = np.gradient(momentum, 1 / (rate_hz * fine), axis=0) + beta
        gravity = tree.momentum(q, np.zeros_like(q))[1]
        way = _dahl(q, drive.presliding_rad) if drive.presliding_rad else np.tanh(dq / 0.02)
        friction = drive.friction * size * (way + 0.8 * dq) + drive.load * np.abs(gravity) * way
        if drive.warming:
            at_s = 60 * minutes * piece / pieces + np.arange(len(q))[:, None] / (rate_hz * fine)
            friction *= 1 - drive.warming * np.minimum(1, at_s / WARM_S)
        tau = torque + friction + drive.noise * (torque + friction).std(axis=0) * rng.standard_normal(q.shape)
        if drive.nm_per_a is not None:
            tau = tau / np.resize(drive.nm_per_a, tree.size)
        if drive.step:
            tau = np.round(tau / drive.step) * drive.step
        encoder = np.round(q / ENCODER_RAD) * ENCODER_RAD
        velocity = np.gradient(encoder, 1 / (rate_hz * fine), axis=0)
        if drive.velocity_filter_s:
            velocity = _filtered(velocity, 1 / drive.velocity_filter_s / (rate_hz * fine))
        keep = slice(0, None, fine)
        recordings.append(
            Recording(
                name=f"free-{piece}",
                joints=names,
                t_ns=np.arange(len(q[keep]), dtype=np.int64) * round(1e9 / rate_hz),
                q=encoder[keep],
                dq=velocity[keep] + 1e-4 * rng.standard_normal(q[keep].shape),
                tau=tau[keep],
                contact=np.zeros(len(q[keep]), dtype=np.int8),
                rate_hz=rate_hz,
                torque_timing="instant",
                source="made",
                robot_sha256="",
                provenance={"contacts": "none"},
            )
        )
        gravities.append(gravity[keep]), frictions.append(friction[keep])
    return Made(recordings, gravities, frictions)


def _moves(rng: np.random.Generator, samples: int, rate_hz: float, reach: np.ndarray, drive: Drive) -> np.ndarray:
    parts, length, here = [], 0, np.zeros(len(reach))
    while length < samples:
        there = rng.uniform(-reach, reach)
        seconds = max(0.5, float(np.abs(there - here).max()) / rng.uniform(0.4, 1.2))
        x = np.linspace(0, 1, round(seconds * rate_hz))[:, None]
        parts += [here + (there - here) * (_trapezoid(x) if drive.profile == "trapezoid" else _quintic(x))]
        parts += [np.repeat(there[None], round(rng.uniform(0, drive.pause_s) * rate_hz), axis=0)]
        length, here = length + len(parts[-1]) + len(parts[-2]), there
    return np.concatenate(parts)[:samples]


def _quintic(x: np.ndarray) -> np.ndarray:
    return 10 * x**3 - 15 * x**4 + 6 * x**5


def _trapezoid(x: np.ndarray, rise: float = 0.25) -> np.ndarray:
    """Way over time of a speed that rises for a quarter, holds, and falls for a quarter."""
    top = 1 / (1 - rise)
    late = 1 - np.minimum(1 - x, rise) ** 2 * top / (2 * rise)
    return np.where(x < rise, top * x**2 / (2 * rise), np.where(x > 1 - rise, late, top * (x - rise / 2)))


def _dahl(q: np.ndarray, width: float) -> np.ndarray:
    """Friction in -1 to 1 that turns round over `width` of travel [rad], and stays where the joint stands."""
    way, z = np.zeros_like(q), np.zeros(q.shape[1])
    for k, step in enumerate(np.diff(q, axis=0), start=1):
        z = np.clip(z + step / width * (1 - np.sign(step) * z), -1, 1)
        way[k] = z
    return way


def _filtered(x: np.ndarray, share: float) -> np.ndarray:
    from scipy.signal import lfilter

    a = np.exp(-share)
    return lfilter([1 - a], [1, -a], x, axis=0, zi=a * x[:1])[0]


JOINTS = ("base", "Wrist 1", "tip")


def motion(samples: int = 400, rate_hz: float = 100.0, joints: int = 3) -> tuple[np.ndarray, ...]:
    """Stamps [ns], q, dq and tau of a smooth motion; no two rows are equal."""
    t_ns = 10**18 + np.round(np.arange(samples) * 1e9 / rate_hz).astype(np.int64)
    time_s = np.arange(samples)[:, None] / rate_hz
    phase = np.arange(joints)
    return (
        t_ns,
        np.sin(time_s + phase),
        np.cos(time_s + phase),
        3 * np.sin(2 * time_s + phase) + 0.1 * np.sin(2**0.5 * time_s),
    )


def smooth_motion(seed: int, samples: int) -> tuple[np.ndarray, ...]:
    """Positions, velocities and friction's torques of two joints at 1 kHz."""
    rng = np.random.default_rng(seed)
    phase, speed = rng.uniform(0, 6, 2), rng.uniform(1, 3, 2)
    angle = speed * (np.arange(samples) * 1e-3)[:, None] + phase
    dq = speed * np.cos(angle)
    return np.sin(angle), dq, 5 * np.tanh(dq / 0.05) + 2 * dq


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
