"""Processes beside the loop: each ends with this one, and is started again when it ends by itself."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from contextlib import suppress
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any

from tauext.monitor.stop_signals import without_interrupts

LONGEST_WAIT_S = 60.0
"""Longest wait before an ended process is started again."""
SOUND_S = 60.0
"""After so long without an end the next wait is short again."""


def start_worker(target: Any, *arguments: Any) -> tuple[BaseProcess, Connection]:
    """A process of its own interpreter that ends with this one, and this end of its pipe."""
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    process = context.Process(target=target, args=(there, *arguments), daemon=True)
    with without_interrupts():
        process.start()
    there.close()
    return process, here


def end_with_parent(parent: int) -> None:
    """End this process at once when its parent is killed, whatever it is doing; Linux only, others close the pipe."""
    with suppress(ImportError, OSError, AttributeError):
        import ctypes

        ctypes.CDLL(None, use_errno=True).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
    if os.getppid() != parent:  # killed before the request
        os._exit(1)


def run_child(pipe: Connection, parent: int, is_low: bool, target: Any, arguments: tuple[Any, ...]) -> None:
    """The first function of a child.

    Args:
        is_low: use only processor time that nothing else wants.
    """
    end_with_parent(parent)
    if is_low:
        with suppress(OSError, AttributeError):
            os.nice(19)
            os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    target(pipe, *arguments)


class Child:
    """A worker that is started again, after 2, 4 ... 60 s, when it ends by itself."""

    def __init__(self, name: str, target: Any, arguments: tuple[Any, ...], is_low: bool = False):
        self.name = name
        self._arguments = (os.getpid(), is_low, target, arguments)
        self._process: BaseProcess | None = None
        self._pipe: Connection | None = None
        self._wait_s, self._due_s, self._began_s = 1.0, 0.0, 0.0
        self._terminated = False

    @property
    def pid(self) -> int | None:
        """Number of the running process."""
        return self._process.pid if self._process is not None and self._process.is_alive() else None

    def tend(self) -> str:
        """Start the process if it does not run and is due; what happened in words, or nothing.

        Call it in a thread that lives as long as the child: Linux ends a child with the thread that started it.
        """
        now_s = time.monotonic()
        if self._process is not None and not self._process.is_alive():
            code = self._process.exitcode
            self.end()
            self._wait_s = 1.0 if now_s - self._began_s > SOUND_S else min(2 * self._wait_s, LONGEST_WAIT_S)
            self._due_s = now_s + self._wait_s
            if code == -signal.SIGTERM:  # most often sent to the whole group, which ends before the line would be true
                self._terminated = True
                return ""
            return f"the {self.name} ended (status {code}); it starts again in {self._wait_s:g} s"
        if self._process is None and now_s >= self._due_s:
            try:
                self._process, self._pipe = start_worker(run_child, *self._arguments)
                self._began_s = now_s
                if self._terminated:
                    self._terminated = False
                    return f"the {self.name} was ended by SIGTERM and is started again"
            except OSError as error:
                self._due_s = now_s + self._wait_s
                return f"the {self.name} cannot be started: {error.strerror or error}"
        return ""

    def end(self) -> None:
        """End the process; it leaves only whole files."""
        if self._pipe is not None:
            self._pipe.close()
        if self._process is not None:
            self._process.terminate()
            self._process.join(2.0)
            if self._process.is_alive():
                self._process.kill()
                self._process.join(2.0)
        self._process = self._pipe = None
