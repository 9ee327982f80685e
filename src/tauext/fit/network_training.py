"""Training of the network: schedule, loop, checkpoints, and the gate that a network must pass to ship."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol, TypeVar
from zipfile import BadZipFile

import numpy as np

from tauext import _core, plugins
from tauext.bundle.estimates import OK
from tauext.config import TrainConfig
from tauext.data.recording import Recording
from tauext.errors import ConfigError, TrainingError
from tauext.files.atomic_write import atomic_write
from tauext.fit.core_backend import Adam, CoreBackend
from tauext.fit.training_set import Scaling, Setup, TooShort, WindowSet
from tauext.recipes import Drawing

# --- Targets and sizes of training steps: the paper's schedule, and the dense one.


Number = TypeVar("Number", int, float)


@dataclass
class Schedule:
    """Sequences of `length` network steps from zero state; the last `targets` have a loss."""

    setup: Setup
    training: WindowSet
    config: TrainConfig
    steps: int = field(init=False)
    length: int = field(init=False)
    targets: int = field(init=False, default=1)
    largest_gradient: float = field(init=False, default=math.inf)
    """A gradient of a larger norm is shortened to it."""
    square_decay: float = field(init=False, default=0.999)
    """Decay rate of Adam's mean of the squared gradient."""
    report_every: int = field(init=False, default=200)
    """Steps between two reports."""
    validation_windows: int = field(init=False, default=20_000)
    """Largest number of validation windows in each report, evenly spread."""

    def ends(self, step: int) -> np.ndarray:
        """Rows that end the sequences of this step; they depend on the seed and the step alone."""
        raise NotImplementedError

    def learning_rate(self, step: int) -> float:
        """Step size of Adam."""
        return resolved(self.config.learning_rate)

    def score(self, step: int, validation_loss: float) -> float:
        """Score of the weights after this number of steps; those with the lowest score are kept."""
        return validation_loss

    def gives_up(self, history: list[tuple[int, float, float]]) -> bool:
        """Whether to stop early, after these (step, training loss, validation loss)."""
        return False


@dataclass
class PaperSchedule(Schedule):
    """One target a window, all windows in a new random order each epoch, constant learning rate [Lim2021]."""

    def __post_init__(self) -> None:
        batch = resolved(self.config.batch)
        self.length = self.setup.window_steps
        self.steps_an_epoch = self.training.windows // batch
        if self.steps_an_epoch == 0:
            raise TrainingError(
                f"{self.training.windows} training windows are fewer than a batch of {batch}; record more"
            )
        self.steps = min(resolved(self.config.epochs) * self.steps_an_epoch, self.config.max_steps or 1 << 62)
        self._order_of = -1

    def ends(self, step: int) -> np.ndarray:
        epoch, index = divmod(step, self.steps_an_epoch)
        if self._order_of != epoch:
            self._order_of = epoch
            self._order = np.random.default_rng([self.config.seed, epoch]).permutation(self.training.windows)
        batch = resolved(self.config.batch)
        return self.training.ends[self._order[index * batch : (index + 1) * batch]]


@dataclass
class DenseSchedule(Schedule):
    """Sequences drawn at random; after a burn-in of a window or a part of it (Drawing.early_targets) every step has a
    target.

    A state that has seen a whole window hardly depends on what came before, so these states represent those of a
    window from zero state, on which the network is used. The exception is a joint that stuck for the whole window:
    only a longer sequence shows on which side of its friction. Early targets make such states common. One sequence of
    199 steps has 100 to 140 targets; 100 cost the paper's schedule 10,000 steps. The learning rate rises over the first
    twentieth of the training and falls to zero along a cosine.
    """

    validation_windows: int = field(init=False, default=10_000)
    warm_up: float = 0.05
    """Share of the steps in which the learning rate rises."""
    settled: float = 0.8
    """Share of the steps after which the learning rate is low."""
    unsettled_handicap: float = 1.5
    """Factor on validation losses before that."""
    patience: float = 0.1
    """Share of the steps without a better score after which a settled training stops."""

    def __post_init__(self) -> None:
        drawing = self.config.row.drawing
        self.largest_gradient, self.square_decay = drawing.largest_gradient, drawing.square_decay
        self.targets = resolved(self.config.targets)
        early = min(round(drawing.early_targets * self.setup.window_steps), self.targets - 1)
        self.length = self.setup.window_steps - 1 + self.targets - early
        self.steps = resolved(self.config.max_steps)
        self.report_every = max(500, self.steps // 25)
        reach = self.setup.reach - self.setup.window_steps + self.length  # with the lag of the inputs
        ends = self.training.ends
        self._ends = ends[ends - reach >= self.training.first_rows]
        if len(self._ends) == 0:
            period_s = 1e-9 * self.setup.observer.sample_period_ns * self.setup.observer.network_stride
            raise TooShort(
                f"no training recording holds a sequence of {self.length} steps ({self.length * period_s:g} s without "
                f"a gap); lower targets = {self.targets} or record longer"
            )

    def ends(self, step: int) -> np.ndarray:
        chosen = np.random.default_rng([self.config.seed, step]).integers(len(self._ends), size=self.config.batch)
        return self._ends[chosen]

    def learning_rate(self, step: int) -> float:
        done = step / self.steps
        if done < self.warm_up:
            return resolved(self.config.learning_rate) * (step + 1) / (self.warm_up * self.steps + 1)
        falling = 1 + math.cos(math.pi * (done - self.warm_up) / (1 - self.warm_up))
        return 0.5 * resolved(self.config.learning_rate) * falling

    def score(self, step: int, validation_loss: float) -> float:
        """At a high learning rate the validation loss jumps, and its lowest value is luck: weights from then must be
        clearly better than settled ones, as they are where a network overfits."""
        return validation_loss * (1.0 if step >= self.settled * self.steps else self.unsettled_handicap)

    def gives_up(self, history: list[tuple[int, float, float]]) -> bool:
        scores = [(self.score(step, validation), step) for step, _, validation in history]
        if not scores or scores[-1][1] < (self.settled + self.patience) * self.steps:
            return False
        return min(scores)[1] <= scores[-1][1] - self.patience * self.steps


def make_schedule(setup: Setup, training: WindowSet, config: TrainConfig) -> Schedule:
    """The training schedule of a resolved config's recipe."""
    if config.row.draws:
        return DenseSchedule(setup, training, config)
    return PaperSchedule(setup, training, config)


def resolved(value: Number | None) -> Number:
    """A setting that a resolved config has."""
    assert value is not None
    return value


# --- Training state on disk, from which an interrupted run continues.


@dataclass
class TrainState:
    """The state of training. Fields are replaced, never changed in place, so a copy stays as it is."""

    at: tuple[np.ndarray, Adam]  # parameters (float64) and the optimiser's state
    history: list[tuple[int, float, float]]  # (step, training loss, validation loss), scaled units
    best: np.ndarray  # float32, the parameters of the lowest validation loss so far
    seconds: float = 0.0
    running_loss: float | None = None
    """The training loss as the next entry of the history goes on from it; None before the first step."""


def save_checkpoint(state: TrainState, settings: dict, path: Path) -> None:
    """Write under a temporary name, then rename: an interruption leaves the last complete checkpoint."""
    parameters, adam = state.at
    with atomic_write(path) as part, part.open("wb") as file:
        np.savez(
            file,
            parameters=parameters,
            m=adam.m,
            v=adam.v,
            steps=adam.steps,
            history=np.array(state.history, dtype=float).reshape(-1, 3),
            best=state.best,
            seconds=state.seconds,
            running_loss=np.nan if state.running_loss is None else state.running_loss,
            settings=json.dumps(settings, sort_keys=True),
        )


def is_as(one: np.ndarray, parameters: np.ndarray) -> bool:
    """Whether these are finite numbers, as many as the parameters."""
    return one.dtype.kind == "f" and one.shape == parameters.shape and bool(np.isfinite(one).all())


def load_checkpoint(settings: dict, path: Path) -> TrainState | None:
    """The state of an interrupted run with these settings, or None without a checkpoint.

    Raises:
        ConfigError: the checkpoint is damaged or has other settings; the message names the difference.
    """
    if not path.exists():
        return None
    advice = "remove it to start again, or write elsewhere"
    try:
        with np.load(path, allow_pickle=False) as stored:
            theirs = json.loads(str(stored["settings"]))
            running = float(stored["running_loss"])
            parameters, m, v, best = (stored[name] for name in ("parameters", "m", "v", "best"))
            if not isinstance(theirs, dict) or not all(is_as(one, parameters) for one in (parameters, m, v, best)):
                raise ValueError("its settings or parameters are of the wrong kind")
            state = TrainState(
                (parameters, Adam(m, v, int(stored["steps"]))),
                [(int(step), float(loss), float(validation)) for step, loss, validation in stored["history"]],
                best,
                float(stored["seconds"]),
                None if np.isnan(running) else running,
            )
    except (OSError, EOFError, KeyError, TypeError, AttributeError, OverflowError, ValueError, BadZipFile) as error:
        raise ConfigError(f"{path}: this checkpoint cannot be read ({error}); {advice}") from error
    differing = sorted(key for key in settings.keys() | theirs.keys() if settings.get(key) != theirs.get(key))
    if differing:
        raise ConfigError(f"{path}: this checkpoint is of a run with other settings ({', '.join(differing)}); {advice}")
    return state


# --- The gate: a bundle contains a joint's network only if it helps on validation recordings.


@dataclass(frozen=True)
class Gate:
    """RMSE in free motion on validation recordings, and the joints whose network is kept."""

    prior_rmse_nm: np.ndarray  # (n,)
    network_rmse_nm: np.ndarray  # (n,) of prior and network together
    opened: np.ndarray  # (n,) bool

    def reason(self, joint: int, margin: float) -> str:
        """Reason for the joint's network or its absence."""
        before, after = self.prior_rmse_nm[joint], self.network_rmse_nm[joint]
        verdict = "prior and network" if self.opened[joint] else "prior only"
        growth = after / before - 1 if before > 0 else np.inf
        change = f"{growth:+.1%}, required {-margin:.0%}"
        return f"{verdict}: RMSE {before:.3g} Nm without a network, {after:.3g} Nm with it ({change})"


def apply_gate(bundle: _core.Bundle, validation: Sequence[Recording], margin: float, threads: int) -> Gate:
    """Evaluate every joint's network, and disable it in the bundle unless it lowers the RMSE by `margin`.

    A disabled joint has an output scale of 0; if all are disabled, the bundle keeps no network.
    """
    n = bundle.joints
    prior, both, samples = np.zeros(n), np.zeros(n), 0
    for recording in validation:
        estimates = _core.estimate(bundle, *recording.signals, threads, recording.temperature)
        healthy = estimates["health"] == OK
        prior += ((estimates["residual"] - estimates["prior"])[healthy] ** 2).sum(axis=0)
        both += (estimates["tau_ext"][healthy] ** 2).sum(axis=0)
        samples += int(healthy.sum())
    prior, both = np.sqrt(prior / max(samples, 1)), np.sqrt(both / max(samples, 1))
    gate = Gate(prior, both, both < (1 - margin) * prior)
    bundle.output_scale_nm = np.where(gate.opened, bundle.output_scale_nm, 0.0).tolist()
    if gate.opened.any():
        bundle.answer_reference()
    else:
        bundle.drop_network()
    return gate


# --- The training loop: data, model, loop, checkpoint, from top to bottom.


CHECKPOINT_EVERY_S = 20.0
"""Including a step, a validation and the writing, a killed training loses less than 30 s."""
LARGEST_LOSS = 1e3  # targets lie within +-1, so a useful loss is far below 1


class Backend(Protocol):
    """Computes gradients; the loop below keeps the parameters as one vector of float64 and passes them as float32."""

    def initial_parameters(self, seed: int) -> np.ndarray: ...

    def gradient(self, parameters: np.ndarray, ends: np.ndarray) -> tuple[float, np.ndarray]:
        """Mean squared error of the training sequences that end at these rows, and its gradient."""

    def predict(self, parameters: np.ndarray, windows: WindowSet, ends: np.ndarray) -> np.ndarray:
        """Output of the windows that end at these rows of a set: (ends, n), scaled units."""


@dataclass(frozen=True)
class Progress:
    """Content of a progress bar; losses are mean squared errors in scaled units."""

    step: int
    steps: int
    loss: float
    validation_loss: float


@dataclass(frozen=True)
class TrainedNetwork:
    shape: _core.LstmShape
    parameters: np.ndarray  # float32, layout of LstmShape
    history: list[tuple[int, float, float]]  # (step, training loss, validation loss)
    steps: int
    seconds: float


@dataclass(frozen=True)
class ScaledNetwork:
    """A trained network with the scales of its inputs and outputs."""

    scaling: Scaling
    trained: TrainedNetwork


def validation_loss(backend: Backend, parameters: np.ndarray, validation: WindowSet, ends: np.ndarray) -> float:
    """Mean squared error of the windows that end at these rows."""
    error = backend.predict(parameters, validation, ends) - validation.target_rows[ends]
    return float(np.mean(np.square(error, dtype=np.float64)))


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
    up now and then and recovers, so the last step would be arbitrary. The paper does not state which it keeps.

    The same seed and data give the same bytes for any number of threads, whether or not the run was interrupted, also
    by SIGKILL: the work of the last CHECKPOINT_EVERY_S is repeated.

    Args:
        checkpoint_path: where the state is kept while training; resumed from, and saved on KeyboardInterrupt and at the
            end. The caller removes it after writing the bundle.
        settings: must equal those of a checkpoint to resume it.
        report: called every few hundred steps.
        backend: computes gradients, for any kind of network; default: the config's.

    Raises:
        TrainingError: too little data for the schedule, or a loss that diverges.
    """
    config = config.resolved()
    schedule = make_schedule(setup, training, config)
    backend = backend or make_backend(setup, training, config, schedule.length, schedule.targets)
    shown = validation.ends[:: max(1, validation.windows // schedule.validation_windows)].copy()
    state = load_checkpoint(settings or {}, checkpoint_path) if checkpoint_path else None
    state = state or first_state(backend, config.seed)
    resumed_seconds = state.seconds
    started = saved = time.monotonic()
    whole = replace(state)  # after a step with all that belongs to it: an interruption may come between
    try:
        while (done := state.at[1].steps) < schedule.steps and not schedule.gives_up(state.history):
            loss = take_step(state, backend, schedule, config)
            done += 1
            if done % schedule.report_every == 0 or done == schedule.steps:
                candidate = state.at[0].astype(np.float32)
                keep_best(state, schedule, candidate, loss, validation_loss(backend, candidate, validation, shown))
                state.seconds = resumed_seconds + time.monotonic() - started
                report(Progress(done, schedule.steps, *state.history[-1][1:]))
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
    best = backend.weights(state.best) if isinstance(backend, InputBasis) else state.best
    return TrainedNetwork(shape, best, state.history, state.at[1].steps, state.seconds)


def first_state(backend: Backend, seed: int) -> TrainState:
    """The state before any step."""
    start = backend.initial_parameters(seed)
    return TrainState((start, Adam.start(len(start))), [], start.astype(np.float32))


def take_step(state: TrainState, backend: Backend, schedule: Schedule, config: TrainConfig) -> float:
    """Advance the state by one step; returns the running mean of the loss.

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
    state.at = adam.step(parameters, gradient, schedule.learning_rate(done), schedule.square_decay)
    mean = loss if state.running_loss is None else 0.99 * state.running_loss + 0.01 * loss
    state.running_loss = mean
    return mean


def keep_best(state: TrainState, schedule: Schedule, candidate: np.ndarray, loss: float, validated: float) -> None:
    """Add both losses to the history, and keep these weights where no earlier ones scored as well."""
    done = state.at[1].steps
    score = schedule.score(done, validated)
    if all(score < schedule.score(step, earlier) for step, _, earlier in state.history):
        state.best = candidate
    state.history = [*state.history, (done, loss, validated)]


def make_backend(setup: Setup, training: WindowSet, config: TrainConfig, length: int, targets: int) -> Backend:
    """The backend that the config names, for sequences of this length and so many targets."""
    if config.backend == "core":
        backend: Backend = CoreBackend(setup, training, config.hidden, length, targets, config.threads)
    else:
        backend = plugins.part(config.backend)(setup, training, config, length, targets)
    drawing = config.row.drawing
    if not config.row.draws or (drawing.speed_factor, drawing.change_factor) == (1.0, 0.0):
        return backend
    return InputBasis(backend, 4 * config.hidden, input_basis(setup, drawing))


def input_basis(setup: Setup, drawing: Drawing) -> np.ndarray:
    """A of x' = A x: the inputs as the optimiser sees them, from those of the network; (F, F)."""
    inputs, n = setup.inputs, setup.tree.size
    basis = np.eye(len(inputs))
    for column in range(n, 2 * n):
        now, before = inputs.index((column, 0)), inputs.index((column, 1))
        basis[now, now] = basis[before, before] = drawing.speed_factor
        if drawing.change_factor:
            change = drawing.speed_factor * drawing.change_factor
            basis[before, now], basis[before, before] = change, -change
    return basis


class InputBasis:
    """A backend whose network is trained on inputs x' = A x, while its weights remain those of x: W_x = W' A.

    Adam depends on the basis: it moves every weight of W' at one pace.

    Args:
        backend: its parameters begin with W_x (gates, F), as in LstmShape.
        gates: rows of W_x.
        basis: A, (F, F).
    """

    def __init__(self, backend: Backend, gates: int, basis: np.ndarray):
        self._backend, self._basis, self._count = backend, basis, gates * len(basis)

    def initial_parameters(self, seed: int) -> np.ndarray:
        return self._backend.initial_parameters(seed)

    def weights(self, parameters: np.ndarray) -> np.ndarray:
        """Parameters of the network itself."""
        return self._times(parameters, self._basis)

    def gradient(self, parameters: np.ndarray, ends: np.ndarray) -> tuple[float, np.ndarray]:
        loss, gradient = self._backend.gradient(self.weights(parameters), ends)
        return loss, self._times(gradient, self._basis.T)

    def predict(self, parameters: np.ndarray, windows: WindowSet, ends: np.ndarray) -> np.ndarray:
        return self._backend.predict(self.weights(parameters), windows, ends)

    def _times(self, vector: np.ndarray, matrix: np.ndarray) -> np.ndarray:
        """The vector with its first matrix multiplied from the right: sums in double precision, in one order."""
        result = vector.copy()
        rows = vector[: self._count].reshape(-1, 1, len(matrix)).astype(np.float64)
        result[: self._count] = (rows * matrix.T).sum(axis=2).ravel()
        return result
