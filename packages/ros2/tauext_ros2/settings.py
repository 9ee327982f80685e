"""Settings of the ROS 2 connection, which are also options of the command line."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from typing import Literal

from tauext.errors import ConfigError

DOMAINS = 232
"""Highest domain with valid ports on every system."""
LONG_GID_DISTROS = ("foxy", "galactic", "humble")
"""Distributions whose graph messages have ids of 24 bytes; later ones have 16."""
Reliability = Literal["best-effort", "reliable"]
Durability = Literal["volatile", "transient-local"]
PART = "[A-Za-z_][A-Za-z0-9_]*"
ROOTED = re.compile(f"(/{PART})+"), "begin with / and consist of letters, digits and _ between slashes"
NAME = re.compile(f"/?{PART}(/{PART})*"), "consist of letters, digits and _ between slashes"
NODE = re.compile(PART), "consist of letters, digits and _"
"""Names of topics that begin with /, of topics below the namespace or not, and of nodes, with their rules."""


@dataclass(frozen=True)
class Ros2Settings:
    """Topics, quality of service and domain; the defaults fit joint_state_broadcaster and robot drivers.

    Raises:
        ConfigError: a name is not allowed in ROS 2, or a number is out of range.
    """

    topic: str = "/joint_states"
    """Topic of the arm's sensor_msgs/JointState: position [rad], velocity [rad/s], effort [N m]."""
    names: tuple[str, ...] = ()
    """Names of the arm's joints in the messages, in the order of the bundle's joints; empty: the bundle's names."""
    temperatures: tuple[str, ...] = ()
    """Topics of sensor_msgs/Temperature [degC], one for each joint in the bundle's order; empty: temperatures are
    unknown."""
    reliability: Reliability = "best-effort"
    """Reliability requested from publishers: best-effort receives from both kinds; reliable refuses best-effort
    ones."""
    durability: Durability = "volatile"
    """Durability requested from publishers: transient-local also receives earlier messages, and refuses volatile
    publishers."""
    depth: int = 256
    """Largest number of samples that wait for a late monitor; older ones are lost and counted."""
    namespace: str = "/tauext"
    """Namespace of the monitor's topics: external_torque, contact, collision, event, diagnostics and requests."""
    diagnostics: str = "diagnostics"
    """Topic of diagnostics. A name that begins with / is used as it is: aggregators listen on /diagnostics."""
    wrench_frames: tuple[str, ...] = ()
    """Frames of the bundle at which force and moment are published, one topic wrench/NAME per frame; empty: none."""
    node: str = "tauext"
    """Name of the node, as `ros2 node list` shows it after the namespace."""
    domain: int | None = None
    """ROS domain; None: ROS_DOMAIN_ID, else 0."""
    distro: str | None = None
    """Distribution of the other ROS nodes: foxy, galactic and humble announce nodes in another format than later ones.
    None: ROS_DISTRO, else a later one."""

    def __post_init__(self) -> None:
        for field, name, (pattern, rule) in (
            ("topic", self.topic, ROOTED),
            ("namespace", self.namespace, ROOTED),
            *(("temperatures", name, ROOTED) for name in self.temperatures),
            ("diagnostics", self.diagnostics, NAME),
            ("node", self.node, NODE),
        ):
            if not pattern.fullmatch(name):
                raise ConfigError(f"ROS 2 {field} {name!r} must {rule}, no part beginning with a digit")
        if self.depth < 1:
            raise ConfigError(f"ROS 2 depth = {self.depth} must be >= 1")
        if len(set(self.names)) < len(self.names):
            raise ConfigError(f"ROS 2 names {', '.join(self.names)}: names must be unique")
        if self.domain is not None and not 0 <= self.domain <= DOMAINS:
            raise ConfigError(f"ROS 2 domain = {self.domain} must lie between 0 and {DOMAINS}")

    @property
    def domain_id(self) -> int:
        """Domain of the settings, else of the environment; raises ConfigError if it is invalid."""
        if self.domain is not None:
            return self.domain
        text = os.environ.get("ROS_DOMAIN_ID") or "0"
        if not text.isdecimal() or int(text) > DOMAINS:
            raise ConfigError(f"ROS_DOMAIN_ID = {text!r} must be a whole number between 0 and {DOMAINS}")
        return int(text)

    @property
    def gid_bytes(self) -> int:
        """Length of an id in graph messages."""
        return 24 if (self.distro or os.environ.get("ROS_DISTRO", "")) in LONG_GID_DISTROS else 16

    def full_name(self, name: str) -> str:
        """Full name of a topic: under the namespace, unless it begins with /."""
        return name if name.startswith("/") else f"{self.namespace}/{name}"
