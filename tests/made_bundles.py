"""Bundles whose answers are known, and a moving arm that is pushed at known times to watch with them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from made_arms import no_model, planar_arm, settings

from tauext import _core
from tauext.config import ObserverConfig
from tauext.data.recording import Recording
from tauext.fit.bundle_writing import build_setup, make_bundle
from tauext.fit.torque_constants import TorqueConstants, with_constants
from tauext.robot.read import load_tree

SEVEN_AXIS = Path(__file__).parents[1] / "benchmarks" / "seven_axis.urdf"

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


SIGMA_NM, SIGMA_PER_SPEED, SIGMA_NEAR_NM, LARGEST = 0.1, 0.2, 0.3, 4.0


def with_error_scale(bundle: _core.Bundle, per_speed: float = 1.0) -> _core.Bundle:
    """This bundle, changed: limits grow by per_speed of themselves a rad/s, sigma with the speed, too."""
    scale, n = _core.ErrorScaleSettings(), bundle.joints
    scale.features = [_core.MotionFeature.constant, _core.MotionFeature.speed]
    scale.limit_weights = [1.0, per_speed] * n
    scale.largest = [LARGEST] * n
    scale.sigma_weights = [SIGMA_NM, SIGMA_PER_SPEED] * n
    scale.sigma_near_weights = [SIGMA_NEAR_NM, 0.0] * n
    scale.largest_sigma = [1e3] * n
    bundle.error_scale = scale
    return bundle


def taking_amperes(bundle: _core.Bundle, nm_per_ampere: np.ndarray) -> _core.Bundle:
    """The same bundle for currents: it says of tau / nm_per_ampere what it said of tau."""
    bundle.observer = with_constants(bundle.observer, constants_of(nm_per_ampere))
    bundle.units = _core.TorqueUnits(_core.TorqueUnit.ampere)
    bundle.scale_reference((1 / nm_per_ampere).tolist())
    return bundle


def without_constants(bundle: _core.Bundle, joints: Sequence[int]) -> _core.Bundle:
    """The same bundle, whose tau is in N m, with these joints in amperes of unknown torque constants."""
    bundle.observer = with_constants(bundle.observer, constants_of(np.ones(bundle.joints), joints))
    bundle.units = _core.TorqueUnits(_core.TorqueUnit.ampere)
    if bundle.observer.sample_period_ns:  # else it holds a model alone, and no reference
        bundle.answer_reference()
    return bundle


def constants_of(nm_per_ampere: np.ndarray, unknown: Sequence[int] = ()) -> TorqueConstants:
    """These torque constants, without errors; those of the unknown joints are undetermined."""
    known = ~np.isin(np.arange(len(nm_per_ampere)), unknown)
    return TorqueConstants(nm_per_ampere, np.where(known, 0.0, np.inf), known)


def constant_error_scale(sigma_nm: Sequence[float]) -> _core.ErrorScaleSettings:
    """Limits as they are, and these standard errors, in any motion."""
    scale = _core.ErrorScaleSettings()
    scale.features = [_core.MotionFeature.constant]
    scale.limit_weights = scale.largest = [1.0] * len(sigma_nm)
    scale.sigma_weights = scale.sigma_near_weights = scale.largest_sigma = list(sigma_nm)
    return scale


def seven_axis_bundle(sigma_nm: Sequence[float], *capsules: _core.Capsule) -> _core.Bundle:
    """A seven-axis arm with constant standard errors; if capsules are given, also one from each joint to the next."""
    tree = load_tree(SEVEN_AXIS)
    made = _core.Bundle()
    made.links, made.gravity = tree.links, tree.gravity
    made.error_scale = constant_error_scale(sigma_nm)
    if capsules:
        between = [_core.Capsule(k, [0, 0, 0], link.translation, 0.05) for k, link in enumerate(tree.links[1:])]
        made.capsules = [*between, *capsules]
    return made


TOOL_M = 0.2


def planar_tool_bundle() -> _core.Bundle:
    """Two links of 0.3 m in the x-y plane with a tool TOOL_M on from the elbow's axis; the error scale is constant."""
    bundle, tree = _core.Bundle(), planar_arm()
    bundle.name, bundle.links, bundle.gravity, bundle.observer = "planar", tree.links, tree.gravity, settings()
    bundle.sliding_limit_nm, bundle.near_stiction_limit_nm = [6.0, 3.0], [9.0, 4.0]
    bundle.contact_sliding_limit_nm = bundle.contact_near_stiction_limit_nm = [2.0, 1.0]
    load = bundle.load_settings
    load.frame, load.link, load.translation = "tool", 1, [TOOL_M, 0.0, 0.0]
    bundle.load_settings = load
    return with_error_scale(bundle, 0.0)


def planar_arm_bundle() -> _core.Bundle:
    """The planar arm as a whole bundle without friction, with a tool TOOL_M on from the elbow's axis."""
    made = pushed(pushes=())
    bundle = make_bundle("planar", build_setup(planar_arm(), made, ObserverConfig(window_s=0.1)), 0.02, made)
    bundle.sliding_limit_nm, bundle.near_stiction_limit_nm = [6.0, 3.0], [9.0, 4.0]
    bundle.contact_sliding_limit_nm, bundle.contact_near_stiction_limit_nm = [2.0, 1.0], [3.0, 1.5]
    load = bundle.load_settings
    load.frame, load.link, load.translation = "tool", 1, [TOOL_M, 0.0, 0.0]
    bundle.load_settings = load
    first = slice(0, 1000)
    bundle.set_reference(*(np.ascontiguousarray(a[first]) for a in (made.t_ns, made.q, made.dq, made.tau)))
    return with_error_scale(bundle, 0.0)
