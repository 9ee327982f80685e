"""The monitor on ROS 2 over CycloneDDS, without ROS: reads joint states, publishes torques, alarms and diagnostics.

The extra `tauext[ros2]` installs the library; the settings do not need it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from tauext.sources.ros2_settings import Ros2Settings

if TYPE_CHECKING:
    from tauext import _core
    from tauext.sources.ros2_publisher import Ros2Publisher
    from tauext.sources.ros2_source import Ros2Source


def connect(settings: Ros2Settings, bundle: _core.Bundle | None = None) -> tuple[Ros2Source, Ros2Publisher]:
    """Connect a source and a publisher that share one node. The bundle estimates forces at settings.wrench_frames.

    Raises:
        ConfigError: CycloneDDS is not installed, the domain cannot be joined, or the bundle has no such frame.
    """
    from tauext.sources.ros2_node import Conditions, Node
    from tauext.sources.ros2_publisher import Ros2Publisher, Wrenches
    from tauext.sources.ros2_source import Ros2Source

    wrenches = Wrenches(settings.wrench_frames, bundle)
    node, conditions = Node(settings), Conditions()
    source = Ros2Source(node, conditions)
    return source, Ros2Publisher(node, conditions, source, wrenches)
