"""Methods of others, and all methods at equal false alarms."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import beta
from sliding_mass import observer_bundle, pushed
from tauext_lab.evaluate.comparison import evaluate
from tauext_lab.evaluate.config import OTHER_METHODS
from tauext_lab.evaluate.missed_curve import Scored, equal_false_alarms
from tauext_lab.evaluate.results import results_of, to_json
from tauext_lab.other_methods import NextConfig, NextNetwork, StallRule, fit_stall_rule, train_next, train_other_methods
from tauext_lab.report.tables import events_table
from test_baselines import Listener

from tauext.data.recording import Recording
from tauext.errors import ConfigError, TrainingError

RATE_HZ = 50


def recorded(seed: int = 0, seconds: float = 30.0) -> Recording:
    """Two joints of a position-controlled arm in free motion: goals of sines, followed with friction."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    pace, phase = rng.uniform(0.5, 2.0, 2), rng.uniform(0, 6, 2)
    q, dq = np.sin(t[:, None] * pace + phase), pace * np.cos(t[:, None] * pace + phase)
    tau = 2 * np.sin(q) + 0.5 * np.tanh(dq / 0.05) + rng.normal(0, 0.01, q.shape)
    return Recording(
        "made", ("a", "b"), (t * 1e9).astype(np.int64), q, dq, tau, RATE_HZ, "held", "made", "", q_des=q + tau / 20
    )


# --- NEXT.


def test_the_network_is_two_lstm_layers_and_a_rectified_head():
    config = NextConfig(hidden=4, head=6, history=5)
    network, rng = NextNetwork(3, 2, config), np.random.default_rng(1)
    vector = network.initial(rng)
    windows = rng.normal(size=(5, 7, 3)).astype(np.float32)
    arrays = network.arrays(vector)

    def logistic(z):
        return 1 / (1 + np.exp(-z))

    for n in range(7):
        sequence = list(windows[:, n].astype(float))
        for w_x, w_h, b in (arrays[0:3], arrays[3:6]):
            h = c = np.zeros(4)
            for k, x in enumerate(sequence):
                i, f, o, g = (x @ w_x[gate] + h @ w_h[gate] + b[gate, 0] for gate in range(4))
                c = logistic(f) * c + logistic(i) * np.tanh(g)
                sequence[k] = h = logistic(o) * np.tanh(c)
        w3, b3, w4, b4 = arrays[6:]
        expected = np.maximum(sequence[-1] @ w3 + b3, 0) @ w4 + b4
        np.testing.assert_allclose(network.predict(vector, windows)[n], expected, rtol=1e-4, atol=1e-6)


def test_its_gradient_is_that_of_the_squared_error():
    config = NextConfig(hidden=4, head=6, history=5)
    network, rng = NextNetwork(3, 2, config), np.random.default_rng(2)
    vector = network.initial(rng)
    windows, target = rng.normal(size=(5, 7, 3)).astype(np.float32), rng.normal(size=(7, 2)).astype(np.float32)
    loss, gradient = network.gradient(vector, windows, target)
    assert loss == pytest.approx(np.sum((network.predict(vector, windows) - target) ** 2), rel=1e-5)
    for direction in rng.normal(size=(6, len(vector))):
        step = 2e-3 * direction
        change = [np.sum((network.predict(vector + s * step, windows) - target) ** 2) for s in (1, -1)]
        assert gradient @ step == pytest.approx((change[0] - change[1]) / 2, rel=0.02, abs=2e-3)


SMALL = NextConfig(hidden=8, head=8, history=5, batch=64, epochs=12, learning_rate=1e-2)


@pytest.fixture(scope="module")
def trained():
    """Two small networks, by whether they are given commanded positions."""
    free = [recorded(0), recorded(1)]
    return {given: train_next(free, 0, replace(SMALL, commanded=given)) for given in (True, False)}


@pytest.mark.parametrize("commanded", [True, False])
def test_its_estimate_is_small_in_free_motion_and_shows_a_torque_that_the_inputs_do_not(trained, commanded):
    network, free = trained[commanded], recorded(2, 10.0)
    sudden = replace(free, tau=free.tau + np.where(free.time_s > 5, 1.0, 0.0)[:, None])
    error, push = network.tau_ext(free), network.tau_ext(sudden) - network.tau_ext(free)
    assert np.sqrt(np.mean(error[50:] ** 2)) < 0.25 * np.sqrt(np.mean(free.tau**2))
    # A first-order low-pass of 20 1/s: 1 - exp(-20 t).
    np.testing.assert_allclose(push[free.time_s > 5][:5, 0], 1 - np.exp(-0.4 * np.arange(1, 6)), atol=1e-6)
    assert (network.ratio(recorded(0)) <= 1 + 1e-9).all() and (error[: SMALL.history - 1] == 0).all()


def test_it_explains_a_push_by_the_position_error_that_the_push_causes(trained):
    free = recorded(2, 10.0)
    push = np.where(free.time_s > 5, 0.5, 0.0)[:, None] * [1.0, 0.0]
    # A P controller lags behind by the torque that it gives.
    leaning = replace(free, tau=free.tau + push, q_des=free.q_des + push / 20)
    found = {given: (one.tau_ext(leaning) - one.tau_ext(free))[-100:, 0] for given, one in trained.items()}
    assert np.median(found[False]) == pytest.approx(0.5, abs=1e-3)
    assert np.median(found[True]) < 0.4


def test_faster_recordings_are_reduced_to_its_rate():
    slow = recorded(3, 6.0)
    fast = replace(slow, t_ns=slow.t_ns // 10, rate_hz=10.0 * RATE_HZ, q_des=slow.q_des, dq=slow.dq * 10)  # 500 Hz
    estimate = train_next([fast], 0, replace(SMALL, epochs=1)).tau_ext(fast)
    assert estimate.shape == fast.tau.shape
    np.testing.assert_array_equal(estimate[45:50], np.tile(estimate[45], (5, 1)))
    assert (estimate[45] != estimate[50]).any()


def test_recordings_without_commanded_positions_or_too_short_are_refused():
    bare = replace(recorded(), q_des=None)
    for fit in (train_next, fit_stall_rule):
        with pytest.raises(TrainingError, match="'made' has no commanded positions"):
            fit([bare])
    with pytest.raises(TrainingError, match="no recording holds a window of 50 samples"):
        train_next([recorded(seconds=0.9)])


# --- The stall rule.


def stalled(recording: Recording, from_s: float) -> Recording:
    """Joint a stops while its goal goes on to 1 rad away, at five times the torque of free motion."""
    at = recording.time_s >= from_s
    q, dq, tau, goal = (one.copy() for one in (recording.q, recording.dq, recording.tau, recording.q_des))
    q[at, 0], dq[at, 0], tau[at, 0] = q[at][0, 0], 0.0, 10.0
    goal[at, 0] = q[at][0, 0] + 1.0
    return replace(recording, q=q, dq=dq, tau=tau, q_des=goal)


def test_the_stall_rule_finds_a_stall_after_its_samples_and_nothing_in_free_motion():
    rule = fit_stall_rule([recorded(0), recorded(1)])
    free = recorded(2)
    assert (rule.ratio(free) < 1.05).all()
    score = rule.ratio(stalled(free, 10.0)).max(axis=1)
    first = int(np.argmax(score > 1.05))
    assert free.time_s[first] == pytest.approx(10.0 + (rule.samples - 1) / RATE_HZ)
    assert (score[first:] > 3).all()


@pytest.mark.parametrize("missing", ["current", "error", "rest"])
def test_the_stall_rule_needs_current_error_and_rest_together(missing):
    rule = StallRule(np.full(2, 4.0), np.full(2, 0.3))
    one = stalled(recorded(2), 10.0)
    changed = {
        "current": replace(one, current=np.full(one.q.shape, 1.0)),
        "error": replace(one, q_des=one.q + 0.1),
        "rest": replace(one, dq=np.full(one.q.shape, 0.2)),
    }[missing]
    assert rule.ratio(one).max() > 2 and rule.ratio(changed).max() < 1


# --- Beside bundles, compared with labels.


def following(name: str, force: float) -> Recording:
    """A mass whose drive gives the torque of its position error; it is pushed against a stop."""
    one = pushed(name, force)
    still = np.zeros_like(one.q)
    return replace(one, q=still, dq=still, tau=one.tau_ext + 0.1, q_des=0.01 * (one.tau_ext + 0.1))


def test_a_rival_is_compared_with_labels_beside_bundles(tmp_path):
    others = train_other_methods(["stall-rule"], [following("quiet", 0.0)], 0)
    hit = following("hit", 10.0)
    results = evaluate({"observer": observer_bundle()}, [lambda: hit], [], tmp_path, 0, 1, others=others)
    (one,) = results.others
    counts = one.events.all
    assert (one.name, counts.events, counts.found, counts.false_alarms) == ("stall-rule", 1, 1, 0)
    # It holds from its fifth sample on; a ratio of exactly 1 is none.
    assert one.events.verdicts[0].delay_s == pytest.approx(0.004)
    assert results_of(to_json(results), "results.json").others == results.others
    assert "stall-rule" in [row.cells[0] for row in events_table(results).rows]


def test_rivals_that_recordings_do_not_allow_are_left_out_with_the_reason():
    listener = Listener()
    assert train_other_methods(OTHER_METHODS, [replace(recorded(), q_des=None)], 0, listener) == {}
    assert [line.partition(":")[0] for line in listener.sentences] == ["next is left out", "stall-rule is left out"]


# --- Equal false alarms.


def scored(values: dict[float, float], contacts=(), busy=(), seconds: float = 3600.0) -> Scored:
    """An hour at 10 Hz with these scores at these times, else 0."""
    t_ns = np.arange(round(seconds * 10)) * 100_000_000
    score, free = np.zeros(len(t_ns)), np.ones(len(t_ns), dtype=bool)
    for at_s, value in values.items():
        score[round(at_s * 10)] = value
    for begin, end in (*contacts, *busy):
        free[begin:end] = False
    return Scored(t_ns, score, free, contacts)


CONTACTS = [(1000, 1020), (2000, 2020), (3000, 3020)]
PEAKS = {10: 5.0, 20: 3.0, 20.2: 2.9, 30: 2.0, 100.5: 4.0, 200.1: 2.5, 300: 1.0}


def test_the_curve_has_the_lowest_factor_for_each_number_of_false_alarms():
    curve, last = equal_false_alarms([scored(PEAKS, CONTACTS)], 2.5)
    assert [(one.false, one.factor, one.found) for one in curve] == [(0, 5.0, 0), (1, 3.0, 1), (2, 2.0, 2)]
    assert last is curve[-1] and last.hours == pytest.approx(1.0, rel=0.01)
    assert last.delays_s == pytest.approx((0.5, 0.1))
    assert last.found_share == pytest.approx((beta.ppf(0.025, 2, 2), beta.ppf(0.975, 3, 1)))
    assert last.false_per_hour[0] < 2 < last.false_per_hour[1]


def test_several_recordings_have_one_factor_and_join_their_hours():
    twice = [scored(PEAKS, CONTACTS), scored({50: 3.5}, [(1000, 1020)])]
    _, last = equal_false_alarms(twice, 1.1)  # two in two hours
    assert (last.false, last.factor, last.found, last.contacts) == (2, 3.0, 1, 4)


def test_a_method_without_false_alarms_finds_whatever_it_scores():
    curve, last = equal_false_alarms([scored({100.5: 1e-3}, CONTACTS)], 0.0)
    assert len(curve) == 1 and (last.false, last.found) == (0, 1)


def test_time_that_is_not_free_counts_neither_as_false_nor_as_hours():
    _, last = equal_false_alarms([scored({10: 5.0, 20: 1.0}, busy=[(0, 18000)])], 0.0)
    assert (last.false, last.hours) == (0, pytest.approx(0.5, rel=0.01))
    with pytest.raises(ConfigError, match="no free time"):
        equal_false_alarms([scored({}, busy=[(0, 36000)])], 1.0)
