"""Setpoints and instruments of the virtual rig, one at a time."""

import numpy as np
import pytest

from tauext.sim.config import MotionConfig, RigConfig
from tauext.sim.contacts import force_torque, link_frames
from tauext.sim.rig import draw_motion, encoder, low_pass, quintic, velocity


def test_quintic_starts_and_ends_at_rest():
    done, rate = quintic(np.array([-1.0, 0.0, 0.5, 1.0, 2.0]))
    np.testing.assert_allclose(done, [0.0, 0.0, 0.5, 1.0, 1.0])
    np.testing.assert_allclose(rate, [0.0, 0.0, 15.0 / 8.0, 0.0, 0.0])
    h = 1e-4  # acceleration near an end: 60 s, so it vanishes there
    assert quintic(np.array([h]))[1][0] / h < 1e-2
    s = np.linspace(0.01, 0.99, 99)
    np.testing.assert_allclose((quintic(s + h)[0] - quintic(s - h)[0]) / (2 * h), quintic(s)[1], atol=1e-7)


def test_moves_keep_range_travel_and_mean_speed_of_the_fastest_joint():
    config = MotionConfig(pause_s=(0.1, 0.4))
    q_des, dq_des = draw_motion(config, 2, 300_000, 1000, np.random.default_rng(0))
    assert np.abs(q_des).max() <= np.pi
    moving = np.concatenate([[False], (dq_des != 0.0).any(axis=1), [False]])
    begins, ends = np.flatnonzero(moving[1:] & ~moving[:-1]), np.flatnonzero(~moving[1:] & moving[:-1])
    assert len(begins) > 30
    for begin, end in zip(begins[:-1], ends[:-1], strict=True):  # the clock cuts the last one
        travel = np.rad2deg(np.abs(q_des[end] - q_des[begin - 1])).max()
        assert travel >= config.least_travel_deg
        # The first and last moving samples are up to two periods inside the move.
        assert 20.0 * 0.99 < travel / ((end - begin) / 1000.0) < 50.0 * 1.01


def test_velocity_setpoint_is_the_derivative_of_the_position_setpoint():
    q_des, dq_des = draw_motion(MotionConfig(), 3, 20_000, 1000, np.random.default_rng(1))
    np.testing.assert_allclose(np.gradient(q_des, 1e-3, axis=0)[1:-1], dq_des[1:-1], atol=1e-4)


@pytest.mark.parametrize("samples", [1, 2, 7, 1000])
def test_low_pass_is_its_recursion(samples):
    x = np.random.default_rng(0).normal(size=(samples, 2))
    a, expected = np.exp(-20.0 * 1e-3), x[0]
    for k, row in enumerate(low_pass(x, 20.0, 1e-3)):
        expected = a * expected + (1.0 - a) * x[k]
        np.testing.assert_allclose(row, expected, atol=1e-12)


def test_low_pass_answers_a_step_with_its_time_constant():
    step = np.concatenate([[0.0], np.ones(500)])
    np.testing.assert_allclose(low_pass(step, 20.0, 1e-3), 1.0 - np.exp(-0.02 * np.arange(501)), atol=1e-12)


def test_encoder_reads_whole_counts_within_half_a_count():
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (1000, 2))
    step = 2.0 * np.pi / 4096
    read = encoder(q, 4096)
    np.testing.assert_allclose(read / step, np.round(read / step), atol=1e-9)
    assert np.abs(read - q).max() <= step / 2 + 1e-15


def test_velocity_of_a_ramp_is_its_slope_and_of_an_acceleration_lags():
    t = np.arange(2000)[:, None] * 1e-3
    np.testing.assert_allclose(velocity(0.7 * t, 300.0, 1e-3), np.full_like(t, 0.7), atol=1e-9)
    lag = t - velocity(0.5 * t**2, 300.0, 1e-3)
    # Half a sample for the difference, and a / (1 - a) samples for the filter.
    a = np.exp(-0.3)
    np.testing.assert_allclose(lag[500:], (0.5 + a / (1.0 - a)) * 1e-3, rtol=1e-3)


def test_force_torque_is_the_gradient_of_the_place_it_acts_on():
    rng, h = np.random.default_rng(0), 1e-6
    for link in (0, 1):
        q, force, along = rng.uniform(-3.0, 3.0, (1, 2)), rng.normal(size=(1, 2)), 0.2

        def place(q, link=link, along=along):
            origins, angles = link_frames(RigConfig(), q)
            return origins[:, link] + along * np.stack([np.sin(angles[:, link]), np.cos(angles[:, link])], axis=1)

        jacobian = [(place(q + h * e) - place(q - h * e))[0] / (2 * h) for e in np.eye(2)]
        torque = force_torque(RigConfig(), q, link, force, place(q))
        np.testing.assert_allclose(torque[0], jacobian @ force[0], atol=1e-8)
