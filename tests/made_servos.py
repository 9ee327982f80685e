"""What tests of servo sources share: settings of a bundle of servos, samples as they come, a bus file."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
from arms import prismatic_mass

from tauext import _core
from tauext.config import ObserverConfig
from tauext.data.recording import Recording
from tauext.fit.bundle_writing import build_setup, make_bundle
from tauext.monitor.source import Sample, SourceSettings
from tauext.sources.servo import ServoSource
from tauext.sources.servo_bus_file import ServoBusFile, ServoJoint

NAMES = ("pan", "lift", "elbow", "wrist", "roll", "grip")
PATIENCE_S = 1.0
"""An answer that is on its way is waited for, however busy the machine is."""


def servo_settings(joints: int, torque_from: str = "duty", period_ns: int = 5_000_000) -> SourceSettings:
    """Of a bundle of these servos."""
    known = {"volts": 7.4, "ohm": 2.75, "back_emf_v_s": 1.2, "nm_per_ampere": 1.2}
    one = _core.ServoConstants(**known, duty_per_rad=2.6, most_duty=0.97, count_rad=0.00153)
    servo = _core.ServoSettings(getattr(_core.TorqueFrom, torque_from), [one] * joints, 0, period_ns)
    return SourceSettings(NAMES[:joints], period_ns, ("N m",) * joints, "instant", servo)


def servo_bundle(joints: int, limit_nm: float) -> _core.Bundle:
    """A bundle of an arm of sliding masses that servos drive."""
    links = []
    for k in range(joints):
        (link,) = prismatic_mass(1.0).links
        link.joint_name, link.parent = NAMES[k], k - 1
        links.append(link)
    settings = servo_settings(joints)
    signals = {"t_ns": np.arange(401) * settings.period_ns}
    signals |= {signal: np.zeros((401, joints)) for signal in ("q", "dq", "tau")}
    made = Recording(
        name="still",
        joints=NAMES[:joints],
        **signals,
        rate_hz=200.0,
        torque_timing="instant",
        source="",
        robot_sha256="",
    )
    bundle = make_bundle("masses", build_setup(_core.Tree(links, [0, 0, 0]), made, ObserverConfig()), 0.02, made)
    bundle.sliding_limit_nm = bundle.near_stiction_limit_nm = [limit_nm] * joints
    bundle.servo = settings.servo
    return bundle


def bus_file(*joints: ServoJoint) -> ServoBusFile:
    return ServoBusFile(Path("bus.toml"), {joint.name: joint for joint in joints})


def patient(source: ServoSource, seconds: float = PATIENCE_S) -> ServoSource:
    """The source, waiting so long for late answers."""
    source.bus.port.answer_s = seconds
    return source


def taken(source, count: int, within_s: float = 20.0) -> list[Sample]:
    """The next samples."""
    samples, until = [], time.monotonic() + within_s
    while len(samples) < count and time.monotonic() < until:
        if (sample := source.next_sample(0.1)) is not None:
            samples.append(sample)
    assert len(samples) == count, f"{len(samples)} of {count} samples; {source.counts}; {source.notes()}"
    return samples
