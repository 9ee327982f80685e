"""A small fleet on disk: planar arms of one type whose friction differs, without a simulator."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from arms import PLANAR_MJCF, planar_arm

from tauext import _core
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
"""Few terms, so that a fleet takes seconds."""


def model_torque(q: np.ndarray, dq: np.ndarray) -> np.ndarray:
    """What the planar arm's drives exert without friction: the observer's r, fast enough to be the torque itself."""
    t_ns = np.arange(len(q), dtype=np.int64) * 8_000_000
    fast = _core.ObserverSettings(
        gain_per_s=1e4, timing=_core.TorqueTiming.averaged, sample_period_ns=8_000_000, network_stride=1
    )
    return _core.observe(planar_arm(), fast, t_ns, q, dq, np.zeros_like(q)).residual


def moving(seed: int, seconds: float, friction: tuple[float, float], name: str = "made", **changes) -> Recording:
    """Two joints on a way of many sines, with friction of each by that of the type."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    speeds, phases = rng.uniform(0.2, 2.0, (2, 6)), rng.uniform(0, 6, (2, 6))
    angle = t[:, None, None] * speeds + phases
    q, dq = 0.4 * np.sin(angle).sum(axis=2), 0.4 * (speeds * np.cos(angle)).sum(axis=2)
    torque = model_torque(q, dq) + np.array(friction) * (COULOMB_NM * np.tanh(dq / 0.03) + VISCOUS * dq)
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


FRICTION = ((1.0, 0.9), (0.8, 1.1), (1.2, 1.0), (0.9, 1.2), (1.1, 0.8), (1.0, 3.0))
"""Of each arm's joints by that of the type; the last arm's elbow is the odd one."""


def fleet(folder: Path) -> list[Path]:
    """Datasets of two minutes and a half each."""
    return [dataset(folder / f"arm-{k}" / "data", moving(k, 150.0, one)) for k, one in enumerate(FRICTION)]
