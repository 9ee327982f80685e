"""The monitor through Python: against a slow twin of the whole chain in NumPy, the batch evaluation, and itself."""

from collections.abc import Callable

import numpy as np
import pytest
from made_arms import ROTOR_INERTIA, planar_arm
from made_recordings import smooth_motion

from tauext import _core
from tauext.config import AlarmConfig, ObserverConfig
from tauext.data.recording import Recording
from tauext.errors import TauextError
from tauext.fit.bundle_writing import build_setup, make_bundle, set_signal_ranges
from tauext.fit.network_training import TrainedNetwork
from tauext.fit.training_set import Scaling, find_scaling
from tauext.train.paper_limits import set_limits

HIDDEN, GAIN_PER_S = 20, 20.0


def recording(seed: int, samples: int = 2500, push_nm: float = 0.0) -> Recording:
    """A smooth motion of two joints at 1 kHz; a push on the elbow from sample 1800 to 1900."""
    q, dq, tau = smooth_motion(seed, samples)
    tau[1800:1900, 1] += push_nm
    signals = {"t_ns": np.arange(samples, dtype=np.int64) * 1_000_000, "q": q, "dq": dq, "tau": tau}
    meta = {"rate_hz": 1000.0, "torque_timing": "held", "source": "test", "robot_sha256": ""}
    return Recording(name=f"made-{seed}", joints=("shoulder", "elbow"), **signals, **meta)


def bundle_of_real_size() -> tuple[_core.Bundle, Scaling]:
    """The paper's sizes with random weights: two joints, 20 units, windows of 100 steps of 10 ms."""
    made = recording(1)
    setup = build_setup(planar_arm(), made, ObserverConfig(gain_per_s=GAIN_PER_S))
    scaling = find_scaling(setup, [made])
    shape = _core.LstmShape(6, HIDDEN, 2)
    parameters = np.random.default_rng(2).normal(0, 0.4, shape.parameter_count).astype(np.float32)
    network = TrainedNetwork(shape, parameters, [], 0, 0.0)
    bundle = make_bundle("random", setup, 0.02, made, scaling, network)
    healthy = _core.estimate(bundle, made.t_ns, made.q, made.dq, made.tau, 1)["tau_ext"][1000:]
    largest = np.abs(healthy).max(axis=0)
    set_limits(bundle, np.array([1.05 * largest, 1.1 * largest]), AlarmConfig())
    set_signal_ranges(bundle, [made])
    return bundle, scaling


def twin_residual(made: Recording) -> np.ndarray:
    """The observer with the textbook matrices of two planar links, from the recurrence of docs/method/theory.md."""
    (m1, m2), (c1, c2), (i1, i2), link = (8.191, 9.920), (0.12079, 0.16078), (0.06, 0.07), 0.3
    (q1, q2), (w1, w2) = made.q.T, made.dq.T
    own, coupled = i2 + m2 * c2**2, m2 * link * c2
    first = i1 + m1 * c1**2 + m2 * link**2 + own + ROTOR_INERTIA[0]
    p = np.stack(
        [
            (first + 2 * coupled * np.cos(q2)) * w1 + (own + coupled * np.cos(q2)) * w2,
            (own + coupled * np.cos(q2)) * w1 + (own + ROTOR_INERTIA[1]) * w2,
        ],
        axis=1,
    )
    weight_2 = 9.81 * m2 * c2 * np.cos(q1 + q2)
    weight_1 = 9.81 * (m1 * c1 + m2 * link) * np.cos(q1) + weight_2
    beta = np.stack([weight_1, weight_2 + coupled * np.sin(q2) * (w1**2 + w1 * w2)], axis=1)
    a, r = np.exp(-GAIN_PER_S * 1e-3), np.zeros_like(p)
    for k in range(1, len(p)):
        disturbance = (p[k] - p[k - 1]) / 1e-3 - (made.tau[k - 1] - (beta[k - 1] + beta[k]) / 2)
        r[k] = a * r[k - 1] + (1 - a) * disturbance
    return r


def twin_network(bundle: _core.Bundle, scaling: Scaling, made: Recording, end: int) -> np.ndarray:
    """The window that ends at this sample, recomputed from its first step in float64."""

    def sigmoid(x):
        return 1 / (1 + np.exp(-x))

    H = HIDDEN
    parts = np.cumsum([4 * H * 6, 4 * H * H, 4 * H, 2 * H])
    w_x, w_h, b, w_head, b_head = np.split(np.array(bundle.parameters, dtype=float), parts)
    w_x, w_h, w_head = w_x.reshape(4 * H, 6), w_h.reshape(4 * H, H), w_head.reshape(2, H)
    x = np.hstack([made.q, made.dq]) * scaling.input_factors
    h = c = np.zeros(H)
    for k in range(end - 990, end + 1, 10):
        gates = w_x @ np.r_[x[k], x[k - 10, 2:]] + w_h @ h + b
        i, f, g, o = np.split(gates, 4)
        c = sigmoid(f) * c + sigmoid(i) * np.tanh(g)
        h = sigmoid(o) * np.tanh(c)
    return w_head @ h + b_head


def test_the_monitor_equals_a_slow_twin_of_the_whole_chain():
    bundle, scaling = bundle_of_real_size()
    made = recording(3)
    said = _core.Monitor(bundle).run(made.t_ns, made.q, made.dq, made.tau)
    np.testing.assert_allclose(said["residual"], twin_residual(made), atol=1e-9, rtol=0)
    warm = said["health"] == 1
    assert warm.argmax() == 1000 and warm[1000:].all()  # a window reaches back over its 99 steps and the lag
    for end in np.random.default_rng(4).integers(1000, made.samples, 40):
        # 1e-6 in units of the network: float32 against float64 through 100 steps.
        network = said["uncertainty"][end] / scaling.output_scale_nm
        np.testing.assert_allclose(network, twin_network(bundle, scaling, made, end), atol=1e-6, rtol=0)
    np.testing.assert_array_equal(said["tau_ext"][warm], (said["residual"] - said["uncertainty"])[warm])
    np.testing.assert_array_equal(said["margin_nm"][warm], (said["limit_nm"] - np.abs(said["tau_ext"]))[warm])


def test_online_equals_offline_bit_for_bit_at_every_sample():
    bundle, _ = bundle_of_real_size()
    made = recording(5, push_nm=-60)
    online = _core.Monitor(bundle).run(made.t_ns, made.q, made.dq, made.tau)
    offline = _core.estimate(bundle, made.t_ns, made.q, made.dq, made.tau, 2)
    assert set(online) - set(offline) == {
        "uncertainty",
        "margin_nm",
        "drift_saturated",
        "load_nm",
        "load_kg",
        "load_error_kg",
        "load_phase",
        "load_found_ns",
        "alarm_number",
        "touch_t_ns",
        "touch_over",
        "declared_moment_nm",
        "declared_travel_m",
    }
    assert set(offline) - set(online) == {"entered", "restarted"}
    for name in set(offline) & set(online):
        np.testing.assert_array_equal(online[name], offline[name], err_msg=name)
    assert offline["detection"].any()


def test_estimates_of_some_torque_columns_are_those_of_all():
    bundle, _ = bundle_of_real_size()
    made = recording(5)
    signals = made.t_ns, made.q, made.dq, made.tau
    whole, some = _core.estimate(bundle, *signals, 1), _core.estimate(bundle, *signals, 1, torques=["doubt", "tau_ext"])
    torques = {"residual", "prior", "network", "drift", "sigma_nm", "contact_sigma_nm", "limit_scale", "limit_nm"}
    assert set(whole) - set(some) == torques | {"contact_limit_nm", "declared_nm"}
    for name, values in some.items():
        np.testing.assert_array_equal(values, whole[name], err_msg=name)
    with pytest.raises(_core.CoreError, match="no torque column 'health'"):
        _core.estimate(bundle, *signals, 1, torques=["health"])


def test_a_push_raises_contact_then_a_latched_collision_and_run_equals_step():
    bundle, _ = bundle_of_real_size()
    made = recording(1, push_nm=-60)  # the motor gives way by 60 Nm, as if something pushed the elbow forward
    stepped, batch = _core.Monitor(bundle), _core.Monitor(bundle).run(made.t_ns, made.q, made.dq, made.tau)
    for k in range(made.samples):
        estimate = stepped.step(int(made.t_ns[k]), made.q[k], made.dq[k], made.tau[k])
        assert [estimate.health.value, estimate.alarm.value] == [batch["health"][k], batch["alarm"][k]]
        np.testing.assert_array_equal(estimate.tau_ext, batch["tau_ext"][k])
        assert estimate.clear == (batch["health"][k] == 1 and batch["alarm"][k] == 0)
    raised, latched = np.argmax(batch["alarm"] == 1), np.argmax(batch["alarm"] == 2)
    assert 1800 < raised < latched == raised + 10  # held for 10 ms
    assert batch["alarm_joint"][latched] == 1 and batch["tau_ext"][latched, 1] > 0
    assert (batch["alarm"][latched:] == 2).all()
    assert stepped.last.alarm == _core.Alarm.collision and stepped.last.alarm_t_ns == made.t_ns[latched]
    stepped.acknowledge()
    assert stepped.last.clear


def test_a_fault_has_a_name_and_the_state_outlives_it():
    bundle, _ = bundle_of_real_size()
    made = recording(1)
    monitor = _core.Monitor(bundle)
    monitor.run(made.t_ns, made.q, made.dq, made.tau)
    state = monitor.save_state()
    broken = made.q[0].copy()
    broken[1] = np.nan
    estimate = monitor.step(int(made.t_ns[-1]) + 1_000_000, broken, made.dq[0], made.tau[0])
    assert (estimate.health, estimate.causes, estimate.cause_joint) == (_core.Health.fault, ["not finite"], 1)
    assert np.isnan(estimate.tau_ext).all() and not estimate.clear
    monitor.restore_state(state)
    assert monitor.last.clear and monitor.samples == made.samples
    with pytest.raises(TauextError, match="another bundle, network rate or build"):
        _core.Monitor(bundle, own_rate=True).restore_state(state)
    with pytest.raises(TauextError, match="damaged"):
        monitor.restore_state(state[:-1] + bytes([state[-1] ^ 1]))


def test_run_and_step_take_the_same_arrays():
    bundle, _ = bundle_of_real_size()
    made = recording(1)
    t_ns, q, dq, tau = (x[:50] for x in (made.t_ns, made.q, made.dq, made.tau))
    plain = _core.Monitor(bundle).run(t_ns, q, dq, tau)
    other = [
        (t_ns.astype(">i8"), q.astype(">f8"), np.asfortranarray(dq), np.repeat(tau, 2, axis=0)[::2]),
        (t_ns.astype(np.uint64), q.tolist(), dq, tau),
        (t_ns.tolist(), q, dq, memoryview(tau)),
    ]
    for signals in other:
        found = _core.Monitor(bundle).run(*signals)
        assert all(np.array_equal(found[name], plain[name], equal_nan=True) for name in plain)
        stepped = _core.Monitor(bundle)
        rows = [stepped.step(*(np.asarray(x)[k] for x in signals)).residual for k in range(50)]
        np.testing.assert_array_equal(rows, plain["residual"])


def test_what_is_no_sample_is_refused_in_one_sentence():
    bundle, _ = bundle_of_real_size()
    made = recording(1)
    t_ns, q = made.t_ns[:5], made.q[:5]
    hot = np.array([[20.0, 20.0]] * 4 + [[20.0, np.inf]])
    three = np.zeros((5, 3))

    def refused(words: str, call: Callable[..., object], *given: object) -> None:
        with pytest.raises(TauextError) as error:
            call(*given)
        assert words in str(error.value) and "\n" not in str(error.value) and len(str(error.value)) < 200

    monitor = _core.Monitor(bundle)
    refused("t_ns holds float64; it must be an array of whole numbers", monitor.run, t_ns.astype(float), q, q, q)
    refused("t_ns holds numbers of 2^63 or more", monitor.run, np.full(5, 2**63, np.uint64), q, q, q)
    refused("t_ns has the shape (5, 1); it must have 1 dimension", monitor.run, t_ns[:, None], q, q, q)
    refused("q holds complex128", monitor.run, t_ns, q.astype(complex), q, q)
    refused("dq is a masked array", monitor.run, t_ns, q, np.ma.array(q), q)
    refused("tau is of type NoneType", monitor.run, t_ns, q, q, None)
    refused("tau has the shape (4, 2); it must be (5, 2)", monitor.run, t_ns, q, q, q[:4])
    refused("q has 3 columns; it must have 2", monitor.run, t_ns, three, three, three)
    refused("q cannot be read as an array", monitor.run, t_ns, [[1.0], [2.0, 3.0]], q, q)
    refused("temperature is infinite in column 1 of row 4", monitor.run, t_ns, q, q, q, None, hot)
    refused("t_ns = 1.5 must be a whole number", monitor.step, 1.5, q[0], q[0], q[0])
    refused("t_ns = 9223372036854775808 must be within", monitor.step, 2**63, q[0], q[0], q[0])
    refused("dq is a masked array", monitor.step, 0, q[0], np.ma.array(q[0]), q[0])
    refused("q has the shape (3,); it must be (2,)", monitor.step, 0, three[0], q[0], q[0])
    refused("temperature is infinite in column 1", monitor.step, 0, q[0], q[0], q[0], hot[4])
    refused("temperature is infinite in column 1", monitor.set_temperature, hot[4])
    refused("now_ns = '1' must be a whole number", monitor.no_sample, "1")
    refused("collision has the shape (1,); it must be (2,)", monitor.set_limit_factors, [1.0], [1.0, 1.0])
    refused("mass is of type str; it must be a number", monitor.set_load, "1")
    refused("com has 2 numbers; it must have 3", monitor.set_load, 1.0, [0.0, 0.0])
    refused("later than the last sample", lambda: monitor.set_load(0.1, since_ns=2**63 - 1))
    refused("bundle is of type str", _core.Monitor, "arm.tauext")
    assert monitor.samples == 0
    unknown = np.where(np.isinf(hot), np.nan, hot)  # a temperature may be unknown
    assert len(monitor.run(t_ns, q, q, q, None, unknown)["health"]) == 5
