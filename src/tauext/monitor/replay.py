"""Sends samples through the core's monitor, a chunk at a time: no Python runs between two samples of a chunk."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from tauext import _core
from tauext.bundle.units import not_in_newtons
from tauext.monitor.changes import COLLISION, Change, ChangeFinder, LoadChange
from tauext.monitor.loads import TimedLoad
from tauext.monitor.pace import Pace
from tauext.monitor.places import PlaceFinder

CHUNK_S = 1.0
PACED_CHUNK_S = 0.02
"""Paced by the clock a chunk is this long on the wall: what a viewer takes for at once."""


class Samples(Protocol):
    """What is replayed: a Recording, or anything with its fields that may also hold NaN or times that go backwards."""

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
    """Some consecutive samples and what the monitor said of them."""

    first_row: int
    t_ns: np.ndarray
    """(rows,), [ns]."""
    dq: np.ndarray
    """(rows, joints), [rad/s]."""
    said: dict[str, np.ndarray]
    """As Monitor.run gives it: one row a sample."""
    changes: list[Change]
    core_s: float
    """Time spent in the core, [s]."""

    def peak_row(self, joint: int) -> int:
        """Where |tau_ext| of this joint is largest against its limit; the last row where there is no estimate."""
        share = np.abs(self.said["tau_ext"][:, joint]) / self.said["limit_nm"][:, joint]
        return int(np.nanargmax(share)) if np.isfinite(share).any() else len(share) - 1


def replay(
    monitor: _core.Monitor,
    samples: Samples,
    pace: Pace | None = None,
    recorder: _core.FlightRecorder | None = None,
    acknowledge_after_s: float | None = None,
    chunk_s: float = CHUNK_S,
    loads: Sequence[TimedLoad] = (),
    places: PlaceFinder | None = None,
) -> Iterator[Chunk]:
    """Every sample in order, as a control loop would send it; chunks come when their last sample has its time.

    What is said, and at which sample, does not depend on chunk_s or pace. A gap is judged by the stamp of the sample
    that follows it, as in a loop that was not told that samples were missing.

    Args:
        monitor: newly made or reset.
        pace: None for as fast as it can.
        recorder: gets every sample; a flight must be taken from it after every chunk, and chunk_s not be longer than
            what it keeps after an event, or flights may be missed.
        acknowledge_after_s: a collision alarm is acknowledged before the first sample that is this much later than the
            one that raised it, > 0; None: never.
        chunk_s: length of a chunk in the time of the samples, [s]; a chunk has at least one sample.
        loads: what the arm carries and since when, in the order of their times.
        places: finds which link is touched, and where; None: nobody asks.

    Raises:
        CoreError: the bundle takes no such load.
    """
    pace = pace or Pace(None)
    changes = ChangeFinder()
    t_ns, temperature = samples.t_ns, getattr(samples, "temperature", None)
    if len(t_ns):
        pace.wait_until(int(t_ns[0]))
    most = max(1, round(chunk_s * 1e9 / monitor.sample_period_ns))
    wait_ns = None if acknowledge_after_s is None else round(acknowledge_after_s * 1e9)
    due_ns, begin = None, 0
    left_out = not_in_newtons(monitor.joint_names, monitor.estimate_units)
    waiting = [(int(t_ns[0]) + round(one.from_s * 1e9), one.load) for one in loads] if len(t_ns) else []
    while begin < len(t_ns):
        noted: list[Change] = []
        if due_ns is not None and t_ns[begin] >= due_ns:
            monitor.acknowledge()
            noted.append(changes.acknowledged(begin, t_ns[begin]))
            if places is not None:
                places.acknowledged()
            due_ns = None
        while waiting and t_ns[begin] >= waiting[0][0]:
            load = waiting.pop(0)[1]
            monitor.set_load(load.mass, load.com, load.inertia, error_share=load.error_share)
            noted.append(LoadChange(begin, int(t_ns[begin]), load, left_out=left_out))
        ends = [end for end in (due_ns, *(load[0] for load in waiting[:1])) if end is not None]
        rows = slice(begin, begin + chunk_rows(t_ns[begin : begin + most], wait_ns, min(ends, default=None)))
        pace.wait_until(int(t_ns[rows.stop - 1]))
        started = time.perf_counter()
        warm = None if temperature is None else temperature[rows]
        said = monitor.run(t_ns[rows], samples.q[rows], samples.dq[rows], samples.tau[rows], recorder, warm)
        core_s = time.perf_counter() - started
        noted += changes.find(begin, t_ns[rows], said)
        if places is not None:
            noted += places.find(begin, t_ns[rows], samples.q[rows], samples.dq[rows], said)
        yield Chunk(begin, t_ns[rows], samples.dq[rows], said, noted, core_s)
        if wait_ns is not None:
            due_ns = monitor.last.alarm_t_ns + wait_ns if said["alarm"][-1] == COLLISION else None
        begin = rows.stop


def chunk_rows(t_ns: np.ndarray, wait_ns: int | None, due_ns: int | None) -> int:
    """How many of these samples may go into one call, at least 1.

    It ends before the sample that an acknowledgement is due at, and no alarm that it raises may be due within it.
    """
    rows = len(t_ns)
    if wait_ns is not None:
        since_first = np.maximum.accumulate(t_ns) - np.minimum.accumulate(t_ns)
        rows = min([rows, *np.flatnonzero(since_first >= wait_ns)[:1].tolist()])
    if due_ns is not None:
        rows = min([rows, *np.flatnonzero(t_ns >= due_ns)[:1].tolist()])
    return max(rows, 1)
