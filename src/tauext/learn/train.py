"""The training loop: data, model, loop, checkpoint, from top to bottom."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tauext import _core
from tauext.config import TrainConfig
from tauext.errors import TrainingError
from tauext.learn import checkpoint
from tauext.learn.adam import Adam
from tauext.learn.checkpoint import TrainState
from tauext.learn.training_set import Chain, WindowSet

VALIDATION_WINDOWS = 20_000  # at most so many, evenly spread, are looked at in each report
REPORT_EVERY_STEPS = 200
CHECKPOINT_EVERY_S = 30.0
LARGEST_LOSS = 1e3  # targets lie within +-1, so a useful loss is far below 1


@dataclass(frozen=True)
class Progress:
    """What a progress bar shows: losses are mean squared errors in scaled units."""

    step: int
    steps: int
    loss: float
    validation_loss: float
    seconds_left: float


@dataclass(frozen=True)
class TrainedNetwork:
    shape: _core.LstmShape
    parameters: np.ndarray  # float32, layout of LstmShape
    history: list[tuple[int, float, float]]  # (step, training loss, validation loss)
    steps: int
    seconds: float


def train(
    chain: Chain,
    training: WindowSet,
    validation: WindowSet,
    config: TrainConfig,
    checkpoint_path: Path | None = None,
    settings: dict | None = None,
    report: Callable[[Progress], None] = lambda progress: None,
) -> TrainedNetwork:
    """Train the paper's network: mean squared error, Adam, shuffled windows.

    The weights of the lowest validation loss are kept (looked at every REPORT_EVERY_STEPS): at the paper's learning
    rate the loss jumps up now and then and recovers, and the last step would be a draw of luck. The paper does not say
    which weights it keeps.

    The same seed and data give the same bytes for any number of threads, whether or not the run was interrupted.

    Args:
        checkpoint_path: where the state is kept while training; resumed from, saved on KeyboardInterrupt, removed at
            the end.
        settings: what a checkpoint must agree on to be resumed.
        report: called every few hundred steps.

    Raises:
        TrainingError: fewer windows than a batch, or a loss that diverges.
    """
    shape = _core.LstmShape(len(chain.inputs), config.hidden, chain.tree.size)
    batch = config.batch
    steps_an_epoch = training.windows // batch
    if steps_an_epoch == 0:
        raise TrainingError(
            f"{training.windows} training windows are fewer than a batch of {batch}; record more motion"
        )
    steps = min(config.epochs * steps_an_epoch, config.max_steps or np.iinfo(np.int64).max)
    threads = config.threads or os.cpu_count() or 1
    shown = slice(None, None, max(1, validation.windows // VALIDATION_WINDOWS))

    def validation_loss(parameters: np.ndarray) -> float:
        out = _core.lstm_forward(
            shape,
            parameters,
            validation.rows,
            1,
            chain.window_steps,
            chain.inputs,
            validation.ends[shown].copy(),
            threads,
        )
        return float(np.mean(np.square(out - validation.targets[shown], dtype=np.float64)))

    state = checkpoint_path and checkpoint.load(settings or {}, checkpoint_path)
    if state is None:
        start = initial_parameters(shape, config.seed)
        state = TrainState((start, Adam.start(shape.parameter_count)), [], start.astype(np.float32))
    resumed_at, resumed_seconds = state.at[1].steps, state.seconds
    started = saved = time.monotonic()
    running_loss = state.history[-1][1] if state.history else None
    order_of, order = -1, None
    try:
        while (done := state.at[1].steps) < steps:
            epoch, index = divmod(done, steps_an_epoch)
            if order_of != epoch:
                order_of, order = epoch, np.random.default_rng([config.seed, epoch]).permutation(training.windows)
            chosen = order[index * batch : (index + 1) * batch]
            parameters, adam = state.at
            loss, gradient = _core.lstm_gradient(
                shape,
                parameters.astype(np.float32),
                training.rows,
                1,
                chain.window_steps,
                chain.inputs,
                training.ends[chosen],
                training.targets[chosen],
                threads,
            )
            if not loss <= LARGEST_LOSS:
                raise TrainingError(
                    f"the loss diverges ({loss:g} at step {done}, in units of the largest residual squared); "
                    f"lower learning_rate = {config.learning_rate:g}"
                )
            state.at = adam.step(parameters, gradient, config.learning_rate)
            running_loss = loss if running_loss is None else 0.99 * running_loss + 0.01 * loss
            done += 1
            if done % REPORT_EVERY_STEPS == 0 or done == steps:
                candidate = state.at[0].astype(np.float32)
                validated = validation_loss(candidate)
                if not state.history or validated < min(entry[2] for entry in state.history):
                    state.best = candidate
                state.history.append((done, running_loss, validated))
                state.seconds = resumed_seconds + time.monotonic() - started
                pace = (state.seconds - resumed_seconds) / (done - resumed_at)
                report(Progress(done, steps, *state.history[-1][1:], pace * (steps - done)))
                if checkpoint_path and time.monotonic() - saved > CHECKPOINT_EVERY_S:
                    checkpoint.save(state, settings or {}, checkpoint_path)
                    saved = time.monotonic()
    except KeyboardInterrupt:
        if checkpoint_path:
            state.seconds = resumed_seconds + time.monotonic() - started
            checkpoint.save(state, settings or {}, checkpoint_path)
        raise
    if checkpoint_path:
        checkpoint_path.unlink(missing_ok=True)
    return TrainedNetwork(shape, state.best, state.history, state.at[1].steps, state.seconds)


def initial_parameters(shape: _core.LstmShape, seed: int) -> np.ndarray:
    """Uniform in +-1/sqrt(hidden), forget gates open by a bias of 1: (parameter_count,) float64."""
    rng = np.random.default_rng([seed, 0x1517])
    bound = 1 / np.sqrt(shape.hidden)
    parameters = rng.uniform(-bound, bound, shape.parameter_count)
    forget = 4 * shape.hidden * (shape.inputs + shape.hidden) + shape.hidden
    parameters[forget : forget + shape.hidden] += 1.0
    return parameters
