"""Settings of `tauext evaluate`."""

from __future__ import annotations

from dataclasses import dataclass

from tauext.config import Seconds, Settings


@dataclass(frozen=True)
class EventsConfig(Settings):
    """Comparison of alarms with labels that may be imprecise."""

    shortest_event_s: Seconds = 0.0
    """Shortest labelled event that counts, [s]; shorter ones are neither an event nor free motion."""
    tolerance_s: Seconds = 0.1
    """Time before and after an event's label in which an alarm counts for the event, [s]."""


OTHER_METHODS = ("next", "stall-rule")
"""Methods of others without a bundle, by their names in `evaluate --methods`; tauext_lab.other_methods trains them."""
