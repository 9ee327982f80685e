"""The stream of events of a monitor; chunks of its estimates for output, and their sums."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from tauext import _core
from tauext.bundle.estimates import ALARMS, HEALTHS, NONE
from tauext.bundle.units import not_in_newtons
from tauext.monitor.changes import Change, ChangeFinder, LoadChange
from tauext.monitor.explanation import KINDS, Unseen, unseen_of
from tauext.monitor.loads import TimedLoad
from tauext.monitor.no_monitor import AnyMonitor
from tauext.monitor.phases import Phases
from tauext.monitor.touch_place import PlaceFinder

# --- Chunks of samples and estimates, for output.


@dataclass(frozen=True)
class Chunk:
    """Some consecutive samples and their estimates."""

    first_row: int
    t_ns: np.ndarray
    """(rows,), [ns]."""
    dq: np.ndarray
    """(rows, joints), [rad/s]."""
    estimates: dict[str, np.ndarray]
    """Result of Monitor.run, one row a sample."""
    changes: list[Change]
    core_s: float
    """Time spent in the core, [s]."""

    def peak_row(self, joint: int) -> int:
        """Row with the largest ratio of |tau_ext| to the limit of this joint; the last row without estimates."""
        share = np.abs(self.estimates["tau_ext"][:, joint]) / self.estimates["limit_nm"][:, joint]
        return int(np.nanargmax(share)) if np.isfinite(share).any() else len(share) - 1


# --- The stream of events.


class EventStream:
    """A monitor and the changes in its estimates: the stream of events of a replay or the live loop."""

    def __init__(self, monitor: AnyMonitor, places: PlaceFinder | None = None, phases: Phases | None = None):
        """
        Args:
            places: estimates the touched link and place; None: not estimated.
            phases: whose contacts are declared to the monitor.
        """
        self.monitor, self.phases = monitor, phases or Phases()
        self._finder, self._places = ChangeFinder(self.phases.declared), places
        self._next_places: PlaceFinder | None = None
        self._left_out = not_in_newtons(monitor.joint_names, monitor.estimate_units)
        self._noted: list[Change] = []
        self._scheduled: list[tuple[int, Callable[[int, int], None]]] = []

    def schedule(self, first_ns: int, loads: Sequence[TimedLoad]) -> None:
        """Set loads, and declare the contacts of the phases, at their times in a recording with this first stamp."""
        acts: list[tuple[int, Callable[[int, int], None]]] = [
            (from_ns, partial(self._declare, name, contact, seconds))
            for name, contact, from_ns, seconds in self.phases.scheduled(first_ns)
        ]
        acts += [(first_ns + round(one.from_s * 1e9), partial(self.carry, one.load)) for one in loads]
        self._scheduled = sorted(acts, key=lambda act: act[0])

    def act_when_due(self, row: int, t_ns: int) -> int | None:
        """Do what is scheduled before the sample of this row; returns the time of the next act, [ns]; None: none.

        Raises:
            CoreError: the monitor refuses a contact or a load.
        """
        while self._scheduled and t_ns >= self._scheduled[0][0]:
            self._scheduled.pop(0)[1](row, t_ns)
        return self._scheduled[0][0] if self._scheduled else None

    def _declare(self, name: str, contact: _core.DeclaredContact, seconds: float, row: int, t_ns: int) -> None:
        assert isinstance(self.monitor, _core.Monitor)  # a NoMonitor takes no contacts
        self.phases.declare(self.monitor, name, contact, seconds)

    def exchange(self, monitor: AnyMonitor, places: PlaceFinder) -> None:
        """Another bundle's monitor makes the estimates from here on. An alarm that stands keeps its places."""
        self.monitor, self._next_places = monitor, places
        self._left_out = not_in_newtons(monitor.joint_names, monitor.estimate_units)
        self._finder.forget_drift()

    def stand(self, alarm: int, number: int) -> None:
        """This alarm stands from before the first sample on, and is not reported again."""
        self._finder.stand(alarm, number)
        if self._places is not None:
            self._places.stand(alarm)

    def note(self, change: Change) -> None:
        """Add a change made just before the next samples."""
        self._noted.append(change)

    def end_alarm(self, end: Callable[[], None], row: int, t_ns: int) -> None:
        """End the alarm by acknowledge or resume of the monitor, just before the sample of this row."""
        stood = self.monitor.last.alarm != _core.Alarm.none
        end()
        if stood:
            self.note(self._finder.acknowledged(row, t_ns))
            if self._places is not None:
                self._places.acknowledged()

    def carry(self, load: _core.Load, row: int, t_ns: int, by: str = "", since_ns: int | None = None) -> None:
        """Set the load from the sample of this row on, or from since_ns on.

        Raises:
            CoreError: the bundle refuses the load.
        """
        assert isinstance(self.monitor, _core.Monitor)  # a NoMonitor takes no loads
        self.monitor.set_load(load.mass, load.com, load.inertia, since_ns=since_ns, error_share=load.error_share)
        self.note(LoadChange(row, t_ns, load, by, since_ns, self._left_out))

    def find(
        self,
        row: int,
        t_ns: np.ndarray,
        estimates: dict[str, np.ndarray],
        q: np.ndarray | None = None,
        dq: np.ndarray | None = None,
    ) -> list[Change]:
        """Noted changes, then changes in the estimates, then places; see ChangeFinder and PlaceFinder."""
        noted, self._noted = self._noted, []
        # An acknowledgement, and what was set before the first sample, applies from here on.
        changes = [replace(one, t_ns=int(t_ns[0])) if one.is_acknowledgement or row == 0 else one for one in noted]
        changes += self._finder.find(row, t_ns, estimates)
        if self._next_places is not None and estimates["alarm"][0] == NONE:
            self._places, self._next_places = self._next_places, None
        if self._places is not None and q is not None and dq is not None:
            changes += self._places.find(row, t_ns, q, dq, estimates)
        return sorted(changes, key=lambda change: change.row)


# --- Sums of a replay: counts, shares and worst margins.


@dataclass
class Tally:
    """Sums over chunks of one recording or, merged, of several."""

    joints: tuple[str, ...]
    sample_period_ns: int
    units: tuple[str, ...] = ()
    """Units of the estimates, one a joint; empty: N m."""
    samples: int = 0
    bridged_ticks: int = 0
    restarts: int = 0
    core_s: float = 0.0
    acknowledged: int = 0
    hidden: int = 0
    """Collisions without alarm, since one was latched."""
    health: np.ndarray = field(default_factory=lambda: np.zeros(len(HEALTHS), dtype=np.int64))
    """Number of samples of each health."""
    unfamiliar: Counter[Unseen] = field(default_factory=Counter)
    """Samples with motion that the training data do not contain, by kind and joints."""
    alarms: np.ndarray = field(init=False)
    """Number of alarms of each level raised by each joint, (levels, joints)."""
    worst_margin_nm: np.ndarray = field(init=False)
    """Smallest margin of each joint; negative: over the limit; infinite: no margin."""

    def __post_init__(self) -> None:
        self.units = self.units or ("N m",) * len(self.joints)
        self.alarms = np.zeros((len(ALARMS), len(self.joints)), dtype=np.int64)
        self.worst_margin_nm = np.full(len(self.joints), np.inf)

    def add(self, chunk: Chunk, monitor: AnyMonitor, came: Sequence[bool] = ()) -> None:
        """Count one more chunk; counters of the monitor are copied.

        Args:
            came: whether each row belongs to a received sample, which counts; empty: all.
        """
        for change in chunk.changes:
            self.hidden += change.event == "hidden"
            self.acknowledged += change.is_acknowledgement
            if change.raised is not None:
                self.alarms[change.raised] += 1
        if came and not any(came):
            return
        if not all(came):
            rows = np.array(came)
            estimates = {name: values[rows] for name, values in chunk.estimates.items()}
            chunk = replace(chunk, t_ns=chunk.t_ns[rows], estimates=estimates)
        self.samples += len(chunk.t_ns)
        self.core_s += chunk.core_s
        self.health += np.bincount(chunk.estimates["health"], minlength=len(HEALTHS))
        self.worst_margin_nm = np.fmin(self.worst_margin_nm, np.fmin.reduce(chunk.estimates["margin_nm"], axis=0))
        self.unfamiliar += unseen_of(chunk.estimates)
        self.bridged_ticks, self.restarts = monitor.bridged_ticks, monitor.restarts

    def merge(self, other: Tally) -> None:
        """Add the tally of another recording."""
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
        """Share of samples with unfamiliar motion."""
        return self.unfamiliar.total() / self.samples if self.samples else 0.0

    @property
    def hours(self) -> float:
        return self.samples * self.sample_period_ns * 1e-9 / 3600

    def summary(self) -> dict:
        """Content as plain JSON; null for missing numbers."""
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


# --- Single samples of a replay, at the reader's rate.


class StatusClock:
    """Picks the first sample of every period from a recording's first sample on, independent of chunks."""

    def __init__(self, start_ns: int, period_ns: int):
        self._start_ns, self._period_ns = start_ns, period_ns
        self._last = -1

    def rows(self, t_ns: np.ndarray) -> list[int]:
        """Rows of a chunk with these stamps, (rows,), [ns]; call it for every chunk in order."""
        periods = (t_ns - self._start_ns) // self._period_ns
        rows = np.flatnonzero(periods > np.append(self._last, periods[:-1]))
        self._last = int(periods[-1])
        return rows.tolist()
