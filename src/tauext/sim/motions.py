"""Quintic moves between random joint targets: the setpoints of free motion."""

import numpy as np

from tauext.sim.config import MotionConfig


def quintic(s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Share of a move that is done at share `s` of its time, and its derivative by s.

    10 s^3 - 15 s^4 + 6 s^5: velocity and acceleration vanish at both ends, the peak speed is 15/8 of the mean.
    Before 0 the move has not begun, after 1 it is done.
    """
    s = np.clip(s, 0.0, 1.0)
    return s**3 * (10.0 - 15.0 * s + 6.0 * s**2), 30.0 * (s * (1.0 - s)) ** 2


def draw_move(config: MotionConfig, pose: np.ndarray, rng: np.random.Generator) -> tuple[float, np.ndarray, float]:
    """Pause before the next move from a pose (joints,), [s]; its travel (joints,), [rad]; its duration, [s]."""
    reach = np.deg2rad(config.range_deg)
    pause_s = rng.uniform(*config.pause_s)
    travel = rng.uniform(-reach, reach, len(pose)) - pose
    while np.abs(travel).max() < np.deg2rad(config.least_travel_deg):
        travel = rng.uniform(-reach, reach, len(pose)) - pose
    return pause_s, travel, np.abs(travel).max() / np.deg2rad(rng.uniform(*config.mean_speed_deg_s))


def draw_motion(
    config: MotionConfig, joints: int, samples: int, rate_hz: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Setpoints q_des, dq_des of one recording, each (samples, joints), [rad], [rad/s].

    A recording begins at rest in a random pose, with a pause; it ends wherever the clock cuts the last move.
    """
    reach = np.deg2rad(config.range_deg)
    q_des, dq_des = np.empty((samples, joints)), np.zeros((samples, joints))
    pose, start = rng.uniform(-reach, reach, joints), 0
    while start < samples:
        pause_s, travel, duration_s = draw_move(config, pose, rng)
        pause = round(pause_s * rate_hz)
        end = min(start + pause + round(duration_s * rate_hz), samples)
        done, rate = quintic((np.arange(start, end) - start - pause)[:, None] / (duration_s * rate_hz))
        q_des[start:end] = pose + travel * done
        dq_des[start:end] = travel * rate / duration_s
        pose, start = pose + travel, end
    return q_des, dq_des
