"""The recipes of `train`: one row each. A new baseline is one row here and, where it is fitted, one function.

Standard library only, since the settings and with them the command line's help are made from this table.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from tauext.errors import ConfigError

Network = Literal["windows", "sequences", "samples"]
"""windows: one target a window, in epochs, as published. sequences: longer ones, drawn at random, that teach a target
at every step. samples: no memory at all, a feed-forward network on x(k), drawn at random."""


@dataclass(frozen=True)
class Recipe:
    """What makes one kind of bundle: the residual, the fit, the network for the rest, and the limits."""

    name: str
    method: str = "momentum"
    """Method of the residual: a name of the core's ResidualMethod."""
    needs_model: str = ""
    """Why there is no such bundle without a model; empty: there is."""
    high_pass: bool = False
    """r is high-passed at the settings' filters.high_pass_per_s ..."""
    low_pass: bool = False
    """... and low-passed at filters.low_pass_per_s."""
    fit: str | None = None
    """Function that fits a prior, as "module:function" (see tauext.train.fitting), imported on use; None: no prior."""
    presliding: bool = False
    """The prior has presliding states, described by the setting `prior`."""
    drift: bool = False
    """The monitor follows slow changes of the prior's friction and offset: the setting `drift`."""
    finds_arm: bool = False
    """Without a model the fit finds the arm itself, which needs all joints in one unit; others take each by itself,
    in whatever unit."""
    network: Network | None = None
    """Network that is trained in steps. After a fit, which alone makes a bundle, the network is kept only if it
    helps."""
    chooses_gain: bool = False
    """By default, the observer's gain is the one that finds a hit soonest; others have the paper's."""
    coverage: bool = False
    """The monitor reports motion that the training data do not contain."""
    error_scale: bool = False
    """By default, limits follow the error that the motion announces; others are constants."""
    largest_error_limits: bool = False
    """By default, limits are the largest errors on validation recordings, as in the paper."""
    defaults: Mapping[str, float] = field(default_factory=dict)
    """Values for settings that are None in TrainConfig."""
    baseline: str | None = None
    """Its name among the baselines; None: it is not a baseline ..."""
    rank: int = 0
    """... and its position there, simplest first."""

    @property
    def learns(self) -> bool:
        """Whether the recipe learns from motion; others are fixed, and only find limits."""
        return self.fit is not None or self.network is not None

    @property
    def gated(self) -> bool:
        """Whether the network ships only if it helps: there is a prior that works without it."""
        return self.fit is not None and self.network is not None

    @property
    def judges_itself(self) -> bool:
        """Whether it needs no validation recordings: a fit alone is judged by motion that is left out of it in turn."""
        return self.fit is not None and self.network is None

    @property
    def draws(self) -> bool:
        """Whether its network trains on random draws, in steps instead of epochs."""
        return self.network is not None and self.network != "windows"

    @property
    def unused(self) -> tuple[str, ...]:
        """Fields of TrainConfig that its bundles do not depend on."""
        used = {
            "threads": False,
            "epochs": not self.draws,
            "targets": self.network == "sequences",
            "prior": self.presliding,
            "gate_margin": self.gated,
            "drift": self.drift,
            "filters": self.high_pass or self.low_pass,
        }
        return tuple(name for name, is_used in used.items() if not is_used)


FULL_PRIOR: dict[str, Any] = {
    "fit": "tauext.fit.prior:fit_prior",
    "presliding": True,
    "drift": True,
    "finds_arm": True,
    "chooses_gain": True,
    "error_scale": True,
    "coverage": True,
}
DENSE = {"batch": 64, "learning_rate": 0.01}

RECIPES = {
    recipe.name: recipe
    for recipe in (
        Recipe(
            "tauext",
            **FULL_PRIOR,
            network="sequences",
            defaults=DENSE | {"max_steps": 10_000},
            baseline="tauext",
            rank=10,
        ),
        Recipe("prior", **FULL_PRIOR, baseline="prior", rank=9),
        Recipe(
            "paper",
            network="windows",
            largest_error_limits=True,
            defaults={"epochs": 500, "batch": 1000, "learning_rate": 0.001},
        ),
        # Stands for the paper's network among the baselines: its errors are below the published ones at a fraction of
        # the time. A bundle of the paper's whole recipe can be given beside it.
        Recipe(
            "dense",
            network="sequences",
            largest_error_limits=True,
            defaults=DENSE | {"max_steps": 45_000},
            baseline="paper-lstm",
            rank=8,
        ),
        Recipe(
            "feedforward",
            network="samples",
            defaults={"max_steps": 10_000, "batch": 1000, "learning_rate": 0.01},
            baseline="feedforward",
            rank=7,
        ),
        Recipe("observer", baseline="observer", rank=0),
        Recipe("friction", fit="tauext.fit.prior:fit_friction", baseline="friction", rank=1),
        Recipe("highpass", high_pass=True, baseline="highpass", rank=2),
        Recipe("bandpass", high_pass=True, low_pass=True, baseline="bandpass", rank=3),
        Recipe("direct", method="direct", baseline="direct", rank=6),
        Recipe("velocity", method="velocity", needs_model="it divides by the inertia", baseline="velocity", rank=4),
        Recipe("energy", method="energy", baseline="energy", rank=5),
    )
}
"""Recipes by name, in the order of the help."""


def recipe_of(name: str) -> Recipe:
    """The row of this name.

    Raises:
        ConfigError: there is none.
    """
    if name not in RECIPES:
        raise ConfigError(f"recipe = {name} must be one of {', '.join(RECIPES)}")
    return RECIPES[name]


def baselines() -> dict[str, str]:
    """Recipes by the name of their baseline, simplest first; tauext itself is the last."""
    ranked = sorted(RECIPES.values(), key=lambda recipe: recipe.rank)
    return {recipe.baseline: recipe.name for recipe in ranked if recipe.baseline is not None}
