"""The network's gradient and output from PyTorch: for a GPU, and for networks of any kind.

A research network of your own, trained by the same loop on the same windows as ours:

    config = TrainConfig(recipe="paper", max_steps=20_000)
    schedule = make_schedule(setup, training, config.resolved())
    backend = TorchBackend(MyNetwork(), setup, training, schedule.length, schedule.targets)
    network = train(setup, training, validation, config, backend=backend)
    backend.load(network.parameters)  # the best weights, into backend.module

`network.shape` describes the LSTM that a bundle holds, so of a network of another kind only `network.parameters` and
`network.history` are valid, and no bundle can be made of it.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import numpy as np

from tauext import _core
from tauext.config import TrainConfig
from tauext.errors import TrainingError
from tauext.fit.core_backend import CoreBackend
from tauext.fit.training_set import Setup, WindowSet
from tauext.plugins import not_installed
from tauext_lab.own_network import CORE_ORDER

try:
    import torch
except ImportError as missing:
    raise not_installed("backend = torch", "torch") from missing

WINDOWS_AT_ONCE = 1000  # in predict


class TorchBackend:
    """Gradient and output of any module, float32, on the GPU where there is one.

    The parameters are one vector: the module's trainable ones, each flattened, in the order of `module.parameters()`.
    Rows and targets lie on the device; windows are gathered there. On a CPU the same module, data and
    `torch.get_num_threads()` give the same bytes; dropout, if any, draws from PyTorch's own generator.
    PyTorch's LSTM on a CPU sums the gradient of the biases in single precision: at 1000 windows of 100 steps the whole
    gradient is 1e-5 to 6e-5 off, where the core's is 1e-7.

    Args:
        module: maps windows (B, T, F) to the residual at their last step (B, n), scaled units; inputs are in the
            order of `setup.inputs`. For more than one target a sequence it also has `sequence(x)`, which maps (B, T, F)
            to an output at every step (B, T, n) and uses no later step. Training starts from its weights as they
            are, so seed PyTorch before making it. It is moved to the device, and after each call holds the parameters
            of that call; `load` puts others into it.
        length: network steps of a sequence.
        targets: number of its last steps that have a target.

    Raises:
        TrainingError: a module that lacks `sequence` where it is needed, has nothing to train, or whose output depends
            on more than its parameters and input (running statistics).
    """

    def __init__(self, module: torch.nn.Module, setup: Setup, training: WindowSet, length: int, targets: int):
        name = type(module).__name__
        if targets > 1 and not callable(getattr(module, "sequence", None)):
            raise TrainingError(
                f"{name} has no sequence(x), (B, T, F) to (B, T, n), which recipe = dense needs to teach {targets} "
                "targets a sequence; add it, or use recipe = paper"
            )
        if any(key.endswith("running_mean") and held is not None for key, held in module.named_buffers()):
            raise TrainingError(
                f"{name} keeps running statistics, which are not parameters and would not fit the weights that are "
                "kept; use a normalisation without them (layer norm, or track_running_stats=False)"
            )
        self.device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        self.module = module.to(self.device, torch.float32)
        self._trained = [p for p in self.module.parameters() if p.requires_grad]
        if not self._trained:
            raise TrainingError(f"{name} has no trainable parameters")
        self._start = flat(self._trained).cpu().numpy().astype(np.float64)
        self._setup, self._length, self._targets = setup, length, targets
        self._inputs = self._input_rows(training)
        self._target_rows = torch.from_numpy(training.target_rows).to(self.device)
        self._shown: tuple[WindowSet, torch.Tensor] | None = None  # the last set that was predicted

    def initial_parameters(self, seed: int) -> np.ndarray:
        """The module's initial parameters, whatever the seed: (parameters,) float64."""
        return self._start.copy()

    def load(self, parameters: np.ndarray) -> None:
        """Put a vector of parameters into the module.

        Raises:
            TrainingError: a vector of another length.
        """
        if len(parameters) != len(self._start):
            raise TrainingError(
                f"{type(self.module).__name__} has {len(self._start)} parameters, not {len(parameters)}"
            )
        vector = torch.as_tensor(parameters, dtype=torch.float32).to(self.device)
        with torch.no_grad():
            for p, part in zip(self._trained, vector.split([p.numel() for p in self._trained]), strict=True):
                p.copy_(part.view_as(p))

    def gradient(self, parameters: np.ndarray, ends: np.ndarray) -> tuple[float, np.ndarray]:
        """Mean squared error of the sequences that end at these rows, and its gradient.

        Rows without a target (NaN) count as no error, but are counted: the divisor is always N targets n.
        """
        self.load(parameters)
        self.module.train()
        target = self._target_rows[self._steps_before(ends, self._targets)]  # (N, targets, n)
        with exact_float32(self.device):
            y = self._output(self._inputs, ends, self._length, self._targets)
            error = y - torch.where(target.isnan(), y.detach(), target)
            loss = error.square().mean()
            gradient = torch.autograd.grad(loss, self._trained, materialize_grads=True)
        return loss.item(), flat(gradient).cpu().numpy()

    def predict(self, parameters: np.ndarray, windows: WindowSet, ends: np.ndarray) -> np.ndarray:
        """Output of the windows that end at these rows of a set: (ends, n), scaled units."""
        self.load(parameters)
        self.module.eval()
        if self._shown is None or self._shown[0] is not windows:
            self._shown = windows, self._input_rows(windows)
        out = np.empty((len(ends), self._target_rows.shape[1]), dtype=np.float32)
        with torch.no_grad(), exact_float32(self.device):
            for first in range(0, len(ends), WINDOWS_AT_ONCE):
                some = ends[first : first + WINDOWS_AT_ONCE]
                y = self._output(self._shown[1], some, self._setup.window_steps, 1)
                out[first : first + len(some)] = y[:, 0].cpu().numpy()
        return out

    def _input_rows(self, windows: WindowSet) -> torch.Tensor:
        """Input f of each network step, (rows, F), on the device; NaN where its lag reaches before the first row."""
        rows = torch.from_numpy(windows.rows).to(self.device)
        inputs = torch.full((len(rows), len(self._setup.inputs)), torch.nan, device=self.device)
        for f, (column, lag) in enumerate(self._setup.inputs):
            inputs[lag:, f] = rows[: len(rows) - lag, column]
        return inputs

    def _output(self, inputs: torch.Tensor, ends: np.ndarray, length: int, targets: int) -> torch.Tensor:
        """Output at the last `targets` steps of the sequences that end at these rows: (N, targets, n)."""
        x = inputs[self._steps_before(ends, length)]  # (N, length, F)
        y = self.module.sequence(x)[:, -targets:] if targets > 1 else self.module(x)[:, None]
        wanted = (len(ends), targets, self._target_rows.shape[1])
        if y.shape != wanted:
            form = "sequence(x) must give (B, T, n)" if targets > 1 else "its output must be (B, n)"
            raise TrainingError(
                f"{type(self.module).__name__}: {form} with n = {wanted[-1]} joints; of {len(ends)} sequences the last "
                f"{targets} outputs have the shape {tuple(y.shape)}, not {wanted}"
            )
        return y

    def _steps_before(self, ends: np.ndarray, steps: int) -> torch.Tensor:
        """Rows of the sequences of so many steps that end at these rows, oldest first: (N, steps)."""
        if ends.min() < steps - 1:
            raise TrainingError(f"a sequence of {steps} steps cannot end at row {ends.min()}")
        last = torch.from_numpy(ends).to(self.device)
        return last[:, None] + torch.arange(1 - steps, 1, device=self.device)


def lstm_backend(setup: Setup, training: WindowSet, config: TrainConfig, length: int, targets: int) -> TorchBackend:
    """The backend of `tauext train --backend torch`: the core's network as a module."""
    return TorchBackend(lstm_module(setup, config.hidden, config.seed), setup, training, length, targets)


class LstmModule(torch.nn.Module):
    """The core's network as a PyTorch module, for windows and for sequences."""

    def __init__(self, lstm: torch.nn.LSTM, head: torch.nn.Linear):
        super().__init__()
        self.lstm, self.head = lstm, head

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.head(self.lstm(x)[0][:, -1])

    def sequence(self, x: torch.Tensor) -> torch.Tensor:
        return self.head(self.lstm(x)[0])


def lstm_module(setup: Setup, hidden: int, seed: int) -> LstmModule:
    """The core's network with the core's initial parameters for this seed; a TorchBackend's vector has their layout."""
    shape = _core.LstmShape(len(setup.inputs), hidden, setup.tree.size)
    nothing = WindowSet(*(np.empty(0) for _ in range(4)))
    start = CoreBackend(setup, nothing, hidden, setup.window_steps, targets=1, threads=1).initial_parameters(seed)
    return LstmModule(*lstm_from_parameters(shape, start))


def lstm_from_parameters(shape: _core.LstmShape, parameters: np.ndarray) -> tuple[torch.nn.LSTM, torch.nn.Linear]:
    """LSTM (batch first) and head with these weights, for example `bundle.parameters` with `bundle.shape`.

    PyTorch has two biases a gate and only their sum matters. The second stays at zero and is not trained: two would
    move twice as far in a step of Adam.

    Raises:
        TrainingError: a vector of another length than the shape's.
    """
    vector = torch.as_tensor(np.asarray(parameters, dtype=np.float32))
    if len(vector) != shape.parameter_count:
        raise TrainingError(f"the network has {shape.parameter_count} parameters, not {len(vector)}")
    lstm = torch.nn.LSTM(shape.inputs, shape.hidden, batch_first=True)
    head = torch.nn.Linear(shape.hidden, shape.outputs)
    ordered = in_core_order(lstm, head)
    with torch.no_grad():
        for p, part in zip(ordered, vector.split([p.numel() for p in ordered]), strict=True):
            p.copy_(part.view_as(p))
        lstm.bias_hh_l0.zero_()
    lstm.bias_hh_l0.requires_grad_(False)
    return lstm, head


def in_core_order(lstm: torch.nn.LSTM, head: torch.nn.Linear) -> list[torch.nn.Parameter]:
    """The parameters in the order of LstmShape, which is also that of LstmModule's trainable ones."""
    named = dict([*lstm.named_parameters(), *head.named_parameters()])
    return [named[name] for name in CORE_ORDER]


def flat(tensors: list[torch.Tensor] | tuple[torch.Tensor, ...]) -> torch.Tensor:
    return torch.cat([t.detach().reshape(-1) for t in tensors])


@contextlib.contextmanager
def exact_float32(device: torch.device) -> Iterator[None]:
    """Without TF32, which cuDNN otherwise takes for LSTMs and convolutions: three decimals instead of seven."""
    if device.type != "cuda":
        yield
        return
    with torch.backends.cudnn.flags(enabled=True, deterministic=True, allow_tf32=False):
        yield
