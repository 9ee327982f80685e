"""Velocity from position, as a control loop can do it too: from samples so far."""

from __future__ import annotations

import math

import numpy as np

from tauext.data.stamps import BRIDGE_STEPS


def derived_velocity(t_ns: np.ndarray, q: np.ndarray, low_pass_hz: float) -> np.ndarray:
    r"""Backward difference behind a first-order low-pass, (samples, joints), [rad/s].

    .. math:: dq_k = a\,dq_{k-1} + (1-a)\,(q_k - q_{k-1})/\Delta t, \quad a = e^{-2\pi f \Delta t}

    It lags the true velocity by half a step and by 1/(2 pi f). It sees no future, so a monitor that derives it the same
    way gets the same values. A step of more than 2.5 median steps starts it anew; a first sample takes the difference
    that follows it.

    Args:
        t_ns: (samples,), increasing, [ns].
        q: (samples, joints), [rad].
        low_pass_hz: cut-off f, [Hz]; 0: no low-pass.
    """
    velocity = np.zeros_like(q)
    if len(q) < 2:
        return velocity
    steps_s = np.diff(t_ns) * 1e-9
    velocity[1:] = np.diff(q, axis=0) / steps_s[:, None]
    begins = np.r_[True, steps_s > BRIDGE_STEPS * np.median(steps_s)]
    followed = np.flatnonzero(begins[:-1] & ~begins[1:])
    velocity[begins] = 0.0
    velocity[followed] = velocity[followed + 1]
    if low_pass_hz:
        keep = np.r_[0.0, np.exp(-2 * math.pi * low_pass_hz * steps_s)]
        keep[begins] = 0.0
        for k in range(1, len(q)):
            velocity[k] += keep[k] * (velocity[k - 1] - velocity[k])
    return velocity
