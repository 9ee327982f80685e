"""The momentum observer: closed forms, the meaning of a torque sample, gaps."""

import mujoco
import numpy as np
import pytest
from made_arms import PLANAR_MJCF, no_model, planar_arm, prismatic_mass, regular_times, settings

from tauext import _core

MASS, PUSH, GAIN = 3.0, 7.0, 20.0


def jittered_times(count: int, seed: int) -> np.ndarray:
    """Steps of 0.2 to 1.8 ms: every one of another length."""
    steps = np.random.default_rng(seed).integers(200_000, 1_800_000, count)
    return np.append(0, np.cumsum(steps)).astype(np.int64)


def pushed_mass(t: np.ndarray, impulse: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Position and speed from rest under the push and a motor of this impulse up to each time."""
    speed = (PUSH * t + impulse) / MASS
    return np.zeros((len(t), 1)), speed[:, None]  # the position of a free mass enters neither p nor beta


@pytest.mark.parametrize("timing", ["held", "instant", "averaged"])
def test_a_constant_push_from_rest_gives_the_closed_form_whatever_the_steps(timing):
    t_ns = jittered_times(2000, seed=1)
    t = t_ns * 1e-9
    dt = np.diff(t)
    if timing == "instant":  # a torque that is linear in time: its trapezoid is its mean
        tau = 4.0 + 3.0 * t
        impulse = 4.0 * t + 1.5 * t**2
    else:
        per_step = np.random.default_rng(2).normal(0, 30, len(dt))
        tau = np.append(per_step, 0.0) if timing == "held" else np.append(0.0, per_step)
        impulse = np.append(0.0, np.cumsum(per_step * dt))
    q, dq = pushed_mass(t, impulse)
    r = _core.observe(prismatic_mass(MASS), settings(timing), t_ns, q, dq, tau[:, None]).residual[:, 0]
    # 1e-8: rounding of p (up to some N s) divided by steps of 0.2 ms.
    np.testing.assert_allclose(r, (1 - np.exp(-GAIN * t)) * PUSH, atol=1e-8)


def test_without_a_model_the_residual_is_the_low_passed_motor_torque_with_its_sign_turned():
    rng = np.random.default_rng(3)
    t_ns = regular_times(500)
    q, dq, tau = (rng.normal(size=(500, 2)) for _ in range(3))
    r = _core.observe(no_model(planar_arm()), settings("held"), t_ns, q, dq, tau).residual
    a, expected = np.exp(-GAIN * 1e-3), np.zeros(2)
    for k in range(1, 500):
        expected = a * expected - (1 - a) * tau[k - 1]
        np.testing.assert_allclose(r[k], expected, atol=1e-12)


@pytest.mark.parametrize("method", ["momentum", "direct"])
def test_r_of_a_joint_whose_torque_constant_is_unknown_is_without_the_model_alone(method):
    """A model's torque is in N m, and that joint's tau in amperes."""
    rng = np.random.default_rng(4)
    arrays = (regular_times(500), *(rng.normal(size=(500, 2)) for _ in range(3)))
    kept = {"gain_per_s": GAIN, "timing": _core.TorqueTiming.held, "sample_period_ns": 1_000_000, "network_stride": 10}
    kept["method"] = getattr(_core.ResidualMethod, method)
    known = _core.ObserverSettings(**kept)
    unknown = _core.ObserverSettings(**kept, nm_per_unit=[1.0, 1.0], unknown_constant=[1, 0])
    r = _core.observe(planar_arm(), unknown, *arrays).residual
    np.testing.assert_array_equal(r[:, 0], _core.observe(no_model(planar_arm()), known, *arrays).residual[:, 0])
    np.testing.assert_array_equal(r[:, 1], _core.observe(planar_arm(), known, *arrays).residual[:, 1])


def simulated_step(rate_hz: float) -> tuple[np.ndarray, ...]:
    """The arm without friction in MuJoCo, held by its gravity torque; after 1 s a step of 30 Nm on joint 1."""
    model = mujoco.MjModel.from_xml_string(PLANAR_MJCF)
    model.opt.timestep = 1e-5  # so that the integrator's own error does not show
    data = mujoco.MjData(model)
    every = round(1 / (rate_hz * model.opt.timestep))
    samples = round(1.5 * rate_hz)
    q, dq, tau = (np.zeros((samples, 2)) for _ in range(3))
    for k in range(samples):
        mujoco.mj_forward(model, data)
        q[k], dq[k] = data.qpos, data.qvel
        tau[k] = data.qfrc_bias
        tau[k, 0] += 30.0 if k >= rate_hz else 0.0
        data.qfrc_applied[:] = tau[k]
        mujoco.mj_step(model, data, every)
    return regular_times(samples, rate_hz), q, dq, tau


@pytest.mark.parametrize("rate_hz, right, low, high", [(1000, 0.02, 0.25, 0.65), (100, 0.6, 2.0, 6.0)])
def test_the_wrong_torque_timing_shows_a_false_residual_after_a_step_and_the_right_one_none(rate_hz, right, low, high):
    # A step of 30 Nm seen half a sample wrong leaves 15 (1 - a) Nm, a whole sample 30 (1 - a): 0.3 and 0.6 Nm at 1 kHz,
    # 2.7 and 5.4 at 100 Hz. With the right timing what is left is the trapezoid of beta, of the order of dt.
    recording = simulated_step(rate_hz)

    def largest(timing):
        return np.abs(_core.observe(planar_arm(), settings(timing, rate_hz), *recording).residual[:, 0]).max()

    assert largest("held") < right
    assert low < largest("instant") < high
    assert low < largest("averaged") < high


def test_times_that_do_not_increase_are_an_error_that_names_the_sample():
    t_ns = regular_times(10)
    t_ns[6] = t_ns[5]
    zeros = np.zeros((10, 1))
    with pytest.raises(_core.CoreError, match="sample 6"):
        _core.observe(prismatic_mass(1.0), settings(), t_ns, zeros, zeros, zeros)


def observe_with_gap(missing: int) -> _core.Observation:
    """A pushed mass at 1 kHz of which `missing` samples are lost after 600."""
    keep = np.r_[0:600, 600 + missing : 1500]
    t_ns = regular_times(1500)[keep]
    q, dq = pushed_mass(t_ns * 1e-9, np.zeros(len(keep)))
    return _core.observe(prismatic_mass(MASS), settings(), t_ns, q, dq, np.zeros_like(q))


def test_a_gap_of_at_most_one_network_period_is_bridged_and_counted():
    observation = observe_with_gap(missing=10)
    assert (observation.restarts, observation.held_rows) == (0, 10)
    assert observation.row[600] - observation.row[599] == 11
    assert observation.residual[-1, 0] == pytest.approx(PUSH, rel=1e-6)  # the step across the gap is only a longer one


def test_a_longer_gap_restarts_observer_and_rows():
    observation = observe_with_gap(missing=11)
    assert observation.restarts == 1
    assert observation.residual[600, 0] == 0.0
    assert observation.stretch_begin[600] == observation.row[600] == observation.row[599] + 1
    assert observation.warm[599] == 1 and observation.warm[600] == 0


def test_jittering_stamps_fall_on_consecutive_ticks_and_ticks_count_time():
    rng = np.random.default_rng(4)
    t_ns = regular_times(5000) + rng.integers(-300_000, 300_000, 5000)
    zeros = np.zeros((5000, 1))
    observation = _core.observe(prismatic_mass(MASS), settings(), np.sort(t_ns), zeros, zeros, zeros)
    assert observation.restarts == 0
    assert abs(int(observation.row[-1]) - 4999) <= 2
    assert (np.diff(observation.row) >= 1).all()
