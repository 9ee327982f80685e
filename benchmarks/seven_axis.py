"""A 7-axis arm in motion at 1 kHz, and a bundle of full size to watch it with: what loops are timed on."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tauext import _core
from tauext.config import ObserverConfig
from tauext.data.recording import Recording
from tauext.fit.bundle_writing import build_setup, make_bundle
from tauext.robot.read import load_tree

ARM = Path(__file__).parent / "seven_axis.urdf"
JOINTS = tuple(f"joint{j}" for j in range(1, 8))
HIDDEN = 20
LIMIT_NM = 1e6
"""No alarm is wanted."""


def motion(seconds: float, seed: int = 0) -> Recording:
    """Every joint swings by itself."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(seconds * 1000)) * 1e-3
    phase, speed = rng.uniform(0, 6, 7), rng.uniform(0.5, 2, 7)
    q, dq = np.sin(speed * t[:, None] + phase), speed * np.cos(speed * t[:, None] + phase)
    return Recording(
        name="swinging",
        joints=JOINTS,
        t_ns=np.round(t * 1e9).astype(np.int64),
        q=q,
        dq=dq,
        tau=5 * np.tanh(dq / 0.05) + 2 * dq,
        rate_hz=1000.0,
        torque_timing="instant",
        source="made",
        robot_sha256="",
    )


def bundle() -> _core.Bundle:
    """Windows of 100 steps, 20 hidden units, random weights: the arithmetic of a trained one."""
    made = motion(2.0)
    setup = build_setup(load_tree(ARM), made, ObserverConfig())
    made_bundle = make_bundle("seven axes", setup, 0.02, made)
    rng = np.random.default_rng(1)
    made_bundle.shape = _core.LstmShape(3 * 7, HIDDEN, 7)
    made_bundle.inputs = setup.inputs
    made_bundle.input_factors = [1.0] * 14
    made_bundle.parameters = rng.normal(0, 0.3, made_bundle.shape.parameter_count).astype(np.float32).tolist()
    made_bundle.output_scale_nm = [1.0] * 7
    for name in ("sliding_limit_nm", "near_stiction_limit_nm"):
        setattr(made_bundle, name, [LIMIT_NM] * 7)
        setattr(made_bundle, f"contact_{name}", [LIMIT_NM] * 7)
    made_bundle.set_reference(made.t_ns, made.q, made.dq, made.tau)
    return made_bundle
