"""The table of labelled events: found, how late, false alarms an hour of free time, moving and resting apart."""

from __future__ import annotations

from dataclasses import dataclass

from tauext.report.entry import Entry
from tauext.report.naming import bundle_label
from tauext.report.tables import NONE, Row, Table, milliseconds, number

STATES = ("all", "moving", "resting")
OWN = "the robot's own tau_ext"


@dataclass(frozen=True)
class EventCounts:
    """Of one method in one state of the arm; None where a number does not exist."""

    events: int
    found: int
    delay_median_s: float | None
    """From the label's start, as the next; then from the re-timed onset."""
    delay_p95_s: float | None
    delay_from_onset_median_s: float | None
    delay_from_onset_p95_s: float | None
    free_hours: float
    false_alarms: int
    false_alarms_per_hour: float | None


@dataclass(frozen=True)
class MethodEvents:
    """Of one method, by the state of the arm."""

    name: str
    label: str
    counts: dict[str, EventCounts]
    tolerance_s: float
    shortest_event_s: float
    left_out: int


def read_events(top: Entry) -> tuple[MethodEvents, ...]:
    """Of every bundle that was held against labels, and of the robot's own torque; none where nothing was labelled."""
    found = []
    for bundle in top.entries("bundles", needed=True):
        name = bundle.text("name", needed=True)
        found.append(read_method(bundle.object("events"), name, bundle_label(name, bundle.text("recipe"))))
    found.append(read_method(top.object("own_torque").object("events"), OWN, OWN))
    methods = tuple(method for method in found if method is not None)
    return methods if any(method.counts["all"].events for method in methods) else ()


def read_method(entry: Entry, name: str, label: str) -> MethodEvents | None:
    if not entry.content:
        return None
    return MethodEvents(
        name=name,
        label=label,
        counts={state: read_counts(entry.object(state)) for state in STATES},
        tolerance_s=entry.number("tolerance_s", needed=True),
        shortest_event_s=entry.number("shortest_event_s", needed=True),
        left_out=entry.get("left_out", int, needed=True),
    )


def read_counts(entry: Entry) -> EventCounts:
    delays = ("delay_median_s", "delay_p95_s", "delay_from_onset_median_s", "delay_from_onset_p95_s")
    return EventCounts(
        **{key: entry.get(key, int, needed=True) for key in ("events", "found", "false_alarms")},
        **entry.each_number(*delays, "false_alarms_per_hour"),
        free_hours=entry.number("free_hours", needed=True),
    )


def events_table(methods: tuple[MethodEvents, ...]) -> Table:
    """One row a method and state that occurred."""
    groups = (("", 3), ("delay from label, ms", 2), ("delay from onset, ms", 2), ("false alarms in free time", 3))
    columns = ("method", "arm", "found", "median", "95 %", "median", "95 %", "count", "minutes", "an hour")
    rows = []
    for method in methods:
        for state in STATES:
            counts = method.counts[state]
            if state == "all" or counts.events or counts.free_hours:
                bundle = None if method.name == OWN else method.name
                rows.append(Row(cells(method, state, counts), bundle, opens=state == "all"))
    return Table(groups, columns, tuple(rows), words=2)


def cells(method: MethodEvents, state: str, counts: EventCounts) -> tuple[str, ...]:
    delays = (
        counts.delay_median_s,
        counts.delay_p95_s,
        counts.delay_from_onset_median_s,
        counts.delay_from_onset_p95_s,
    )
    return (
        method.label if state == "all" else "",
        state,
        f"{counts.found} of {counts.events}" if counts.events else NONE,
        *(milliseconds(delay) for delay in delays),
        f"{counts.false_alarms:,}",
        number(60 * counts.free_hours, 1),
        number(counts.false_alarms_per_hour, 1),
    )
