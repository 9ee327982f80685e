"""The virtual rig with something at its tip: recordings and datasets as of the other arms of the weighing trial."""

from __future__ import annotations

import hashlib
import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path

import mujoco
import numpy as np
from unseen.arms import with_ball

from tauext import _core
from tauext.data.dataset import Split, save_split
from tauext.data.recording import Recording
from tauext.data.recording_file import save_recording
from tauext.data.servo import FROM_AMPERES
from tauext.monitor.weighing import NamedFrame
from tauext.sim.collect import SETTLE_S
from tauext.sim.config import RigConfig
from tauext.sim.rig import arm_xml, build_scene, draw_motion, joint_names, measure, roll_out
from weighing.takes import FARTHEST_M, FIRST_S, KNOWN_KG, KNOWN_S, LOADS, PUSHES, TRAIN, WINDOW_S, WINDOWS, Carried

PLANE = (0, 2)
"""Axes of the tip's frame in which the arm moves: nothing tells where a load is across them."""
MJCF_AXES = (1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0)
"""Of the robot file's body in the frame of its link, z of which is along the joint's axis, +y: row by row."""
SIDEWAYS = 0.3
"""Most of a push's direction that is along gravity: that would be a load."""


def tip() -> NamedFrame:
    """The end of the last link, axes as in the robot file."""
    links = RigConfig().links
    return NamedFrame(_core.LoadFrame(len(links) - 1, list(MJCF_AXES), [0.0, -links[-1].length_m, 0.0]), "the tip")


def rig_carried(seed: int) -> dict[str, Carried]:
    """As `carried` of the other arms, in the tip's frame; centres and forces lie in the plane of motion."""
    rng = np.random.default_rng([seed, 500])
    takes = {}
    for k in range(LOADS):
        com = in_plane(rng) * rng.uniform(0, FARTHEST_M)
        mass, radius = float(rng.uniform(0.5, 3.0)), float(rng.uniform(0.02, 0.06))
        takes[f"load-{k:02d}"] = Carried(mass, tuple(com.tolist()), radius)
    takes["known"] = Carried(KNOWN_KG, tuple((in_plane(rng) * 0.06).tolist()))
    for k in range(PUSHES):
        across = np.array([rng.choice([-1.0, 1.0]), 0.0, rng.uniform(-SIDEWAYS, SIDEWAYS)])
        across /= np.linalg.norm(across)
        takes[f"push-{k}"] = Carried(0.0, (0.0, 0.0, 0.0), 0.0, float(rng.uniform(10, 40)), tuple(across.tolist()))
    return takes


def in_plane(rng: np.random.Generator) -> np.ndarray:
    x, z = rng.standard_normal(2)
    return np.array([x, 0.0, z]) / np.hypot(x, z)


def make_rig(folder: Path, seed: int, wrong: dict[str, np.ndarray]) -> None:
    """Write a dataset for each kind of constants, its torques times what the constants are wrong by."""
    carried = rig_carried(seed)
    takes: dict[str, tuple[float, Carried | None]] = {take.name: (60 * take.minutes, None) for take in TRAIN}
    for name, what in carried.items():
        takes[name] = (KNOWN_S if name == "known" else FIRST_S + WINDOWS * WINDOW_S + 0.1, what)
    missing = [kind for kind in wrong if not (folder / f"data-{kind}" / "split.json").exists()]
    if not missing:
        return
    (folder / "csv").mkdir(parents=True, exist_ok=True)
    with ThreadPoolExecutor() as pool:
        made = list(pool.map(lambda k: record(seed, k, *takes[list(takes)[k]]), range(len(takes))))
    for kind in missing:
        data = folder / f"data-{kind}"
        data.mkdir(parents=True, exist_ok=True)
        robot = arm_xml(RigConfig())
        (data / "robot.xml").write_text(robot)
        for name, signals in zip(takes, made, strict=True):
            save_recording(as_recording(name, signals, wrong[kind], robot), data / f"{name}.parquet")
        train = tuple(f"{take.name}.parquet" for take in TRAIN)
        save_split(Split(train, (), tuple(f"{name}.parquet" for name in carried)), data)
    for name, what in carried.items():
        (folder / "csv" / f"{name}.truth.json").write_text(json.dumps(asdict(what)) + "\n")


def record(seed: int, number: int, seconds: float, what: Carried | None) -> dict[str, np.ndarray]:
    """Measured signals of the rig on a motion of its own, with what it carries or what pushes its tip."""
    config = RigConfig()
    moving, measuring = (np.random.default_rng([seed, 600, number, k]) for k in range(2))
    settle = round(SETTLE_S * config.rate_hz)
    q_des, dq_des = draw_motion(
        config.motion, len(config.links), settle + round(seconds * config.rate_hz), config.rate_hz, moving
    )
    scene = build_scene(config, "pulses")
    if what is not None and what.mass_kg > 0:
        add_load(scene, config, what)
    push = np.zeros((len(q_des), 3 * len(config.links)))
    if what is not None and what.push_n > 0:
        push[:, -3:] = wrench_at_tip(config, q_des, what)
    drives = np.stack([q_des, dq_des], axis=2).reshape(len(q_des), -1)
    truth = roll_out(config, scene, q_des[0], np.hstack([drives, push])).after(settle)
    return measure(config, truth, np.zeros_like(truth.q), measuring)


def add_load(scene: mujoco.MjModel, config: RigConfig, what: Carried) -> None:
    """Fix a ball to the last link."""
    body = scene.body(f"link{len(config.links)}").id
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, scene.body_iquat[body])
    own_m, mass_kg, load_kg = scene.body_ipos[body].copy(), float(scene.body_mass[body]), what.mass_kg
    load_m = np.array(what.com_m) + [0.0, 0.0, config.links[-1].length_m]
    inertia = turn.reshape(3, 3) @ np.diag(scene.body_inertia[body]) @ turn.reshape(3, 3).T
    both_kg, both_m, inertia = with_ball(mass_kg, own_m, inertia, load_kg, load_m, what.radius_m)
    sizes, axes = np.linalg.eigh(inertia)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, axes.ravel())
    scene.body_mass[body], scene.body_ipos[body] = both_kg, both_m
    scene.body_inertia[body], scene.body_iquat[body] = sizes, quat
    mujoco.mj_setConst(scene, mujoco.MjData(scene))


def wrench_at_tip(config: RigConfig, q_des: np.ndarray, what: Carried) -> np.ndarray:
    """Of a force along a direction of the base: fx, fz and torque about +y in the last link's frame, (samples, 3).

    The drives keep the arm within milliradians of its setpoints, so these turn the force.
    """
    angle = q_des.sum(axis=1)
    x, z = what.push_n * what.direction[0], what.push_n * what.direction[2]
    along_x, along_z = np.cos(angle) * x - np.sin(angle) * z, np.sin(angle) * x + np.cos(angle) * z
    return np.stack([along_x, along_z, config.links[-1].length_m * along_x], axis=1)


def as_recording(name: str, signals: dict[str, np.ndarray], wrong: np.ndarray, robot: str) -> Recording:
    """With torques as a controller logs them that believes in wrong constants."""
    config = RigConfig()
    samples = len(signals["q"])
    return Recording(
        name=name,
        joints=tuple(joint_names(config)),
        t_ns=np.arange(samples, dtype=np.int64) * round(1e9 / config.rate_hz),
        q=signals["q"],
        dq=signals["dq"],
        tau=signals["tau"] * wrong,
        contact=np.zeros(samples, dtype=np.int8),
        rate_hz=float(config.rate_hz),
        torque_timing="held",
        source=f"virtual rig {config.name}",
        robot_sha256=hashlib.sha256(robot.encode()).hexdigest(),
        provenance={"torque": FROM_AMPERES},
    )
