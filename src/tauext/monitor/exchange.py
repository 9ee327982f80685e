"""Another bundle takes over in a running loop, without a sample that is not monitored.

A new monitor knows no drift, no friction state and no load, so it may not begin at once. The loop therefore keeps its
last minute of samples in a Ring. In a thread of its own, a Successor with the new bundle's monitor repeats that minute
and then follows the newest samples. Once it is healthy and raised no alarm of its own for a while, the loop exchanges
the monitors between two samples: exchange() is that course. NoMonitor stands in before there is any bundle.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from tauext import _core
from tauext.bundle.estimates import OK
from tauext.data.servo import servo_facts
from tauext.errors import TauextError
from tauext.monitor.source import Block, SourceSettings, settings_of
from tauext.monitor.touch_place import PlaceFinder

# --- Before any bundle.

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

# --- The newest samples.

RING_S = 60.0
"""Time that is replayed to a new bundle's monitor, so that its drift trackers have strokes of every joint, [s]."""
MARK_S = 1.0
"""Time between two states from which a replay may start, [s]."""

SILENT_ROWS = 20
"""Most missing samples in succession that are kept: enough for a monitor to report a fault."""


@dataclass(frozen=True)
class Piece:
    """Consecutive samples, and missing ones, of a Ring."""

    t_ns: np.ndarray
    q: np.ndarray
    dq: np.ndarray
    tau: np.ndarray
    temperature: np.ndarray | None
    came: np.ndarray
    """False: the sample was missing."""
    held: np.ndarray
    """Level exceeded at this sample in the loop's monitor."""


class Ring:
    """The last minute of samples, with what was done to the monitor between them. One thread writes, others copy."""

    def __init__(self, joints: int, period_ns: int):
        self._slack = max(10, round(1e9 / period_ns))
        self.rows = max(1, round(RING_S * 1e9 / period_ns)) + self._slack
        self.count = 0
        """Number of samples so far; the next one has this row."""
        self._t_ns, self._came = np.zeros(self.rows, dtype=np.int64), np.zeros(self.rows, dtype=bool)
        self._held = np.zeros(self.rows, dtype=np.uint8)
        self._q, self._dq, self._tau, self._temperature = (np.full((self.rows, joints), np.nan) for _ in range(4))
        self._warm, self._silent = False, 0
        self._marks: deque[tuple[int, bytes, int]] = deque(maxlen=round(RING_S / MARK_S) + 1)
        self._acts: deque[tuple[int, Callable[[_core.Monitor], None]]] = deque(maxlen=1000)

    def add(self, block: Block, held: np.ndarray) -> None:
        """held: levels exceeded at these samples."""
        k, count = self.count % self.rows, len(block)
        at = slice(k, k + count) if k + count <= self.rows else np.arange(k, k + count) % self.rows
        self._t_ns[at], self._came[at], self._held[at] = block.t_ns, True, held
        self._q[at], self._dq[at], self._tau[at] = block.q, block.dq, block.tau
        if block.temperature is not None:
            self._temperature[at], self._warm = block.temperature, True
        elif self._warm:
            self._temperature[at] = np.nan
        self._silent = 0
        self.count += count

    def miss(self, t_ns: int) -> None:
        """A sample did not come. A long silence does not fill the ring."""
        if self._silent >= SILENT_ROWS:
            return
        k = self.count % self.rows
        self._t_ns[k], self._came[k], self._held[k] = t_ns, False, 0
        self._silent += 1
        self.count += 1

    def mark(self, carried: bytes, model: int) -> None:
        """What the monitor of a bundle with this model_digest carries before the next sample."""
        self._marks.append((self.count, carried, model))

    def act(self, done: Callable[[_core.Monitor], None], ahead: int = 0) -> None:
        """What was done to the monitor before the next sample, or before one `ahead` of it, to be repeated there."""
        self._acts.append((self.count + ahead, done))

    @property
    def carried(self) -> bytes:
        """The newest mark; empty: none."""
        marks = tuple(self._marks)
        return marks[-1][1] if marks else b""

    def start(self, model: int) -> tuple[int, bytes]:
        """Row from which a bundle with this model_digest replays, and what is carried there; empty: nothing.

        It is the oldest mark of the same model, so that drift learns each second once; else the oldest of all.
        """
        oldest = max(0, self.count - self.rows + self._slack)
        marks = [mark for mark in tuple(self._marks) if mark[0] >= oldest]
        of_model = [mark for mark in marks if mark[2] == model]
        return (of_model or marks or [(oldest, b"", 0)])[0][:2]

    def acts(self, begin: int, end: int) -> list[tuple[int, Callable[[_core.Monitor], None]]]:
        """What was done before the samples of rows begin to end, with their rows."""
        return [act for act in tuple(self._acts) if begin <= act[0] < end]

    def since(self, row: int, most: int) -> Piece | None:
        """Copy up to `most` samples from this row on; None: they were overwritten."""
        at = np.arange(row, min(self.count, row + most)) % self.rows
        warm = self._temperature[at] if self._warm else None
        signals = self._q[at], self._dq[at], self._tau[at]
        piece = Piece(self._t_ns[at], *signals, warm, self._came[at], self._held[at])
        return piece if self.count - row < self.rows - self._slack // 2 else None  # a block may be half in


# --- A new bundle's monitor on its way into the loop.

QUIET_S, FIRST_QUIET_S = 50.0, 10.0
"""Healthy time without an alarm of its own, after which a new monitor may replace another, and be the first, [s].

On an arm whose friction is a fifth off, ten seconds are too few: the new one's drift has not seen all strokes.
"""
GIVE_UP_S = 600.0
"""Healthy time after which a monitor that is not quiet is given up, [s]."""
PIECE_ROWS = 64
"""Samples in one go: half a millisecond."""
CAUGHT_UP_ROWS, CATCH_UP_ROWS = 8, 32
"""Samples left when the loop is asked to take over, and the most that its thread then repeats itself.

A loop whose samples come faster than in real time has no deadline: its thread repeats all that are left.
"""
FASTER, MEASURED_S = 2.0, 0.1
"""Such a loop receives samples at this multiple of the sample rate, measured over at least MEASURED_S."""
WAIT_S = 0.05


def why_not_exchange(bundle: _core.Bundle, arm: SourceSettings) -> str:
    """Reason why this bundle is not for the arm of a running loop; empty: it is."""
    new = settings_of(bundle)
    servo = [servo_facts(one.servo) if one.servo is not None and one.servo.on else None for one in (new, arm)]
    off = abs(new.period_ns / arm.period_ns - 1) > bundle.rate_tolerance
    named = {
        "joints": (new.joints, arm.joints),
        "sample period in ns": (new.period_ns, arm.period_ns if off else new.period_ns),
        "units of the torque": (new.torque_units, arm.torque_units or new.torque_units),
        "timing of the torque": (new.torque_timing, arm.torque_timing or new.torque_timing),
        "settings of the servos": servo,
    }
    for what, (of_bundle, of_arm) in named.items():
        if of_bundle != of_arm:
            return f"bundle {bundle.name} is for another arm: its {what} {of_bundle} must be {of_arm}"
    return ""


def put_load(monitor: _core.Monitor, load: _core.Load, since_ns: int | None) -> None:
    """Set the load that the loop's monitor carries, or found, from this time on; see Ring.act()."""
    monitor.set_load(load.mass, load.com, load.inertia, since_ns=since_ns, error_share=load.error_share)


def holds_back(load_phase: np.ndarray) -> np.ndarray:
    """Whether an alarm may be held back for an expected load. Afterwards the load is only weighed more accurately."""
    return (load_phase != _core.LoadPhase.none.value) & (load_phase != _core.LoadPhase.weighing.value)


class Successor:
    """A new bundle's monitor that repeats the samples of a ring and then follows them."""

    def __init__(self, bundle: _core.Bundle, ring: Ring, own_rate: bool, wrench: str | None, quiet_s: float):
        """Raises ConfigError if the bundle lacks the frame, or CoreError if it refuses the load."""
        self.bundle, self._ring, self._own_rate = bundle, ring, own_rate
        self._quiet_s = quiet_s
        self._made_s, self._made_at = time.monotonic(), ring.count
        self.model = bundle.model_digest
        self.places = PlaceFinder(bundle, wrench)
        self.alarms = 0
        """Alarms of its own, which the loop's monitor did not raise."""
        self.followed_s = 0.0
        """Healthy time so far, [s]."""
        self.left = b""
        """What the old monitor carried at the exchange."""
        self.replaced: object = None
        """What the loop had before, so that it is freed outside the loop."""
        self._begin()

    def _begin(self) -> None:
        self.monitor = _core.Monitor(self.bundle, self._own_rate)
        self._period_s = self.monitor.sample_period_ns * 1e-9
        self.first_row, self.carried = self.row, carried = self._ring.start(self.model)
        """Row of the first repeated sample, and what was carried there."""
        if carried:
            self.monitor.carry(carried)
        self.quiet_s = 0.0
        self._held = False

    def follow(self, most: int) -> int:
        """Repeat up to `most` further samples; returns the number of those that are left."""
        end = min(self._ring.count, self.row + most)
        piece = self._ring.since(self.row, end - self.row)
        if piece is None:  # too slow, or stopped meanwhile
            self._begin()
            return self._ring.count - self.row
        acts = self._ring.acts(self.row, end)
        cuts = {0, len(piece.came), *(row - self.row for row, _ in acts)}
        cuts |= set((np.flatnonzero(np.diff(piece.came)) + 1).tolist())
        for begin, stop in pairwise(sorted(cuts)):
            for row, act in acts:
                if row == self.row + begin:
                    act(self.monitor)
            self._repeat(piece, slice(begin, stop))
        self.row = end
        return self._ring.count - end

    def _repeat(self, piece: Piece, rows: slice) -> None:
        if not piece.came[rows.start]:
            for t_ns in piece.t_ns[rows].tolist():
                self.monitor.run_missing(t_ns)
            return
        warm = None if piece.temperature is None else piece.temperature[rows]
        signals = piece.t_ns[rows], piece.q[rows], piece.dq[rows], piece.tau[rows]
        estimates = self.monitor.run(*signals, None, warm)
        healthy_s = (estimates["health"] == OK) * self._period_s
        own = (estimates["held_alarm"] > 0) & (piece.held[rows] == 0)
        self.followed_s += float(healthy_s.sum())
        if own.any():
            self.alarms += int(np.count_nonzero(np.diff(own, prepend=self._held) & own))
            self.quiet_s = 0.0
        self._held = bool(own[-1])
        after = int(np.flatnonzero(own)[-1]) + 1 if own.any() else 0
        self.quiet_s += float(healthy_s[after:].sum())

    @property
    def has_time(self) -> bool:
        """Whether the loop's samples come faster than in real time."""
        elapsed_s = time.monotonic() - self._made_s
        return elapsed_s > MEASURED_S and (self._ring.count - self._made_at) * self._period_s > FASTER * elapsed_s

    def why_not_yet(self) -> str:
        """Reason why it cannot take over now; empty: it can."""
        if self.monitor.last.health != _core.Health.ok:
            return "its health is not ok"
        if self.quiet_s < self._quiet_s:
            return f"{self.alarms} alarms that the active bundle did not raise" if self.alarms else "it is not warm yet"
        return ""

    def finish(self, old: AnyMonitor) -> str:
        """In the loop's thread: repeat the last samples and continue what the old monitor holds, or why not yet."""
        left = self._ring.count - self.row
        if left > CATCH_UP_ROWS and not self.has_time:
            return "the replay is late"
        self.follow(left)
        if old.weighing or holds_back(np.array(old.last.load_phase.value)):
            return "a load is expected or being weighed"
        if reason := self.why_not_yet():
            return reason
        for _, act in self._ring.acts(self.row, self.row + 1):  # since the last sample
            act(self.monitor)
        self.monitor.set_limit_factors(*(np.array(factors) for factors in old.limit_factors))
        self.left = old.carried()
        if self.left:
            self.monitor.carry_alarm(self.left)
        else:  # what it raised over the repeated samples is past
            self.monitor.acknowledge()
        self.monitor.alarms = old.alarms
        return ""


@dataclass(frozen=True)
class Exchanged:
    """An exchange of the loop's bundle."""

    bundle: str
    """Name of the new one."""
    replaced: str
    """Name of the old one; empty: none."""
    row: int
    """Number of the loop's samples before it."""
    t_ns: int | None
    """Stamp of the last of them, [ns]."""
    replayed: int
    """Number of samples, and missing ones, that the new monitor repeated."""
    carried: bytes
    """Mark from which it repeated them; empty: from nothing."""
    left: bytes
    """What the old monitor carried in the end, whose alarm goes on; empty: there was none."""
    alarms: int
    """Alarms of its own that it raised meanwhile."""
    took_us: float
    """Time that it took in the loop's thread, [µs]."""


def exchange(
    path: Path,
    ring: Ring,
    arm: SourceSettings,
    why_not: Callable[[Successor], str],
    take_over: Callable[[Successor], str],
    stop: Callable[[], str],
    own_rate: bool,
    wrench: str | None,
    quiet_s: float,
) -> str:
    """Bring the bundle of this file into the loop; returns "" once it is there, or the reason why it is not.

    Args:
        why_not: reason why the loop refuses this bundle; empty: it takes it.
        take_over: has the loop's thread finish the exchange, see Successor.finish().
        quiet_s: healthy time without an alarm of its own before it may take over, [s].
        stop: reason why to give up now, such as the loop's end; empty: none.
    """
    try:
        bundle = _core.Bundle.load(str(path))
        if reason := why_not_exchange(bundle, arm):
            return reason
        successor = Successor(bundle, ring, own_rate, wrench, quiet_s)
        if reason := why_not(successor):
            return reason
        while not (reason := stop()):
            started = time.monotonic()
            has_time = successor.has_time
            left = successor.follow(ring.rows if has_time else PIECE_ROWS)
            if left > CAUGHT_UP_ROWS and not has_time:  # leave the core and the interpreter to the loop for as long
                time.sleep(min(time.monotonic() - started, WAIT_S))
                continue
            if not (reason := successor.why_not_yet() or take_over(successor)):
                return ""
            if successor.followed_s > GIVE_UP_S:
                return f"bundle {bundle.name} stays out: {reason} in {GIVE_UP_S:g} s"
            time.sleep(WAIT_S)
    except TauextError as error:
        return str(error)
    return reason
