"""A moving arm that is pushed at known times, and a bundle to watch it with: what a replay should find is known.

The bundle has no model, so its observer shows minus the low-passed torque: a torque pulse of -F looks like a push of F.
"""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
from arms import no_model, planar_arm

from tauext import _core
from tauext.config import ObserverConfig
from tauext.data.recording import Recording
from tauext.fit.bundle_writing import build_setup, make_bundle

JOINTS = ("shoulder", "elbow")
LIMIT_NM = 2.0
PUSHES = ((2.0, 0, 12.0), (3.6, 1, -9.0))  # s, joint, N m


def pushed(
    name: str = "pushed",
    seconds: float = 6.0,
    pushes: tuple[tuple[float, int, float], ...] = PUSHES,
    length_s: float = 0.3,
    **changes,
) -> Recording:
    """Two joints that swing; each push lasts length_s."""
    t = np.arange(round(seconds * 1000)) * 1e-3
    phase, speed = np.array([0.3, 1.9]), np.array([1.1, 2.3])
    tau = np.zeros((len(t), 2))
    for start_s, joint, push_nm in pushes:
        tau[(t >= start_s) & (t < start_s + length_s), joint] = -push_nm
    content = {
        "name": name,
        "joints": JOINTS,
        "t_ns": 7_000_000_000 + np.round(t * 1e9).astype(np.int64),
        "q": np.sin(speed * t[:, None] + phase),
        "dq": speed * np.cos(speed * t[:, None] + phase),
        "tau": tau,
        "rate_hz": 1000.0,
        "torque_timing": "held",
        "source": "test",
        "robot_sha256": "5" * 64,
    }
    return Recording(**(content | changes))


def watching_bundle(network: bool = True, hold_s: float = 0.005, contact_nm: float = LIMIT_NM / 2) -> _core.Bundle:
    """Limits of 2 Nm sliding and 3 near stiction; the network is random and small, its window a tenth of a second."""
    made = pushed(pushes=())
    setup = build_setup(no_model(planar_arm()), made, ObserverConfig(window_s=0.1))
    bundle = make_bundle("watching", setup, 0.02, made)
    if network:
        rng = np.random.default_rng(3)
        bundle.shape = _core.LstmShape(6, 4, 2)
        bundle.inputs = setup.inputs
        bundle.input_factors = [1.0, 1.0, 0.5, 0.5]
        bundle.parameters = rng.normal(0, 0.4, bundle.shape.parameter_count).astype(np.float32).tolist()
        bundle.output_scale_nm = [0.5, 0.5]
    bundle.sliding_limit_nm, bundle.near_stiction_limit_nm = [LIMIT_NM] * 2, [1.5 * LIMIT_NM] * 2
    bundle.contact_sliding_limit_nm, bundle.contact_near_stiction_limit_nm = [contact_nm] * 2, [1.5 * contact_nm] * 2
    bundle.hold_s, bundle.contact_hold_s, bundle.contact_release_s = hold_s, 0.0, 0.05
    first = slice(0, 1000)
    bundle.set_reference(*(np.ascontiguousarray(a[first]) for a in (made.t_ns, made.q, made.dq, made.tau)))
    return bundle


def damaged(recording: Recording, **signals: np.ndarray) -> SimpleNamespace:
    """The recording's fields with other arrays, unchecked: NaN and late samples as a bad cable sends them."""
    keep = ("name", "joints", "t_ns", "q", "dq", "tau", "rate_hz", "torque_timing", "robot_sha256")
    return SimpleNamespace(**{name: getattr(recording, name) for name in keep} | signals)


def cut_flight(bundle: _core.Bundle, samples, row: int, before: int = 1000, after: int = 500) -> dict:
    """A flight around this row as the core's recorder hands it over, put together from a run over all samples."""
    arrays = (samples.t_ns, samples.q, samples.dq, samples.tau)
    said = _core.Monitor(bundle).run(*arrays)
    monitor = _core.Monitor(bundle)
    monitor.run(*(signal[: row + 1] for signal in arrays))
    first = max(0, row - before)
    rows = slice(first, row + after + 1)
    flight = {name: getattr(samples, name)[rows] for name in ("t_ns", "q", "dq", "tau")}
    torques = ("residual", "prior", "network", "drift", "tau_ext", "load_nm", "sigma_nm", "contact_sigma_nm")
    torques += ("limit_nm", "contact_limit_nm")
    flight |= {
        key: said[key][rows]
        for key in (*torques, "near_stiction", "causes", "health", "alarm", "held_alarm", "touch", "detection")
    }
    flight["load"] = np.zeros((len(flight["t_ns"]), 10))
    return flight | {"event_row": row - first, "event": monitor.last}
