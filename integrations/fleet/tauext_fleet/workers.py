"""Workers of a fleet: their interface, and processes of this machine."""

from __future__ import annotations

import json
import os
import selectors
import subprocess
import sys
import tempfile
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import IO, Protocol, Self

from tauext_fleet.task import LONGEST_REASON, Outcome, Task

# --- The interface of workers: processes of this machine, or Ray.


Begun = Callable[[Task], None]
"""Called when a worker begins a task, where that is known."""


@dataclass(frozen=True)
class Ended:
    """A task that ended, done or not."""

    task: Task
    outcome: Outcome
    begun: int = 1
    """How often it was begun, where that is known."""


class Workers(Protocol):
    """A context manager: no worker runs after its exit."""

    def __enter__(self) -> Workers: ...

    def __exit__(self, *error: object) -> None: ...

    def submit(self, task: Task) -> None:
        """Queue a task; free workers take tasks in the order of these calls where they can choose."""

    def wait(self) -> Ended:
        """Wait for the next task to end, in any order; at least one must be running."""


# --- Workers that are processes of this machine: a task whose worker dies is restarted.


ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")
"""Environment variables of libraries that would use all cores."""


def cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@dataclass(eq=False)
class Process:
    """One worker."""

    process: subprocess.Popen[str]
    errors: IO[str]
    """File of its stderr."""
    task: Task | None = None

    @classmethod
    def start(cls) -> Process:
        environment = os.environ | dict.fromkeys(ONE_THREAD, "1")
        errors = tempfile.TemporaryFile("w+")
        process = subprocess.Popen(
            [sys.executable, "-m", "tauext_fleet.worker"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
            env=environment,
            start_new_session=True,  # a Ctrl-C on the terminal is the driver's alone
        )
        return cls(process, errors)

    @property
    def answers(self) -> IO[str]:
        assert self.process.stdout is not None
        return self.process.stdout

    def give(self, task: Task) -> None:
        assert self.process.stdin is not None
        self.task = task
        try:
            self.process.stdin.write(json.dumps(task.to_json()) + "\n")
            self.process.stdin.flush()
        except BrokenPipeError:
            pass  # it is dead; its end of file is detected later

    def end(self) -> str:
        """Kill it, if it lives; how it ended, for a person."""
        self.process.kill()
        status = self.process.wait()
        for pipe in (self.process.stdin, self.process.stdout):
            try:
                if pipe is not None:
                    pipe.close()
            except OSError:
                pass
        self.errors.seek(0)
        last = ([line.strip() for line in self.errors if line.strip()] or [""])[-1][:LONGEST_REASON]
        self.errors.close()
        how = f"signal {-status} (killed, or out of memory)" if status < 0 else f"status {status}"
        return f"{how}: {last}" if last else how


@dataclass
class LocalWorkers:
    """A context manager of so many processes, each started when there is work for it."""

    workers: int
    retries: int
    begun: Begun
    _waiting: deque[Task] = field(default_factory=deque)
    _processes: list[Process] = field(default_factory=list)
    _deaths: dict[str, int] = field(default_factory=dict)
    """Of workers, by the folder of the task they were at."""
    _selector: selectors.BaseSelector = field(default_factory=selectors.DefaultSelector)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        for one in self._processes:
            one.end()
        self._processes.clear()
        self._selector.close()

    def submit(self, task: Task) -> None:
        self._waiting.append(task)
        self._give()

    def wait(self) -> Ended:
        while True:
            for key, _ in self._selector.select():
                one: Process = key.data
                task, line = one.task, one.answers.readline()
                one.task = None
                if line.endswith("\n"):
                    self._give()
                    assert task is not None
                    return Ended(task, Outcome(**json.loads(line)), self._deaths.get(task.folder, 0) + 1)
                how = self._bury(one)
                ended = None if task is None else self._again(task, how)
                self._give()
                if ended is not None:
                    return ended

    def _bury(self, one: Process) -> str:
        self._selector.unregister(one.answers)
        self._processes.remove(one)
        return one.end()

    def _again(self, task: Task, how: str) -> Ended | None:
        """A task whose worker died comes first, unless too many died of it."""
        deaths = self._deaths[task.folder] = self._deaths.get(task.folder, 0) + 1
        if deaths <= self.retries:
            self._waiting.appendleft(task)
            return None
        times = "once" if deaths == 1 else f"{deaths} times"
        return Ended(task, Outcome("failed", f"its worker died {times}, by {how}"), deaths)

    def _give(self) -> None:
        """Give tasks to free workers; start a new process if there are too few."""
        while self._waiting:
            free = next((one for one in self._processes if one.task is None), None)
            if free is None:
                if len(self._processes) >= self.workers:
                    return
                free = Process.start()
                self._processes.append(free)
                self._selector.register(free.answers, selectors.EVENT_READ, free)
            task = self._waiting.popleft()
            free.give(task)
            self.begun(task)
