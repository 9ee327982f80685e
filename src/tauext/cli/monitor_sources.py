"""The sources that `tauext monitor --source` knows; a new one is registered here."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tauext.errors import ConfigError
from tauext.files.place import Place, place_of

if TYPE_CHECKING:
    from tauext._core import Bundle
    from tauext.monitor.sink import Sink
    from tauext.monitor.source import Source
    from tauext.sources.settings import Ros2Settings


@dataclass(frozen=True)
class SourceOptions:
    """Options of the command that only some sources take; None: not given."""

    speed: float | None = None
    torque_constants: Place | None = None
    ros2: Ros2Settings | None = None
    bus: Place | None = None


@dataclass(frozen=True)
class Connection:
    """A source, and who publishes on its side."""

    source: Source
    sinks: tuple[Sink, ...] = ()


def replay(target: str, options: SourceOptions, bundle: Bundle | None) -> Connection:
    """replay:FILE, a recording at its own pace or --speed times as fast."""
    from tauext.sources.replay_source import ReplaySource

    speed = options.speed or 1.0
    if speed < 1:  # by the clock, every sample would be missing
        raise ConfigError(f"speed = {speed:g} must be >= 1: a live loop takes samples that are slower for missing ones")
    return Connection(ReplaySource(place_of(target), speed))


def ur(target: str, options: SourceOptions, bundle: Bundle | None) -> Connection:
    """ur:HOST."""
    from tauext.sources.ur_source import UrSource

    return Connection(UrSource(target, options.torque_constants))


def franka(target: str, options: SourceOptions, bundle: Bundle | None) -> Connection:
    """franka:HOST."""
    from tauext.sources.franka_source import FrankaSource

    return Connection(FrankaSource(target))


def ros2(target: str, options: SourceOptions, bundle: Bundle | None) -> Connection:
    """ros2, joint states of a topic; torques, alarms and diagnostics go to others."""
    from tauext.sources.ros2 import connect
    from tauext.sources.settings import Ros2Settings

    source, publisher = connect(options.ros2 or Ros2Settings(), bundle)
    return Connection(source, (publisher,))


def feetech(target: str, options: SourceOptions, bundle: Bundle | None) -> Connection:
    """feetech:PORT."""
    from tauext.sources.feetech_source import FeetechSource
    from tauext.sources.servo_bus_file import load_servo_bus

    return Connection(FeetechSource(target, load_servo_bus(bus_of("feetech:PORT", options))))


def dynamixel(target: str, options: SourceOptions, bundle: Bundle | None) -> Connection:
    """dynamixel:PORT."""
    from tauext.sources.dynamixel_source import DynamixelSource
    from tauext.sources.servo_bus_file import load_servo_bus

    return Connection(DynamixelSource(target, load_servo_bus(bus_of("dynamixel:PORT", options))))


def damiao(target: str, options: SourceOptions, bundle: Bundle | None) -> Connection:
    """damiao:CAN."""
    from tauext.sources.can_bus_file import load_can_bus
    from tauext.sources.damiao_source import DamiaoSource

    return Connection(DamiaoSource(target, load_can_bus(bus_of("damiao:CAN", options))))


def bus_of(source: str, options: SourceOptions) -> Place:
    """The bus file. Raises ConfigError: none was given."""
    if options.bus is None:
        raise ConfigError(f"--source {source} needs --bus FILE: which servo is which joint (docs/servo-buses.md)")
    return options.bus


@dataclass(frozen=True)
class Kind:
    """A kind of source."""

    target: str
    """What stands behind its colon; empty: nothing does."""
    connect: Callable[[str, SourceOptions, Bundle | None], Connection]
    takes: tuple[str, ...] = ()
    """Of SourceOptions."""


KINDS = {
    "replay": Kind("FILE", replay, ("speed",)),
    "ur": Kind("HOST", ur, ("torque_constants",)),
    "franka": Kind("HOST", franka),
    "feetech": Kind("PORT", feetech, ("bus",)),
    "dynamixel": Kind("PORT", dynamixel, ("bus",)),
    "damiao": Kind("CAN", damiao, ("bus",)),
    "ros2": Kind("", ros2, ("ros2",)),
}


def connect(text: str, options: SourceOptions, bundle: Bundle | None = None) -> Connection:
    """The source of this text, KIND:TARGET; it is not open yet. bundle: what publishers on its side tell forces with.

    Raises:
        ConfigError: an unknown kind, a target that is missing, an option that is for another kind; or the source's own.
    """
    kind, colon, target = text.partition(":")
    choices = ", ".join(f"{name}:{known.target}" if known.target else name for name, known in KINDS.items())
    known = KINDS.get(kind)
    if known is None or bool(target) != bool(known.target) or (colon and not target):
        raise ConfigError(f"--source {text!r} must be one of {choices}")
    for name in SourceOptions.__dataclass_fields__:
        if getattr(options, name) is not None and name not in known.takes:
            those = ", ".join(other for other, one in KINDS.items() if name in one.takes)
            raise ConfigError(f"--{name.replace('_', '-')} is for source {those}, not for {kind}")
    return known.connect(target, options, bundle)
