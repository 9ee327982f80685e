"""Settings with their defaults: the one place where a default stands. The docstring under a field is its help text."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Literal

from tauext.errors import ConfigError

Recipe = Literal["paper", "dense", "observer"]
Backend = Literal["core", "torch"]


@dataclass(frozen=True)
class ModelCase:
    """How the estimated model differs from the robot file: what the paper calls a model case."""

    name: str
    mass_factor: float = 1.0
    """Every link's mass times this; inertia about the centre of mass unchanged."""
    com_factor: float = 1.0
    """Every centre of mass moved toward its joint by this factor."""
    no_model: bool = False
    """Zero throughout, rotor inertia included: the observer sees minus the low-passed motor torque."""


PAPER_CASES = {
    case.name: case
    for case in (
        ModelCase("exact"),
        ModelCase("mass", mass_factor=0.5),
        ModelCase("com", com_factor=0.5),
        ModelCase("mass+com", mass_factor=0.5, com_factor=0.5),
        ModelCase("none", no_model=True),
    )
}


@dataclass(frozen=True)
class ObserverConfig:
    """The momentum observer and the rates of the chain."""

    gain_per_s: float = 20.0
    """Observer gain K0, [1/s]: the residual lags the true disturbance by 1/K0."""
    network_period_s: float = 0.01
    """Wanted time between two network steps, [s]; the nearest whole multiple of the sample period is used."""
    window_s: float = 1.0
    """Wanted length of the network's window, [s]."""
    near_stiction_rad_s: float = 0.02
    """Below this joint speed, [rad/s], a joint counts as near stiction and has a limit of its own."""

    def __post_init__(self) -> None:
        for name in ("gain_per_s", "network_period_s", "window_s", "near_stiction_rad_s"):
            require(math.isfinite(getattr(self, name)) and getattr(self, name) > 0, name, getattr(self, name), "> 0")

    def sample_period_ns(self, rate_hz: float) -> int:
        """Sample period of a recording of this rate, [ns]."""
        return round(1e9 / rate_hz)

    def network_stride(self, rate_hz: float) -> int:
        """Samples in a network period: the whole number of sample periods nearest to it, at least 1."""
        return max(1, round(self.network_period_s * rate_hz))

    def window_steps(self, rate_hz: float) -> int:
        """Network steps in a window, at least 1."""
        return max(1, round(self.window_s * rate_hz / self.network_stride(rate_hz)))


@dataclass(frozen=True)
class AlarmConfig:
    """From a joint over its limit to an alarm."""

    collision_hold_s: float = 0.01
    """A joint must stay over its collision limit for so long before the collision is latched, [s]."""
    contact_hold_s: float = 0.0
    """The same before a contact is reported, which falls back by itself, [s]; 0: at the first sample."""
    contact_release_s: float = 0.1
    """A contact is over when no joint has been over its limit for so long, [s]."""

    def __post_init__(self) -> None:
        for name in ("collision_hold_s", "contact_hold_s", "contact_release_s"):
            require(0 <= getattr(self, name) <= 60, name, getattr(self, name), "0 to 60")


@dataclass(frozen=True)
class TrainConfig:
    """What is trained, how, and for how long. None: the recipe's own value."""

    recipe: Recipe = "paper"
    """paper: windows, as published. dense: the same network from longer sequences that teach a target at every step;
    far fewer steps. observer: no network at all, the plain momentum observer."""
    hidden: int = 20
    """Hidden units of the LSTM."""
    epochs: int | None = None
    """Passes over all training windows (paper: 500; dense draws its sequences at random and has none)."""
    max_steps: int | None = None
    """Stop after so many steps (paper: no limit but its epochs; dense: 45,000)."""
    batch: int | None = None
    """Windows or sequences a step (paper: 1000, dense: 64)."""
    learning_rate: float | None = None
    """Step size of Adam (its decay rates are 0.9 and 0.999); dense rises to it and falls to zero
    (paper: 0.001, dense: 0.01)."""
    targets: int = 100
    """Dense only: targets a sequence teaches after its burn-in of one window."""
    backend: Backend = "core"
    """core: gradient in C++. torch: PyTorch, on a GPU where there is one (needs the extra tauext[torch])."""
    seed: int = 0
    """Of the initial weights and of the order of the windows."""
    threads: int = 0
    """Threads of the gradient, 0: one a core. The result does not depend on it."""
    observer: ObserverConfig = field(default_factory=ObserverConfig)
    alarm: AlarmConfig = field(default_factory=AlarmConfig)

    def __post_init__(self) -> None:
        for name in ("hidden", "epochs", "max_steps", "batch", "targets"):
            value = getattr(self, name)
            require(value is None or value >= 1, name, value, ">= 1")
        require(self.recipe != "dense" or self.epochs is None, "epochs", self.epochs, "left out with recipe dense")
        require(self.learning_rate is None or self.learning_rate > 0, "learning_rate", self.learning_rate, "> 0")
        require(self.threads >= 0, "threads", self.threads, ">= 0")
        require(self.seed >= 0, "seed", self.seed, ">= 0")

    def resolved(self) -> TrainConfig:
        """With the recipe's own values where None stands."""
        own = RECIPE_VALUES[self.recipe]
        return replace(self, **{name: value for name, value in own.items() if getattr(self, name) is None})


RECIPE_VALUES = {
    "paper": {"epochs": 500, "batch": 1000, "learning_rate": 0.001},
    "dense": {"max_steps": 45_000, "batch": 64, "learning_rate": 0.01},
    "observer": {},
}


def require(ok: bool, name: str, value: object, rule: str) -> None:
    """Raise ConfigError `name = value must be rule` unless ok."""
    if not ok:
        raise ConfigError(f"{name} = {value} must be {rule}")
