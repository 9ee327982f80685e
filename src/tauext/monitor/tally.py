"""What a replay comes to: counts, shares and worst margins."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from tauext import _core
from tauext.bundle.estimates import HEALTHS
from tauext.monitor.changes import ALARMS, NONE, AlarmChange, Change
from tauext.monitor.hidden import HiddenFinder
from tauext.monitor.replay import Chunk
from tauext.monitor.unfamiliar import KINDS, Unseen, unseen_of


@dataclass
class Tally:
    """Sums over chunks of one recording or, merged, of several."""

    joints: tuple[str, ...]
    sample_period_ns: int
    units: tuple[str, ...] = ()
    """Of the answers, a joint; empty: N m."""
    samples: int = 0
    bridged_ticks: int = 0
    restarts: int = 0
    core_s: float = 0.0
    acknowledged: int = 0
    hidden: int = 0
    """Collisions that raised no alarm, since one stood."""
    health: np.ndarray = field(default_factory=lambda: np.zeros(len(HEALTHS), dtype=np.int64))
    """Samples of each health."""
    unfamiliar: Counter[Unseen] = field(default_factory=Counter)
    """Samples whose motion training never saw, by what of it."""
    alarms: np.ndarray = field(init=False)
    """Times that a joint raised the alarm to a level, (levels, joints)."""
    worst_margin_nm: np.ndarray = field(init=False)
    """Smallest margin of each joint where there is one; negative: over the limit; infinite: there was none."""

    def __post_init__(self) -> None:
        self._finder = HiddenFinder()
        self.units = self.units or ("N m",) * len(self.joints)
        self.alarms = np.zeros((len(ALARMS), len(self.joints)), dtype=np.int64)
        self.worst_margin_nm = np.full(len(self.joints), np.inf)

    def add(self, chunk: Chunk, monitor: _core.Monitor) -> None:
        """Count one more chunk; the counters of the monitor are taken as they stand."""
        self.samples += len(chunk.t_ns)
        self.core_s += chunk.core_s
        self.health += np.bincount(chunk.said["health"], minlength=len(HEALTHS))
        self.worst_margin_nm = np.fmin(self.worst_margin_nm, np.fmin.reduce(chunk.said["margin_nm"], axis=0))
        self.unfamiliar += unseen_of(chunk.said)
        self.hidden += len(self._finder.find(chunk))
        self.add_changes(chunk.changes)
        self.bridged_ticks, self.restarts = monitor.bridged_ticks, monitor.restarts

    def add_changes(self, changes: Iterable[Change]) -> None:
        """Count alarms and acknowledgements alone."""
        for change in changes:
            if isinstance(change, AlarmChange):
                self.acknowledged += change.acknowledged
                if change.joint >= 0:
                    self.alarms[change.alarm, change.joint] += 1

    def merge(self, other: Tally) -> None:
        """Add another recording's."""
        for name in (
            "samples",
            "bridged_ticks",
            "restarts",
            "core_s",
            "acknowledged",
            "hidden",
            "health",
            "alarms",
            "unfamiliar",
        ):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        self.worst_margin_nm = np.fmin(self.worst_margin_nm, other.worst_margin_nm)

    @property
    def unfamiliar_share(self) -> float:
        """Of the samples."""
        return self.unfamiliar.total() / self.samples if self.samples else 0.0

    @property
    def hours(self) -> float:
        return self.samples * self.sample_period_ns * 1e-9 / 3600

    def summary(self) -> dict:
        """Plain content for JSON; null where a number does not exist."""
        shares = self.health / self.samples if self.samples else np.zeros(len(HEALTHS))
        worst = [float(margin) if np.isfinite(margin) else None for margin in self.worst_margin_nm]
        return {
            "samples": self.samples,
            "hours": self.hours,
            "health_share": dict(zip(HEALTHS, shares.tolist(), strict=True)),
            "alarms": {
                level: dict(zip(self.joints, counts.tolist(), strict=True))
                for level, counts in zip(ALARMS, self.alarms, strict=True)
                if level != ALARMS[NONE]
            },
            "acknowledged": self.acknowledged,
            "hidden_collisions": self.hidden,
            "bridged_ticks": self.bridged_ticks,
            "restarts": self.restarts,
            "unfamiliar_share": self.unfamiliar_share,
            "unfamiliar": [
                {
                    "what": KINDS[what],
                    "joint": self.joints[joint],
                    "other": self.joints[other] if other >= 0 else None,
                    "share": count / self.samples,
                }
                for (what, joint, other), count in self.unfamiliar.most_common()
            ],
            "worst_margin_nm": dict(zip(self.joints, worst, strict=True)),
            "us_per_sample": self.core_s / self.samples * 1e6 if self.samples else None,
        }
