"""Training steps of the network on the C++ core: gradient, output, and Adam."""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np

from tauext import _core
from tauext.fit.training_set import Setup, WindowSet

# --- Adam on one flat vector of parameters.


@dataclass(frozen=True)
class Adam:
    """Running means m of the gradient and v of its square, corrected for their start at zero [Kingma2015]."""

    m: np.ndarray
    v: np.ndarray
    steps: int = 0

    @classmethod
    def start(cls, count: int) -> Adam:
        return cls(np.zeros(count), np.zeros(count))

    def step(
        self, parameters: np.ndarray, gradient: np.ndarray, learning_rate: float, beta_2: float = 0.999
    ) -> tuple[np.ndarray, Adam]:
        """Parameters (float64) and state after one step against the gradient; the old ones are left as they are."""
        steps = self.steps + 1
        m = self.m + (1 - 0.9) * (gradient - self.m)
        v = self.v + (1 - beta_2) * (np.square(gradient, dtype=np.float64) - self.v)
        m_hat = m / (1 - 0.9**steps)
        v_hat = v / (1 - beta_2**steps)
        return parameters - learning_rate * m_hat / (np.sqrt(v_hat) + 1e-8), Adam(m, v, steps)


# --- The network's gradient and output from the C++ core.


class CoreBackend:
    """Gradient of the LSTM over sequences of a training set; parameters are one vector, layout of LstmShape."""

    def __init__(self, setup: Setup, training: WindowSet, hidden: int, length: int, targets: int, threads: int):
        self.shape = _core.LstmShape(len(setup.inputs), hidden, setup.tree.size)
        self._setup, self._training, self._length, self._targets = setup, training, length, targets
        self._threads = threads or os.cpu_count() or 1

    def initial_parameters(self, seed: int) -> np.ndarray:
        """Uniform in +-1/sqrt(hidden), forget gates open by a bias of 1: (parameters,) float64."""
        shape, rng = self.shape, np.random.default_rng([seed, 0x1517])
        bound = 1 / np.sqrt(shape.hidden)
        parameters = rng.uniform(-bound, bound, shape.parameter_count)
        forget = 4 * shape.hidden * (shape.inputs + shape.hidden) + shape.hidden
        parameters[forget : forget + shape.hidden] += 1.0
        return parameters

    def gradient(self, parameters: np.ndarray, ends: np.ndarray) -> tuple[float, np.ndarray]:
        """Mean squared error of the sequences that end at these rows, and its gradient."""
        return _core.lstm_gradient(
            self.shape,
            parameters,
            self._training.rows,
            1,
            self._length,
            self._setup.inputs,
            ends,
            self._training.target_rows,
            self._targets,
            self._threads,
        )

    def predict(self, parameters: np.ndarray, windows: WindowSet, ends: np.ndarray) -> np.ndarray:
        """Output of the windows that end at these rows of a set: (ends, n), scaled units."""
        return _core.lstm_forward(
            self.shape, parameters, windows.rows, 1, self._setup.window_steps, self._setup.inputs, ends, self._threads
        )
