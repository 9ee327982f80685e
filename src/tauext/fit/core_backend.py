"""The network's gradient and output from the C++ core."""

from __future__ import annotations

import os

import numpy as np

from tauext import _core
from tauext.fit.training_set import Setup, WindowSet


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
