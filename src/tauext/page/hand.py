"""A weight in the arm's hand: what it is, since when it is there, and which monitors were told of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tauext import _core
from tauext.errors import ConfigError
from tauext.page.watch import Watch
from tauext.sim.arms import DemoArm

STEEL_KG_M3 = 7850.0
LEAST_KG, MOST_KG = 1.0, 3.0
"""Of the weights on offer: less shows on the last joints alone, more is no load for an arm of this size."""


def ball_radius_m(mass_kg: float) -> float:
    """Of a steel ball."""
    return float(np.cbrt(3 * mass_kg / (4 * np.pi * STEEL_KG_M3)))


def ball(arm: DemoArm, mass_kg: float) -> _core.Load:
    """A steel ball in the hand, in the frame of the last link.

    It lies on the last joint's axis and is round: so it is the same for a bundle without a model, whose last link has
    another x axis.

    Raises:
        ConfigError: the arm has no hand, or the mass is none of those on offer.
    """
    if arm.hand_m is None:
        raise ConfigError(f"arm {arm.name} has no hand; another one has")
    if not LEAST_KG <= mass_kg <= MOST_KG:
        raise ConfigError(f"mass_kg = {mass_kg:g} must be {LEAST_KG:g} to {MOST_KG:g}")
    about_centre = 0.4 * mass_kg * ball_radius_m(mass_kg) ** 2
    return _core.Load(mass_kg, [0.0, 0.0, arm.hand_m], [about_centre] * 3 + [0.0] * 3)


@dataclass(frozen=True)
class Held:
    """What a viewer is told of the weight in the hand."""

    mass_kg: float
    since_s: float
    knows: bool
    """The method shown was told of it."""
    refused: str
    """Why the method shown refused to be told; empty: it did not."""


class Hand:
    """The weight in the hand, and who knows of it; the arm's physics are changed by whoever calls take()."""

    def __init__(self) -> None:
        self.load: _core.Load | None = None
        self.since_ns = -1
        self.told = False
        self._refused: dict[str, str] = {}

    def take(self, load: _core.Load | None, last_ns: int) -> None:
        """Hold this from the sample after this time on; None: nothing."""
        self.load, self.since_ns = load, last_ns

    def tell(self, told: bool, watch: Watch | None, afterwards: bool = False) -> None:
        """Tell every monitor what is held, or that nothing is; those that refuse go on without.

        Args:
            told: False: they believe that the hand is empty.
            afterwards: as if they had been told when it was taken, where a monitor can go back.
        """
        self.told, self._refused = told, {}
        if watch is None:
            return
        for method, monitor in watch.monitors.items():
            load = self.load if told else None
            if load is None:
                if monitor.load.mass > 0:  # a monitor that refuses loads refuses this, too
                    monitor.clear_load()
            elif reason := monitor.why_no_load(load):
                self._refused[method] = reason
            else:
                since_ns = self.since_ns if afterwards and not monitor.why_no_load(load, self.since_ns) else None
                monitor.set_load(load.mass, load.com, load.inertia, since_ns=since_ns)

    def knows(self, method: str) -> bool:
        """Whether a method takes the arm for what it is: nothing is held, or it was told what."""
        return self.load is None or (self.told and method not in self._refused)

    def held(self, method: str) -> Held | None:
        """For a viewer of this method; None: nothing."""
        if self.load is None:
            return None
        return Held(self.load.mass, 1e-9 * self.since_ns, self.knows(method), self._refused.get(method, ""))
