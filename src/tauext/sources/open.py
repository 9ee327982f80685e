"""Sources by text, KIND:TARGET."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from tauext.errors import ConfigError
from tauext.files.places import Place, place_of
from tauext.sources.ros2_settings import Ros2Settings

if TYPE_CHECKING:
    from tauext._core import Bundle
    from tauext.monitor.sink import Sink
    from tauext.monitor.source import Source

# --- The kinds of sources; a new one is registered here.


@dataclass(frozen=True)
class SourceOptions:
    """Options of the command that only some sources take; None: not given."""

    speed: float | None = None
    torque_constants: Place | None = None
    ros2: Ros2Settings | None = None
    bus: Place | None = None


@dataclass(frozen=True)
class Kind:
    """A kind of source."""

    target: str
    """Name of the target after the colon; empty: the kind has no target."""
    takes: tuple[str, ...] = ()
    """Fields of SourceOptions that the kind accepts."""


KINDS = {
    "replay": Kind("FILE", ("speed",)),
    "ur": Kind("HOST", ("torque_constants",)),
    "franka": Kind("HOST"),
    "feetech": Kind("PORT", ("bus",)),
    "dynamixel": Kind("PORT", ("bus",)),
    "damiao": Kind("CAN", ("bus",)),
    "ros2": Kind("", ("ros2",)),
}


def open_source(text: str, options: SourceOptions, bundle: Bundle | None = None) -> tuple[Source, tuple[Sink, ...]]:
    """The source of this text, KIND:TARGET, not open yet, and the publishers that belong to it.

    Args:
        bundle: basis of the forces that publishers send.

    Raises:
        ConfigError: an unknown kind, a target that is missing, an option that is for another kind; or the source's own.
    """
    kind, colon, target = text.partition(":")
    choices = ", ".join(f"{name}:{one.target}" if one.target else name for name, one in KINDS.items())
    chosen = KINDS.get(kind)
    if chosen is None or bool(target) != bool(chosen.target) or (colon and not target):
        raise ConfigError(f"--source {text!r} must be one of {choices}")
    for name in SourceOptions.__dataclass_fields__:
        if getattr(options, name) is not None and name not in chosen.takes:
            those = ", ".join(other for other, one in KINDS.items() if name in one.takes)
            raise ConfigError(f"--{name.replace('_', '-')} is for source {those}, not for {kind}")
    if kind == "ros2":
        from tauext.sources import ros2

        source, publisher = ros2.connect(options.ros2 or Ros2Settings(), bundle)
        return source, (publisher,)
    return source_of(kind, target, options), ()


def source_of(kind: str, target: str, options: SourceOptions) -> Source:
    """A source without publishers of its own; only the modules of this kind are imported."""
    if kind == "replay":
        from tauext.sources.replay import ReplaySource

        speed = options.speed or 1.0
        if speed < 1:  # by the clock, every sample would be missing
            raise ConfigError(
                f"speed = {speed:g} must be >= 1: at a lower speed a live loop counts late samples as missing"
            )
        return ReplaySource(place_of(target), speed)
    if kind == "ur":
        from tauext.sources.ur import UrSource

        return UrSource(target, options.torque_constants)
    if kind == "franka":
        from tauext.sources.franka import FrankaSource

        return FrankaSource(target)
    if options.bus is None:
        named = f"{kind}:{KINDS[kind].target}"
        raise ConfigError(f"--source {named} needs --bus FILE: which servo is which joint (docs/servo-arms.md)")
    if kind == "damiao":
        from tauext.sources.damiao import DamiaoSource, load_can_bus

        return DamiaoSource(target, load_can_bus(options.bus))
    from tauext.sources.servo import ServoSource
    from tauext.sources.servo_bus_file import load_servo_bus
    from tauext.sources.servo_series import DYNAMIXEL, FEETECH

    return ServoSource(FEETECH if kind == "feetech" else DYNAMIXEL, target, load_servo_bus(options.bus))
