"""Velocity and torque of a servo arm's live samples, by the bundle's word."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tauext import _core
from tauext.monitor.source import Sample


class ServoStage:
    """Fills dq and tau of one sample after the other, as import did for the recordings that the bundle was trained on.

    A signal that is needed and that the source did not measure makes them NaN, which the monitor takes for a fault.
    """

    def __init__(self, settings: _core.ServoSettings):
        self._input = _core.ServoInput(settings)

    def made(self, sample: Sample) -> Sample:
        """The sample with dq [rad/s] and tau in the unit that the bundle takes."""
        kept = (sample.dq, sample.tau, sample.q_des, sample.current, sample.duty, sample.voltage)
        signals = (None if values is None else np.ascontiguousarray(values, dtype=np.float64) for values in kept)
        dq, tau = self._input.step(sample.t_ns, np.ascontiguousarray(sample.q, dtype=np.float64), *signals)
        return replace(sample, dq=dq, tau=tau)
