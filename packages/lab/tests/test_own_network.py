"""A bundle from the weights of a network that was trained elsewhere: its output, its limits, and bad files."""

import hashlib
import json
import pickle
import zipfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from doc_pages import Page, parses
from made_results import run_command
from tauext_lab.own_network import load_network

from tauext import _core
from tauext.cli import main
from tauext.config import ObserverConfig, TrainConfig
from tauext.data.dataset import load_dataset
from tauext.errors import ConfigError
from tauext.train.stage import train_bundle

HIDDEN, JOINTS = 7, 2


def weights(hidden: int = HIDDEN, joints: int = JOINTS, kind=np.float64, **changes) -> dict[str, np.ndarray]:
    """Random weights under PyTorch's names, whose speeds have two scales."""
    rng = np.random.default_rng(3)
    made = {
        "lstm.weight_ih_l0": rng.normal(0, 0.5, (4 * hidden, 3 * joints)),
        "lstm.weight_hh_l0": rng.normal(0, 0.3, (4 * hidden, hidden)),
        "lstm.bias_ih_l0": rng.normal(0, 0.3, 4 * hidden),
        "lstm.bias_hh_l0": rng.normal(0, 0.3, 4 * hidden),
        "linear.weight": rng.normal(0, 0.3, (joints, hidden)),
        "linear.bias": rng.normal(0, 0.3, joints),
        "input_scale": rng.uniform(1.0, 3.0, 3 * joints),
        "output_scale_nm": rng.uniform(5.0, 50.0, joints),
    }
    made = {name: array.astype(kind) for name, array in made.items()} | changes
    return {name: array for name, array in made.items() if array is not None}


def saved(path, **changes):
    np.savez(path, **weights(**changes))
    return path


def windows_of(recording, ends: np.ndarray, stride: int) -> np.ndarray:
    """Inputs q(k), dq(k), dq(k-1) of 100 network steps, oldest first: (ends, 100, 3n)."""
    k = ends[:, None] - stride * np.arange(99, -1, -1)
    return np.concatenate([recording.q[k], recording.dq[k], recording.dq[k - stride]], axis=-1)


def twin(w: dict[str, np.ndarray], windows: np.ndarray) -> np.ndarray:
    """Scaled output of each window from PyTorch's arrays in float64: (windows, n)."""

    def sigmoid(x):
        return 1 / (1 + np.exp(-x))

    h = c = np.zeros((len(windows), w["lstm.weight_hh_l0"].shape[1]))
    for x in np.swapaxes(windows / w["input_scale"], 0, 1):
        gates = x @ w["lstm.weight_ih_l0"].T + w["lstm.bias_ih_l0"] + h @ w["lstm.weight_hh_l0"].T
        i, f, g, o = np.split(gates + w["lstm.bias_hh_l0"], 4, axis=1)
        c = sigmoid(f) * c + sigmoid(i) * np.tanh(g)
        h = sigmoid(o) * np.tanh(c)
    return h @ w["linear.weight"].T + w["linear.bias"]


def network_output(bundle: _core.Bundle, recording) -> tuple[np.ndarray, np.ndarray]:
    """Output of the bundle's network, (samples, n) [N m], and the samples that have one."""
    signals = (recording.t_ns, recording.q, recording.dq, recording.tau)
    estimates = _core.estimate(bundle, *signals, 1)
    return estimates["network"], np.flatnonzero(estimates["health"] == 1)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("own") / "data"
    assert main(["simulate", "--out", str(folder), "--minutes", "1", "--collision-recordings", "1"]) == 0
    return folder


def trained(data, file, out, **settings) -> _core.Bundle:
    config = TrainConfig(**({"recipe": "paper"} | settings))
    return train_bundle(
        load_dataset(data), out, case="none", config=config, check=False, start=load_network(Path(file))
    )


@pytest.mark.parametrize("kind", [np.float64, np.float32])
def test_a_bundle_of_given_weights_equals_a_slow_twin(data, tmp_path, kind):
    file = saved(tmp_path / "own.npz", kind=kind)
    bundle = trained(data, file, tmp_path / "own.tauext")
    recording = load_dataset(data).recordings("test")[0]
    output, healthy = network_output(bundle, recording)
    ends = np.random.default_rng(1).choice(healthy, 200)
    w = {name: array.astype(float) for name, array in weights(kind=kind).items()}
    expected = twin(w, windows_of(recording, ends, bundle.observer.network_stride))
    # 1e-6 in units of the network: float32 against float64 through 100 steps.
    np.testing.assert_allclose(output[ends] / w["output_scale_nm"], expected, atol=1e-6, rtol=0)
    assert np.ptp(expected, axis=0).min() > 0.01  # the windows differ


def test_a_bundle_of_given_weights_equals_pytorch(data, tmp_path):
    torch = pytest.importorskip("torch")

    class Network(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.lstm = torch.nn.LSTM(3 * JOINTS, HIDDEN, batch_first=True)
            self.head = torch.nn.Linear(HIDDEN, JOINTS)

        def forward(self, x):
            return self.head(self.lstm(x)[0][:, -1])

    torch.manual_seed(3)
    network, scale, output_nm = Network(), np.array([3.0, 2.0, 1.5, 2.5, 1.7, 2.2]), np.array([40.0, 9.0])
    state = {name: tensor.numpy() for name, tensor in network.state_dict().items()}
    np.savez(tmp_path / "own.npz", **state, input_scale=scale, output_scale_nm=output_nm)
    bundle = trained(data, tmp_path / "own.npz", tmp_path / "own.tauext")
    recording = load_dataset(data).recordings("test")[0]
    output, healthy = network_output(bundle, recording)
    ends = np.random.default_rng(1).choice(healthy, 200)
    windows = windows_of(recording, ends, bundle.observer.network_stride) / scale
    with torch.no_grad():
        expected = network(torch.from_numpy(windows.astype(np.float32))).numpy()
    np.testing.assert_allclose(output[ends] / output_nm, expected, atol=1e-6, rtol=0)


def test_the_run_file_names_the_weights_and_no_training(data, tmp_path, capsys):
    file, out = saved(tmp_path / "own.npz"), tmp_path / "own.tauext"
    options = ("--data", data, "--case", "none", "--recipe", "paper", "--network", file, "--out", out)
    assert run_command(capsys, "train", *options)[0] == 0
    run = json.loads(out.with_suffix(".run.json").read_text())
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    assert run["network"] == {"file": "own.npz", "sha256": digest, "hidden": HIDDEN}
    assert (run["steps"], run["training_minutes"], run["epochs"], run["seed"], run["loss_history"]) == (
        0,
        0,
        None,
        None,
        [],
    )
    assert run["settings"]["config"]["hidden"] == HIDDEN and "batch" not in run["settings"]["config"]
    code, text, _ = run_command(capsys, "show", out)
    assert code == 0 and f"own.npz, SHA-256 {digest}" in text
    bundle = _core.Bundle.load(str(out))
    assert (bundle.shape.hidden, bundle.window_steps, bundle.observer.gain_per_s) == (HIDDEN, 100, 20.0)
    arguments = ("evaluate", "--data", data, "--bundles", out, "--out", tmp_path / "results")
    assert run_command(capsys, *arguments)[0] == 0


def test_limits_are_those_of_the_file_unless_a_kind_is_asked_for(data, tmp_path):
    plain, limited = saved(tmp_path / "a.npz"), saved(tmp_path / "b.npz", limit_nm=np.array([15.0, 3.0]))
    ours = trained(data, plain, tmp_path / "a.tauext", observer=ObserverConfig(gain_per_s=5.0))
    given = trained(data, limited, tmp_path / "b.tauext", observer=ObserverConfig(gain_per_s=5.0))
    asked = trained(data, limited, tmp_path / "c.tauext", limits="paper", observer=ObserverConfig(gain_per_s=5.0))
    assert given.sliding_limit_nm == given.near_stiction_limit_nm == given.contact_sliding_limit_nm == [15.0, 3.0]
    assert "b.npz" in json.loads(given.provenance)["limits"]["sentence"]
    assert asked.sliding_limit_nm == ours.sliding_limit_nm != given.sliding_limit_nm
    validation = load_dataset(data).recordings("validation")
    errors = [_core.estimate(ours, r.t_ns, r.q, r.dq, r.tau, 1) for r in validation]
    largest = np.max([np.abs(e["tau_ext"][e["health"] == 1]).max(axis=0) for e in errors], axis=0)
    np.testing.assert_allclose(np.maximum(ours.sliding_limit_nm, ours.near_stiction_limit_nm), largest, rtol=1e-6)


def test_without_validation_recordings_all_free_motion_gives_the_limits(data, tmp_path):
    bare = tmp_path / "bare"
    bare.mkdir()
    for path in data.iterdir():
        (bare / path.name).symlink_to(path)
    split = json.loads((data / "split.json").read_text())
    (bare / "split.json").unlink()
    (bare / "split.json").write_text(json.dumps({"format": 1, "train": split["train"]}))
    bundle = trained(bare, saved(tmp_path / "own.npz"), tmp_path / "own.tauext")
    assert any("on the training recordings" in note for note in json.loads(bundle.provenance)["notes"])


@pytest.mark.parametrize(
    "settings, message",
    [
        ({"recipe": "prior"}, "recipe = prior must be paper with a given network"),
        ({"batch": 64}, "batch = 64 must be left out with a given network"),
        ({"seed": 1}, "seed = 1 must be left out with a given network"),
        ({"backend": "torch"}, "backend = torch must be left out with a given network"),
        ({"hidden": 12}, "hidden = 12 must be left out with a given network, which has 7"),
        ({"error_scale": "on"}, "error_scale = on must be left out with limit_nm"),
    ],
)
def test_settings_without_effect_are_refused(data, tmp_path, settings, message):
    file = saved(tmp_path / "own.npz", limit_nm=np.ones(JOINTS))
    with pytest.raises(ConfigError, match=message):
        trained(data, file, tmp_path / "own.tauext", **settings)
    assert not (tmp_path / "own.tauext").exists()


def test_a_network_of_other_joints_is_refused(data, tmp_path):
    with pytest.raises(ConfigError, match="a network of 3 joints; the recordings have 2: joint1, joint2"):
        trained(data, saved(tmp_path / "own.npz", joints=3), tmp_path / "own.tauext")


NAN = weights()["lstm.weight_hh_l0"].copy()
NAN[3, 2] = np.nan
INFINITE = weights(kind=np.float32)["linear.bias"] * np.float32(np.inf)


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"lstm.bias_hh_l0": None}, "a key that ends in 'bias_hh_l0' is missing; the file has lstm.weight_ih_l0, lstm"),
        ({"input_scale": None}, "'input_scale' is missing; the file has lstm.weight_ih_l0"),
        ({"lstm.weight_ih_l1": np.zeros((28, 7))}, "lstm.weight_ih_l1 is unknown; the network has one LSTM layer"),
        ({"norm.weight": np.zeros(7)}, "linear.weight and norm.weight end in 'weight', must be one"),
        ({"lstm.weight_ih_l0": np.zeros((28, 4))}, r"weight_ih_l0 has the shape \(28, 4\), must be \(28, 6\): 4H x 3n"),
        (
            {"lstm.weight_hh_l0": np.zeros((7, 28))},
            r"weight_hh_l0 has the shape \(7, 28\), must be \(112, 28\): 4H x H",
        ),
        ({"lstm.weight_hh_l0": np.zeros((0, 0))}, "0 hidden units and 2 joints, must be 1 to 256"),
        ({"lstm.weight_hh_l0": np.zeros(())}, "0 hidden units and 2 joints, must be 1 to 256"),
        (
            {"output_scale_nm": np.ones(3)},
            r"output_scale_nm has the shape \(3,\), must be \(2,\): n with H = 7 .* n = 2",
        ),
        ({"limit_nm": np.ones((2, 1))}, r"limit_nm has the shape \(2, 1\), must be \(2,\)"),
        ({"lstm.weight_hh_l0": NAN}, r"weight_hh_l0\[3, 2\] = nan must be a number"),
        ({"linear.bias": INFINITE}, r"bias\[0\] = -?inf must be a number"),
        ({"linear.weight": np.full((2, 7), 1e30)}, r"weight\[0, 0\] = 1e\+30 must be a number within \+-1e\+09"),
        ({"input_scale": np.array([1, 1, 1, 0, 1, 1])}, r"input_scale\[3\] = 0 must be 1e-9 to 1e\+09"),
        ({"output_scale_nm": np.array([1.0, -2.0])}, r"output_scale_nm\[1\] = -2 must be 1e-9"),
        ({"limit_nm": np.array([np.nan, 1.0])}, r"limit_nm\[0\] = nan must be 1e-9"),
        ({"linear.bias": np.array([True, False])}, "linear.bias is of type bool, must be float32 or float64"),
        ({"linear.bias": np.array(["a", "b"])}, "linear.bias is of type <U1, must be float32 or float64"),
        ({"linear.bias": np.array([{}, {}])}, "no file of numpy.savez with plain arrays .*allow_pickle=False"),
    ],
)
def test_bad_weights_are_refused_in_one_line(tmp_path, changes, message):
    file = saved(tmp_path / "own.npz", **changes)
    with pytest.raises(ConfigError, match=message) as raised:
        load_network(file)
    assert str(raised.value).startswith(f"{file}: ") and "\n" not in str(raised.value)


def test_bad_files_are_refused_in_one_line(data, tmp_path, capsys):
    good = saved(tmp_path / "good.npz").read_bytes()
    contents = {
        "text.npz": b"q, dq\n1, 2\n",
        "empty.npz": b"",
        "cut.npz": good[: len(good) // 2],
        "pickled.npz": pickle.dumps({"weight_ih_l0": 1}),
    }
    for name, content in contents.items():
        (tmp_path / name).write_bytes(content)
    np.save(tmp_path / "one.npy", np.zeros(3))
    with (
        zipfile.ZipFile(tmp_path / "large.npz", "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("a.npy", "w") as file,
    ):
        for _ in range(300):
            file.write(bytes(1 << 20))
    for name in (*contents, "one.npy", "large.npz"):
        with pytest.raises(ConfigError, match=f"{name}: no file of numpy.savez with plain arrays") as raised:
            load_network(tmp_path / name)
        assert "\n" not in str(raised.value)
    options = ("--data", data, "--recipe", "paper", "--network", "gone.npz", "--out", tmp_path / "own.tauext")
    code, _, err = run_command(capsys, "train", *options)
    assert code == 2 and err.splitlines()[-1].startswith("tauext: error: gone.npz: there is no such file")
    with pytest.raises(ConfigError, match="not readable"):
        load_network(tmp_path)


def test_a_damaged_file_is_refused_or_read(tmp_path):
    good, rng = saved(tmp_path / "good.npz").read_bytes(), np.random.default_rng(0)
    refused = 0
    for _ in range(300):
        raw = bytearray(good)
        for at in rng.integers(0, len(raw), 8):
            raw[at] = rng.integers(256)
        (tmp_path / "bad.npz").write_bytes(raw)
        try:
            load_network(tmp_path / "bad.npz")
        except ConfigError as error:
            refused += 1
            assert "\n" not in str(error)
    assert refused > 250


class Tensor:
    """An array with the two methods of a PyTorch tensor that the guide calls."""

    def __init__(self, array: np.ndarray):
        self.numpy = lambda: array

    def cpu(self):
        return self


def test_the_guide_makes_a_bundle(data, tmp_path, monkeypatch):
    page = Page("../packages/lab/README.md", "A network of your own")
    names = (
        "lstm.weight_ih_l0",
        "lstm.weight_hh_l0",
        "lstm.bias_ih_l0",
        "lstm.bias_hh_l0",
        "linear.weight",
        "linear.bias",
    )
    state = {name.replace("linear", "head"): Tensor(weights()[name]) for name in names}
    (snippet,), (settings,), (command,) = page.blocks("python"), page.blocks("toml"), page.commands()
    monkeypatch.chdir(tmp_path)
    exec(snippet, {"network": SimpleNamespace(state_dict=lambda: state)})
    (tmp_path / "own.toml").write_text(settings)
    (tmp_path / "data").symlink_to(data)
    assert parses(command, monkeypatch) and main(command) == 0
    plain = trained(data, "own.npz", tmp_path / "plain.tauext")  # the settings of the guide are the defaults
    assert _core.Bundle.load("own.tauext").parameters == plain.parameters
    assert _core.Bundle.load("own.tauext").observer.gain_per_s == plain.observer.gain_per_s
