"""Options that `tauext run` and `tauext monitor` share: flights, sinks of packages, and what is printed."""

from __future__ import annotations

import sys
from dataclasses import dataclass, fields, make_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from tauext.config import require
from tauext.monitor.sink_kind import Watched, sink_kinds

if TYPE_CHECKING:
    from tauext.cli.json_lines import Output
    from tauext.monitor.flight_files import FlightSettings
    from tauext.monitor.sink import AddedSink


@dataclass(frozen=True)
class FlightOptions:
    """Which flights are written, and where."""

    flights: Path | None = None
    """folder for event logs: recording, estimates and a written explanation around every collision and fault. Existing
    files are never overwritten. None: no event logs."""
    before_s: float = 5.0
    """seconds before the event that an event log keeps."""
    after_s: float = 1.0
    """seconds after the event that an event log keeps."""
    contacts: bool = False
    """also write event logs of contacts."""

    @property
    def settings(self) -> FlightSettings | None:
        from tauext.monitor.flight_files import FlightSettings

        if self.flights is None:
            return None
        return FlightSettings(self.flights, self.before_s, self.after_s, self.contacts)


KINDS = sink_kinds()
SinkOptions: Any = make_dataclass(
    "SinkOptions",
    [(name, Annotated[kind.type, tyro.conf.arg(help=kind.help)], None) for name, kind in KINDS.items()],
    frozen=True,
)
"""Options of all installed kinds of sinks, one field each."""


def chosen_sinks(options: Any) -> dict[str, Any]:
    """Values of the options of sinks that were given, by name."""
    values = {field.name: getattr(options, field.name) for field in fields(options)}
    return {name: value for name, value in values.items() if value is not None}


def opened_sinks(chosen: dict[str, Any], watched: Watched) -> list[AddedSink]:
    """The sinks that were chosen.

    Raises:
        ConfigError: a sink refuses the value of its option.
    """
    return [KINDS[name].open(value, watched) for name, value in chosen.items()]


@dataclass(frozen=True)
class PrintOptions:
    """What is printed."""

    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False
    """print JSON lines, an object an event: `start`, `health`, `alarm`, `flight`, `status`, `end`, `summary`."""
    status_hz: float = 0.0
    """how often --json also prints the estimates, per second of the samples; 0: events only."""

    def output(self, flights: Path | None, acknowledges: bool) -> Output:
        """JSON lines, a live view on a terminal, else lines of text.

        Args:
            flights: folder of flights, as the user gave it.
            acknowledges: whether alarms are acknowledged after a set time.

        Raises:
            ConfigError: a value breaks a rule.
        """
        require(0 <= self.status_hz <= 1e6, "status_hz", self.status_hz, "0 to 1e6")
        require(self.status_hz == 0 or self.as_json, "status_hz", self.status_hz, "left out unless --json is given")
        if self.as_json:
            from tauext.cli.json_lines import JsonLines

            return JsonLines(self.status_hz)
        if sys.stdout.isatty():
            from tauext.cli.live_view import LiveView

            return LiveView(flights, acknowledges)
        from tauext.cli.text_lines import TextLines

        return TextLines(flights, acknowledges)


FlightArg = Annotated[FlightOptions, tyro.conf.arg(name="")]
SinkArg = Annotated[SinkOptions, tyro.conf.arg(name="")]
PrintArg = Annotated[PrintOptions, tyro.conf.arg(name="")]
