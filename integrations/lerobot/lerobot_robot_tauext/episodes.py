"""Detects the end of recorded episodes from LeRobot's dataset, since LeRobot does not report it to robots."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable
from typing import Any
from weakref import WeakSet

ENDS = ("save_episode", "clear_episode_buffer")
_called: WeakSet[Any] = WeakSet()
logger = logging.getLogger(__name__)


def call_at_episodes(robot: Any) -> None:
    """Call `robot.start_episode()` whenever a dataset of this process ends an episode.

    LeRobot's record loop saves or drops an episode right before the first frame of the next one. Without the dataset
    library there are no datasets, and nothing is called.
    """
    try:
        from lerobot.datasets.lerobot_dataset import LeRobotDataset
    except ImportError:
        return
    for name in ENDS:
        method = getattr(LeRobotDataset, name, None)
        if method is None:
            logger.warning(
                "LeRobotDataset has no %s: call start_episode() of the robot at the first frame of each episode", name
            )
        elif not hasattr(method, "calls_robots"):
            setattr(LeRobotDataset, name, _calling(method))
    _called.add(robot)


def stop_calling(robot: Any) -> None:
    """Stop calling the robot."""
    _called.discard(robot)


def _calling(method: Callable) -> Callable:
    @functools.wraps(method)
    def calling(*args: Any, **kwargs: Any) -> Any:
        result = method(*args, **kwargs)
        for robot in list(_called):
            robot.start_episode()
        return result

    calling.calls_robots = True  # type: ignore[attr-defined]
    return calling
