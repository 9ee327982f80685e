"""Runs bundles on recordings: the same chain as the monitor's."""

from __future__ import annotations

import numpy as np

from tauext import _core
from tauext.data import Recording
from tauext.data.estimates import Estimates
from tauext.errors import BundleError


def estimate(bundle: _core.Bundle, recording: Recording, threads: int) -> Estimates:
    """What the bundle says of every sample of the recording.

    Raises:
        BundleError: joints, rate or torque timing of the recording are not the bundle's.
    """
    expect_fit(bundle, recording)
    said = _core.estimate(bundle, recording.t_ns, recording.q, recording.dq, recording.tau, threads)
    return Estimates(
        joints=recording.joints,
        t_ns=recording.t_ns,
        r=said["residual"].astype(np.float32),
        network=said["network"].astype(np.float32),
        tau_ext=said["tau_ext"].astype(np.float32),
        prior=said["prior"].astype(np.float32) if bundle.prior.terms or bundle.prior.corrected_links else None,
        drift=said["drift"].astype(np.float32) if bundle.drift.time_constant_s else None,
        limit=said["limit_nm"].astype(np.float32),
        near_stiction=said["near_stiction"].astype(bool),
        health=said["health"].astype(np.int8),
        causes=said["causes"],
        detection=said["detection"].astype(bool),
        held_alarm=said["held_alarm"].astype(np.int8),
    )


def expect_fit(bundle: _core.Bundle, recording: Recording) -> None:
    """Raise BundleError, naming what differs, where the recording is not of the bundle's robot, rate and timing."""
    joints = tuple(link.joint_name for link in bundle.links)
    if recording.joints != joints:
        raise BundleError(
            f"bundle '{bundle.name}' is for joints {', '.join(joints)}; recording {recording.name} has "
            f"{', '.join(recording.joints)}"
        )
    rate_hz = 1e9 / bundle.observer.sample_period_ns
    if abs(recording.rate_hz / rate_hz - 1) > 0.01:
        raise BundleError(
            f"bundle '{bundle.name}' runs at {rate_hz:g} Hz; recording {recording.name} has {recording.rate_hz:g} Hz"
        )
    timing = bundle.observer.timing.name
    if recording.torque_timing != timing:
        raise BundleError(
            f"bundle '{bundle.name}' takes torques that are {timing}; those of recording {recording.name} are "
            f"{recording.torque_timing}"
        )
