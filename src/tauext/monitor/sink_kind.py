"""Sinks of packages: each is an option of `tauext run` and `tauext monitor`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tauext import plugins
from tauext.errors import ConfigError

if TYPE_CHECKING:
    from tauext._core import Bundle
    from tauext.monitor.sink import AddedSink


@dataclass(frozen=True)
class Watched:
    """The loop whose verdicts a sink will receive."""

    bundle: Bundle
    source: str
    """Name of the source or of the recording."""
    wrench: str | None = None
    """Frame at which the force of a touch is reported, too."""
    is_live: bool = True
    """False: a recording is replayed, and the loop may wait for the sink."""


@dataclass(frozen=True)
class SinkKind:
    """A kind of sink. Packages add kinds as entry points of the group tauext.sinks, whose names are the options."""

    open: Callable[[Any, Watched], AddedSink]
    """open(value, watched) returns the sink; it creates files in Sink.open() and imports libraries only here. Raises
    ConfigError where the value of the option cannot be used."""
    help: str
    """Help of the option."""
    type: Any = Path | None
    """Type of the option's value; its default is None, and then there is no such sink."""


def sink_kinds() -> dict[str, SinkKind]:
    """Kinds of sinks by the names of their options; a package that cannot be loaded is left out."""
    found = {}
    for name, entry in plugins.installed(plugins.SINKS).items():
        try:
            found[name.replace("-", "_")] = plugins.load(entry, SinkKind)
        except ConfigError:  # its option is then unknown
            continue
    return found
