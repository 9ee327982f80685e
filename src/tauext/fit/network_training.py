"""The training loop: data, model, loop, checkpoint, from top to bottom."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np

from tauext import _core
from tauext.config import TrainConfig
from tauext.errors import TrainingError
from tauext.fit.adam import Adam
from tauext.fit.checkpoint import TrainState, load_checkpoint, save_checkpoint
from tauext.fit.core_backend import CoreBackend
from tauext.fit.schedules import Schedule, make_schedule
from tauext.fit.training_set import Setup, WindowSet

CHECKPOINT_EVERY_S = 20.0
"""With what a step, a validation and the writing itself take, a killed training loses less than 30 s."""
LARGEST_LOSS = 1e3  # targets lie within +-1, so a useful loss is far below 1


class Backend(Protocol):
    """What computes; the loop below holds the parameters, as one vector of float64, and passes them as float32."""

    def initial_parameters(self, seed: int) -> np.ndarray: ...

    def gradient(self, parameters: np.ndarray, ends: np.ndarray) -> tuple[float, np.ndarray]:
        """Mean squared error of the training sequences that end at these rows, and its gradient."""

    def predict(self, parameters: np.ndarray, windows: WindowSet, ends: np.ndarray) -> np.ndarray:
        """Output of the windows that end at these rows of a set: (ends, n), scaled units."""


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


def train_network(
    setup: Setup,
    training: WindowSet,
    validation: WindowSet,
    config: TrainConfig,
    checkpoint_path: Path | None = None,
    settings: dict | None = None,
    report: Callable[[Progress], None] = lambda progress: None,
    backend: Backend | None = None,
) -> TrainedNetwork:
    """Train the network by its recipe's schedule: mean squared error, Adam.

    The weights of the lowest validation loss are kept (see Schedule.score): at the paper's learning rate the loss jumps
    up now and then and recovers, and the last step would be a draw of luck. The paper does not say which it keeps.

    The same seed and data give the same bytes for any number of threads, whether or not the run was interrupted, be it
    by SIGKILL: what the last CHECKPOINT_EVERY_S did is done again.

    Args:
        checkpoint_path: where the state is kept while training; resumed from, and saved on KeyboardInterrupt and at the
            end. Whoever has written what the network is for removes it.
        settings: what a checkpoint must agree on to be resumed.
        report: called every few hundred steps.
        backend: what computes, of any kind of network; default: the one that the config names.

    Raises:
        TrainingError: too little data for the schedule, or a loss that diverges.
    """
    config = config.resolved()
    schedule = make_schedule(setup, training, config)
    backend = backend or make_backend(setup, training, config, schedule.length, schedule.targets)
    shown = validation.ends[:: max(1, validation.windows // schedule.validation_windows)].copy()
    state = load_checkpoint(settings or {}, checkpoint_path) if checkpoint_path else None
    if state is None:
        start = backend.initial_parameters(config.seed)
        state = TrainState((start, Adam.start(len(start))), [], start.astype(np.float32))
    resumed_at, resumed_seconds = state.at[1].steps, state.seconds
    started = saved = time.monotonic()
    whole = replace(state)  # after a step with all that belongs to it: an interruption may come between
    try:
        while (done := state.at[1].steps) < schedule.steps and not schedule.gives_up(state.history):
            loss = take_step(state, backend, schedule, config)
            state.running_loss = loss if state.running_loss is None else 0.99 * state.running_loss + 0.01 * loss
            done += 1
            if done % schedule.report_every == 0 or done == schedule.steps:
                candidate = state.at[0].astype(np.float32)
                error = backend.predict(candidate, validation, shown) - validation.target_rows[shown]
                validated = float(np.mean(np.square(error, dtype=np.float64)))
                keep_best(state, schedule, candidate, state.running_loss, validated)
                state.seconds = resumed_seconds + time.monotonic() - started
                pace = (state.seconds - resumed_seconds) / (done - resumed_at)
                report(Progress(done, schedule.steps, *state.history[-1][1:], pace * (schedule.steps - done)))
            whole = replace(state, seconds=resumed_seconds + time.monotonic() - started)
            if checkpoint_path and time.monotonic() - saved > CHECKPOINT_EVERY_S:
                save_checkpoint(whole, settings or {}, checkpoint_path)
                saved = time.monotonic()
    except KeyboardInterrupt:
        if checkpoint_path:
            save_checkpoint(whole, settings or {}, checkpoint_path)
        raise
    if checkpoint_path:
        save_checkpoint(state, settings or {}, checkpoint_path)
    shape = _core.LstmShape(len(setup.inputs), config.hidden, setup.tree.size)
    return TrainedNetwork(shape, state.best, state.history, state.at[1].steps, state.seconds)


def take_step(state: TrainState, backend: Backend, schedule: Schedule, config: TrainConfig) -> float:
    """Move the state on by one step; the loss before it.

    Raises:
        TrainingError: the loss diverges.
    """
    parameters, adam = state.at
    done = adam.steps
    loss, gradient = backend.gradient(parameters.astype(np.float32), schedule.ends(done))
    if not loss <= LARGEST_LOSS:
        raise TrainingError(
            f"the loss diverges ({loss:g} at step {done}, in units of the largest residual squared); "
            f"lower learning_rate = {config.learning_rate:g}"
        )
    norm = float(np.linalg.norm(gradient))
    if norm > schedule.largest_gradient:
        gradient = gradient * (schedule.largest_gradient / norm)
    state.at = adam.step(parameters, gradient, schedule.learning_rate(done))
    return loss


def keep_best(state: TrainState, schedule: Schedule, candidate: np.ndarray, loss: float, validated: float) -> None:
    """Add both losses to the history, and keep these weights where no earlier ones scored as well."""
    done = state.at[1].steps
    score = schedule.score(done, validated)
    if all(score < schedule.score(step, earlier) for step, _, earlier in state.history):
        state.best = candidate
    state.history = [*state.history, (done, loss, validated)]


def make_backend(setup: Setup, training: WindowSet, config: TrainConfig, length: int, targets: int) -> Backend:
    """The backend that the config names, for sequences of this length and so many targets."""
    if config.backend == "torch":
        from tauext.fit.torch_backend import TorchBackend, lstm_module

        return TorchBackend(lstm_module(setup, config.hidden, config.seed), setup, training, length, targets)
    return CoreBackend(setup, training, config.hidden, length, targets, config.threads)
