"""Adam on one flat vector of parameters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

BETA_1, BETA_2, EPSILON = 0.9, 0.999, 1e-8


@dataclass(frozen=True)
class Adam:
    """Running means m of the gradient and v of its square, corrected for their start at zero [Kingma2015]."""

    m: np.ndarray
    v: np.ndarray
    steps: int = 0

    @classmethod
    def start(cls, count: int) -> Adam:
        return cls(np.zeros(count), np.zeros(count))

    def step(self, parameters: np.ndarray, gradient: np.ndarray, learning_rate: float) -> tuple[np.ndarray, Adam]:
        """Parameters (float64) and state after one step against the gradient; the old ones are left as they are."""
        steps = self.steps + 1
        m = self.m + (1 - BETA_1) * (gradient - self.m)
        v = self.v + (1 - BETA_2) * (np.square(gradient, dtype=np.float64) - self.v)
        m_hat = m / (1 - BETA_1**steps)
        v_hat = v / (1 - BETA_2**steps)
        return parameters - learning_rate * m_hat / (np.sqrt(v_hat) + EPSILON), Adam(m, v, steps)
