"""Workers of a fleet: Ray runs its tasks on this machine or a cluster, and repeats those whose worker died."""

from __future__ import annotations

import logging
import os
import secrets
import signal
import sys
import tempfile
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import ExitStack, redirect_stdout
from dataclasses import asdict, dataclass
from typing import Any, Self

from tauext.errors import ConfigError
from tauext_fleet.config import FleetConfig
from tauext_fleet.stages import STAGES
from tauext_fleet.task import Outcome, Task, expect_json, one_line, run_task

ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")
"""Environment variables of libraries that would use all cores."""
LOCAL = {
    **dict.fromkeys(ONE_THREAD, "1"),
    "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",  # all sockets at 127.0.0.1, on Linux too
    "RAY_AUTH_MODE": "token",
    "RAY_AUTH_TOKEN": secrets.token_hex(16),  # Ray keeps the first one for the whole process
    "RAY_worker_niceness": "0",  # else a busy machine never gets to them
}
"""Environment of a Ray that no other computer or user can reach, and whose workers have a thread each."""
STORE_BYTES = 100_000_000
"""Memory of a local Ray for objects: a task and its outcome are some letters."""
LONGEST_FOLDER = 24
"""Most bytes of a folder in which Ray's sockets have names that the system accepts, 107 bytes in all."""


@dataclass(frozen=True)
class Ended:
    """A task that ended, done or not."""

    task: Task
    outcome: Outcome


def remote_task(task: dict[str, Any]) -> dict[str, Any]:
    """Entry point of a worker: task and outcome are plain JSON."""
    return asdict(run_task(expect_json(task), STAGES))


def cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def short_folder() -> tempfile.TemporaryDirectory[str]:
    """A new folder for Ray's sockets and logs, below /tmp where the usual place has a long name."""
    usual = tempfile.gettempdir()
    short = usual.isascii() and len(usual) <= LONGEST_FOLDER
    return tempfile.TemporaryDirectory(prefix="tauext-", dir=usual if short else "/tmp", ignore_cleanup_errors=True)


def started(settings: Mapping[str, Any], retries: int, failed: str) -> Any:
    """The module ray, connected to the cluster of these settings.

    Raises:
        ConfigError: there is none, or it cannot start; begins with `failed`.
    """
    # Ray reads its environment when it is imported: no usage reports to another host, and a task that needs more memory
    # than there is fails in the end.
    os.environ |= {"RAY_USAGE_STATS_ENABLED": "0", "RAY_task_oom_retries": str(retries)}
    import ray

    at_end = signal.getsignal(signal.SIGTERM)
    try:
        ray.init(log_to_driver=False, logging_level=logging.ERROR, **settings)
    except (OSError, RuntimeError, ValueError, ray.exceptions.RayError) as error:
        raise ConfigError(one_line(f"{failed} ({error})")) from error
    finally:
        if signal.getsignal(signal.SIGTERM) is not at_end:
            signal.signal(signal.SIGTERM, at_end)  # Ray's own handler ends in an abort of its core
    return ray


class Workers:
    """A context: no worker of a local Ray runs after its exit, and no task of this job on a cluster."""

    def __init__(self, config: FleetConfig, most: int, begun: Callable[[Task], None]):
        """Start Ray on this machine, or connect to a cluster.

        Args:
            most: largest number of simultaneous tasks.
            begun: called when a task is given to a worker of this machine, or to a cluster.

        Raises:
            ConfigError: there is no such cluster, or Ray cannot start here.
        """
        self._begun, self._free = begun, most
        self._waiting: deque[Task] = deque()
        self._tasks: dict[Any, Task] = {}
        settings: dict[str, Any] = {"address": config.ray}
        failed = f"--ray {config.ray}: no cluster there lets us in; one with tokens wants Ray's own settings for them"
        with ExitStack() as at_exit:
            at_exit.enter_context(redirect_stdout(sys.stderr))  # Ray prints of workers that died, in between
            if config.ray is None:
                os.environ |= LOCAL
                self._free = min(config.workers or cores(), most)
                settings = {"address": "local", "num_cpus": self._free, "object_store_memory": STORE_BYTES}
                settings |= {"include_dashboard": False, "_temp_dir": at_exit.enter_context(short_folder())}
                failed = "Ray cannot start on this machine"
            self._ray = started(settings, config.retries, failed)
            at_exit.callback(self._ray.shutdown)
            claim: dict[str, Any] = {"memory": round(config.task_gb * 1e9)} if config.task_gb else {}
            self._remote = self._ray.remote(num_cpus=1, max_retries=config.retries, **claim)(remote_task)
            self._at_exit = at_exit.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._at_exit.close()

    def submit(self, task: Task) -> None:
        """Queue a task; workers take tasks in the order of these calls."""
        self._waiting.append(task)
        self._give()

    def wait(self) -> Ended:
        """Wait for the next task to end, in any order; at least one must be running."""
        (ready, *_), _ = self._ray.wait(list(self._tasks), num_returns=1)
        task = self._tasks.pop(ready)
        self._free += 1
        self._give()
        try:
            return Ended(task, Outcome(**self._ray.get(ready)))
        except self._ray.exceptions.RayError as error:
            words = str(error).strip().splitlines()
            return Ended(task, Outcome("failed", one_line(f"Ray gave it up: {type(error).__name__}: {words[0]}")))

    def _give(self) -> None:
        while self._waiting and self._free:
            task = self._waiting.popleft()
            self._free -= 1
            self._tasks[self._remote.remote(task.to_json())] = task
            self._begun(task)
