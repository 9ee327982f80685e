"""The monitor of a loop without a bundle."""

from __future__ import annotations

import numpy as np

from tauext import _core
from tauext.monitor.source import SourceSettings

NO_BUNDLE = "nothing is monitored yet: there is no bundle"


class _NoEstimate:
    """The last estimate of a NoMonitor."""

    alarm, load_phase, health = _core.Alarm.none, _core.LoadPhase.none, _core.Health.warming_up
    alarm_t_ns, touch_over = 0, True


class NoMonitor:
    """Stands in for _core.Monitor until there is a bundle: torques are NaN, health is never ok, no alarm is raised."""

    why_no_wrench = why_not_expected = why_no_weighing = why_no_load = lambda self, *arguments: NO_BUNDLE
    last = _NoEstimate
    samples = bridged_ticks = restarts = clock_jumps = alarms = 0
    weighing = False
    load = _core.Load(0.0)

    def __init__(self, arm: SourceSettings):
        n = len(arm.joints)
        self.joints, self.joint_names, self.sample_period_ns = n, list(arm.joints), arm.period_ns
        self.torque_units = self.estimate_units = list(arm.torque_units or ["N m"] * n)
        self.limit_factors = (np.ones(n), np.ones(n))
        self._waiting = _core.no_estimate(n, _core.Health.warming_up)
        self._missing = _core.no_estimate(n, _core.Health.stale)
        self._wrong_size = _core.no_estimate(n, _core.Health.fault)

    def run(self, t_ns: np.ndarray, *signals: object) -> dict[str, np.ndarray]:
        """A row a sample; all calls share it."""
        if len(t_ns) == 1:
            return self._waiting
        return {name: np.broadcast_to(row, (len(t_ns), *row.shape[1:])) for name, row in self._waiting.items()}

    def run_missing(self, now_ns: int, recorder: object = None) -> dict[str, np.ndarray]:
        return self._missing

    def run_wrong_size(self, t_ns: int, recorder: object = None) -> dict[str, np.ndarray]:
        return self._wrong_size

    acknowledge = resume = stop_weighing = lambda self: None

    def set_limit_factors(self, collision: np.ndarray, contact: np.ndarray) -> None:
        self.limit_factors = (collision, contact)

    def carried(self) -> bytes:
        return b""


AnyMonitor = _core.Monitor | NoMonitor
