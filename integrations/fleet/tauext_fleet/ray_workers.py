"""Workers on Ray, which does the queueing, scheduling and retries."""

from __future__ import annotations

import logging
import os
from dataclasses import asdict
from typing import Any, Self

from tauext.errors import ConfigError
from tauext_fleet.stages import STAGES
from tauext_fleet.task import Outcome, Task, expect_json, one_line, run_task
from tauext_fleet.workers import Begun, Ended, cores


def remote_task(task: dict[str, Any]) -> dict[str, Any]:
    """Entry point of a Ray worker: task and outcome are plain JSON."""
    return asdict(run_task(expect_json(task), STAGES))


class RayWorkers:
    """A context: the tasks of a job of Ray's, which ends with it."""

    def __init__(self, address: str, workers: int, retries: int, task_gb: float, begun: Begun):
        """address: of a cluster, auto, or local to start one here with so many workers (0: one a core).

        Raises:
            ConfigError: Ray is not installed, or there is no cluster.
        """
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # no usage reports to another host
        try:
            import ray
        except ImportError as error:
            raise ConfigError(f"--ray needs Ray: pip install 'tauext-fleet[ray]' ({error})") from error
        self._ray: Any = ray
        quiet: dict[str, Any] = {"include_dashboard": False} if address == "local" else {}
        if address == "local":
            quiet["num_cpus"] = workers or cores()
        try:
            ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR, **quiet)
        except (OSError, RuntimeError, ValueError, ray.exceptions.RayError) as error:
            why = f"--ray {address}: no cluster there lets us in; one with tokens wants Ray's own settings for them"
            raise ConfigError(one_line(f"{why} ({error})")) from error
        claim: dict[str, Any] = {"memory": round(task_gb * 1e9)} if task_gb else {}
        self._remote = ray.remote(num_cpus=1, max_retries=retries, **claim)(remote_task)
        self._tasks: dict[Any, Task] = {}
        self._begun = begun

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._ray.shutdown()

    def submit(self, task: Task) -> None:
        self._tasks[self._remote.remote(task.to_json())] = task
        self._begun(task)

    def wait(self) -> Ended:
        (ready, *_), _ = self._ray.wait(list(self._tasks), num_returns=1)
        task = self._tasks.pop(ready)
        try:
            return Ended(task, Outcome(**self._ray.get(ready)))
        except self._ray.exceptions.RayError as error:
            words = str(error).strip().splitlines()
            return Ended(task, Outcome("failed", one_line(f"Ray gave it up: {type(error).__name__}: {words[0]}")))
