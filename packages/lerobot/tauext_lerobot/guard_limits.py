"""Goals of joints that stalled: kept so close to the position that the joint pushes with a usual torque."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

logger = logging.getLogger(__name__)
Action = dict[str, Any]


@dataclass(frozen=True)
class Limit:
    """Bound on a goal: at most `reach` from the position towards `direction`."""

    direction: float
    """Sign of goal minus position at the stall; 0: no goal was sent."""
    reach: float
    """[robot's unit], >= 0."""

    def of(self, goal: float, position: float) -> float:
        """The limited goal; the goal itself where it is within reach or leads away."""
        ahead = goal - position if math.isfinite(goal) else 0.0
        if self.direction * ahead <= self.reach if self.direction else ahead == 0:
            return goal if math.isfinite(goal) else position
        return position + self.direction * self.reach


class Limits:
    """Goals of joints that stalled, until they are commanded to a goal within reach or away from the obstacle.

    Args:
        keys: action of each joint.
        gripper: action of the gripper; empty: none.
        open_at: goal that opens it.
    """

    def __init__(self, keys: Mapping[str, str], gripper: str, open_at: float):
        self._keys, self._gripper, self._open_at = dict(keys), gripper, open_at
        self._limits: dict[str, Limit] = {}
        self._opens_from: float | None = None
        """Position at which the gripper began to open; None: it follows its goals."""

    def begin(
        self, joint: str, share: float, sent: Mapping[str, float], positions: Mapping[str, float], opens: bool
    ) -> None:
        """Limit a joint whose goal minus position is to shrink to this share; open the gripper as well."""
        key = self._keys[joint]
        ahead = sent.get(key, math.nan) - positions.get(key, math.nan)
        ahead = ahead if math.isfinite(ahead) else 0.0
        if not (opens and key == self._gripper):
            self._limits[key] = Limit(math.copysign(1.0, ahead) if ahead else 0.0, abs(ahead) * min(share, 1.0))
        if opens:
            self._opens_from = positions.get(self._gripper)

    def end(self) -> None:
        """All goals pass again."""
        self._limits, self._opens_from = {}, None

    def passed(self, action: Mapping[str, Any], positions: Mapping[str, float]) -> Action:
        """The action to send. A limit ends with the first commanded goal that it does not change."""
        changed = dict(action)
        for key in [key for key in self._limits if key in action and key in positions]:
            changed[key] = self._limits[key].of(float(action[key]), positions[key])
            if changed[key] == action[key]:
                del self._limits[key]
                logger.warning("tauext guard: %s follows its goal again", key.removesuffix(".pos"))
        if self._opens_from is not None and self._gripper in action:
            way = self._open_at - self._opens_from
            if (float(action[self._gripper]) - self._opens_from) * way > 0:
                self._opens_from = None
                logger.warning("tauext guard: %s follows its goal again", self._gripper.removesuffix(".pos"))
            else:
                changed[self._gripper] = self._open_at
        return changed
