"""One recording of the virtual rig, from its seed to its measured signals."""

import numpy as np

from tauext.data.recording import Recording
from tauext.sim.arm import joint_names
from tauext.sim.config import RigConfig
from tauext.sim.motions import draw_motion
from tauext.sim.pads import contact_torque, draw_pads
from tauext.sim.pulses import draw_pulses, pulse_torque
from tauext.sim.scene import Kind, build_scene
from tauext.sim.sensors import measure
from tauext.sim.simulate import Truth, roll_out

KINDS: tuple[Kind, ...] = ("free", "pulses", "pads")
SETTLE_S = 1.0
"""Cut off the front: the arm starts on its setpoint, without the sag and the friction it will have."""


def simulate_recording(
    config: RigConfig, kind: Kind, length_s: float, seed: int, number: int, robot_sha256: str = ""
) -> Recording:
    """Simulate recording `number` of its kind; the same arguments give the same samples, whatever else is simulated."""
    moving, touching, measuring = (
        np.random.default_rng(stream)
        for stream in np.random.SeedSequence(seed, spawn_key=(KINDS.index(kind), number)).spawn(3)
    )
    settle = round(SETTLE_S * config.rate_hz)
    samples = round(length_s * config.rate_hz)
    q_des, dq_des = draw_motion(config.motion, len(config.links), samples + settle, config.rate_hz, moving)
    truth, tau_ext, force = simulate_motion(config, kind, q_des, dq_des, settle, touching)
    measured = measure(config, truth, tau_ext, measuring)
    touched = np.asarray((force > 0.0).any(axis=1))
    return Recording(
        name=f"{kind}-{number:03d}",
        joints=tuple(joint_names(config)),
        t_ns=np.arange(samples, dtype=np.int64) * round(1e9 / config.rate_hz),
        **measured,
        tau_ext=tau_ext,
        q_des=q_des[settle:],
        contact=touched.astype(np.int8),
        contact_link=np.where(touched, force.argmax(axis=1), -1).astype(np.int8),
        rate_hz=float(config.rate_hz),
        torque_timing="held",
        source=f"virtual rig {config.name}",
        robot_sha256=robot_sha256,
        provenance={"contacts": "none" if kind == "free" else kind, "seed": seed, "number": number},
    )


def simulate_motion(
    config: RigConfig,
    kind: Kind,
    q_des: np.ndarray,
    dq_des: np.ndarray,
    settle: int,
    rng: np.random.Generator,
) -> tuple[Truth, np.ndarray, np.ndarray]:
    """What happens along these setpoints (samples, joints), the first `settle` samples cut off.

    Returns: true signals; true external torque (samples, joints), [N m]; force on each link (samples, links), [N].
    """
    drives = np.stack([q_des, dq_des], axis=2).reshape(len(q_des), -1)
    if kind == "pulses":
        pulses = np.zeros((len(q_des), 3 * len(config.links)))
        pulses[settle:] = draw_pulses(config, q_des[settle:], rng)
        truth = roll_out(config, build_scene(config, kind), q_des[0], np.hstack([drives, pulses])).after(settle)
        return truth, *pulse_torque(config, truth.q, pulses[settle:])
    free = roll_out(config, build_scene(config, "free"), q_des[0], drives)
    if kind == "free":
        truth = free.after(settle)
        return truth, np.zeros_like(truth.q), np.zeros_like(truth.q)
    pads = draw_pads(config, free.q, settle, rng)
    start = np.concatenate([q_des[0], pads[0, ::2]])
    truth = roll_out(config, build_scene(config, kind), start, np.hstack([drives, pads])).after(settle)
    return truth, *contact_torque(config, truth.q, truth.touch)
