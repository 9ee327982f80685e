"""What the rig's instruments make of the true signals: quantised position, filtered difference, noise, low-pass."""

import numpy as np

from tauext.sim.config import Drivetrain
from tauext.sim.simulate import Truth


def low_pass(x: np.ndarray, cutoff_rad_s: float, dt_s: float) -> np.ndarray:
    """First-order low-pass over axis 0: y_k = a y_{k-1} + (1 - a) x_k, a = exp(-cutoff dt), y_{-1} = x_0.

    Starts settled on the first sample. The sum over the past is built by doubling: after m rounds y holds the last 2^m
    samples, and the weight of what is older soon is nothing.
    """
    a = np.exp(-cutoff_rad_s * dt_s)
    y = (1.0 - a) * x
    y[0] = x[0]
    shift, weight = 1, a
    while shift < len(y) and weight > 1e-18:
        y[shift:] = y[shift:] + weight * y[:-shift]
        shift, weight = 2 * shift, weight * weight
    return y


def encoder(q: np.ndarray, counts: int) -> np.ndarray:
    """Position as an encoder with `counts` in one turn reads it, [rad]."""
    step = 2.0 * np.pi / counts
    return np.round(q / step) * step


def velocity(q_measured: np.ndarray, cutoff_rad_s: float, dt_s: float) -> np.ndarray:
    """Velocity as a drive computes it: low-passed difference of the measured positions, [rad/s]."""
    dq = np.diff(q_measured, axis=0, prepend=2.0 * q_measured[:1] - q_measured[1:2]) / dt_s
    return low_pass(dq, cutoff_rad_s, dt_s)


def measure(config: Drivetrain, truth: Truth, tau_ext: np.ndarray, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Measured signals of one recording, each (samples, joints), named as a Recording names them.

    The joint torque sensor reads tau_jts = drive - friction - rotor inertia * ddq plus noise: what the drive exerts on
    the link. Its external torque is LP(M ddq + C dq + g - tau_jts) with the true model without rotor inertia and the
    simulator's ddq. The simulator obeys M ddq + C dq + g = drive - friction - rotor inertia * ddq + tau_ext to
    rounding, so the bracket is tau_ext less the sensor's noise, and is taken as that.

    Args:
        tau_ext: true external torque (samples, joints), [N m].
    """
    sensors, dt_s = config.sensors, 1.0 / config.rate_hz
    q = encoder(truth.q, sensors.encoder_counts)
    tau_noise = rng.standard_normal(q.shape) * sensors.torque_noise_nm
    jts_noise = rng.standard_normal(q.shape) * sensors.jts_noise_nm
    rotor = truth.ddq * config.rotor_inertia_kg_m2
    return {
        "q": q,
        "dq": velocity(q, sensors.velocity_cutoff_rad_s, dt_s),
        "tau": truth.drive + tau_noise,
        "tau_jts": truth.drive - truth.friction - rotor + jts_noise,
        "tau_ext_sensor": low_pass(tau_ext - jts_noise, sensors.reference_cutoff_rad_s, dt_s),
    }
