"""The monitors of a demo: one a method, all fed with the same samples."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tauext import _core
from tauext.errors import ConfigError
from tauext.page.places import Placed, Places
from tauext.sim.plant import Sample


class Watch:
    """tauext._core.Monitor of every method."""

    def __init__(self, bundles: Mapping[str, _core.Bundle], sensitivity: float = 1.0):
        """
        Args:
            bundles: by the name of their method, not empty.
            sensitivity: as set_sensitivity() takes it.
        """
        self.monitors = {name: _core.Monitor(bundle) for name, bundle in bundles.items()}
        self._places = {name: Places(bundle) for name, bundle in bundles.items()}
        self.blind_to_stiction = [name for name, bundle in bundles.items() if not bundle.prior.terms]
        """Methods without a prior: what a push left in a joint's static friction raises no limit of theirs."""
        self.set_sensitivity(sensitivity)

    @property
    def methods(self) -> list[str]:
        return list(self.monitors)

    def set_sensitivity(self, sensitivity: float) -> None:
        """Divide the trained limits by this, from the next sample on; 0.1 to 10, the bounds of the monitor's factors.

        Raises:
            ConfigError: outside of them.
        """
        if not 0.1 <= sensitivity <= 10:
            raise ConfigError(f"sensitivity = {sensitivity} must be 0.1 to 10")
        for monitor in self.monitors.values():
            factors = np.full(monitor.joints, 1.0 / sensitivity)
            monitor.set_limit_factors(factors, factors)

    def resume(self) -> None:
        """End every method's latched collision; the arm moves on and nothing touches it."""
        for monitor in self.monitors.values():
            monitor.resume()

    def acknowledge(self, method: str) -> None:
        """End the latched collision of a method."""
        self.monitors[method].acknowledge()

    def step(self, sample: Sample) -> dict[str, _core.Estimate]:
        """What every method says of a sample."""
        signals = (sample.t_ns, sample.q, sample.dq, sample.tau)
        return {name: monitor.step(*signals) for name, monitor in self.monitors.items()}

    def place(self, method: str, q: np.ndarray, said: _core.Estimate) -> Placed | None:
        """Where a method takes the touch of its alarm to be, from what it said of a sample."""
        return self._places[method].find(q, said)

    def places_refused(self, method: str) -> str:
        """Why a method tells no place; empty: it does."""
        return self._places[method].refused
