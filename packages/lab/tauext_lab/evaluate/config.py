"""Settings of `tauext evaluate`."""

from __future__ import annotations

from dataclasses import dataclass

from tauext.config import expect_types, require


@dataclass(frozen=True)
class EventsConfig:
    """Comparison of alarms with labels that may be imprecise."""

    shortest_event_s: float = 0.0
    """Shortest labelled event that counts, [s]; shorter ones are neither an event nor free motion."""
    tolerance_s: float = 0.1
    """Time before and after an event's label in which an alarm counts for the event, [s]."""

    def __post_init__(self) -> None:
        expect_types(vars(self), type(self))
        for name in ("shortest_event_s", "tolerance_s"):
            require(0 <= getattr(self, name) <= 60, name, getattr(self, name), "0 to 60")
