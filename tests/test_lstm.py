"""The network: against stored vectors of PyTorch, PyTorch itself where installed, finite differences, and itself."""

from pathlib import Path

import numpy as np
import pytest

from tauext import _core

GOLDEN = np.load(Path(__file__).parent / "golden" / "lstm.npz")
STEP_INPUTS = [(f, 0) for f in range(6)]


def as_rows(windows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Windows (N, T, F) one after the other as rows (N T, F), and the row that ends each."""
    count, length, inputs = windows.shape
    return windows.reshape(-1, inputs).copy(), np.arange(1, count + 1, dtype=np.int64) * length - 1


def random_case(seed: int, shape: _core.LstmShape, length: int, count: int):
    rng = np.random.default_rng(seed)
    parameters = rng.normal(0, 0.4, shape.parameter_count).astype(np.float32)
    return parameters, rng.uniform(-1, 1, (count, length, shape.inputs)).astype(np.float32)


def test_forward_equals_stored_pytorch_output():
    rows, ends = as_rows(GOLDEN["windows"])
    shape = _core.LstmShape(6, 20, 2)
    out = _core.lstm_forward(shape, GOLDEN["parameters"], rows, 1, 100, STEP_INPUTS, ends, 1)
    # 1e-6: about ten float roundings of values near 1.
    np.testing.assert_allclose(out, GOLDEN["output"], atol=1e-6, rtol=0)


def test_gradient_equals_stored_pytorch_gradient():
    rows, ends = as_rows(GOLDEN["windows"])
    shape, targets = _core.LstmShape(6, 20, 2), np.full((len(rows), 2), np.nan, dtype=np.float32)
    targets[ends] = GOLDEN["targets"]  # rows that end no window have none
    loss, gradient = _core.lstm_gradient(shape, GOLDEN["parameters"], rows, 1, 100, STEP_INPUTS, ends, targets, 1, 1)
    assert loss == pytest.approx(float(GOLDEN["loss"]), rel=1e-6)
    error = np.linalg.norm(gradient - GOLDEN["gradient"]) / np.linalg.norm(GOLDEN["gradient"])
    assert error < 1e-5  # float against double through 100 steps


def test_a_window_gives_the_same_bytes_wherever_it_stands_in_a_batch():
    shape = _core.LstmShape(6, 20, 2)
    parameters, windows = random_case(5, shape, 30, 75)
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


def test_a_nan_input_gives_a_nan_output():
    shape = _core.LstmShape(6, 20, 2)
    parameters, windows = random_case(7, shape, 10, 3)
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
    parameters, windows = random_case(8, shape, 10, 3)
    rows, ends = as_rows(windows)
    arguments = {"shape": shape, "parameters": parameters, "rows": rows, "stride": 1, "length": 10}
    with pytest.raises(_core.CoreError, match=message):
        _core.lstm_forward(**arguments | {"inputs": STEP_INPUTS, "ends": ends, "threads": 1} | change)
