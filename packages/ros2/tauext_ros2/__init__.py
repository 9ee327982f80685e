"""The monitor on ROS 2 over CycloneDDS, without ROS: reads joint states, publishes torques, alarms and diagnostics.

KIND is loaded with every command that has options of sources, so CycloneDDS is imported only to connect.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from tauext.sources.open import Option, SourceKind
from tauext_ros2.settings import Ros2Settings

if TYPE_CHECKING:
    from tauext import _core
    from tauext.monitor.sink import Sink
    from tauext.monitor.source import Source
    from tauext_ros2.publisher import Ros2Publisher
    from tauext_ros2.source import Ros2Source


def connect(
    settings: Ros2Settings, bundle: _core.Bundle | None = None, quiet: bool = False
) -> tuple[Ros2Source, Ros2Publisher]:
    """Connect a source and a publisher that share one node. The bundle estimates forces at settings.wrench_frames.

    Args:
        quiet: remove the library's lines about undecodable messages from stderr while the source is open.

    Raises:
        ConfigError: CycloneDDS is not installed, the domain cannot be joined, or the bundle has no such frame.
    """
    from tauext_ros2.node import Conditions, Node
    from tauext_ros2.publisher import Ros2Publisher, Wrenches
    from tauext_ros2.source import Ros2Source

    wrenches = Wrenches(settings.wrench_frames, bundle)
    node, conditions = Node(settings), Conditions()
    source = Ros2Source(node, conditions, quiet)
    return source, Ros2Publisher(node, conditions, source, wrenches)


def open_ros2(target: str, bundle: _core.Bundle | None, ros2: Ros2Settings | None = None) -> tuple[Source, tuple[Sink]]:
    """See SourceKind.open."""
    source, publisher = connect(ros2 or Ros2Settings(), bundle, quiet=True)
    return source, (publisher,)


KIND = SourceKind(
    open_ros2,
    options=(
        Option(
            "ros2",
            Ros2Settings,
            "topics and quality of service of --source ros2; docs/quickstarts/ros2.md.",
            Ros2Settings(),
        ),
    ),
)
