"""Runs bundles on recordings: the same chain as the monitor's."""

from __future__ import annotations

import os

import numpy as np

from tauext import _core
from tauext.bundle.bundle_fit import expect_fit
from tauext.bundle.estimates import Estimates
from tauext.data.recording import Recording


def estimate_recording(bundle: _core.Bundle, recording: Recording, threads: int = 0) -> Estimates:
    """What the bundle says of every sample of the recording: what a new monitor would, with its answers in bulk.

    Args:
        threads: 0: one a core. The result does not depend on it.

    Raises:
        BundleError: joints, rate or torque timing of the recording are not the bundle's.
    """
    expect_fit(bundle, recording)
    threads = threads or os.cpu_count() or 1
    said = _core.estimate(
        bundle, recording.t_ns, recording.q, recording.dq, recording.tau, threads, recording.temperature
    )
    return Estimates(
        joints=recording.joints,
        t_ns=recording.t_ns,
        r=said["residual"].astype(np.float32),
        network=said["network"].astype(np.float32),
        tau_ext=said["tau_ext"].astype(np.float32),
        prior=said["prior"].astype(np.float32) if bundle.prior.terms or bundle.prior.corrected_links else None,
        drift=said["drift"].astype(np.float32) if bundle.drift.time_constant_s else None,
        sigma_nm=said["sigma_nm"].astype(np.float32) if bundle.error_scale.on else None,
        contact_sigma_nm=said["contact_sigma_nm"].astype(np.float32) if bundle.error_scale.on else None,
        limit=said["limit_nm"].astype(np.float32),
        contact_limit=contact_limit_nm(bundle, said).astype(np.float32),
        near_stiction=said["near_stiction"].astype(bool),
        health=said["health"].astype(np.int8),
        causes=said["causes"],
        detection=said["detection"].astype(bool),
        held_alarm=said["held_alarm"].astype(np.int8),
        touch=said["touch"].astype(np.int8),
    )


def contact_limit_nm(bundle: _core.Bundle, said: dict[str, np.ndarray]) -> np.ndarray:
    """Contact limit in force at every sample, (samples, joints), from that of a collision.

    Both are a limit of the joint's region times the same factor, and the prior's doubt (AlarmStage::step).
    """
    near = said["near_stiction"].astype(bool)
    collision = np.where(near, bundle.near_stiction_limit_nm, bundle.sliding_limit_nm)
    contact = np.where(near, bundle.contact_near_stiction_limit_nm, bundle.contact_sliding_limit_nm)
    with np.errstate(divide="ignore", invalid="ignore"):
        limit: np.ndarray = said["doubt"] + (said["limit_nm"] - said["doubt"]) * (contact / collision)
    return limit
