"""What a step is taught, and how large it is: the paper's schedule, and the dense one."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np

from tauext.config import TrainConfig
from tauext.errors import TrainingError
from tauext.fit.training_set import Setup, TooShort, WindowSet

Number = TypeVar("Number", int, float)


class Schedule(Protocol):
    """Sequences of `length` network steps from zero state, of which the last `targets` teach."""

    steps: int
    length: int
    targets: int
    largest_gradient: float  # a gradient of a larger norm is shortened to it
    report_every: int  # steps
    validation_windows: int  # at most so many, evenly spread, are looked at in each report

    def ends(self, step: int) -> np.ndarray:
        """Rows that end the sequences of this step; the same for the same seed and step, whatever came before."""

    def learning_rate(self, step: int) -> float: ...

    def score(self, step: int, validation_loss: float) -> float:
        """By which weights are compared after so many steps; those of the lowest are kept."""

    def gives_up(self, history: list[tuple[int, float, float]]) -> bool:
        """Whether to stop early, after these (step, training loss, validation loss)."""


@dataclass
class PaperSchedule:
    """One target a window, all windows in a new random order each epoch, constant learning rate [Lim2021]."""

    setup: Setup
    training: WindowSet
    config: TrainConfig
    targets = 1
    largest_gradient = math.inf
    report_every = 200
    validation_windows = 20_000

    def __post_init__(self) -> None:
        batch = number(self.config.batch)
        self.length = self.setup.window_steps
        self.steps_an_epoch = self.training.windows // batch
        if self.steps_an_epoch == 0:
            raise TrainingError(
                f"{self.training.windows} training windows are fewer than a batch of {batch}; record more"
            )
        self.steps = min(number(self.config.epochs) * self.steps_an_epoch, self.config.max_steps or 1 << 62)
        self._order_of = -1

    def ends(self, step: int) -> np.ndarray:
        epoch, index = divmod(step, self.steps_an_epoch)
        if self._order_of != epoch:
            self._order_of = epoch
            self._order = np.random.default_rng([self.config.seed, epoch]).permutation(self.training.windows)
        batch = number(self.config.batch)
        return self.training.ends[self._order[index * batch : (index + 1) * batch]]

    def learning_rate(self, step: int) -> float:
        return number(self.config.learning_rate)

    def score(self, step: int, validation_loss: float) -> float:
        return validation_loss

    def gives_up(self, history: list[tuple[int, float, float]]) -> bool:
        return False


@dataclass
class DenseSchedule:
    """Sequences drawn at random; after a burn-in as long as the window every step has a target.

    A state that has seen a whole window hardly depends on what came before, so these states stand for those of a
    window from zero state, which is what the network is used on. One sequence of 199 steps teaches 100 targets, which
    cost the paper's schedule 10,000 steps. The learning rate rises over the first twentieth of the training and falls
    to zero along a cosine. A feed-forward network has a window of one step and no state to burn in: each of its
    sequences is that step, and teaches one target.
    """

    setup: Setup
    training: WindowSet
    config: TrainConfig
    largest_gradient = 0.1
    report_every = 500
    validation_windows = 10_000
    warm_up = 0.05
    settled = 0.8  # the share of the steps after which the learning rate is low
    unsettled_handicap = 1.5
    patience = 0.1  # the share of the steps without a better score after which a settled training stops

    def __post_init__(self) -> None:
        self.targets = self.config.targets if self.config.row.network == "sequences" else 1
        self.length = self.setup.window_steps - 1 + self.targets
        self.steps = number(self.config.max_steps)
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
            return number(self.config.learning_rate) * (step + 1) / (self.warm_up * self.steps + 1)
        falling = 1 + math.cos(math.pi * (done - self.warm_up) / (1 - self.warm_up))
        return 0.5 * number(self.config.learning_rate) * falling

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
    """The schedule that the network of a resolved config's recipe is taught by."""
    if config.row.draws:
        return DenseSchedule(setup, training, config)
    return PaperSchedule(setup, training, config)


def number(value: Number | None) -> Number:
    """A setting that a resolved config has."""
    assert value is not None
    return value
