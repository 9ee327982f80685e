"""One sliding mass: its recordings, a bundle of its plain observer, and made-up estimates."""

import json

import numpy as np
from made_arms import prismatic_mass

from tauext import _core
from tauext.bundle.estimates import COLLISION, OK, WARMING_UP, Estimates
from tauext.config import ObserverConfig
from tauext.data.recording import Recording
from tauext.fit.bundle_writing import build_setup, make_bundle

MASS = 2.0


def recording(name: str = "made", samples: int = 3000, **changes) -> Recording:
    """One sliding mass at rest."""
    zeros = np.zeros((samples, 1))
    content = {
        "name": name,
        "joints": ("slide",),
        "t_ns": np.arange(samples, dtype=np.int64) * 1_000_000,
        "q": zeros,
        "dq": zeros,
        "tau": zeros,
        "rate_hz": 1000.0,
        "torque_timing": "held",
        "source": "test",
        "robot_sha256": "",
    }
    return Recording(**(content | changes))


def travelled(dq: np.ndarray) -> np.ndarray:
    """Positions to these velocities at 1 kHz: an encoder that stands still would be a fault."""
    return np.cumsum(dq, axis=0) * 1e-3


def pushed(name: str, force: float, begin: int = 1000, end: int = 1400, samples: int = 3000) -> Recording:
    """The mass pushed by a constant force between two samples, and what an ideal sensor says of it."""
    push = np.zeros((samples, 1))
    push[begin:end] = force
    dq = np.vstack([[0.0], np.cumsum(push[:-1], axis=0)]) * 1e-3 / MASS
    a = np.exp(-0.02)
    sensor = np.zeros_like(push)
    for k in range(1, samples):
        sensor[k] = a * sensor[k - 1] + (1 - a) * push[k - 1]
    contact = (push[:, 0] != 0).astype(np.int8)
    return recording(
        name,
        samples,
        q=travelled(dq),
        dq=dq,
        tau_ext=push,
        tau_ext_sensor=sensor,
        contact=contact,
        contact_link=contact - 1,
    )


def observer_bundle(limit_nm: float = 2.0, gain_per_s: float = 20.0) -> _core.Bundle:
    made = recording()
    setup = build_setup(prismatic_mass(MASS), made, ObserverConfig(gain_per_s=gain_per_s))
    bundle = make_bundle("observer", setup, 0.02, made)
    bundle.sliding_limit_nm = bundle.near_stiction_limit_nm = [limit_nm]
    bundle.provenance = json.dumps({"recipe": "observer", "steps": 0})
    return bundle


def estimates_of(tau_ext: np.ndarray, limit: float, warm_from: int = 0) -> Estimates:
    tau_ext = np.asarray(tau_ext, dtype=np.float32).reshape(-1, 1)
    healthy = np.arange(len(tau_ext)) >= warm_from
    zeros = np.zeros_like(tau_ext)
    return Estimates(
        joints=("slide",),
        t_ns=np.arange(len(tau_ext), dtype=np.int64) * 1_000_000,
        residual=tau_ext,
        network=zeros,
        tau_ext=tau_ext,
        limit_nm=zeros + np.float32(limit),
        near_stiction=np.arange(len(tau_ext))[:, None] % 2 == 0,
        health=np.where(healthy, OK, WARMING_UP).astype(np.int8),
        causes=np.zeros(len(tau_ext), np.uint32),
        detection=(over := healthy & (np.abs(tau_ext[:, 0]) > limit)),
        held_alarm=np.where(over, COLLISION, 0).astype(np.int8),
        touch=np.zeros(len(tau_ext), np.int8),
    )


def noisy(name: str, seed: int, samples: int = 20_000, force: float = 0.0) -> Recording:
    """The mass in coloured noise, which the observer takes for external torque; pushed every 3 s, ever harder."""
    rng = np.random.default_rng(seed)
    disturbance = np.repeat(rng.normal(0, 1, samples // 100), 100)[:, None] * 2
    push = np.zeros((samples, 1))
    for k, begin in enumerate(range(2000, samples - 1000, 3000)):
        push[begin : begin + 250] = force * (k + 1) / 3
    contact = (push[:, 0] != 0).astype(np.int8)
    dq = np.vstack([[0.0], np.cumsum((push + disturbance)[:-1], axis=0)]) * 1e-3 / MASS
    return recording(name, samples, q=travelled(dq), dq=dq, tau_ext=push, contact=contact, contact_link=contact - 1)
