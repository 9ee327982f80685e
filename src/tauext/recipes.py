"""The recipes of `train`: one row each. A new baseline is one row here and, where it is fitted, one function.

A fit function takes and returns what the protocol `tauext.train.fitting.Fit` states. A package adds rows as entry
points of the group tauext.recipes (`plugins.py`), each with the name of its row.

Standard library only, since the settings and with them the command line's help are made from this table.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from tauext import plugins
from tauext.errors import ConfigError

Network = Literal["windows", "sequences"]
"""windows: one target a window, in epochs, as published. sequences: longer ones, drawn at random, that teach a target
at every step."""


@dataclass(frozen=True)
class Drawing:
    """How a network is trained on sequences that are drawn at random."""

    speed_factor: float = 1.0
    """Factor on joint speeds as the optimiser sees them. Friction changes its sign within a hundredth of the largest
    speed, and Adam moves all weights at one pace, so the weights of speeds would grow too slowly."""
    change_factor: float = 0.0
    """The optimiser sees the change dq(k) - dq(k-1) times this and speed_factor instead of dq(k-1); 0: dq(k-1). The two
    speeds are almost equal, and inertia acts on their small difference."""
    early_targets: float = 0.0
    """Share of a window by which a sequence's targets begin before a whole window was seen, 0 to below 1. If a joint
    stuck for longer, the network then learns to expect no torque, rather than one from before the window."""
    largest_gradient: float = 0.1
    """A gradient of a larger norm is shortened to it."""
    square_decay: float = 0.999
    """Decay rate of Adam's mean of the squared gradient. A few stuck joints make a gradient ten times as large as
    others; a shorter mean forgets it sooner."""


@dataclass(frozen=True)
class Recipe:
    """What makes one kind of bundle: the residual, the fit, the network for the rest, and the limits."""

    name: str
    summary: str
    """What it is, as the help of --recipe prints it: a phrase in small letters, without a full stop."""
    method: str = "momentum"
    """Method of the residual: a name of the core's ResidualMethod."""
    needs_model: str = ""
    """Why there is no such bundle without a model; empty: there is."""
    high_pass: bool = False
    """r is high-passed at the settings' filters.high_pass_per_s ..."""
    low_pass: bool = False
    """... and low-passed at filters.low_pass_per_s."""
    fit: str | None = None
    """Function that fits a prior, as "module:function", imported on use; None: no prior. Its signature is
    tauext.train.fitting.Fit: fit(setup, recordings, *, config, report, known) returns a PriorFit."""
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
    drawing: Drawing = Drawing()
    """How the network is trained, if on sequences that are drawn at random."""
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
    """Its name among the baselines, the last row first; None: it is not a baseline."""

    @property
    def learns(self) -> bool:
        """Whether the recipe learns from motion; others are fixed, and only find limits."""
        return self.fit is not None or self.network is not None

    @property
    def gated(self) -> bool:
        """Whether the network ships only if it helps: there is a prior that works without it."""
        return self.fit is not None and self.network is not None

    @property
    def draws(self) -> bool:
        """Whether its network trains on random draws, in steps instead of epochs."""
        return self.network == "sequences"

    @property
    def unused(self) -> tuple[str, ...]:
        """Fields of TrainConfig that its bundles do not depend on."""
        used = {
            "threads": False,
            "epochs": not self.draws,
            "targets": self.draws,
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
DRAWN = {"targets": 100, "batch": 64, "learning_rate": 0.01}

RECIPES = {
    recipe.name: recipe
    for recipe in (
        Recipe(
            "tauext",
            "as prior, with a network on its residual where that lowers the error",
            **FULL_PRIOR,
            network="sequences",
            defaults=DRAWN | {"max_steps": 10_000},
            baseline="tauext",
        ),
        Recipe(
            "prior",
            "presliding states and a prior fitted by ridge regression, no network",
            **FULL_PRIOR,
            baseline="prior",
        ),
        Recipe(
            "paper",
            "the paper's network, trained on windows, as published",
            network="windows",
            largest_error_limits=True,
            defaults={"epochs": 500, "batch": 1000, "learning_rate": 0.001},
        ),
        # Stands for the paper's network among the baselines: its errors are below the published ones at a fraction of
        # the time. A bundle of the paper's whole recipe can be given beside it.
        Recipe(
            "dense",
            "the paper's network, trained on longer sequences with a target at every step, in far fewer steps",
            network="sequences",
            largest_error_limits=True,
            drawing=Drawing(
                speed_factor=5.0, change_factor=15.0, early_targets=0.4, largest_gradient=0.03, square_decay=0.99
            ),
            defaults=DRAWN | {"targets": 140, "batch": 32, "max_steps": 90_000},
            baseline="paper-lstm",
        ),
        Recipe("direct", "the residual of the equation of motion, low-passed", method="direct", baseline="direct"),
        Recipe("energy", "an observer of the energy", method="energy", baseline="energy"),
        Recipe(
            "velocity",
            "an observer of the joint velocities",
            method="velocity",
            needs_model="it divides by the inertia",
            baseline="velocity",
        ),
        Recipe(
            "bandpass",
            "the observer's r through a high-pass and a low-pass",
            high_pass=True,
            low_pass=True,
            baseline="bandpass",
        ),
        Recipe("highpass", "the observer's r through a high-pass", high_pass=True, baseline="highpass"),
        Recipe(
            "friction",
            "constant, viscous and Coulomb friction of each joint, fitted",
            fit="tauext.fit.prior:fit_friction",
            baseline="friction",
        ),
        Recipe("observer", "the plain momentum observer, nothing learned", baseline="observer"),
    )
}
"""Recipes of tauext by name, in the order of the help; the baselines are in the reverse one, simplest first."""


def recipe_of(name: str) -> Recipe:
    """The row of this name, of tauext or of a plug-in.

    Raises:
        ConfigError: there is none, or its plug-in cannot be loaded.
    """
    row = plugins.named(name, RECIPES, plugins.RECIPES, Recipe)
    if row is None:
        raise ConfigError(plugins.how_to_add(name) or f"recipe = {name} must be one of {', '.join(recipes())}")
    return row


def recipes() -> dict[str, Recipe]:
    """All rows by name, plug-ins last; the summary of a plug-in that cannot be loaded is the reason."""
    rows = dict(RECIPES)
    for name, entry in plugins.installed(plugins.RECIPES, RECIPES).items():
        try:
            rows[name] = plugins.load(entry, Recipe)
        except ConfigError as error:
            rows[name] = Recipe(name, str(error))
    return rows


def summaries() -> dict[str, str]:
    """What each recipe is, by name."""
    return {name: row.summary for name, row in recipes().items()}


def baselines() -> dict[str, str]:
    """Recipes by the name of their baseline, simplest first: the last row comes first."""
    return {row.baseline: name for name, row in reversed(recipes().items()) if row.baseline is not None}
