"""Where one recorded episode ends and the next begins: LeRobot tells its robots nothing, but its dataset knows."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable
from typing import Any
from weakref import WeakSet

ENDS = ("save_episode", "clear_episode_buffer")
_told: WeakSet[Any] = WeakSet()
logger = logging.getLogger(__name__)


def tell_of_episodes(robot: Any) -> None:
    """From now on `robot.start_episode()` is called whenever a dataset of this process has ended an episode.

    LeRobot's record loop saves (or drops) an episode right before the first frame of the next one. Without the dataset
    library there are no datasets, and nothing is told.
    """
    try:
        from lerobot.datasets.lerobot_dataset import LeRobotDataset
    except ImportError:
        return
    for name in ENDS:
        method = getattr(LeRobotDataset, name, None)
        if method is None:
            logger.warning(
                "LeRobotDataset has no %s: call start_episode() of the robot at the first frame of each", name
            )
        elif not hasattr(method, "tells_of_episodes"):
            setattr(LeRobotDataset, name, _telling(method))
    _told.add(robot)


def tell_no_more(robot: Any) -> None:
    """The robot is gone."""
    _told.discard(robot)


def _telling(method: Callable) -> Callable:
    @functools.wraps(method)
    def telling(*args: Any, **kwargs: Any) -> Any:
        result = method(*args, **kwargs)
        for robot in list(_told):
            robot.start_episode()
        return result

    telling.tells_of_episodes = True  # type: ignore[attr-defined]
    return telling
