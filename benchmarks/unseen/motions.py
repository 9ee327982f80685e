"""What an integrator would have the arm do: all joints together from pose to pose, pauses between, some of it slow."""

from __future__ import annotations

import numpy as np

from unseen.arms import Maker

SLOW_SHARE = 0.2
PAUSE_SHARE = 0.7
ACCELERATIONS_RAD_S2 = (1.4, 8.0)
"""Most that a programmed move asks of a joint: from a controller's default to what the makers of such arms allow."""
STOP_S = (0.03, 0.08)
"""From the speed of the move to a stand."""
STOP_SPEEDS = (0.15, 0.6)
"""Shares of the most speed at which drives can stop the arm in so short a time."""
STOP_PLACES = (0.3, 0.6)
"""Shares of the time that the whole move would take; a stop from here ends before the move would have."""


def draw_motion(
    maker: Maker, samples: int, rate_hz: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Setpoints of position, velocity and acceleration, each (samples, joints), [rad, rad/s, rad/s^2]; from rest."""
    low, high = np.array(maker.low_rad), np.array(maker.high_rad)
    here, parts, length = rng.uniform(low, high), [], 0
    while length < samples:
        slow = rng.uniform() < SLOW_SHARE
        stops = maker.stop_share > 0 and not slow and rng.uniform() < maker.stop_share
        there = rng.uniform(low, high)
        if slow:  # a short straight piece, as to a fixture
            there = np.clip(here + rng.uniform(-0.25, 0.25, len(here)), low, high)
        shares = (0.02, 0.08) if slow else STOP_SPEEDS if stops else (0.15, 0.85)
        speed = np.array(maker.speed_rad_s) * rng.uniform(*shares)
        fastest_s = float((np.abs(there - here) / speed).max())
        square_s2 = float(np.abs(there - here).max()) / rng.uniform(*ACCELERATIONS_RAD_S2)
        if rng.uniform() < 0.5:
            s, ds, dds = _quintic(fastest_s, square_s2, rate_hz)
        else:
            s, ds, dds = _trapezoid(fastest_s, square_s2, rng.uniform(0.15, 0.4), rate_hz)
        way = there - here
        if stops:
            at, seconds = round(len(s) * rng.uniform(*STOP_PLACES)), rng.uniform(*STOP_S)
            s, ds, dds = _stopped(s, ds, dds, at, round(seconds * rate_hz), rate_hz)
            there = here + s[-1] * way
        stand = round(rng.uniform(0.2, 3.0) * rate_hz) if stops or rng.uniform() < PAUSE_SHARE else 0
        s = np.append(s, np.full(stand, s[-1]))
        ds, dds = np.append(ds, np.zeros(stand)), np.append(dds, np.zeros(stand))
        parts.append((here + s[:, None] * way, ds[:, None] * way, dds[:, None] * way))
        length, here = length + len(s), there
    q, dq, ddq = (np.concatenate(column)[:samples] for column in zip(*parts, strict=True))
    return q, dq, ddq


def _quintic(fastest_s: float, square_s2: float, rate_hz: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """0 to 1 with speed and acceleration zero at both ends; they peak at 15/8 and 10/sqrt(3) of the means.

    Args:
        fastest_s: the way over the most speed, of the joint where that is longest.
        square_s2: the longest way over the most acceleration.
    """
    seconds = max(0.3, fastest_s * 15 / 8, np.sqrt(square_s2 * 10 / np.sqrt(3)))
    x = np.arange(1, round(seconds * rate_hz) + 1) / round(seconds * rate_hz)
    s = 10 * x**3 - 15 * x**4 + 6 * x**5
    return s, (30 * x**2 - 60 * x**3 + 30 * x**4) / seconds, (60 * x - 180 * x**2 + 120 * x**3) / seconds**2


def _trapezoid(
    fastest_s: float, square_s2: float, share: float, rate_hz: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same with constant acceleration over a share of the time at either end: its steps are jerks."""
    peak = 1 / (1 - share)
    seconds = max(0.3, fastest_s * peak, np.sqrt(square_s2 * peak / share))
    x = np.arange(1, round(seconds * rate_hz) + 1) / round(seconds * rate_hz)
    speed = peak * np.minimum(1, np.minimum(x, 1 - x) / share)
    push = np.where(x < share, peak / share, np.where(x > 1 - share, -peak / share, 0.0))
    rising, falling = peak * x**2 / (2 * share), 1 - peak * (1 - x) ** 2 / (2 * share)
    s = np.where(x < share, rising, np.where(x > 1 - share, falling, peak * (x - share / 2)))
    return s, speed / seconds, push / seconds**2


def _stopped(
    s: np.ndarray, ds: np.ndarray, dds: np.ndarray, at: int, steps: int, rate_hz: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The move up to sample `at`, then to a stand on its path at constant deceleration, in so many steps."""
    x, seconds = np.arange(1, steps + 1) / steps, steps / rate_hz
    return (
        np.append(s[: at + 1], s[at] + ds[at] * seconds * (x - x**2 / 2)),
        np.append(ds[: at + 1], ds[at] * (1 - x)),
        np.append(dds[: at + 1], np.full(steps, -ds[at] / seconds)),
    )
