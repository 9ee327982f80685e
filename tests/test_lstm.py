"""The network: against stored vectors of PyTorch, PyTorch itself where installed, finite differences, and itself."""

from pathlib import Path

import numpy as np
import pytest

from tauext import _core

GOLDEN = np.load(Path(__file__).parent / "golden" / "lstm.npz")
STEP_INPUTS = [(f, 0) for f in range(6)]


def beside(rows: np.ndarray, ends: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Targets of windows as rows beside the features; rows that end no window have none."""
    target_rows = np.full((len(rows), targets.shape[1]), np.nan, dtype=np.float32)
    target_rows[ends] = targets
    return target_rows


def as_rows(windows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Windows (N, T, F) one after the other as rows (N T, F), and the row that ends each."""
    count, length, inputs = windows.shape
    return windows.reshape(-1, inputs).copy(), np.arange(1, count + 1, dtype=np.int64) * length - 1


def random_case(seed: int, shape: _core.LstmShape, length: int, count: int):
    rng = np.random.default_rng(seed)
    parameters = rng.normal(0, 0.4, shape.parameter_count).astype(np.float32)
    windows = rng.uniform(-1, 1, (count, length, shape.inputs)).astype(np.float32)
    targets = rng.uniform(-1, 1, (count, shape.outputs)).astype(np.float32)
    return parameters, windows, targets


def test_forward_equals_stored_pytorch_output():
    rows, ends = as_rows(GOLDEN["windows"])
    shape = _core.LstmShape(6, 20, 2)
    out = _core.lstm_forward(shape, GOLDEN["parameters"], rows, 1, 100, STEP_INPUTS, ends, 1)
    # 1e-6: about ten float roundings of values near 1.
    np.testing.assert_allclose(out, GOLDEN["output"], atol=1e-6, rtol=0)


def test_gradient_equals_stored_pytorch_gradient():
    rows, ends = as_rows(GOLDEN["windows"])
    shape = _core.LstmShape(6, 20, 2)
    loss, gradient = _core.lstm_gradient(
        shape, GOLDEN["parameters"], rows, 1, 100, STEP_INPUTS, ends, beside(rows, ends, GOLDEN["targets"]), 1, 1
    )
    assert loss == pytest.approx(float(GOLDEN["loss"]), rel=1e-6)
    error = np.linalg.norm(gradient - GOLDEN["gradient"]) / np.linalg.norm(GOLDEN["gradient"])
    assert error < 1e-5  # float against double through 100 steps


@pytest.mark.parametrize(
    "hidden, inputs, outputs, count", [(1, 1, 1, 1), (5, 3, 2, 18), (20, 21, 7, 70), (33, 4, 3, 9)]
)
def test_gradient_equals_finite_differences(hidden, inputs, outputs, count):
    shape = _core.LstmShape(inputs, hidden, outputs)
    parameters, windows, targets = random_case(hidden, shape, 12, count)
    rows, ends = as_rows(windows)
    step_inputs = [(f, 0) for f in range(inputs)]

    def loss(p):
        out = _core.lstm_forward(shape, p.astype(np.float32), rows, 1, 12, step_inputs, ends, 1)
        return float(np.mean((out.astype(float) - targets) ** 2))

    _, gradient = _core.lstm_gradient(
        shape, parameters, rows, 1, 12, step_inputs, ends, beside(rows, ends, targets), 1, 2
    )
    rng = np.random.default_rng(1)
    for _ in range(20):
        direction = rng.normal(size=parameters.size)
        direction /= np.linalg.norm(direction)
        h = 2e-3
        numeric = (loss(parameters + h * direction) - loss(parameters - h * direction)) / (2 * h)
        # float rounding of the loss (1e-7) over 2 h, and the cubic term h^2.
        assert numeric == pytest.approx(float(gradient @ direction), abs=3e-4)


def test_forward_and_gradient_equal_pytorch():
    torch = pytest.importorskip("torch")
    shape = _core.LstmShape(21, 20, 7)
    parameters, windows, targets = random_case(3, shape, 100, 130)
    rows, ends = as_rows(windows)
    step_inputs = [(f, 0) for f in range(21)]
    lstm = torch.nn.LSTM(21, 20, batch_first=True).double()
    head = torch.nn.Linear(20, 7).double()
    tensors = [lstm.weight_ih_l0, lstm.weight_hh_l0, lstm.bias_ih_l0, head.weight, head.bias]
    at = 0
    for tensor in tensors:
        tensor.data = torch.from_numpy(parameters[at : at + tensor.numel()]).double().reshape(tensor.shape)
        at += tensor.numel()
    lstm.bias_hh_l0.data.zero_()
    output = head(lstm(torch.from_numpy(windows).double())[0][:, -1])
    torch.nn.functional.mse_loss(output, torch.from_numpy(targets).double()).backward()
    expected = np.concatenate([t.grad.numpy().ravel() for t in tensors])
    out = _core.lstm_forward(shape, parameters, rows, 1, 100, step_inputs, ends, 2)
    _, gradient = _core.lstm_gradient(
        shape, parameters, rows, 1, 100, step_inputs, ends, beside(rows, ends, targets), 1, 2
    )
    np.testing.assert_allclose(out, output.detach().numpy(), atol=1e-6, rtol=0)
    assert np.linalg.norm(gradient - expected) / np.linalg.norm(expected) < 1e-5


def test_gradient_bytes_do_not_depend_on_the_number_of_threads():
    shape = _core.LstmShape(6, 20, 2)
    parameters, windows, targets = random_case(4, shape, 30, 333)
    rows, ends = as_rows(windows)
    one = _core.lstm_gradient(shape, parameters, rows, 1, 30, STEP_INPUTS, ends, beside(rows, ends, targets), 1, 1)
    for threads in (2, 3, 8):
        many = _core.lstm_gradient(
            shape, parameters, rows, 1, 30, STEP_INPUTS, ends, beside(rows, ends, targets), 1, threads
        )
        assert many[0] == one[0]
        assert many[1].tobytes() == one[1].tobytes()


def test_a_window_gives_the_same_bytes_wherever_it_stands_in_a_batch():
    shape = _core.LstmShape(6, 20, 2)
    parameters, windows, _ = random_case(5, shape, 30, 75)
    rows, ends = as_rows(windows)
    together = _core.lstm_forward(shape, parameters, rows, 1, 30, STEP_INPUTS, ends, 2)
    for k in (0, 7, 74):
        alone = _core.lstm_forward(shape, parameters, rows, 1, 30, STEP_INPUTS, ends[k : k + 1], 1)
        assert alone.tobytes() == together[k : k + 1].tobytes()


def test_strided_windows_with_lags_equal_windows_that_were_written_out():
    shape = _core.LstmShape(3, 7, 2)
    rng = np.random.default_rng(6)
    parameters = rng.normal(0, 0.4, shape.parameter_count).astype(np.float32)
    rows = rng.uniform(-1, 1, (500, 2)).astype(np.float32)
    stride, length, inputs = 10, 12, [(0, 0), (1, 0), (1, 1)]
    ends = np.array([120, 121, 333, 499], dtype=np.int64)
    steps = ends[:, None] - stride * np.arange(length - 1, -1, -1)  # (windows, length)
    written = np.stack([rows[steps, 0], rows[steps, 1], rows[steps - stride, 1]], axis=-1)
    plain_rows, plain_ends = as_rows(written)
    expected = _core.lstm_forward(shape, parameters, plain_rows, 1, length, [(0, 0), (1, 0), (2, 0)], plain_ends, 1)
    out = _core.lstm_forward(shape, parameters, rows, stride, length, inputs, ends, 1)
    assert out.tobytes() == expected.tobytes()


def test_activations_stay_within_their_stated_error():
    x = np.concatenate([np.linspace(-25, 25, 400_001), np.linspace(-1e-3, 1e-3, 1001)]).astype(np.float32)
    sigmoid, tanh = _core.lstm_activations(x)
    exact = x.astype(float)
    assert np.abs(sigmoid - 1 / (1 + np.exp(-exact))).max() <= 5e-7
    assert np.abs(tanh - np.tanh(exact)).max() <= 5e-7


def test_a_nan_input_gives_a_nan_output():
    shape = _core.LstmShape(6, 20, 2)
    parameters, windows, _ = random_case(7, shape, 10, 3)
    windows[1, 4, 2] = np.nan
    rows, ends = as_rows(windows)
    out = _core.lstm_forward(shape, parameters, rows, 1, 10, STEP_INPUTS, ends, 1)
    assert np.isnan(out[1]).all()
    assert np.isfinite(out[[0, 2]]).all()


@pytest.mark.parametrize(
    "change, message",
    [
        ({"ends": np.array([3], dtype=np.int64)}, "reaches back 9"),
        ({"ends": np.array([30], dtype=np.int64)}, "there are 30"),
        ({"inputs": [(6, 0)] * 6}, "column 6"),
        ({"inputs": STEP_INPUTS[:5]}, "6 inputs, the windows 5"),
        ({"parameters": np.zeros(5, np.float32)}, "parameters"),
        ({"stride": 0}, "stride"),
        ({"threads": 0}, "threads"),
    ],
)
def test_sizes_that_do_not_fit_are_refused(change, message):
    shape = _core.LstmShape(6, 20, 2)
    parameters, windows, _ = random_case(8, shape, 10, 3)
    rows, ends = as_rows(windows)
    arguments = {
        "shape": shape,
        "parameters": parameters,
        "rows": rows,
        "stride": 1,
        "length": 10,
        "inputs": STEP_INPUTS,
        "ends": ends,
        "threads": 1,
    }
    with pytest.raises(_core.CoreError, match=message):
        _core.lstm_forward(**(arguments | change))
