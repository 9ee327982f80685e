"""Velocity from 12-bit positions at the rates of servo buses: five estimators beside the truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tauext import _core
from unseen.servos import COUNT_RAD

LOW_PASS_HZ = 5.0
SLOPE_S = 0.2
JERK_RAD_S3 = 60.0
"""Standard deviation that the Kalman filter takes the jerk of a sample for: of an arm that starts and stops."""
LAGS_S = np.arange(0, 0.2001, 0.005)
STILL_RAD_S = 2e-3
STILL_FOR_S = 0.5


@dataclass(frozen=True)
class Judged:
    """Of one estimator, all joints together."""

    rms_rad_s: float
    """Error while some joint moves."""
    lag_s: float
    """The delay of the truth that it fits best."""
    still_rad_s: float
    """RMS where the joint has stood still for half a second."""
    invented_nm: float
    """RMS at standstill of the rotor's inertia times the estimate's change over a sample: torque that nobody exerts."""
    worst_nm: float
    """The largest of it."""


def estimators(rate_hz: float, window_s: float) -> dict[str, Callable[[np.ndarray, np.ndarray], np.ndarray]]:
    """By name: from stamps [ns] and positions (samples, joints) to velocities, each from the past alone.

    Args:
        window_s: longest window of the adaptive one, which is the core's.
    """
    return {
        "difference": lambda t_ns, q: _difference(t_ns, q),
        f"difference, low-passed at {LOW_PASS_HZ:g} Hz": lambda t_ns, q: _low_passed(t_ns, _difference(t_ns, q)),
        f"slope over {SLOPE_S:g} s": lambda t_ns, q: _slope(t_ns, q, max(2, round(SLOPE_S * rate_hz))),
        "Kalman, constant acceleration": _kalman,
        f"adaptive window, at most {window_s:g} s": lambda t_ns, q: _adaptive(t_ns, q, rate_hz, window_s),
    }


def judge(t_ns: np.ndarray, estimate: np.ndarray, dq: np.ndarray, rotor_kg_m2: np.ndarray) -> Judged:
    """Against the true velocity (samples, joints)."""
    t_s, error = 1e-9 * (t_ns - t_ns[0]), estimate - dq
    moving = (np.abs(dq) > STILL_RAD_S).any(axis=1)
    delayed = [
        np.mean([np.mean((np.interp(t_s - lag, t_s, dq[:, j]) - estimate[:, j]) ** 2) for j in range(dq.shape[1])])
        for lag in LAGS_S
    ]
    steps = max(1, round(STILL_FOR_S / float(np.median(np.diff(t_s)))))
    moved = np.cumsum(np.abs(dq) > STILL_RAD_S, axis=0)
    still = np.zeros(dq.shape, dtype=bool)
    still[steps:] = moved[steps:] == moved[:-steps]
    torque = rotor_kg_m2 * np.diff(estimate, axis=0, prepend=estimate[:1]) / np.median(np.diff(t_s))
    return Judged(
        rms_rad_s=_rms(error[moving]),
        lag_s=float(LAGS_S[int(np.argmin(delayed))]),
        still_rad_s=_rms(estimate[still]),
        invented_nm=_rms(torque[still]),
        worst_nm=float(np.abs(torque[still]).max(initial=0.0)),
    )


def _rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(x**2))) if x.size else 0.0


def _difference(t_ns: np.ndarray, q: np.ndarray) -> np.ndarray:
    dq = np.zeros_like(q)
    dq[1:] = np.diff(q, axis=0) / (1e-9 * np.diff(t_ns))[:, None]
    return dq


def _low_passed(t_ns: np.ndarray, x: np.ndarray) -> np.ndarray:
    keep = np.exp(-2 * np.pi * LOW_PASS_HZ * 1e-9 * np.diff(t_ns))
    y = x.copy()
    for k in range(1, len(y)):
        y[k] = keep[k - 1] * y[k - 1] + (1 - keep[k - 1]) * x[k]
    return y


def _slope(t_ns: np.ndarray, q: np.ndarray, steps: int) -> np.ndarray:
    """Of the line of least squares through the last steps + 1 samples; 0 before there are as many."""
    t_s, dq = 1e-9 * (t_ns - t_ns[0]), np.zeros_like(q)
    windows = np.lib.stride_tricks.sliding_window_view(t_s, steps + 1)
    centred = windows - windows.mean(axis=1, keepdims=True)
    positions = np.lib.stride_tricks.sliding_window_view(q, steps + 1, axis=0)  # (samples, joints, steps + 1)
    dq[steps:] = np.einsum("kji,ki->kj", positions, centred) / (centred**2).sum(axis=1)[:, None]
    return dq


def _kalman(t_ns: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Position, velocity, acceleration; the jerk is white from sample to sample, and so is the encoder's error."""
    noise, dq = COUNT_RAD**2 / 12, np.zeros_like(q)
    state, p = np.zeros((3, q.shape[1])), np.diag([noise, 1.0, 100.0])
    state[0] = q[0]
    for k in range(1, len(q)):
        h = 1e-9 * float(t_ns[k] - t_ns[k - 1])
        a = np.array([[1, h, h * h / 2], [0, 1, h], [0, 0, 1]])
        g = np.array([h**3 / 6, h**2 / 2, h])
        p = a @ p @ a.T + JERK_RAD_S3**2 * np.outer(g, g)
        state = a @ state
        gain = p[:, 0] / (p[0, 0] + noise)
        state = state + np.outer(gain, q[k] - state[0])
        p = p - np.outer(gain, p[0])
        dq[k] = state[1]
    return dq


def _adaptive(t_ns: np.ndarray, q: np.ndarray, rate_hz: float, window_s: float) -> np.ndarray:
    joint = _core.ServoConstants(count_rad=COUNT_RAD)
    settings = _core.ServoSettings(
        _core.TorqueFrom.duty, [joint] * q.shape[1], round(window_s * rate_hz), round(1e9 / rate_hz)
    )
    dq, _ = _core.ServoInput(settings).recording(np.ascontiguousarray(t_ns), np.ascontiguousarray(q))
    return np.asarray(dq)
