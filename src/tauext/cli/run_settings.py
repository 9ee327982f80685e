"""Options of `tauext run` that what it does and what it prints both need."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tauext.files.places import Place

if TYPE_CHECKING:
    from tauext.monitor.loads import TimedLoad


@dataclass(frozen=True)
class RunSettings:
    """Options of the command that the replay of one recording needs."""

    speed: float | None
    own_rate: bool
    acknowledge_after_s: float | None
    flights: Place | None
    """As it was given."""
    before_s: float
    after_s: float
    contacts: bool
    loads: tuple[TimedLoad, ...] = ()
    folder: Path | None = None
    """Where flights are written on this machine."""
    wrench: str | None = None
    """Frame that the force of a touch is told at, too."""
