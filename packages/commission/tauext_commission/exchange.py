"""Another bundle takes over in a running loop, without a sample that is not monitored.

A new monitor has no drift, no friction state and no load, so it must not begin at once. BundleExchange therefore keeps
the last minute of samples in RecentSamples. In a thread of its own, a WarmUp of the new bundle's monitor repeats that
minute and then follows the newest samples. Once the monitor is healthy and has raised no alarm of its own for a while,
it replaces the loop's monitor between two samples.
"""

from __future__ import annotations

import queue
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np

from tauext import _core
from tauext.bundle.estimates import OK
from tauext.data.servo import servo_facts
from tauext.errors import ConfigError, TauextError
from tauext.monitor.loop import Loop
from tauext.monitor.no_monitor import AnyMonitor
from tauext.monitor.source import Block, SourceSettings, settings_of
from tauext.monitor.touch_place import PlaceFinder

# --- The newest samples.

RECENT_S = 60.0
"""Time that is replayed to a new bundle's monitor, so that its drift trackers have strokes of every joint, [s]."""
MARK_S = 1.0
"""Time between two states from which a replay may start, [s]."""

SILENT_ROWS = 20
"""Most missing samples in succession that are kept: enough for a monitor to report a fault."""


@dataclass(frozen=True)
class Piece:
    """Consecutive samples, and missing ones, of a RecentSamples."""

    t_ns: np.ndarray
    q: np.ndarray
    dq: np.ndarray
    tau: np.ndarray
    temperature: np.ndarray | None
    came: np.ndarray
    """False: the sample was missing."""
    held: np.ndarray
    """Level exceeded at this sample in the loop's monitor."""


class RecentSamples:
    """The last minute of samples, with what was done to the monitor between them. One thread writes, others copy."""

    def __init__(self, joints: int, period_ns: int):
        self._slack = max(10, round(1e9 / period_ns))
        self.rows = max(1, round(RECENT_S * 1e9 / period_ns)) + self._slack
        self.count = 0
        """Number of samples so far; the next one has this row."""
        self._t_ns, self._came = np.zeros(self.rows, dtype=np.int64), np.zeros(self.rows, dtype=bool)
        self._held = np.zeros(self.rows, dtype=np.uint8)
        self._q, self._dq, self._tau, self._temperature = (np.full((self.rows, joints), np.nan) for _ in range(4))
        self._warm, self._silent = False, 0
        self._marks: deque[tuple[int, bytes, int]] = deque(maxlen=round(RECENT_S / MARK_S) + 1)
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
    """Set the load that the loop's monitor carries, or found, from this time on; see RecentSamples.act()."""
    monitor.set_load(load.mass, load.com, load.inertia, since_ns=since_ns, error_share=load.error_share)


def holds_back(load_phase: np.ndarray) -> np.ndarray:
    """Whether an alarm may be held back for an expected load. Afterwards the load is only weighed more accurately."""
    return (load_phase != _core.LoadPhase.none.value) & (load_phase != _core.LoadPhase.weighing.value)


class WarmUp:
    """A new bundle's monitor that repeats the samples of a ring and then follows them."""

    def __init__(self, bundle: _core.Bundle, recent: RecentSamples, own_rate: bool, wrench: str | None, quiet_s: float):
        """Raises ConfigError if the bundle lacks the frame, or CoreError if it refuses the load."""
        self.bundle, self._recent, self._own_rate = bundle, recent, own_rate
        self._quiet_s = quiet_s
        self._made_s, self._made_at = time.monotonic(), recent.count
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
        self.first_row, self.carried = self.row, carried = self._recent.start(self.model)
        """Row of the first repeated sample, and what was carried there."""
        if carried:
            self.monitor.carry(carried)
        self.quiet_s = 0.0
        self._held = False

    def follow(self, most: int) -> int:
        """Repeat up to `most` further samples; returns the number of those that are left."""
        end = min(self._recent.count, self.row + most)
        piece = self._recent.since(self.row, end - self.row)
        if piece is None:  # too slow, or stopped meanwhile
            self._begin()
            return self._recent.count - self.row
        acts = self._recent.acts(self.row, end)
        cuts = {0, len(piece.came), *(row - self.row for row, _ in acts)}
        cuts |= set((np.flatnonzero(np.diff(piece.came)) + 1).tolist())
        for begin, stop in pairwise(sorted(cuts)):
            for row, act in acts:
                if row == self.row + begin:
                    act(self.monitor)
            self._repeat(piece, slice(begin, stop))
        self.row = end
        return self._recent.count - end

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
        return elapsed_s > MEASURED_S and (self._recent.count - self._made_at) * self._period_s > FASTER * elapsed_s

    def why_not_yet(self) -> str:
        """Reason why it cannot take over now; empty: it can."""
        if self.monitor.last.health != _core.Health.ok:
            return "its health is not ok"
        if self.quiet_s < self._quiet_s:
            return f"{self.alarms} alarms that the active bundle did not raise" if self.alarms else "it is not warm yet"
        return ""

    def finish(self, old: AnyMonitor) -> str:
        """In the loop's thread: repeat the last samples and continue what the old monitor holds, or why not yet."""
        left = self._recent.count - self.row
        if left > CATCH_UP_ROWS and not self.has_time:
            return "the replay is late"
        self.follow(left)
        if old.weighing or holds_back(np.array(old.last.load_phase.value)):
            return "a payload is expected or being identified"
        if reason := self.why_not_yet():
            return reason
        for _, act in self._recent.acts(self.row, self.row + 1):  # since the last sample
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


class BundleExchange:
    """Brings other bundles into a running loop; made before the loop runs."""

    def __init__(self, loop: Loop, arm: SourceSettings, exchanged: Callable[[Exchanged], None]):
        """
        Args:
            arm: what the source delivers, whatever the bundle.
            exchanged: called in the loop's thread with every exchange.

        Raises:
            ConfigError: the loop's bundle is for another arm.
        """
        if loop.bundle is not None and (reason := why_not_exchange(loop.bundle, arm)):
            raise ConfigError(reason)
        self._loop, self._arm, self._exchanged = loop, arm, exchanged
        self.recent = RecentSamples(len(arm.joints), arm.period_ns)
        self._requests: queue.SimpleQueue[tuple[Path, Callable[[str], None]] | None] = queue.SimpleQueue()
        self._load_kg = 0.0
        self._mark_ns: int | None = None
        self._is_running = True
        loop.supply = self

    @property
    def carried(self) -> bytes:
        """What the monitor carried at the newest second, for Loop.start_from(); empty: nothing yet."""
        return self.recent.carried

    def bring(self, path: Path, done: Callable[[str], None]) -> None:
        """Bring the bundle of this file into the loop, between two samples, once it has caught up and is quiet.

        A newer request replaces one that still waits.

        Args:
            done: called in another thread with "" after the exchange, or with the reason why there is none.
        """
        self._requests.put((path, done))

    # Called by the loop, in its thread.

    def start(self) -> None:
        self._load_kg = self._loop.monitor.load.mass
        threading.Thread(target=self._work, name="exchange", daemon=True).start()

    def end(self) -> None:
        self._is_running = False
        self._requests.put(None)

    def judged(self, block: Block, estimates: dict[str, np.ndarray]) -> None:
        """Keep these samples, what they did to the load, and once a second what the monitor carries."""
        monitor, kg, t_ns = self._loop.monitor, estimates["load_kg"], int(block.t_ns[-1])
        if kg[-1] != self._load_kg or (kg != kg[0]).any():
            k = int(np.flatnonzero(np.append(self._load_kg, kg[:-1]) != kg)[-1])
            self._load_kg, since_ns = float(kg[-1]), int(estimates["load_found_ns"][-1])
            self.recent.act(partial(put_load, load=monitor.load, since_ns=since_ns or None), ahead=k)
        self.recent.add(block, np.maximum(estimates["held_alarm"], holds_back(estimates["load_phase"])))
        bundle = self._loop.bundle
        if isinstance(monitor, _core.Monitor) and bundle is not None:
            if self._mark_ns is None or not 0 <= t_ns - self._mark_ns < MARK_S * 1e9:
                self._mark_ns = t_ns
                self.recent.mark(monitor.carried(), bundle.model_digest)

    def missed(self, t_ns: int) -> None:
        self.recent.miss(t_ns)

    def load_set(self, load: _core.Load, since_ns: int | None) -> None:
        self._load_kg = load.mass
        self.recent.act(partial(put_load, load=load, since_ns=since_ns))

    def resumed(self) -> None:
        self.recent.act(lambda monitor: monitor.resume())

    def _take_over(self, warm: WarmUp) -> str:
        """Between two samples: replace the monitor; returns why not yet."""
        started, loop = time.monotonic_ns(), self._loop
        try:
            if reason := warm.finish(loop.monitor):
                return reason
        except Exception as error:  # the loop continues with its own monitor
            return f"{type(error).__name__}: {error}"
        warm.replaced, old = (loop.monitor, loop.bundle), loop.bundle
        loop.take_over(warm.bundle, warm.monitor, warm.places)
        self._load_kg, self._mark_ns = warm.monitor.load.mass, None
        took_us = (time.monotonic_ns() - started) * 1e-3
        facts = (loop.samples, loop.last_t_ns, warm.row - warm.first_row, warm.carried, warm.left, warm.alarms, took_us)
        self._exchanged(Exchanged(warm.bundle.name, "" if old is None else old.name, *facts))
        return ""

    # A thread of its own, which no real-time priority reaches.

    def _work(self) -> None:
        while (request := self._requests.get()) is not None:
            path, done = request
            try:  # whatever is wrong, the next bundle must find this thread
                answer = self._brought(path)
            except Exception as error:
                answer = f"{path.name!r}: {type(error).__name__}: {error}"
            try:
                done(answer)
            except Exception as error:
                text = f"{path.name!r}: {type(error).__name__}: {error}"
                self._loop.request(partial(self._loop.note, text))

    def _brought(self, path: Path) -> str:
        """Bring the bundle of this file into the loop; returns "" once it is there, or the reason why it is not."""
        loop, given = self._loop, self._loop.settings
        quiet_s = FIRST_QUIET_S if loop.bundle is None else QUIET_S
        try:
            bundle = _core.Bundle.load(str(path))
            if reason := why_not_exchange(bundle, self._arm):
                return reason
            warm = WarmUp(bundle, self.recent, given.own_rate, given.wrench, quiet_s)
            if reason := loop.why_refused(warm.monitor, warm.places):
                return reason
            while self._is_running and self._requests.empty():
                started, has_time = time.monotonic(), warm.has_time
                left = warm.follow(self.recent.rows if has_time else PIECE_ROWS)
                if left > CAUGHT_UP_ROWS and not has_time:  # leave core and interpreter to the loop for as long
                    time.sleep(min(time.monotonic() - started, WAIT_S))
                    continue
                if not (reason := warm.why_not_yet() or self._ask_to_take_over(warm)):
                    return ""
                if warm.followed_s > GIVE_UP_S:
                    return f"bundle {bundle.name} stays out: {reason} in {GIVE_UP_S:g} s"
                time.sleep(WAIT_S)
        except TauextError as error:
            return str(error)
        return STOPPED

    def _ask_to_take_over(self, warm: WarmUp) -> str:
        """Have the loop's thread replace the monitor, and wait for its answer."""
        answers: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._loop.request(lambda: answers.put(self._take_over(warm)))
        while self._is_running or not answers.empty():
            with suppress(queue.Empty):
                return answers.get(timeout=WAIT_S)
        return "the loop has ended"


STOPPED = "a newer bundle, or the end of the loop, came first"
