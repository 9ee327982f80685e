"""Recordings that do not belong: of another load, another arm, another specimen of the arm."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.signal import butter, sosfiltfilt

from tauext import _core
from tauext.data.recording import Recording
from tauext.sim.collect import simulate_recording
from tauext.sim.config import LinkConfig, RigConfig, changed_rig

SMOOTH_HZ = 10.0
LOAD_RADIUS_M = 0.05
DONOR_S = 30.0


def with_load(recording: Recording, tree: _core.Tree, share: float) -> Recording:
    """The recording as if a ball of this share of the arm's moving mass were carried at its end, on the same path.

    dp/dt + beta of the arm with the ball less that without it, of smooth positions.
    """
    links = tree.links
    mass = share * sum(link.mass for link in links)
    last = links[-1]
    # Twice the way to the link's centre of mass is about its end.
    at = 2 * np.array(last.com)
    both = (last.mass * np.array(last.com) + mass * at) / (last.mass + mass)
    xx, yy, zz, xy, xz, yz = last.inertia
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) + 0.4 * mass * LOAD_RADIUS_M**2 * np.eye(3)
    for one, place in ((last.mass, np.array(last.com)), (mass, at)):
        arm = place - both
        inertia += one * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    last.mass, last.com = last.mass + mass, both.tolist()
    last.inertia = [float(inertia[k]) for k in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
    loaded = _core.Tree(links, tree.gravity)
    time_s = recording.time_s
    sos = butter(2, SMOOTH_HZ, fs=recording.rate_hz, output="sos")
    q = sosfiltfilt(sos, recording.q, axis=0)
    dq = np.gradient(q, time_s, axis=0)
    (p, beta), (p_bare, beta_bare) = loaded.momentum(q, dq), tree.momentum(q, dq)
    torque = np.gradient(p - p_bare, time_s, axis=0) + beta - beta_bare
    return replace(recording, tau=recording.tau + torque)


def as_if_of(donor: Recording, own: Recording) -> Recording:
    """The donor under the joints, robot and rate of a dataset's own recording: someone named the wrong file."""
    time_s = np.arange(int(donor.duration_s * own.rate_hz)) / own.rate_hz
    signals = {
        name: np.column_stack([np.interp(time_s, donor.time_s, column) for column in getattr(donor, name).T])
        for name in ("q", "dq", "tau")
    }
    own_signals = {name: None for name in ("tau_jts", "tau_ext", "tau_ext_sensor", "q_des", "temperature", "contact",
                                           "contact_link")}  # fmt: skip
    return replace(own, t_ns=np.round(time_s * 1e9).astype(np.int64), **(own_signals | signals))


def other_rig(robot_sha256: str) -> dict[str, Recording]:
    """Recordings of another planar arm, and of the rig with 1.6 times the friction."""
    arms = {
        "arm": RigConfig(links=(LinkConfig(0.4, 11.0, 0.18, 0.12, 0.6), LinkConfig(0.25, 6.0, 0.11, 0.05, 0.25))),
        "friction": changed_rig(20, 1.6),
    }
    return {
        name: simulate_recording(config, "free", DONOR_S, 7, 500 + k, robot_sha256)
        for k, (name, config) in enumerate(arms.items())
    }


def cut_to(donor: Recording, own: Recording) -> Recording:
    """The donor's first samples, as long as the recording in whose place it stands, under its name."""
    count = min(donor.samples, own.samples)
    signals = {
        name: values[:count]
        for name in ("t_ns", "q", "dq", "tau", "tau_jts", "tau_ext", "tau_ext_sensor", "q_des", "contact",
                     "contact_link", "temperature")
        if (values := getattr(donor, name)) is not None
    }  # fmt: skip
    return replace(donor, name=own.name, robot_sha256=own.robot_sha256, **signals)
