"""Free motion of a demo arm, as its instruments record it: what its bundles are trained on."""

from __future__ import annotations

import hashlib

import numpy as np

from tauext.data.recording import Recording
from tauext.sim.arms import DemoArm
from tauext.sim.motions import draw_motion
from tauext.sim.recording import SETTLE_S
from tauext.sim.sensors import measure
from tauext.sim.simulate import roll_out


def practice_recording(arm: DemoArm, seconds: float, seed: int, number: int) -> Recording:
    """Recording `number` of the arm's free motion around its home; the same arguments give the same samples."""
    moving, measuring = (np.random.default_rng(s) for s in np.random.SeedSequence(seed, spawn_key=(number,)).spawn(2))
    settle, samples = round(SETTLE_S * arm.rate_hz), round(seconds * arm.rate_hz)
    q_des, dq_des = draw_motion(arm.motion, len(arm.joints), samples + settle, arm.rate_hz, moving)
    q_des += arm.home
    controls = np.stack([q_des, dq_des], axis=2).reshape(len(q_des), -1)
    truth = roll_out(arm, arm.model, q_des[0], controls).after(settle)
    measured = measure(arm, truth, np.zeros_like(truth.q), measuring)
    return Recording(
        name=f"practice-{number:03d}",
        joints=arm.joints,
        t_ns=np.arange(samples, dtype=np.int64) * round(1e9 / arm.rate_hz),
        **{signal: measured[signal] for signal in ("q", "dq", "tau")},
        rate_hz=float(arm.rate_hz),
        torque_timing="held",
        source=arm.title,
        robot_sha256=hashlib.sha256(arm.xml.encode()).hexdigest(),
        provenance={"seed": seed, "number": number},
    )
