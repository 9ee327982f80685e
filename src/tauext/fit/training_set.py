"""Windows and targets for training, and the largest signals that the arm can send."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from tauext import _core
from tauext.config import warm_up_s
from tauext.data.dataset import ahead
from tauext.data.free_motion import MOST_SHARE, SignalBounds
from tauext.data.recording import Recording
from tauext.errors import TrainingError

# --- Windows and targets for training, read in place from the recordings.


class TooShort(TrainingError):
    """Recordings that are too short for the windows or sequences of a network."""


@dataclass(frozen=True)
class Setup:
    """Setup of a training before its network: estimated model, observer, length of the window, and prior."""

    tree: _core.Tree
    observer: _core.ObserverSettings
    window_steps: int
    prior: _core.PriorSettings = field(default_factory=_core.PriorSettings)  # none: as in the paper
    threads: int = 1
    """Threads of the fits; results do not depend on it."""

    @property
    def widths_rad(self) -> list[float]:
        """Widths of the presliding states."""
        return self.prior.widths_rad

    @property
    def columns(self) -> int:
        """Number of feature columns: q, dq and the presliding states of every joint."""
        return self.tree.size * (2 + len(self.widths_rad))

    @property
    def inputs(self) -> list[tuple[int, int]]:
        """(column, lag) of each network input: q(k), dq(k) and the presliding states, then dq(k-1), as in the paper."""
        n = self.tree.size
        return [(c, 0) for c in range(self.columns)] + [(c, 1) for c in range(n, 2 * n)]

    @property
    def warm_up_s(self) -> float:
        """Warm-up of the observer and its filters, [s]."""
        return warm_up_s(self.observer.gain_per_s, self.observer.low_pass_per_s)

    @property
    def network_period_s(self) -> float:
        """Time between two rows of the network, [s]."""
        return 1e-9 * self.observer.sample_period_ns * self.observer.network_stride

    def observe(
        self, recording: Recording, prior: _core.PriorSettings | None = None
    ) -> tuple[_core.Observation, np.ndarray]:
        """r of a recording, with the share of this prior, and which samples count: warm ones at the network's rate."""
        observation = _core.observe(self.tree, self.observer, *recording.signals, prior or _core.PriorSettings())
        return observation, np.flatnonzero(observation.warm)[:: self.observer.network_stride]

    @property
    def reach(self) -> int:
        """Network steps before its last one that a window needs: its length, since one input lags by one step."""
        return self.window_steps


def with_presliding(setup: Setup, widths_rad: Sequence[float], branches: Sequence[float] = ()) -> Setup:
    """The setup with presliding states of these widths and branches, and no prior yet."""
    prior = _core.PriorSettings()
    prior.widths_rad, prior.branches = list(widths_rad), list(branches)
    return replace(setup, prior=prior)


@dataclass(frozen=True)
class Scaling:
    """Factors that bring inputs and outputs to magnitude 1 over the training recordings."""

    input_factors: np.ndarray  # (columns,) float32, 1/rad, s/rad; 1 for presliding states
    output_scale_nm: np.ndarray  # (n,) float64


@dataclass(frozen=True)
class WindowSet:
    """Rows at the network period of several recordings one after the other, and the windows that may end in them."""

    rows: np.ndarray  # (rows, columns) float32, scaled
    target_rows: np.ndarray  # (rows, n) float32, scaled: observer minus prior; NaN where a row has no target
    ends: np.ndarray  # (windows,) int64: the row that ends each window
    first_rows: np.ndarray  # (windows,) int64: the first row of the stretch that contains each window

    @property
    def windows(self) -> int:
        return len(self.ends)


def find_scaling(setup: Setup, recordings: Sequence[Recording]) -> Scaling:
    """Largest magnitude of every input column and, after the observer's warm-up, of every output.

    Raises:
        TrainingError: a residual that is constant (nothing to learn), or no recording longer than the warm-up.
    """
    n = setup.tree.size
    largest = np.zeros(2 * n)
    low, high = np.full(n, np.inf), np.full(n, -np.inf)
    for recording, observation in _observed(setup, recordings):
        residual = remainder(observation)[observation.warm.astype(bool)]
        largest = np.maximum(largest, np.abs(np.hstack([recording.q, recording.dq])).max(axis=0))
        if len(residual):
            low, high = np.minimum(low, residual.min(axis=0)), np.maximum(high, residual.max(axis=0))
    if not np.isfinite(low).all():
        raise TrainingError(f"no training recording is longer than the observer's warm-up of {setup.warm_up_s:g} s")
    for joint, (a, b) in enumerate(zip(low, high, strict=True)):
        # e^-10 of the first residual is still fading out where the warm-up ends.
        if b - a <= 1e-6 + 1e-4 * max(abs(a), abs(b)):
            name = recordings[0].joints[joint]
            raise TrainingError(
                f"joint '{name}': the observer's residual is constant ({a:g} Nm) over all training recordings, so "
                "there is nothing to learn; is its torque recorded, and does the arm move?"
            )
    factors = 1.0 / np.where(largest > 0, largest, 1.0)
    factors = np.r_[factors, np.ones(setup.columns - 2 * n)]
    return Scaling(factors.astype(np.float32), np.maximum(np.abs(low), np.abs(high)))


def build_windows(setup: Setup, scaling: Scaling, recordings: Sequence[Recording]) -> WindowSet:
    """All windows of one phase: their ends lie a network period apart, counted from the start of each stretch.

    The observer's warm-up and windows that would reach across a restart are left out; ticks that only hold an older
    sample are never targets.

    Raises:
        TrainingError: no recording holds a whole window.
    """
    stride, n = setup.observer.network_stride, setup.tree.size
    rows, target_rows, ends, first_rows, offset = [], [], [], [], 0
    for recording, observation in _observed(setup, recordings):
        features = _core.feature_rows(
            observation, recording.t_ns, recording.q, recording.dq, recording.tau, scaling.input_factors
        )
        row, begin = observation.row, observation.stretch_begin
        stretches = np.unique(begin)
        # Network rows: every stride-th tick of each stretch; first network row of each stretch.
        bounds = np.append(stretches, observation.row_count)
        network_rows = np.concatenate([np.arange(a, b, stride) for a, b in zip(bounds[:-1], bounds[1:], strict=True)])
        first_network_row = np.searchsorted(network_rows, stretches)
        steps, phase = np.divmod(row - begin, stride)
        first = first_network_row[np.searchsorted(stretches, begin)]
        has_target = (phase == 0) & observation.warm.astype(bool)
        targets = np.full((len(network_rows), n), np.nan, dtype=np.float32)
        targets[(first + steps)[has_target]] = remainder(observation)[has_target] / scaling.output_scale_nm
        usable = has_target & (steps >= setup.reach)
        rows.append(features[network_rows])
        target_rows.append(targets)
        ends.append((first + steps)[usable] + offset)
        first_rows.append(first[usable] + offset)
        offset += len(network_rows)
    result = WindowSet(
        np.ascontiguousarray(np.concatenate(rows)),
        np.concatenate(target_rows),
        np.concatenate(ends).astype(np.int64),
        np.concatenate(first_rows).astype(np.int64),
    )
    if result.windows == 0:
        needed = setup.reach * stride * setup.observer.sample_period_ns * 1e-9
        raise TooShort(
            f"no recording holds a whole window: {needed:g} s after the observer's warm-up of {setup.warm_up_s:g} s "
            "are needed"
        )
    return result


def remainder(observation: _core.Observation) -> np.ndarray:
    """Part of r left for the network: (samples, n), [N m]."""
    return observation.residual - observation.prior if observation.prior.size else observation.residual


def _observed(setup: Setup, recordings: Sequence[Recording]) -> Iterator[tuple[Recording, _core.Observation]]:
    """Each recording and its observation; while one is used, the next is observed."""
    return zip(recordings, ahead([partial(_observe, setup, recording) for recording in recordings]), strict=True)


def _observe(setup: Setup, recording: Recording) -> _core.Observation:
    return _core.observe(setup.tree, setup.observer, *recording.signals, setup.prior, recording.temperature)


# --- An arm's largest possible signals, from its recordings and robot file; samples beyond them are invalid.


LEAST_TORQUE_NM = 1.0
"""Smallest torque bound, since a joint that needed no torque in training may need some later."""


@dataclass(frozen=True)
class BoundsConfig:
    """Bounds of possible signals; narrower ones find more faults and may reject a collision."""

    drive: float = 2.0
    """Multiple of the robot file's drive torque: files often state the rated torque, and a peak is twice that."""
    torque: float = 10.0
    """Multiple of a joint's training torque if its drive is unknown: a wrist in gentle motion needs a tenth of its
    drive's torque, and a collision demands all of it."""
    speed: float = 5.0
    """Multiple of a joint's training speed."""
    usual_speed_rad_s: float = 2.0
    """Least training speed for this, [rad/s]: joints hardly reach the bound of 10 rad/s, and no collision adds it."""


def signal_bounds(
    recordings: Sequence[Recording],
    torque_limit_nm: Sequence[float] | np.ndarray | None = None,
    nm_per_unit: Sequence[float] | np.ndarray = (1.0,),
    config: BoundsConfig = BoundsConfig(),
) -> SignalBounds:
    """Torque and speed beyond which a sample of this arm cannot be valid, whatever touches it.

    The largest values of training count, except for MOST_SHARE of all samples, which may be glitches. A joint with
    an unknown drive may have the torque at least that the arm's strongest joint needed.

    Args:
        recordings: at least one.
        torque_limit_nm: what each drive gives at most, infinite where unknown; one that training passed counts as
            unknown.
        nm_per_unit: torque constants of the recordings' tau.
    """
    torque = robust_largest([recording.tau for recording in recordings]) * np.abs(nm_per_unit)
    speed = robust_largest([recording.dq for recording in recordings])
    needed = np.maximum(torque, LEAST_TORQUE_NM)
    unknown = np.maximum(config.torque * needed, torque.max())
    drive = np.full(len(torque), np.inf) if torque_limit_nm is None else np.asarray(torque_limit_nm, dtype=float)
    known = np.isfinite(drive) & (drive >= torque)
    most = np.where(known, np.maximum(config.drive * np.where(known, drive, 0.0), LEAST_TORQUE_NM), unknown)
    return SignalBounds(most, config.speed * np.maximum(speed, config.usual_speed_rad_s))


def robust_largest(signals: Sequence[np.ndarray]) -> np.ndarray:
    """Largest magnitude of each column but for MOST_SHARE of its values, and for one of a few; (joints,)."""
    rows = sum(len(signal) for signal in signals)
    step = -(-rows // 2_000_000)
    magnitude = np.abs(np.concatenate([signal[::step] for signal in signals]))
    return np.quantile(magnitude, 1 - MOST_SHARE, axis=0, method="lower")
