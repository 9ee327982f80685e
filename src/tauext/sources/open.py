"""Kinds of sources, and a source by its text, KIND:TARGET."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tauext import plugins
from tauext.errors import ConfigError

if TYPE_CHECKING:
    from tauext._core import Bundle
    from tauext.monitor.cell_file import Cell
    from tauext.monitor.sink import Sink
    from tauext.monitor.source import Source


@dataclass(frozen=True)
class Option:
    """An option of the commands `monitor` and `commission` for one kind of source, or for several."""

    name: str
    """`torque_constants` is given as --torque-constants."""
    type: Any
    """Type of the value, also `X | None`. A frozen dataclass is a group of options: --ros2.topic."""
    help: str
    default: Any = None
    """Value when the option is not given; the source is then opened without it."""


@dataclass(frozen=True)
class SourceKind:
    """A kind of source. Packages of their own add kinds as entry points of the group tauext.sources."""

    open: Callable[..., Source | tuple[Source, tuple[Sink, ...]]]
    """open(target, bundle, **options) returns the source, not connected yet, alone or with the sinks that belong to it,
    such as a publisher. `bundle` is None where none exists yet; `options` are those that were given. Drivers are
    imported here. Raises ConfigError where an option is missing or does not fit."""
    target: str = ""
    """Name of the target after the colon, such as HOST; empty: the kind has no target."""
    options: tuple[Option, ...] = ()
    """Options that the kind takes."""
    takes_bus: bool = False
    """Whether the kind needs the table [bus] of the cell's file: open() then has the argument `cell`, a
    tauext.monitor.cell_file.Cell."""
    robot: Callable[[str, Path], Path] | None = None
    """robot(target, folder) writes the arm's robot file into the folder and returns its path; None: a user has one."""

    def typed(self, name: str) -> str:
        """How a user names the kind: `ur:HOST`."""
        return f"{name}:{self.target}" if self.target else name


# --- The kinds of this package. Modules of drivers are imported when a source is opened.


def open_replay(target: str, bundle: Bundle | None, speed: float = 1.0) -> Source:
    from tauext.sources.replay import ReplaySource

    if speed < 1:  # by the clock, every sample would be missing
        raise ConfigError(
            f"speed = {speed:g} must be >= 1: at a lower speed a live loop counts late samples as missing"
        )
    return ReplaySource(Path(target), speed)


def open_ur(target: str, bundle: Bundle | None, torque_constants: Path | None = None) -> Source:
    from tauext.sources.ur import UrSource

    return UrSource(target, torque_constants)


def open_franka(target: str, bundle: Bundle | None) -> Source:
    from tauext.sources.franka import FrankaSource

    return FrankaSource(target)


KINDS: Mapping[str, SourceKind] = {
    "replay": SourceKind(
        open_replay,
        "FILE",
        (Option("speed", float | None, "factor on the recorded speed of a replay, at least 1. None: 1."),),
    ),
    "ur": SourceKind(
        open_ur,
        "HOST",
        (
            Option(
                "torque_constants",
                Path | None,
                "with --source ur, a file with the torque constant of each joint, Nm per ampere of motor current.",
            ),
        ),
    ),
    "franka": SourceKind(open_franka, "HOST"),
}


# --- All kinds, and a source by its text.


def kinds() -> dict[str, SourceKind]:
    """Kinds of this package, then those of plug-ins; a plug-in that cannot be loaded is left out."""
    found = dict(KINDS)
    for name, entry in plugins.installed(plugins.SOURCES, KINDS).items():
        try:
            found[name] = plugins.load(entry, SourceKind)
        except ConfigError:  # reported where its source is opened
            continue
    return found


def options_of(kinds: Mapping[str, SourceKind]) -> dict[str, Option]:
    """Options of these kinds by name; of two with one name, the first."""
    found: dict[str, Option] = {}
    for kind in kinds.values():
        for option in kind.options:
            found.setdefault(option.name, option)
    return found


def open_source(
    text: str, options: Mapping[str, Any], bundle: Bundle | None = None, cell: Cell | None = None
) -> tuple[Source, tuple[Sink, ...]]:
    """The source of this text, KIND:TARGET, not connected yet, and the sinks that belong to it.

    Args:
        options: values of the options that were given, by name.
        bundle: what the samples are for; sinks of the source take frames and units from it.
        cell: the cell's file, which describes the joints of a servo bus.

    Raises:
        ConfigError: an unknown kind, a target that is missing, an option that is for another kind; or the source's own.
    """
    name, colon, target = text.partition(":")
    kind = plugins.named(name, KINDS, plugins.SOURCES, SourceKind)
    if kind is None and (how := plugins.how_to_add(name)):
        raise ConfigError(f"--source {text}: {how}")
    if kind is None or bool(target) != bool(kind.target) or (colon and not target):
        choices = ", ".join(one.typed(other) for other, one in kinds().items())
        raise ConfigError(f"--source {text!r} must be one of {choices}")
    for option in options:
        if option not in {one.name for one in kind.options}:
            those = ", ".join(other for other, one in kinds().items() if option in {each.name for each in one.options})
            raise ConfigError(f"--{option.replace('_', '-')} is for source {those}, not for {name}")
    if kind.takes_bus:
        if cell is None or cell.bus is None:
            raise ConfigError(
                f"--source {kind.typed(name)} needs --cell FILE with a table [bus]: which servo is which joint "
                "(docs/servo-arms.md)"
            )
        options = {**options, "cell": cell}
    opened = kind.open(target, bundle, **options)
    return opened if isinstance(opened, tuple) else (opened, ())


def robot_file_of(text: str, folder: Path) -> Path | None:
    """Write the robot file of a source's arm into the folder; None: this kind of source has none."""
    name, _, target = text.partition(":")
    kind = plugins.named(name, KINDS, plugins.SOURCES, SourceKind)
    return kind.robot(target, folder) if kind and kind.robot else None
