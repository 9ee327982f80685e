"""The monitor on a recording: chunks, pace, tally, single samples."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from tauext import _core
from tauext.bundle.estimates import ALARMS, COLLISION, HEALTHS, NONE
from tauext.bundle.units import not_in_newtons
from tauext.monitor.changes import Change, ChangeFinder, LoadChange
from tauext.monitor.exchange import AnyMonitor
from tauext.monitor.explanation import KINDS, Unseen, unseen_of
from tauext.monitor.loads import TimedLoad
from tauext.monitor.phases import Phases
from tauext.monitor.touch_place import PlaceFinder

# --- Replay at wall-clock speed.


class Pace:
    """Delays samples to their times: the recording runs `speed` times as fast as it was recorded.

    A late replay does not wait until it has caught up. Times that go backwards cause no wait.
    """

    def __init__(
        self,
        speed: float | None,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ):
        """speed: None for no delay. clock and sleep count in seconds."""
        self.speed = speed
        self._clock, self._sleep = clock, sleep
        self._began: tuple[float, int] | None = None

    def wait_until(self, t_ns: int) -> None:
        """Wait until the time of this stamp; the first call starts the clock and does not wait."""
        left_s = self.left_s(t_ns)
        if left_s > 0:
            self._sleep(left_s)

    def left_s(self, t_ns: int) -> float:
        """Wall time until this stamp, [s]; 0 or negative if it has passed. The first call starts the clock."""
        if self.speed is None:
            return 0.0
        if self._began is None:
            self._began = (self._clock(), t_ns)
        clock_s, first_ns = self._began
        return clock_s + (t_ns - first_ns) * 1e-9 / self.speed - self._clock()


# --- Samples through the core's monitor in chunks: no Python runs between two samples of a chunk.


CHUNK_S = 1.0
PACED_CHUNK_S = 0.02
"""Wall time of a chunk of a paced replay, short enough for viewers."""


class Samples(Protocol):
    """Samples to replay: a Recording, or an object with its fields that may contain NaN or times that go backwards."""

    @property
    def t_ns(self) -> np.ndarray: ...  # (samples,) int64, [ns]
    @property
    def q(self) -> np.ndarray: ...  # (samples, joints) float64, [rad]
    @property
    def dq(self) -> np.ndarray: ...  # [rad/s]
    @property
    def tau(self) -> np.ndarray: ...  # [N m]


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
        self._scheduled: list[tuple[str, _core.DeclaredContact, int, float]] = []

    def schedule(self, first_ns: int) -> None:
        """Declare the contacts of the phases at their times in a recording whose first stamp this is."""
        self._scheduled = self.phases.scheduled(first_ns)

    def declare_due(self, t_ns: int) -> int | None:
        """Declare the scheduled contacts that begin by this stamp; returns the next one's begin, [ns]; None: none.

        Raises:
            CoreError: the monitor refuses a contact.
        """
        while self._scheduled and t_ns >= self._scheduled[0][2]:
            assert isinstance(self.monitor, _core.Monitor)  # a NoMonitor takes no contacts
            name, contact, _, seconds = self._scheduled.pop(0)
            self.phases.declare(self.monitor, name, contact, seconds)
        return self._scheduled[0][2] if self._scheduled else None

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
        changes, self._noted = self._noted, []
        if row == 0:  # what was set before the first sample applies from there on
            changes = [replace(one, t_ns=int(t_ns[0])) for one in changes]
        changes += self._finder.find(row, t_ns, estimates)
        if self._next_places is not None and estimates["alarm"][0] == NONE:
            self._places, self._next_places = self._next_places, None
        if self._places is not None and q is not None and dq is not None:
            changes += self._places.find(row, t_ns, q, dq, estimates)
        return sorted(changes, key=lambda change: change.row)


def replay(
    monitor: _core.Monitor,
    samples: Samples,
    pace: Pace | None = None,
    recorder: _core.FlightRecorder | None = None,
    acknowledge_after_s: float | None = None,
    chunk_s: float = CHUNK_S,
    loads: Sequence[TimedLoad] = (),
    places: PlaceFinder | None = None,
    phases: Phases | None = None,
) -> Iterator[Chunk]:
    """Send every sample in order, as a control loop would; chunks come at the time of their last sample.

    Estimates and events do not depend on chunk_s or pace. A gap is detected by the stamp of the sample that follows it,
    as in a loop that does not report missing samples.

    Args:
        monitor: newly made or reset.
        pace: None for no delay.
        recorder: receives every sample. Take its flight after every chunk, and keep chunk_s below the time kept after
            an event, or flights may be missed.
        acknowledge_after_s: time after which a collision alarm is acknowledged, before the next sample, > 0; None:
            never.
        chunk_s: length of a chunk in the time of the samples, [s]; a chunk has at least one sample.
        loads: loads of the arm with their start times, in the order of these times.
        places: estimates the touched link and place; None: not estimated.
        phases: contacts that are declared, at their times in the recording.

    Raises:
        CoreError: the bundle refuses the load or a contact.
    """
    pace = pace or Pace(None)
    events = EventStream(monitor, places, phases)
    t_ns, temperature = samples.t_ns, getattr(samples, "temperature", None)
    if len(t_ns):
        pace.wait_until(int(t_ns[0]))
    most = max(1, round(chunk_s * 1e9 / monitor.sample_period_ns))
    wait_ns = None if acknowledge_after_s is None else round(acknowledge_after_s * 1e9)
    due_ns, begin = None, 0
    waiting = [(int(t_ns[0]) + round(one.from_s * 1e9), one.load) for one in loads] if len(t_ns) else []
    if len(t_ns):
        events.schedule(int(t_ns[0]))
    while begin < len(t_ns):
        declared_ns = events.declare_due(int(t_ns[begin]))
        if due_ns is not None and t_ns[begin] >= due_ns:
            events.end_alarm(monitor.acknowledge, begin, int(t_ns[begin]))
            due_ns = None
        while waiting and t_ns[begin] >= waiting[0][0]:
            events.carry(waiting.pop(0)[1], begin, int(t_ns[begin]))
        next_ns = (due_ns, declared_ns, *(load[0] for load in waiting[:1]))
        ends = [end for end in next_ns if end is not None]
        rows = slice(begin, begin + chunk_rows(t_ns[begin : begin + most], wait_ns, min(ends, default=None)))
        pace.wait_until(int(t_ns[rows.stop - 1]))
        started = time.perf_counter()
        warm = None if temperature is None else temperature[rows]
        estimates = monitor.run(t_ns[rows], samples.q[rows], samples.dq[rows], samples.tau[rows], recorder, warm)
        core_s = time.perf_counter() - started
        changes = events.find(begin, t_ns[rows], estimates, samples.q[rows], samples.dq[rows])
        yield Chunk(begin, t_ns[rows], samples.dq[rows], estimates, changes, core_s)
        if wait_ns is not None:
            due_ns = monitor.last.alarm_t_ns + wait_ns if estimates["alarm"][-1] == COLLISION else None
        begin = rows.stop


def chunk_rows(t_ns: np.ndarray, wait_ns: int | None, due_ns: int | None) -> int:
    """Number of these samples for one call, at least 1.

    The call ends before the sample of a due acknowledgement, and no alarm raised in it may be due within it.
    """
    rows = len(t_ns)
    if wait_ns is not None:
        since_first = np.maximum.accumulate(t_ns) - np.minimum.accumulate(t_ns)
        rows = min([rows, *np.flatnonzero(since_first >= wait_ns)[:1].tolist()])
    if due_ns is not None:
        rows = min([rows, *np.flatnonzero(t_ns >= due_ns)[:1].tolist()])
    return max(rows, 1)


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
