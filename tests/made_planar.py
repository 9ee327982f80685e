"""Recordings and datasets of the planar arm with friction, and settings that fit it in seconds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from made_arms import PLANAR_MJCF, planar_torque

from tauext.config import ObserverConfig, PriorConfig, TrainConfig
from tauext.data.dataset import Split, save_split
from tauext.data.recording import Recording
from tauext.data.recording_file import save_recording

RATE_HZ = 125.0
COULOMB_NM, VISCOUS, NOISE_NM = 3.0, 2.0, 0.2
CONFIG = TrainConfig(
    recipe="prior",
    threads=1,
    observer=ObserverConfig(gain_per_s=20.0),
    prior=PriorConfig(widths_rad=(3e-3,), coulomb_speeds_rad_s=(0.03, 0.1), most_ripples=0),
)
"""Few terms, so that a fit takes seconds."""


def moving(seed: int, seconds: float, friction: tuple[float, float], name: str = "made", **changes) -> Recording:
    """Two joints on a way of many sines, with friction of each by that of the type."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    speeds, phases = rng.uniform(0.2, 2.0, (2, 6)), rng.uniform(0, 6, (2, 6))
    angle = t[:, None, None] * speeds + phases
    q, dq = 0.4 * np.sin(angle).sum(axis=2), 0.4 * (speeds * np.cos(angle)).sum(axis=2)
    torque = planar_torque(q, dq) + np.array(friction) * (COULOMB_NM * np.tanh(dq / 0.03) + VISCOUS * dq)
    torque += NOISE_NM * rng.normal(size=q.shape)
    named = {"name": name, "joints": ("shoulder", "elbow"), "t_ns": np.arange(len(t), dtype=np.int64) * 8_000_000}
    meta = {"rate_hz": RATE_HZ, "torque_timing": "averaged", "source": "test", "robot_sha256": ""}
    return Recording(**(named | {"q": q, "dq": dq, "tau": torque} | meta | changes))


def dataset(folder: Path, *recordings: Recording) -> Path:
    """A dataset folder whose training recordings these are."""
    folder.mkdir(parents=True)
    (folder / "robot.xml").write_text(PLANAR_MJCF)
    for recording in recordings:
        save_recording(recording, folder / f"{recording.name}.parquet")
    save_split(Split(tuple(f"{recording.name}.parquet" for recording in recordings), (), ()), folder)
    return folder
