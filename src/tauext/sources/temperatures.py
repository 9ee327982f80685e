"""Temperatures of the joints, each a topic of its own: the latest of each holds, as they change slowly."""

from __future__ import annotations

import math

import numpy as np

from tauext.errors import ConfigError
from tauext.sources.messages import Temperature
from tauext.sources.node import Node


class Temperatures:
    """Reads sensor_msgs/Temperature where the settings name topics; never waits."""

    def __init__(self, node: Node, joints: int):
        """Subscribe; a publisher need not be there yet.

        Raises:
            ConfigError: topics are not one a joint.
        """
        settings = node.settings
        topics = settings.temperatures
        if topics and len(topics) != joints:
            raise ConfigError(f"ROS 2 temperatures {', '.join(topics)}: {len(topics)} topics for {joints} joints")
        self._node = node
        self._inboxes = [
            node.inbox(topic, Temperature, settings.reliability, settings.durability, settings.depth)
            for topic in topics
        ]
        self._celsius = np.full(joints, np.nan)

    def latest(self) -> np.ndarray | None:
        """(joints,), [degC], NaN where none came yet; None: there are no topics. What cannot be read is no news."""
        if not self._inboxes:
            return None
        for joint, inbox in enumerate(self._inboxes):
            told = [message.temperature for message in inbox.take()[0] if math.isfinite(message.temperature)]
            if told:
                self._celsius[joint] = told[-1]
        return self._celsius.copy()

    @property
    def readers(self) -> list:
        """To be handed back to the node."""
        return [inbox.reader for inbox in self._inboxes]
