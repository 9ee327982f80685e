"""Windows, training loop and bundle writing, on small recordings made here."""

import io
import itertools
import json
import os
import signal
from dataclasses import replace

import numpy as np
import pytest
from made_arms import planar_arm
from made_recordings import smooth_motion

from tauext import _core
from tauext.config import ObserverConfig, TrainConfig
from tauext.data.recording import Recording
from tauext.errors import ConfigError, TrainingError
from tauext.fit import network_training
from tauext.fit.bundle_writing import build_setup, make_bundle
from tauext.fit.core_backend import Adam, CoreBackend
from tauext.fit.network_training import (
    DenseSchedule,
    PaperSchedule,
    input_basis,
    load_checkpoint,
    make_backend,
    train_network,
)
from tauext.fit.training_set import build_windows, find_scaling
from tauext.recipes import RECIPES
from tauext.train.error_scale import with_outputs
from tauext.train.paper_limits import paper_limits

SMALL = ObserverConfig(window_s=0.1)  # windows of ten network steps


def recording(seed: int, seconds: float = 4.0, missing: slice | None = None, **changes) -> Recording:
    """A smooth motion of two joints with a torque that holds friction: something to learn."""
    t = np.arange(round(seconds * 1000)) * 1e-3
    q, dq, tau = smooth_motion(seed, len(t))
    keep = np.ones(len(t), dtype=bool)
    if missing:
        keep[missing] = False
    signals = {"t_ns": np.round(t * 1e9).astype(np.int64)[keep], "q": q[keep], "dq": dq[keep], "tau": tau[keep]}
    meta = {"rate_hz": 1000.0, "torque_timing": "held", "source": "test", "robot_sha256": ""}
    named = {"name": f"made-{seed}", "joints": ("shoulder", "elbow")}
    return Recording(**(named | signals | meta | changes))


def prepared(recordings):
    setup = build_setup(planar_arm(), recordings[0], SMALL)
    scaling = find_scaling(setup, recordings)
    return setup, scaling, build_windows(setup, scaling, recordings)


@pytest.fixture(scope="module")
def one():
    """Setup and windows of one recording."""
    setup, _, windows = prepared([recording(1)])
    return setup, windows


@pytest.fixture(scope="module")
def four():
    """Setup and windows of four recordings."""
    setup, _, windows = prepared([recording(k) for k in range(4)])
    return setup, windows


LONG = TrainConfig(recipe="paper", hidden=4, epochs=60, batch=200)


@pytest.fixture(scope="module")
def whole(four):
    """The network of LONG, trained without an interruption."""
    return train_network(*four, four[1], LONG)


def trained_like(one, other) -> bool:
    return one.parameters.tobytes() == other.parameters.tobytes() and one.history == other.history


def test_windows_hold_the_papers_inputs_and_the_observers_residual():
    made = recording(1)
    setup, scaling, windows = prepared([made])
    observation = _core.observe(setup.tree, setup.observer, *made.signals)
    # Network samples are every tenth; the first that is warm (0.5 s) and has ten steps and one lag behind it is 500.
    assert windows.windows == (4000 - 500) // 10
    first = windows.ends[0] * 10
    assert first == 500
    np.testing.assert_allclose(
        windows.target_rows[windows.ends[0]] * scaling.output_scale_nm, observation.residual[first], rtol=1e-6
    )
    row = windows.rows[windows.ends[0]] / scaling.input_factors
    np.testing.assert_allclose(row, np.r_[made.q[first], made.dq[first]], rtol=1e-6)
    assert setup.inputs == [(0, 0), (1, 0), (2, 0), (3, 0), (2, 1), (3, 1)]  # q(k), dq(k), dq(k-1)


def test_no_window_reaches_across_a_restart_or_starts_in_the_observers_warm_up():
    setup, _, whole = prepared([recording(1)])
    _, _, broken = prepared([recording(1, missing=slice(2003, 2103))])
    # Both stretches lose the 0.5 s of warm-up: 350 windows shrink by those of the gap and of the second warm-up.
    assert whole.windows == 350
    assert broken.windows == (2003 - 500 + 9) // 10 + (4000 - 2103 - 500 + 9) // 10
    reach = setup.reach
    assert (broken.ends - reach >= 0).all()


def test_windows_of_several_recordings_never_mix():
    parts = [recording(1), recording(2)]
    setup, scaling, both = prepared(parts)
    separate = [build_windows(setup, scaling, [part]) for part in parts]
    assert both.windows == sum(s.windows for s in separate)
    second = both.ends[separate[0].windows :] - len(separate[0].rows)
    np.testing.assert_array_equal(second, separate[1].ends)
    np.testing.assert_array_equal(both.rows[len(separate[0].rows) :], separate[1].rows)


def test_training_lowers_the_loss_and_the_same_seed_gives_the_same_bytes_on_any_number_of_threads(four):
    setup, windows = four
    config = TrainConfig(recipe="paper", hidden=8, epochs=20, batch=100, learning_rate=0.01, threads=1)
    changed = config, replace(config, threads=2), replace(config, seed=1)
    one, two, other = (train_network(setup, windows, windows, some) for some in changed)
    assert one.parameters.tobytes() == two.parameters.tobytes()
    assert one.parameters.tobytes() != other.parameters.tobytes()
    assert one.history[-1][2] < 0.5 * np.mean(windows.target_rows[windows.ends] ** 2)


def stopped(gradient, at: int, stop):
    """The core's gradient, whose call number `at` ends in stop()."""
    calls = []

    def counted(*arguments):
        calls.append(1)
        if len(calls) == at:
            stop()
        return gradient(*arguments)

    return counted


def interrupt(*_):
    raise KeyboardInterrupt


@pytest.mark.parametrize("at", [1, 38, 200, 700])  # before the first entry, between two, and right after one
def test_an_interrupted_run_goes_on_to_the_same_bytes(at, four, whole, tmp_path, monkeypatch):
    arguments = *four, four[1], LONG, tmp_path / "checkpoint.npz", {"case": "exact"}
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(_core, "lstm_gradient", stopped(_core.lstm_gradient, min(at, whole.steps), interrupt))
        train_network(*arguments)
    assert (tmp_path / "checkpoint.npz").exists()
    assert trained_like(train_network(*arguments), whole)
    assert trained_like(train_network(*arguments, interrupt), whole)  # nothing is left to do


def test_an_interruption_while_a_loss_is_reported_changes_no_entry(four, whole, tmp_path):
    arguments = *four, four[1], LONG, tmp_path / "checkpoint.npz", {}
    with pytest.raises(KeyboardInterrupt):
        train_network(*arguments, interrupt)
    assert train_network(*arguments).history == whole.history


def test_a_killed_training_loses_what_came_after_its_last_checkpoint_alone(four, whole, tmp_path, monkeypatch):
    path, killed_at = tmp_path / "checkpoint.npz", 30
    arguments = *four, four[1], LONG, path, {}
    monkeypatch.setattr(network_training, "CHECKPOINT_EVERY_S", 0.0)  # at every step
    pid = os.fork()
    if pid == 0:
        _core.lstm_gradient = stopped(_core.lstm_gradient, killed_at, lambda: os.kill(os.getpid(), signal.SIGKILL))
        train_network(*arguments)
        os._exit(0)  # not reached
    assert os.WTERMSIG(os.waitpid(pid, 0)[1]) == signal.SIGKILL
    assert load_checkpoint({}, path).at[1].steps == killed_at - 1
    assert trained_like(train_network(*arguments), whole)


def test_a_checkpoint_of_other_settings_or_a_damaged_one_is_refused_and_kept(one, tmp_path):
    path, settings = tmp_path / "checkpoint.npz", {"case": "exact", "seed": 0}
    arguments = *one, one[1], TrainConfig(recipe="paper", hidden=4, epochs=1, batch=100), path
    with pytest.raises(KeyboardInterrupt):
        train_network(*arguments, settings, interrupt)
    with pytest.raises(ConfigError, match=r"other settings \(seed\)"):
        train_network(*arguments, settings | {"seed": 1})
    assert path.exists()
    with np.load(path) as stored:
        kept = dict(stored)
    damages = [
        ("parameters", np.full(len(kept["parameters"]), "a")),
        ("m", kept["m"][1:]),
        ("best", np.full_like(kept["best"], np.nan)),
        ("history", np.array("strings")),
        ("settings", np.array('"text"')),
        ("seconds", np.array("soon")),
    ]
    files = [io.BytesIO() for _ in range(len(damages) + 1)]
    for file, (name, odd) in zip(files, damages, strict=False):
        np.savez(file, **kept | {name: odd})
    np.save(files[-1], np.array(["strings"]))
    for content in (*(file.getvalue() for file in files), path.read_bytes()[:100]):
        path.write_bytes(content)
        with pytest.raises(ConfigError, match="checkpoint cannot be read"):
            train_network(*arguments, settings)


def test_a_constant_target_is_an_error_that_names_the_joint():
    # At rest in one pose without torque the residual is the constant gravity torque once it has settled.
    zeros = np.zeros((4000, 2))
    still = recording(1, q=zeros, dq=zeros, tau=zeros)
    with pytest.raises(TrainingError, match="'shoulder'.*constant"):
        find_scaling(build_setup(planar_arm(), still, SMALL), [still])


def test_a_diverging_loss_is_an_error_that_names_the_learning_rate(one):
    config = TrainConfig(recipe="paper", hidden=4, epochs=5, batch=100, learning_rate=1e3)
    with pytest.raises(TrainingError, match="diverges.*learning_rate = 1000"):
        train_network(*one, one[1], config)


@pytest.mark.parametrize(
    "seconds, message", [(0.3, "longer than the observer's warm-up"), (0.55, "fewer than a batch")]
)
def test_too_little_data_is_an_error(seconds, message):
    with pytest.raises(TrainingError, match=message):
        setup, _, windows = prepared([recording(1, seconds=seconds)])
        train_network(setup, windows, windows, TrainConfig(recipe="paper", hidden=4, epochs=1, batch=100))


def test_a_bundle_says_of_a_recording_what_the_network_was_trained_on(tmp_path):
    made = [recording(k) for k in range(3)]
    setup, scaling, windows = prepared(made)
    network = train_network(setup, windows, windows, TrainConfig(recipe="paper", hidden=4, epochs=2, batch=100))
    bundle = make_bundle("small", setup, 0.02, made[0], scaling, network)
    limits = paper_limits(bundle, made[1:], threads=1)
    kept = paper_limits(bundle, [with_outputs(bundle, one, 2) for one in made[1:]], threads=1)
    np.testing.assert_array_equal(kept, limits)
    bundle.sliding_limit_nm, bundle.near_stiction_limit_nm = limits.tolist()
    bundle.provenance = json.dumps({"made": "here"})
    path = tmp_path / "small.tauext"
    bundle.save(str(path))
    loaded = _core.Bundle.load(str(path))
    said = _core.estimate(loaded, *made[0].signals, 2)
    at = windows.ends[:350] * 10  # the first recording's windows are the first
    expected = _core.lstm_forward(
        network.shape, network.parameters, windows.rows, 1, setup.window_steps, setup.inputs, windows.ends[:350], 1
    )
    np.testing.assert_array_equal(said["network"][at], expected * scaling.output_scale_nm)
    np.testing.assert_array_equal(said["tau_ext"][at], (said["residual"] - said["network"])[at])
    # On the recordings that set the limit nothing exceeds it.
    for one in made[1:]:
        assert not _core.estimate(loaded, *one.signals, 1)["detection"].any()
    assert np.isnan(said["network"][:500]).all() and not (said["health"][:500] == 1).any()


def test_a_recording_of_other_joints_is_refused_by_name():
    made = recording(1, joints=("a", "b"))
    with pytest.raises(TrainingError, match="a, b are not the model's shoulder, elbow"):
        build_setup(planar_arm(), made, SMALL)


def test_dense_sequences_lie_whole_in_one_stretch_of_one_recording():
    parts = [recording(1), recording(2, missing=slice(2003, 2103)), recording(3)]
    setup, _, windows = prepared(parts)
    config = TrainConfig(recipe="dense", targets=20, batch=500, max_steps=10).resolved()
    schedule = DenseSchedule(setup, windows, config)
    ends = np.unique(np.concatenate([schedule.ends(step) for step in range(10)]))
    first_row = dict(zip(windows.ends, windows.first_rows, strict=True))
    assert schedule.length == setup.window_steps - 1 + 20 - 4  # the first four targets see less than a window
    assert all(end - (schedule.length - 1) - 1 >= first_row[end] for end in ends)  # one more for the lag of dq
    assert len(ends) > 200
    np.testing.assert_array_equal(schedule.ends(3), schedule.ends(3))
    assert not np.array_equal(schedule.ends(3), schedule.ends(4))


def test_a_dense_sequence_with_one_target_is_the_papers_window(one):
    setup, windows = one
    config = TrainConfig(recipe="dense", targets=1, batch=50, max_steps=5).resolved()
    schedule = DenseSchedule(setup, windows, config)
    assert (schedule.length, schedule.targets) == (setup.window_steps, 1)
    dense = CoreBackend(setup, windows, 6, schedule.length, schedule.targets, threads=1)
    paper = CoreBackend(setup, windows, 6, setup.window_steps, 1, threads=1)
    start = dense.initial_parameters(0).astype(np.float32)
    assert dense.gradient(start, schedule.ends(0))[1].tobytes() == paper.gradient(start, schedule.ends(0))[1].tobytes()


def test_the_network_of_recipe_tauext_sees_a_whole_window_before_every_target(one):
    setup, windows = one
    schedule = DenseSchedule(setup, windows, TrainConfig(recipe="tauext", targets=20, max_steps=10).resolved())
    assert schedule.length == setup.window_steps - 1 + 20
    assert (schedule.largest_gradient, schedule.square_decay) == (0.1, 0.999)


def test_the_optimiser_of_the_dense_recipe_sees_larger_speeds_and_their_changes(one):
    setup, windows = one
    x = np.array([0.1, 0.2, 0.3, 0.4, 0.25, 0.45])  # q, dq, dq a step before
    basis = input_basis(setup, RECIPES["dense"].drawing)
    assert basis @ x == pytest.approx([0.1, 0.2, 1.5, 2.0, 75 * 0.05, -75 * 0.05])
    config = TrainConfig(recipe="dense", hidden=3, targets=5).resolved()
    seen = make_backend(setup, windows, config, setup.window_steps, 5)
    plain = CoreBackend(setup, windows, 3, setup.window_steps, 5, threads=1)
    parameters, ends = seen.initial_parameters(0), windows.ends[:20]
    weights = seen.weights(parameters)
    np.testing.assert_allclose(weights[:72].reshape(12, 6), parameters[:72].reshape(12, 6) @ basis)
    np.testing.assert_array_equal(weights[72:], parameters[72:])
    small = parameters.astype(np.float32)
    np.testing.assert_array_equal(seen.predict(small, windows, ends), plain.predict(seen.weights(small), windows, ends))
    loss, gradient = seen.gradient(small, ends)
    for at in (1, 2, 4, 80):  # against differences
        losses = []
        for step in (-2e-3, 2e-3):
            moved = parameters.copy()
            moved[at] += step
            losses.append(seen.gradient(moved.astype(np.float32), ends)[0])
        assert gradient[at] == pytest.approx((losses[1] - losses[0]) / 4e-3, rel=0.02, abs=2e-6)


@pytest.mark.parametrize("recipe", ["paper", "tauext"])
def test_other_recipes_train_on_the_inputs_themselves(recipe, one):
    setup, windows = one
    config = TrainConfig(recipe=recipe, hidden=3).resolved()
    assert isinstance(make_backend(setup, windows, config, setup.window_steps, 1), CoreBackend)


def test_adam_forgets_a_large_gradient_by_the_schedules_decay():
    def step_after_a_large_one(beta_2: float) -> float:
        """The last of 300 steps with gradients of 0.1 behind one of 10."""
        at, adam = Adam.start(1).step(np.zeros(1), np.full(1, 10.0), 0.01, beta_2)
        for _ in range(300):
            before = at
            at, adam = adam.step(at, np.full(1, 0.1), 0.01, beta_2)
        return float(before[0] - at[0])

    assert step_after_a_large_one(0.99) > 2 * step_after_a_large_one(0.999)
    assert PaperSchedule.square_decay == 0.999


def test_the_dense_learning_rate_rises_and_falls_to_zero(one):
    schedule = DenseSchedule(*one, TrainConfig(recipe="dense", targets=20, max_steps=1000).resolved())
    rates = np.array([schedule.learning_rate(step) for step in range(1000)])
    assert rates.max() == pytest.approx(0.01, rel=0.03) and 40 <= rates.argmax() <= 60
    assert (rates > 0).all() and rates[-1] < 1e-6
    assert (np.diff(rates[:50]) > 0).all() and (np.diff(rates[51:]) < 0).all()


def test_dense_training_prefers_settled_weights_and_stops_early_only_when_it_gets_no_better(one):
    schedule = DenseSchedule(*one, TrainConfig(recipe="dense", targets=20, max_steps=1000).resolved())
    assert schedule.score(900, 1.0) < schedule.score(700, 0.8)  # a lucky draw at a high rate
    assert schedule.score(900, 1.0) > schedule.score(300, 0.5)  # the network overfitted since
    for best_at, until in itertools.product((300, 800, 850), (850, 900)):
        history = [(step, 1.0, 0.5 if step == best_at else 1.0) for step in range(50, until + 1, 50)]
        assert schedule.gives_up(history) == (best_at < 850 < until)
    assert not schedule.gives_up([])


def test_in_equal_arithmetic_the_dense_recipe_gets_further_than_the_papers():
    setup, _, windows = prepared([recording(k, seconds=6.0) for k in range(6)])
    steps = 300
    # A dense sequence of 29 steps costs about three windows of ten: a third of the sequences.
    dense = TrainConfig(recipe="dense", hidden=8, targets=20, batch=32, max_steps=steps)
    paper = TrainConfig(recipe="paper", hidden=8, batch=96, max_steps=steps, epochs=1000)
    losses = [min(h[2] for h in train_network(setup, windows, windows, config).history) for config in (dense, paper)]
    assert losses[0] < 0.5 * losses[1]


def test_sequences_longer_than_every_recording_are_refused():
    setup, _, windows = prepared([recording(1, seconds=2.0)])
    with pytest.raises(TrainingError, match="sequence of 305 steps.*lower targets = 300"):
        train_network(setup, windows, windows, TrainConfig(recipe="dense", targets=300, max_steps=5))


def test_epochs_are_refused_where_a_recipe_has_none():
    with pytest.raises(ConfigError, match="epochs = 3 must be left out"):
        TrainConfig(recipe="dense", epochs=3)
