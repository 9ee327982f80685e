"""PyTorch as a backend: the core's gradient, losses and weights, and networks of other kinds in the same loop."""

import dataclasses
import importlib
import json
import subprocess
import sys

import numpy as np
import pytest
from tauext_lab.own_network import core_parameters
from test_train import prepared, recording

from tauext import _core
from tauext.cli import main
from tauext.config import TrainConfig
from tauext.errors import ConfigError, TrainingError
from tauext.fit.bundle_writing import make_bundle
from tauext.fit.core_backend import CoreBackend
from tauext.fit.network_training import make_backend, make_schedule, train_network

BACKEND = "tauext_lab.torch_backend"
RECIPES = {
    "paper": TrainConfig(recipe="paper", hidden=8, epochs=1000, batch=100, max_steps=200),
    "dense": TrainConfig(recipe="dense", hidden=8, targets=20, batch=50, max_steps=200),
}


@pytest.fixture
def torch():
    return pytest.importorskip("torch")


@pytest.fixture
def backend(torch):
    """The module of TorchBackend."""
    return importlib.import_module(BACKEND)


def small_gru(torch, outputs: int = 2):
    """Another recurrent network, which also answers at every step."""

    class SmallGru(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.gru, self.head = torch.nn.GRU(6, 12, batch_first=True), torch.nn.Linear(12, outputs)

        def sequence(self, x):
            return self.head(self.gru(x)[0])

        def forward(self, x):
            return self.sequence(x)[:, -1]

    torch.manual_seed(0)
    return SmallGru()


def small_tcn(torch):
    """A convolution over time, for windows only."""

    class SmallTcn(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.layers = torch.nn.Sequential(torch.nn.Conv1d(6, 16, 5), torch.nn.ReLU(), torch.nn.Conv1d(16, 2, 6))

        def forward(self, x):
            return self.layers(x.transpose(1, 2))[..., -1]

    torch.manual_seed(0)
    return SmallTcn()


def reference(torch, shape, parameters, setup, windows, ends, length, targets) -> tuple[float, np.ndarray]:
    """Loss and gradient in double precision, from windows written out and PyTorch's own parts alone."""
    lstm = torch.nn.LSTM(shape.inputs, shape.hidden, batch_first=True).double()
    head = torch.nn.Linear(shape.hidden, shape.outputs).double()
    ordered = [lstm.weight_ih_l0, lstm.weight_hh_l0, lstm.bias_ih_l0, head.weight, head.bias]
    parts = np.split(parameters.astype(float), np.cumsum([p.numel() for p in ordered])[:-1])
    for p, part in zip(ordered, parts, strict=True):
        p.data = torch.from_numpy(part.reshape(p.shape).copy())
    lstm.bias_hh_l0.data.zero_()
    steps = ends[:, None] + np.arange(1 - length, 1)
    x = np.stack([windows.rows[steps - lag, column] for column, lag in setup.inputs], axis=-1)
    target = torch.from_numpy(windows.target_rows[steps[:, -targets:]].astype(float))
    y = head(lstm(torch.from_numpy(x.astype(float)))[0])[:, -targets:]
    known = ~target.isnan()
    loss = (y - target)[known].square().sum() / target.numel()
    loss.backward()
    return loss.item(), np.concatenate([p.grad.numpy().ravel() for p in ordered])


def relative(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.linalg.norm(a - b) / np.linalg.norm(b))


def test_without_pytorch_one_line_says_how_to_install_it(monkeypatch):
    setup, _, windows = prepared([recording(1)])
    monkeypatch.setitem(sys.modules, "torch", None)  # what a missing module looks like
    monkeypatch.delitem(sys.modules, BACKEND, raising=False)
    with pytest.raises(ConfigError, match=r"backend = torch needs torch: pip install 'torch'") as raised:
        train_network(
            setup, windows, windows, TrainConfig(recipe="paper", hidden=4, epochs=1, batch=100, backend="torch")
        )
    assert "\n" not in str(raised.value)


def test_pytorch_is_not_imported_before_it_is_asked_for():
    code = "import sys, tauext.cli, tauext.fit, tauext.train; assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("recipe", RECIPES)
def test_the_gradient_equals_the_cores_and_one_in_double_precision(torch, backend, recipe):
    setup, _, windows = prepared([recording(k) for k in range(3)])
    config = RECIPES[recipe].resolved()
    steps = make_schedule(setup, windows, config)
    # A tenth of the targets missing, as where a tick only holds an older sample.
    target_rows = windows.target_rows.copy()
    target_rows[::10] = np.nan
    windows = dataclasses.replace(windows, target_rows=target_rows)
    core = CoreBackend(setup, windows, config.hidden, steps.length, steps.targets, threads=2)
    module = backend.lstm_module(setup, config.hidden, seed=0)
    ours = backend.TorchBackend(module, setup, windows, steps.length, steps.targets)
    rng = np.random.default_rng(0)
    parameters = rng.normal(0, 0.4, core.shape.parameter_count).astype(np.float32)
    ends = steps.ends(0)
    exact_loss, exact = reference(torch, core.shape, parameters, setup, windows, ends, steps.length, steps.targets)
    for one in (ours, core):
        loss, gradient = one.gradient(parameters, ends)
        assert loss == pytest.approx(exact_loss, rel=1e-5)
        assert relative(gradient, exact) < 1e-5  # float against double, through up to 29 steps
    assert relative(ours.gradient(parameters, ends)[1], core.gradient(parameters, ends)[1]) < 1e-5
    # cuDNN on an H200: up to 5e-6 off, also without TF32; the CPU: 1e-7.
    atol = 1e-6 if ours.device.type == "cpu" else 1e-5
    np.testing.assert_allclose(
        ours.predict(parameters, windows, windows.ends), core.predict(parameters, windows, windows.ends), atol=atol
    )


def test_both_backends_start_from_the_same_parameters(backend):
    setup, _, windows = prepared([recording(1)])
    for seed in (0, 7):
        config = TrainConfig(recipe="paper", hidden=5, seed=seed)
        core, ours = (
            make_backend(setup, windows, dataclasses.replace(config, backend=name), setup.window_steps, 1)
            for name in ("core", "torch")
        )
        start = ours.initial_parameters(seed)
        np.testing.assert_array_equal(start.astype(np.float32), core.initial_parameters(seed).astype(np.float32))
        # The untrained second bias is no parameter of the vector, and zero.
        assert len(start) == core.shape.parameter_count and not ours.module.lstm.bias_hh_l0.any()


@pytest.mark.parametrize("recipe", RECIPES)
def test_losses_of_both_backends_agree_after_200_steps(backend, recipe):
    setup, _, windows = prepared([recording(k) for k in range(4)])
    config = RECIPES[recipe]
    runs = [
        train_network(setup, windows, windows, dataclasses.replace(config, backend=name)) for name in ("core", "torch")
    ]
    core, ours = (run.history[-1] for run in runs)
    assert core[0] == ours[0] == 200
    # Roundings differ and Adam divides by small gradients, so the paths part slowly.
    assert ours[1:] == pytest.approx(core[1:], rel=0.01)
    assert not backend.lstm_from_parameters(runs[1].shape, runs[1].parameters)[0].bias_hh_l0.any()


def test_the_same_seed_gives_the_same_bytes(backend):
    setup, _, windows = prepared([recording(k) for k in range(2)])
    config = TrainConfig(recipe="paper", hidden=8, epochs=2, batch=100, backend="torch")
    one, two = (train_network(setup, windows, windows, config).parameters.tobytes() for _ in range(2))
    other = train_network(setup, windows, windows, dataclasses.replace(config, seed=1)).parameters.tobytes()
    assert one == two != other


def parameters_of(lstm, head) -> np.ndarray:
    named = [*lstm.named_parameters(), *head.named_parameters()]
    return core_parameters({name: p.detach().double().numpy() for name, p in named})


def test_weights_go_from_pytorch_into_a_bundle_and_back(torch, backend, tmp_path):
    made = recording(1)
    setup, scaling, windows = prepared([made])
    network = train_network(setup, windows, windows, TrainConfig(recipe="paper", hidden=20, epochs=1, batch=100))
    torch.manual_seed(3)
    lstm, head = torch.nn.LSTM(6, 20, batch_first=True), torch.nn.Linear(20, 2)  # with two biases, both at work
    vector = parameters_of(lstm, head)
    bundle = make_bundle("there", setup, 0.02, made, scaling, dataclasses.replace(network, parameters=vector))
    bundle.save(str(tmp_path / "there.tauext"))
    back = _core.Bundle.load(str(tmp_path / "there.tauext"))
    np.testing.assert_array_equal(np.float32(back.parameters), vector)
    there = backend.LstmModule(lstm, head)
    here = backend.LstmModule(*backend.lstm_from_parameters(back.shape, back.parameters))
    x = torch.from_numpy(np.random.default_rng(0).uniform(-1, 1, (50, 100, 6)).astype(np.float32))
    rows, ends = x.numpy().reshape(-1, 6), np.arange(1, 51) * 100 - 1
    with torch.no_grad():
        expected = there(x).numpy()
        np.testing.assert_allclose(here(x).numpy(), expected, atol=1e-6, rtol=0)
        np.testing.assert_array_equal(here.sequence(x)[:, -1].numpy(), here(x).numpy())
    out = _core.lstm_forward(back.shape, vector, rows, 1, 100, [(f, 0) for f in range(6)], ends, 1)
    np.testing.assert_allclose(out, expected, atol=1e-6, rtol=0)
    np.testing.assert_array_equal(parameters_of(here.lstm, here.head), vector)


def test_a_vector_of_another_length_is_refused(torch, backend):
    setup, _, windows = prepared([recording(1)])
    with pytest.raises(TrainingError, match="2202 parameters, not 5"):
        backend.lstm_from_parameters(_core.LstmShape(6, 20, 2), np.zeros(5))
    research = backend.TorchBackend(small_tcn(torch), setup, windows, setup.window_steps, 1)
    with pytest.raises(TrainingError, match="SmallTcn has 690 parameters, not 5"):
        research.load(np.zeros(5))


@pytest.mark.parametrize("make, recipe", [(small_gru, "paper"), (small_gru, "dense"), (small_tcn, "paper")])
def test_a_network_of_another_kind_learns_in_the_same_loop_and_comes_out_usable(torch, backend, make, recipe):
    setup, _, windows = prepared([recording(k) for k in range(4)])
    config = dataclasses.replace(RECIPES[recipe], learning_rate=0.01)
    steps = make_schedule(setup, windows, config.resolved())
    research = backend.TorchBackend(make(torch), setup, windows, steps.length, steps.targets)
    network = train_network(setup, windows, windows, config, backend=research)
    assert network.history[-1][2] < 0.5 * np.mean(windows.target_rows[windows.ends] ** 2)
    # The best weights, put back into the module, give the loss that was reported for them.
    research.load(network.parameters)
    at = windows.ends[:, None] + np.arange(1 - setup.window_steps, 1)
    x = np.stack([windows.rows[at - lag, column] for column, lag in setup.inputs], axis=-1)
    with torch.no_grad():
        y = research.module(torch.from_numpy(x).to(research.device)).cpu().numpy()
    loss = np.mean((y - windows.target_rows[windows.ends]) ** 2)
    assert loss == pytest.approx(min(validation for _, _, validation in network.history), rel=1e-4)


def test_a_network_without_sequences_is_refused_where_a_sequence_has_several_targets(torch, backend):
    setup, _, windows = prepared([recording(1)])
    with pytest.raises(TrainingError, match=r"SmallTcn has no sequence\(x\).*20 targets"):
        backend.TorchBackend(small_tcn(torch), setup, windows, setup.window_steps + 19, 20)


def test_an_output_of_another_width_is_refused_and_not_spread(torch, backend):
    setup, _, windows = prepared([recording(1)])
    for targets in (1, 5):
        narrow = backend.TorchBackend(
            small_gru(torch, outputs=1), setup, windows, setup.window_steps + targets - 1, targets
        )
        with pytest.raises(TrainingError, match="SmallGru.*n = 2"):
            narrow.gradient(narrow.initial_parameters(0), windows.ends[20:60])
        with pytest.raises(TrainingError, match="SmallGru.*n = 2"):
            narrow.predict(narrow.initial_parameters(0), windows, windows.ends[20:60])


def test_running_statistics_and_an_empty_module_are_refused(torch, backend):
    setup, _, windows = prepared([recording(1)])
    normalised = torch.nn.Sequential(small_tcn(torch), torch.nn.BatchNorm1d(2))
    with pytest.raises(TrainingError, match="Sequential keeps running statistics"):
        backend.TorchBackend(normalised, setup, windows, setup.window_steps, 1)
    with pytest.raises(TrainingError, match="Identity has no trainable parameters"):
        backend.TorchBackend(torch.nn.Identity(), setup, windows, setup.window_steps, 1)


def test_a_sequence_that_would_reach_before_the_first_row_is_refused_or_not_a_number(backend):
    setup, _, windows = prepared([recording(1)])
    length = setup.window_steps
    ours = backend.TorchBackend(backend.lstm_module(setup, 4, 0), setup, windows, length, 1)
    start = ours.initial_parameters(0)
    with pytest.raises(TrainingError, match=f"{length} steps cannot end at row {length - 2}"):
        ours.predict(start, windows, np.array([length - 2]))
    assert np.isnan(ours.predict(start, windows, np.array([length - 1]))).all()  # dq(k-1) of the first step
    assert np.isfinite(ours.predict(start, windows, np.array([length]))).all()


def test_the_command_line_trains_with_pytorch(torch, tmp_path):
    data = tmp_path / "data"
    assert main(["simulate", "--out", str(data), "--minutes", "2", "--collision-recordings", "1"]) == 0
    runs = {}
    for name in ("core", "torch"):
        out = tmp_path / f"{name}.tauext"
        options = ["--recipe", "dense", "--case", "none", "--max-steps", "20", "--batch", "64", "--backend", name]
        assert main(["train", "--data", str(data), *options, "--out", str(out)]) == 0
        runs[name] = json.loads(out.with_suffix(".run.json").read_text())
        assert _core.Bundle.load(str(out)).has_network
    assert runs["torch"]["settings"]["config"]["backend"] == "torch"
    (core,), (ours,) = (runs[name]["loss_history"] for name in ("core", "torch"))
    assert ours == pytest.approx(core, rel=0.01)
