"""What a training of this size takes at least, held against what is there before anything is loaded."""

from __future__ import annotations

import os

from tauext.config import TrainConfig
from tauext.files.room import expect_memory, expect_time

FLOPS_A_CORE = 2e11
"""Above what a core reaches in single precision (32 sums and products a cycle at 3 GHz), so that times are bounds."""
LEAST_INPUTS = 3
"""Of a network: one joint's q(k), dq(k) and dq(k-1)."""
BYTES_A_SEQUENCE = 3 * 8
"""Of a training step: which sequences are drawn, and the rows at which they end."""


def expect_size(config: TrainConfig) -> None:
    """Refuse what no machine of this kind finishes within a month, or what its memory cannot hold.

    Raises:
        ConfigError: the setting, what it needs, and what is there.
    """
    config = config.resolved()
    if config.row.network is None or config.batch is None:
        return
    expect_memory(BYTES_A_SEQUENCE * config.batch, f"batch = {config.batch}")
    window = max(1, int(config.observer.window_s / config.observer.network_period_s))
    length = window + config.targets if config.row.network == "sequences" else window
    # An epoch holds a batch at least.
    steps = min(config.epochs or config.max_steps or 1, config.max_steps or config.epochs or 1)
    a_step = 3 * 2 * 4 * config.hidden * (config.hidden + LEAST_INPUTS)  # backwards costs twice forwards
    flops = float(steps) * config.batch * length * a_step
    told = f"a training of {steps} steps of {config.batch} sequences of {length} with {config.hidden} hidden units"
    expect_time(flops / (FLOPS_A_CORE * (os.cpu_count() or 1)), told)
