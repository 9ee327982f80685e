"""Residuals of other detectors against slow twins in NumPy, and the bundle format that holds them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_arms import ROTOR_INERTIA, no_model, planar_arm, prismatic_mass, regular_times
from sliding_mass import noisy

from tauext import _core
from tauext.config import FilterConfig, TrainConfig
from tauext.errors import TrainingError
from tauext.fit.bundle_writing import build_setup, make_bundle
from tauext.fit.training_set import Setup
from tauext.train.paper_limits import paper_limits

GAIN, DURATION_S = 20.0, 2.0
FINE = 20  # steps of the twin in a sample


def planar_model(q, dq):
    """M (samples, 2, 2), C dq and g (samples, 2) of planar_arm(), written out for two links."""
    m1, m2, c1, c2, along = 8.191, 9.920, 0.12079, 0.16078, 0.3
    own = 0.07 + m2 * c2**2
    mass = np.empty((len(q), 2, 2))
    mass[:, 1, 1] = own + ROTOR_INERTIA[1]
    mass[:, 0, 1] = mass[:, 1, 0] = own + m2 * along * c2 * np.cos(q[:, 1])
    mass[:, 0, 0] = 0.06 + m1 * c1**2 + own + m2 * along * (along + 2 * c2 * np.cos(q[:, 1])) + ROTOR_INERTIA[0]
    h = m2 * along * c2 * np.sin(q[:, 1])
    coriolis = np.stack([-h * (2 * dq[:, 0] + dq[:, 1]) * dq[:, 1], h * dq[:, 0] ** 2], axis=1)
    lower = 9.81 * m2 * c2 * np.cos(q.sum(axis=1))
    gravity = np.stack([9.81 * (m1 * c1 + m2 * along) * np.cos(q[:, 0]) + lower, lower], axis=1)
    return mass, coriolis, gravity


def motion(t):
    """q, dq and the motor torque of a swing during which the environment pushes by tau_ext; all (samples, 2)."""
    frequency, size = np.array([2.1, 3.3]), np.array([0.9, 1.2])
    q = size * np.sin(np.outer(t, frequency) + [0.3, 1.1])
    dq = size * frequency * np.cos(np.outer(t, frequency) + [0.3, 1.1])
    ddq = -(frequency**2) * q
    tau_ext = np.stack([4 * np.sin(5 * t), 3 - 2 * np.cos(3 * t)], axis=1)
    mass, coriolis, gravity = planar_model(q, dq)
    tau = np.einsum("kij,kj->ki", mass, ddq) + coriolis + gravity - tau_ext
    return q, dq, tau, tau_ext


def settings(method, rate_hz=1000.0, timing="instant", **filters):
    return _core.ObserverSettings(
        gain_per_s=GAIN,
        timing=getattr(_core.TorqueTiming, timing),
        sample_period_ns=round(1e9 / rate_hz),
        network_stride=10,
        method=getattr(_core.ResidualMethod, method),
        **filters,
    )


def observed(method, rate_hz=1000.0, **filters):
    """Times and the core's residual of the swing."""
    t_ns = regular_times(round(DURATION_S * rate_hz), rate_hz)
    q, dq, tau, _ = motion(t_ns * 1e-9)
    return t_ns * 1e-9, _core.observe(planar_arm(), settings(method, rate_hz, **filters), t_ns, q, dq, tau).residual


def test_the_direct_residual_is_inertia_coriolis_and_gravity_less_the_motor_torque():
    errors = []
    for rate_hz in (500.0, 1000.0):
        t, r = observed("direct", rate_hz)
        middle = t[1:] - 0.5 / rate_hz  # of the step over which speed is differenced
        errors.append(np.abs(r[1:] - motion(middle)[3]).max())
    assert errors[0] < 2e-3  # of pushes up to 5 Nm, with steps of 2 ms
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.1)  # second order


def twin(method, rate_hz):
    """The integral form of [Haddadin2017], in small explicit steps; at the core's samples."""
    dt = 1 / (rate_hz * FINE)
    q, dq, tau, _ = motion(np.arange(round(DURATION_S * rate_hz) * FINE) * dt)
    mass, coriolis, gravity = planar_model(q, dq)
    if method == "velocity":
        gain = GAIN * np.diag(mass[0])
        inverse = np.linalg.inv(mass)
        state, known = dq, np.einsum("kij,kj->ki", inverse, tau - coriolis - gravity)
    else:
        gain, inverse = GAIN, np.ones((len(q), 1, 1))
        state = 0.5 * np.einsum("ki,kij,kj->k", dq, mass, dq)[:, None]
        known = np.sum(dq * (tau - gravity), axis=1, keepdims=True)
    r, integral = np.zeros_like(state), np.zeros(state.shape[1])
    for k in range(1, len(q)):
        integral += dt * (0.5 * (known[k - 1] + known[k]) + inverse[k] @ r[k - 1])
        r[k] = gain * (state[k] - state[0] - integral)
    return r[::FINE]


@pytest.mark.parametrize("method, tolerance", [("velocity", 0.05), ("energy", 0.1)])
def test_the_observers_are_the_published_integrals(method, tolerance):
    # Of some Nm and tens of W. Left are a step's order, K0 dt = 0.02, of what is still moving, and the twin's own.
    t, r = observed(method)
    expected = twin(method, 1000.0)
    assert np.abs(expected[t > 0.5]).max() > 3
    np.testing.assert_allclose(r, np.broadcast_to(expected, r.shape), atol=tolerance)


def test_without_a_model_power_is_that_of_the_motor_and_a_velocity_observer_cannot_be():
    rng = np.random.default_rng(1)
    t_ns = regular_times(300)
    q, dq, tau = (rng.normal(size=(300, 2)) for _ in range(3))
    tree, a, expected = no_model(planar_arm()), np.exp(-GAIN * 1e-3), 0.0
    r = _core.observe(tree, settings("energy", timing="held"), t_ns, q, dq, tau).residual
    for k in range(1, 300):
        expected = a * expected - (1 - a) * (dq[k - 1] + dq[k]) / 2 @ tau[k - 1]
        np.testing.assert_allclose(r[k], expected, atol=1e-12)
    with pytest.raises(
        _core.CoreError, match="joint 'shoulder': its inertia is 0 .* the velocity observer needs a model"
    ):
        _core.observe(tree, settings("velocity"), t_ns, q, dq, tau)


@pytest.mark.parametrize("method", ["momentum", "direct", "velocity", "energy"])
def test_filters_act_on_the_residual_of_every_method(method):
    low, high = 40.0, 2.0
    t_ns = regular_times(1500)
    q, dq, tau, _ = motion(t_ns * 1e-9)
    plain = _core.observe(planar_arm(), settings(method), t_ns, q, dq, tau)
    filtered = _core.observe(planar_arm(), settings(method, low_pass_per_s=low, high_pass_per_s=high), t_ns, q, dq, tau)
    slow, passed, expected, warm = np.zeros(2), np.zeros(2), np.zeros((1500, 2)), False
    for k in range(1, 1500):
        passed = passed + (1 - np.exp(-low * 1e-3)) * (plain.residual[k] - passed)
        slow = slow + (1 - np.exp(-high * 1e-3)) * (passed - slow) if warm else passed
        expected[k] = passed - slow
        warm = bool(plain.warm[k]) and low * k * 1e-3 >= 10
    np.testing.assert_allclose(filtered.residual, expected, atol=1e-11)
    assert (filtered.warm == plain.warm).all()  # the low-pass is the faster one


def test_a_slow_low_pass_prolongs_the_warm_up_and_a_high_pass_does_not():
    t_ns = regular_times(1500)
    zeros = np.zeros((1500, 1))

    def first_warm(**filters):
        setup = Setup(prismatic_mass(1.0), settings("momentum", **filters), window_steps=1)
        observation = _core.observe(setup.tree, setup.observer, t_ns, zeros, zeros, zeros)
        first = int(np.argmax(observation.warm))
        assert setup.warm_up_s == pytest.approx(first * 1e-3)  # what messages speak of is what the core does
        return first

    assert first_warm() == first_warm(high_pass_per_s=0.1) == first_warm(low_pass_per_s=50.0) == 500
    assert first_warm(low_pass_per_s=10.0) == 1000


def test_the_warm_up_of_a_recipe_counts_its_low_pass_and_messages_name_it():
    slow = TrainConfig(recipe="bandpass", filters=FilterConfig(high_pass_per_s=1.0, low_pass_per_s=4.0))
    assert slow.warm_up_s == 2.5 and replace(slow, recipe="highpass").warm_up_s == TrainConfig().warm_up_s == 0.5
    made, longer = noisy("made", 0, 2000), noisy("longer", 0, 5000)  # 2 and 5 s
    setup = build_setup(prismatic_mass(1.0), made, slow.observer, slow.recipe, slow.filters)
    bundle = make_bundle("slow", setup, 0.02, longer)
    with pytest.raises(TrainingError, match="beyond the warm-up of 2.5 s, with 0.2 s before and 1 s after"):
        paper_limits(bundle, [made], 1)


def test_settings_are_the_plain_momentum_observer_unless_set():
    plain = _core.ObserverSettings(
        gain_per_s=20.0, timing=_core.TorqueTiming.held, sample_period_ns=1_000_000, network_stride=10
    )
    assert (plain.method, plain.high_pass_per_s, plain.low_pass_per_s) == (_core.ResidualMethod.momentum, 0.0, 0.0)


def test_a_bundle_with_a_prior_has_the_momentum_observer():
    bundle = _core.Bundle.from_bytes((Path(__file__).parent / "golden" / "format-1-network.tauext").read_bytes())
    bundle.observer = settings("velocity", timing="held", high_pass_per_s=2.0, low_pass_per_s=30.0)
    with pytest.raises(_core.CoreError, match="a prior is filtered as the momentum observer filters"):
        bundle.drop_network()
