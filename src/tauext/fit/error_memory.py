"""How large a fit's errors are, and for how long they stay what they are: so many rows of a minute say the same."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tauext import _core
from tauext.data.recording import Recording
from tauext.fit.training_set import Setup, remainder

LONGEST_S = 2.0
CORRELATED = 0.05
"""Correlation below it is none."""


def error_memory_s(setup: Setup, recordings: Sequence[Recording], settings: _core.PriorSettings) -> np.ndarray:
    """For how long each joint's error stays what it is, (n,), [s]: a period and twice the sum of its correlations.

    Summed up to the first lag at which they are gone, LONGEST_S at most; as the core's refit counts it.
    """
    stride = setup.observer.network_stride
    period_s = 1e-9 * setup.observer.sample_period_ns * stride
    most = max(2, round(LONGEST_S / period_s))
    n = setup.tree.size
    products = np.zeros((most, n))
    for recording in recordings:
        signals = (recording.t_ns, recording.q, recording.dq, recording.tau)
        observation = _core.observe(setup.tree, setup.observer, *signals, settings)
        left = remainder(observation)[np.flatnonzero(observation.warm.astype(bool))[::stride]]
        for lag in range(min(most, len(left))):
            products[lag] += (left[lag:] * left[: len(left) - lag]).sum(axis=0)
    correlation = products / np.maximum(products[0], 1e-300)
    gone = np.argmax(np.vstack([correlation < CORRELATED, np.ones(n, dtype=bool)]), axis=0)
    inside = np.arange(most)[:, None] < gone
    return period_s * np.maximum(1.0, 2 * (correlation * inside).sum(axis=0) - 1)
