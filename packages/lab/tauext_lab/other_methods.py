"""Methods of others that make no bundle: a network of the motor torque, and the stall rule of servo users.

Each gives the ratio of every joint to its limit, at every sample. `tauext evaluate --methods next stall-rule` compares
them with labels at these limits, `evaluate.missed_curve.equal_false_alarms` at equal measured false alarms.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.signal import lfilter

from tauext.data.free_motion import free_pieces
from tauext.data.recording import Recording
from tauext.errors import TrainingError
from tauext.fit.core_backend import Adam
from tauext.progress import SILENT, Reporter
from tauext.train.held_peaks import held_minimum


class OtherMethod(Protocol):
    """A trained method: an alarm rises where the ratio of a joint to its limit exceeds 1."""

    def ratio(self, recording: Recording) -> np.ndarray:
        """Ratio of each joint to its limit, (samples, joints).

        Raises:
            TrainingError: the recording lacks a signal that the method needs.
        """


# --- NEXT [Oh2026]: the motor torque of free motion by two LSTM layers, trained on windows. In NumPy, since the core's
# network has one layer and learns the momentum observer's residual.


@dataclass(frozen=True)
class NextConfig:
    """NEXT as published; the rate and the smoothing are not, and follow the observer's."""

    hidden: int = 128
    """Units of each of the two LSTM layers."""
    head: int = 256
    """Rectified units between them and the torques."""
    history: int = 50
    """Samples of a window."""
    learning_rate: float = 1e-3
    batch: int = 2048
    epochs: int = 20
    commanded: bool = True
    """Whether commanded minus measured position is an input; without, only q and dq are."""
    most_hz: float = 100.0
    """Faster recordings are reduced to this rate, or just above."""
    low_pass_per_s: float = 20.0
    """Rate of the first-order low-pass on tau_ext."""


CHUNK = 256
"""Windows at once: more fill no processor better, and take 0.3 MB each."""


class NextNetwork:
    """Two LSTM layers and a head of one rectified layer; parameters are one vector."""

    def __init__(self, inputs: int, outputs: int, config: NextConfig) -> None:
        F, H, M, n = inputs, config.hidden, config.head, outputs
        recurrent = (4, H, H), (4, 1, H)
        self._shapes = [(4, F, H), *recurrent, (4, H, H), *recurrent, (H, M), (M,), (M, n), (n,)]
        self._bounds = [H**-0.5] * 8 + [M**-0.5] * 2
        self._ends = np.cumsum([int(np.prod(shape)) for shape in self._shapes])

    def arrays(self, vector: np.ndarray) -> list[np.ndarray]:
        """W_x, W_h and b of both LSTM layers, gates i, f, o, g first; W and b of both layers of the head: float32."""
        parts = np.split(np.asarray(vector, dtype=np.float32), self._ends[:-1])
        return [part.reshape(shape) for part, shape in zip(parts, self._shapes, strict=True)]

    def initial(self, rng: np.random.Generator) -> np.ndarray:
        """Uniform in +-1/sqrt(units), (parameters,) float64, as in PyTorch."""
        each = zip(self._bounds, self._shapes, strict=True)
        return np.concatenate([rng.uniform(-bound, bound, int(np.prod(shape))) for bound, shape in each])

    def predict(self, vector: np.ndarray, windows: np.ndarray) -> np.ndarray:
        """Output of windows (steps, N, inputs), oldest step first: (N, outputs)."""
        *lower, wx, wh, b, w3, b3, w4, b4 = self.arrays(vector)
        last = lstm(lstm(windows, *lower).outputs, wx, wh, b).outputs[-1]
        return np.maximum(last @ w3 + b3, 0) @ w4 + b4

    def gradient(self, vector: np.ndarray, windows: np.ndarray, target: np.ndarray) -> tuple[float, np.ndarray]:
        """Sum of squared errors of windows, and its gradient."""
        wx1, wh1, b1, wx2, wh2, b2, w3, b3, w4, b4 = self.arrays(vector)
        lower = lstm(windows, wx1, wh1, b1)
        upper = lstm(lower.outputs, wx2, wh2, b2)
        last = upper.outputs[-1]
        active = np.maximum(last @ w3 + b3, 0)
        error = active @ w4 + b4 - target
        back = 2 * error
        at_head = (back @ w4.T) * (active > 0)
        at_upper = np.zeros_like(upper.outputs)
        at_upper[-1] = at_head @ w3.T
        changes, *of_upper = upper.gradient(at_upper, wh2)
        at_lower = np.matmul(changes, wx2.transpose(0, 2, 1)).sum(axis=0).reshape(lower.outputs.shape)
        _, *of_lower = lower.gradient(at_lower, wh1)
        of_head = last.T @ at_head, at_head.sum(axis=0), active.T @ back, back.sum(axis=0)
        return float(np.sum(error**2)), np.concatenate([part.ravel() for part in (*of_lower, *of_upper, *of_head)])


@dataclass(frozen=True)
class LstmPass:
    """A layer's values at every step."""

    inputs: np.ndarray  # (steps, N, F)
    gates: np.ndarray  # (4, steps, N, H): i, f, o, g
    cells: np.ndarray  # (steps, N, H)
    outputs: np.ndarray  # (steps, N, H)

    def gradient(self, at: np.ndarray, w_h: np.ndarray) -> tuple[np.ndarray, ...]:
        """From the gradient at the outputs: that at the gates before their functions, of W_x, of W_h and of b."""
        changes, back = np.empty_like(self.gates), np.ascontiguousarray(w_h.transpose(0, 2, 1))
        at_cell = at_output = np.zeros_like(self.cells[0])
        for k in reversed(range(len(at))):
            i, f, o, g = self.gates[:, k]
            level, before = np.tanh(self.cells[k]), self.cells[k - 1] if k else np.zeros_like(self.cells[0])
            at_output = at_output + at[k]
            at_cell = at_cell + at_output * o * (1 - level * level)
            changes[0, k] = at_cell * g * i * (1 - i)
            changes[1, k] = at_cell * before * f * (1 - f)
            changes[2, k] = at_output * level * o * (1 - o)
            changes[3, k] = at_cell * i * (1 - g * g)
            at_cell = at_cell * f
            at_output = np.matmul(changes[:, k], back).sum(axis=0)
        H, rows = w_h.shape[-1], self.inputs.shape[0] * self.inputs.shape[1]
        of_h = np.matmul(self.outputs[:-1].reshape(-1, H).T, changes[:, 1:].reshape(4, -1, H))
        changes = changes.reshape(4, rows, H)
        of_x = np.matmul(self.inputs.reshape(rows, -1).T, changes)
        return changes, of_x, of_h, changes.sum(axis=1)


def lstm(inputs: np.ndarray, w_x: np.ndarray, w_h: np.ndarray, b: np.ndarray) -> LstmPass:
    """Pass of one layer over windows (steps, N, F), from states of zero."""
    steps, count, features = inputs.shape
    gates = (np.matmul(inputs.reshape(-1, features), w_x) + b).reshape(4, steps, count, -1)
    cells, outputs = np.empty((2, *gates.shape[1:]), dtype=np.float32)
    h = c = np.zeros_like(cells[0])
    for k in range(steps):
        z = gates[:, k] + np.matmul(h, w_h)
        z[:3] *= 0.5
        np.tanh(z, out=z)
        z[:3] += 1
        z[:3] *= 0.5  # the logistic function
        gates[:, k] = i, f, o, g = z
        c = f * c + i * g
        h = o * np.tanh(c)
        cells[k], outputs[k] = c, h
    return LstmPass(inputs, gates, cells, outputs)


@dataclass(frozen=True)
class Next:
    """A trained network with its scales and the limits of tau_ext."""

    network: NextNetwork
    parameters: np.ndarray
    config: NextConfig
    inputs: tuple[np.ndarray, np.ndarray]
    """Mean and spread of each input in training."""
    torques: tuple[np.ndarray, np.ndarray]
    """Of each joint's torque."""
    limit_nm: np.ndarray
    """Largest |tau_ext| of each joint in the training motion."""

    def tau_ext(self, recording: Recording) -> np.ndarray:
        """Measured minus predicted torque, low-passed, (samples, joints), [N m]; 0 before a whole window."""
        rows, every = input_rows(recording, self.config), reduction(recording, self.config)
        rows = ((rows - self.inputs[0]) / self.inputs[1]).astype(np.float32)
        taken = recording.tau[::every]
        error = np.zeros_like(taken)
        ends = np.arange(self.config.history - 1, len(rows))
        for some in chunks(ends):
            predicted = self.network.predict(self.parameters, windows_at(rows, some, self.config.history))
            error[some] = taken[some] - (predicted * self.torques[1] + self.torques[0])
        kept = np.exp(-self.config.low_pass_per_s * every / recording.rate_hz)
        smooth = lfilter([1 - kept], [1, -kept], error, axis=0)
        return np.repeat(smooth, every, axis=0)[: recording.samples]

    def ratio(self, recording: Recording) -> np.ndarray:
        """See OtherMethod.ratio: |tau_ext| over its limit."""
        return np.abs(self.tau_ext(recording)) / self.limit_nm


def train_next(
    recordings: Sequence[Recording],
    seed: int = 0,
    config: NextConfig = NextConfig(),
    report: Callable[[str], None] = lambda line: None,
) -> Next:
    """Train the network on the free motion of recordings, whose samples count as evenly spaced.

    Args:
        report: gets a line each epoch.

    Raises:
        TrainingError: a recording has no commanded positions although the settings ask for them, or none holds a whole
            window.
    """
    pieces = free_pieces(recordings)
    rows = [input_rows(one, config) for one in pieces]
    torque = [one.tau[:: reduction(one, config)] for one in pieces]
    firsts = np.cumsum([0, *map(len, rows)])
    ends = np.concatenate([np.arange(a + config.history - 1, b) for a, b in zip(firsts[:-1], firsts[1:], strict=True)])
    if len(ends) == 0:
        raise TrainingError(f"no recording holds a window of {config.history} samples of free motion")
    (scaled, inputs), (targets, torques) = standardised(rows), standardised(torque)
    network = NextNetwork(scaled.shape[1], targets.shape[1], config)
    rng = np.random.default_rng([seed, 0x2026])
    vector = network.initial(rng)
    adam = Adam.start(len(vector))
    for epoch in range(config.epochs):
        rng.shuffle(ends)
        square = 0.0
        for batch in np.split(ends, range(config.batch, len(ends), config.batch)):
            parts = [
                network.gradient(vector, windows_at(scaled, some, config.history), targets[some])
                for some in chunks(batch)
            ]
            square += sum(loss for loss, _ in parts)
            total = np.sum([gradient for _, gradient in parts], axis=0, dtype=np.float64)
            vector, adam = adam.step(vector, total / (len(batch) * targets.shape[1]), config.learning_rate)
        report(f"epoch {epoch + 1}: {np.sqrt(square / (len(ends) * targets.shape[1])):.4f} of the torque's spread")
    made = Next(network, vector, config, inputs, torques, np.ones(targets.shape[1]))
    largest = np.max([np.abs(made.tau_ext(one)).max(axis=0) for one in pieces], axis=0)
    return Next(network, vector, config, inputs, torques, np.maximum(largest, 1e-9))


def input_rows(recording: Recording, config: NextConfig) -> np.ndarray:
    """q, dq and, if asked for, commanded minus measured position: (rows, 3 joints), at the network's rate.

    Raises:
        TrainingError: no commanded positions are recorded.
    """
    signals = [recording.q, recording.dq]
    if config.commanded:
        signals.append(position_error(recording))
    return np.hstack(signals)[:: reduction(recording, config)]


def position_error(recording: Recording) -> np.ndarray:
    """Commanded minus measured position, (samples, joints), [rad].

    Raises:
        TrainingError: no commanded positions are recorded.
    """
    if recording.q_des is None:
        raise TrainingError(
            f"recording '{recording.name}' has no commanded positions, which this method needs: import it with "
            "[signals.q_des] in arm.toml"
        )
    return recording.q_des - recording.q


def reduction(recording: Recording, config: NextConfig) -> int:
    """Samples to each row of the network."""
    return max(1, int(recording.rate_hz / config.most_hz * 1.001))


def standardised(parts: Sequence[np.ndarray]) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Rows with mean 0 and spread 1, float32, and both; a column that never changes keeps its unit."""
    rows = np.concatenate(parts)
    mean, spread = rows.mean(axis=0), rows.std(axis=0)
    spread[spread < 1e-9] = 1.0
    return ((rows - mean) / spread).astype(np.float32), (mean, spread)


def windows_at(rows: np.ndarray, ends: np.ndarray, history: int) -> np.ndarray:
    """Windows that end at these rows: (history, windows, inputs), oldest step first."""
    return rows[ends + np.arange(1 - history, 1)[:, None]]


def chunks(ends: np.ndarray) -> Iterator[np.ndarray]:
    """Parts of at most CHUNK windows."""
    return (ends[first : first + CHUNK] for first in range(0, len(ends), CHUNK))


# --- The stall rule of servo users: much current and a large position error at rest, for several samples.


@dataclass(frozen=True)
class StallRule:
    """A joint stalls if current and position error exceed their thresholds at rest for several samples in a row."""

    current: np.ndarray
    """Of each motor, in the unit of the recordings' current, or of tau where none is recorded."""
    error_rad: np.ndarray
    rest_rad_s: float = 0.1
    samples: int = 5

    def ratio(self, recording: Recording) -> np.ndarray:
        """See OtherMethod.ratio: the factor on both thresholds below which a joint stalls."""
        ratio = np.minimum(drawn(recording) / self.current, np.abs(position_error(recording)) / self.error_rad)
        ratio[np.abs(recording.dq) > self.rest_rad_s] = 0.0
        length, healthy = np.full(recording.samples, self.samples - 1), np.ones(recording.samples, dtype=bool)
        return np.nan_to_num(held_minimum(ratio, healthy, length))


def fit_stall_rule(recordings: Sequence[Recording]) -> StallRule:
    """The rule with the largest current and position error of each joint in the free motion of recordings.

    Raises:
        TrainingError: a recording has no commanded positions.
    """
    pieces = free_pieces(recordings)
    currents = [drawn(one).max(axis=0) for one in pieces]
    errors = [np.abs(position_error(one)).max(axis=0) for one in pieces]
    return StallRule(*(np.maximum(np.max(values, axis=0), 1e-9) for values in (currents, errors)))


def drawn(recording: Recording) -> np.ndarray:
    """Magnitude of each motor's current, or of its torque where none is recorded, (samples, joints)."""
    return np.abs(recording.tau if recording.current is None else recording.current)


# --- Methods by name, beside the bundles of `tauext evaluate --baselines`.


def train_other_methods(
    names: Iterable[str], recordings: Sequence[Recording], seed: int, report: Reporter = SILENT
) -> dict[str, OtherMethod]:
    """Train methods of OTHER_METHODS; one that the recordings do not allow is left out, and the reason is reported."""
    made: dict[str, OtherMethod] = {}
    for name in names:
        try:
            made[name] = (
                train_next(recordings, seed, report=report.say) if name == "next" else fit_stall_rule(recordings)
            )
        except TrainingError as error:
            report.say(f"{name} is left out: {error}")
    return made
