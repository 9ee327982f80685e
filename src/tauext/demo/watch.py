"""The monitors of a demo: one a method, all fed with the same samples."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tauext import _core
from tauext.demo.plant import Sample
from tauext.errors import ConfigError

LIMITS = ("sliding_limit_nm", "near_stiction_limit_nm", "contact_sliding_limit_nm", "contact_near_stiction_limit_nm")


class Watch:
    """tauext._core.Monitor of every method; new limits take over once their monitor is warm, so none goes blind."""

    def __init__(self, bundles: Mapping[str, _core.Bundle], sensitivity: float = 1.0):
        """
        Args:
            bundles: by the name of their method, not empty.
            sensitivity: limits are divided by it, > 0.
        """
        self._bundles = dict(bundles)
        self._limits = {name: {key: getattr(b, key) for key in LIMITS} for name, b in self._bundles.items()}
        self.monitors = self._made(sensitivity)
        self._next: dict[str, _core.Monitor] | None = None

    @property
    def methods(self) -> list[str]:
        return list(self.monitors)

    def set_sensitivity(self, sensitivity: float) -> None:
        """Divide the trained limits by this, once a monitor with the new ones is warm (about 1.5 s)."""
        self._next = self._made(sensitivity)

    def acknowledge(self) -> None:
        """End every method's latched collision."""
        for monitor in self.monitors.values():
            monitor.acknowledge()

    def step(self, sample: Sample) -> dict[str, _core.Estimate]:
        """What every method says of a sample."""
        signals = (sample.t_ns, sample.q, sample.dq, sample.tau)
        said = {name: monitor.step(*signals) for name, monitor in self.monitors.items()}
        if self._next is not None:
            warm = [monitor.step(*signals).health == _core.Health.ok for monitor in self._next.values()]
            if all(warm):
                for name, monitor in self._next.items():
                    if self.monitors[name].last.alarm != _core.Alarm.collision:
                        monitor.acknowledge()
                self.monitors, self._next = self._next, None
        return said

    def _made(self, sensitivity: float) -> dict[str, _core.Monitor]:
        if not 0 < sensitivity < float("inf"):
            raise ConfigError(f"sensitivity = {sensitivity} must be > 0")
        for name, bundle in self._bundles.items():
            for key, limits in self._limits[name].items():
                setattr(bundle, key, (np.array(limits) / sensitivity).tolist())
        return {name: _core.Monitor(bundle) for name, bundle in self._bundles.items()}
