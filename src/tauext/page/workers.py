"""The two processes behind the page: one steps the arm in real time, one trains bundles."""

from __future__ import annotations

import gc
import os
import signal
import sys
import time
from collections import deque
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path

from tauext.errors import ConfigError, TauextError
from tauext.page.bundles import Lesson, train_bundles
from tauext.page.simulation import Simulation
from tauext.page.snapshot import Snapshot
from tauext.sim.arms import ARMS

COMMANDS = (
    "watch_with",
    "watch_nothing",
    "set_method",
    "set_reaction",
    "set_sensitivity",
    "set_friction",
    "grab",
    "pull",
    "release",
    "resume",
    "rest",
    "hold",
    "let_go",
    "set_load",
    "move_on",
)
"""Methods of Simulation that a message (name, *arguments) may call."""
SNAPSHOT, RECENT = "snapshot", "recent"
MOST_BEHIND_S = 0.1
"""Further behind the clock the simulation does not catch up: the time is lost, and the real-time factor shows it."""
FACTOR_OVER_S = 2.0
NAP_S = 0.001


class RealTime:
    """How many samples are due by the clock, and how fast simulated time passes."""

    def __init__(self, period_s: float):
        self._period_s = period_s
        self._began_s = time.perf_counter()
        self._done = 0
        self._past: deque[tuple[float, int]] = deque([(self._began_s, 0)])

    def due(self) -> int:
        """Samples to step now; what is too far behind is given up."""
        now_s = time.perf_counter()
        behind = (now_s - self._began_s) / self._period_s - self._done
        if behind * self._period_s > MOST_BEHIND_S:
            self._began_s = now_s - (self._done + 1) * self._period_s
            behind = 1
        self._done += int(behind)
        if now_s - self._past[-1][0] > 0.1:
            self._past.append((now_s, self._done))
            while len(self._past) > 1 and now_s - self._past[1][0] >= FACTOR_OVER_S:
                self._past.popleft()
        return int(behind)

    def factor(self) -> float:
        """Simulated over real time, of the last two seconds; 1 is real time."""
        (began_s, began), now_s = self._past[0], time.perf_counter()
        return (self._done - began) * self._period_s / max(now_s - began_s, 1e-9)


def run_simulation(pipe: Connection, arm_name: str, seed: int) -> None:
    """Step an arm in real time until the pipe closes.

    A message is (name of a command, *arguments); or ("snapshot",), answered by a Snapshot; or ("recent",), answered by
    a Stretch of samples. One Snapshot more is sent when an alarm rises, at once. So nothing waits in the pipe for a
    viewer that is slow, and no viewer holds up a step.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the page ends this process
    arm = ARMS[arm_name]()
    simulation = Simulation(arm, seed)
    clock = RealTime(1.0 / arm.rate_hz)
    gc.freeze()
    wanted = True
    try:
        while True:
            while pipe.poll(0):
                name, *arguments = pipe.recv()
                if name == SNAPSHOT:
                    _send(pipe, simulation, clock)
                    wanted = True
                elif name == RECENT:
                    pipe.send(simulation.recent())
                elif name in COMMANDS:
                    # A page may send anything; invalid numbers and unknown names change nothing.
                    with suppress(TypeError, ValueError, KeyError, IndexError, AttributeError, ConfigError):
                        getattr(simulation, name)(*arguments)
            for _ in range(clock.due()):
                if simulation.step() and wanted:
                    _send(pipe, simulation, clock)
                    wanted = False  # not a second one before the viewer has come back
            pipe.poll(NAP_S)
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return


def _send(pipe: Connection, simulation: Simulation, clock: RealTime) -> None:
    snapshot: Snapshot = simulation.snapshot()
    snapshot.real_time_factor = clock.factor()
    pipe.send(snapshot)


def run_training(pipe: Connection, arm_name: str, error: str, lesson: Lesson, seed: int, cache: Path) -> None:
    """Train and send (share, what is done); at the end {method: path}, or the message of a TauextError as text."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # so that what is half done is removed
    try:
        if hasattr(os, "nice"):
            os.nice(10)  # training leaves the processor to the simulation and the page
        pipe.send(
            train_bundles(ARMS[arm_name](), error, lesson, seed, cache, lambda share, what: pipe.send((share, what)))
        )
    except TauextError as failed:
        pipe.send(str(failed))
    except (BrokenPipeError, ConnectionResetError):
        return
