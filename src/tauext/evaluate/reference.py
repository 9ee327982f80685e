"""The torque that an ideal sensor would show behind the observer's own low-pass: what estimates are held against."""

from __future__ import annotations

import numpy as np

from tauext.data.recording import Recording

FORGOTTEN = 1e-18
"""Of an earlier torque is left so little that no sum of doubles holds it."""


def sensor_reference(recording: Recording, gain_per_s: float) -> np.ndarray | None:
    """The true tau_ext low-passed at the observer's gain, (samples, joints), [N m]; the sensor's where that is unknown.

    A sensor's own low-pass is that of its recording, whatever the gain. None where a recording has neither.
    """
    if recording.tau_ext is None:
        return recording.tau_ext_sensor
    return low_pass(recording.t_ns, recording.tau_ext, gain_per_s)


def low_pass(t_ns: np.ndarray, torque: np.ndarray, gain_per_s: float) -> np.ndarray:
    r"""First-order low-pass of a torque that is held from a sample to the next, (samples, joints); 0 at the first.

    .. math:: y_k = a_k y_{k-1} + (1 - a_k)\,\tau_{k-1}, \quad a_k = e^{-K_0 (t_k - t_{k-1})}

    exact for steps of any length. Steps are joined in pairs of pairs, O(samples log) without a loop over samples, until
    nothing older counts.

    Args:
        t_ns: increasing, (samples,), [ns].
        torque: (samples, joints), [N m].
        gain_per_s: K0, [1/s], > 0.
    """
    share = np.exp(-gain_per_s * 1e-9 * np.diff(t_ns))[:, None]  # of y that a step keeps
    y = (1 - share) * torque[:-1]
    span = 1
    while span < len(y) and share[span:].max() > FORGOTTEN:
        y[span:] += share[span:] * y[:-span]
        share[span:] = share[span:] * share[:-span]
        span *= 2
    return np.vstack([np.zeros((1, torque.shape[1])), y])
