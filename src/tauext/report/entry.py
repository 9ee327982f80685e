"""Entries of results.json that several tables use: one JSON object, labelled events, touches."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, overload

from tauext.errors import ConfigError
from tauext.report.results import Numbers, Results, bundle_label
from tauext.report.tables import NONE, Row, Table, milliseconds, number

# --- One JSON object of results.json: its values, checked as they are read.


@dataclass(frozen=True)
class Entry:
    """One JSON object of results.json and its place, for messages."""

    place: str
    content: dict[str, Any]

    def get(self, key: str, kinds: type | tuple[type, ...], needed: bool = False) -> Any:
        """The value under this key, None where it is null or absent."""
        value = self.content.get(key)
        if value is None and not needed:
            return None
        right = isinstance(value, kinds) and (kinds is bool or not isinstance(value, bool))
        if not right:
            names = [kind.__name__ for kind in (kinds if isinstance(kinds, tuple) else (kinds,))]
            raise ConfigError(f"{self.place}: '{key}' is {json.dumps(value)[:60]}, must be {' or '.join(names)}")
        return value

    @overload
    def number(self, key: str, needed: Literal[True]) -> float: ...
    @overload
    def number(self, key: str, needed: bool = False) -> float | None: ...
    def number(self, key: str, needed: bool = False) -> float | None:
        return self.get(key, (int, float), needed)

    @overload
    def text(self, key: str, needed: Literal[True]) -> str: ...
    @overload
    def text(self, key: str, needed: bool = False) -> str | None: ...
    def text(self, key: str, needed: bool = False) -> str | None:
        return self.get(key, str, needed)

    def entries(self, key: str, needed: bool = False) -> list[Entry]:
        """The objects of a list; none where it is absent."""
        items = [Entry(f"{self.place}, {key}[{k}]", e) for k, e in enumerate(self.get(key, list, needed) or [])]
        for item in items:
            if not isinstance(item.content, dict):
                raise ConfigError(f"{item.place}: is {json.dumps(item.content)[:60]}, must be an object")
        return items

    def object(self, key: str) -> Entry:
        return Entry(f"{self.place}, {key}", self.get(key, dict) or {})

    def texts(self, key: str, needed: bool = False) -> tuple[str, ...]:
        items = self.get(key, list, needed) or []
        if not all(isinstance(item, str) for item in items):
            raise ConfigError(f"{self.place}: '{key}' must be a list of names")
        return tuple(items)

    def numbers(self, key: str, joints: int) -> Numbers:
        """One number or null a joint."""
        items = self.get(key, list)
        if items is None:
            return (None,) * joints
        if len(items) != joints or not all(type(item) in (int, float, type(None)) for item in items):
            raise ConfigError(f"{self.place}: '{key}' must be a list of {joints} numbers or null, one a joint")
        return tuple(items)

    def each_number(self, *keys: str) -> dict[str, Any]:
        """The numbers under these keys, as keyword arguments."""
        return {key: self.number(key) for key in keys}

    def loss_history(self, key: str) -> tuple[tuple[int, float, float], ...]:
        """Triples of a step and its two losses."""
        items = self.get(key, list) or []
        for item in items:
            kinds = [type(number) for number in item] if isinstance(item, list) else []
            if len(kinds) != 3 or kinds[0] is not int or not {*kinds} <= {int, float}:
                raise ConfigError(
                    f"{self.place}: '{key}' holds {json.dumps(item)[:60]}, must be [step, training, validation loss]"
                )
        return tuple(map(tuple, items))


# --- The table of labelled events: found, how late, false alarms an hour of free time, moving and resting apart.


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


# --- Which link collisions were said to be on, and of what kind, beside the labels: from results.json, and as tables.


KINDS = ("impact", "push", "clamp", "load", "unknown")


@dataclass(frozen=True)
class LinkTable:
    """Of one bundle: labelled link by the link that was said to be the most probable."""

    joints: tuple[str, ...]
    table: tuple[tuple[int, ...], ...]
    collisions: int
    first: int
    first_two: int
    stated: int
    stated_right: int


@dataclass(frozen=True)
class Told:
    """What was said of one collision."""

    kind: str | None
    joint: str | None = None
    """That carries the most probable link; None: no place was told."""
    probability: float | None = None
    force_n: float | None = None


@dataclass(frozen=True)
class BundleTouches:
    """Of one bundle."""

    name: str
    label: str
    stated_from: float
    links: LinkTable | None
    kinds: dict[str, dict[str, int]]
    """How many of each kind, by the recordings' word for their contacts."""
    told: dict[str, Told]
    """By the collision's id."""


def read_touches(top: Entry) -> tuple[BundleTouches, ...]:
    """Of every bundle that told a link or a kind."""
    found = []
    for bundle in top.entries("bundles", needed=True):
        entry = bundle.object("touches")
        if not entry.content:
            continue
        name = bundle.text("name", needed=True)
        told = {one.text("id", needed=True): read_told(one) for one in entry.entries("told")}
        found.append(
            BundleTouches(
                name=name,
                label=bundle_label(name, bundle.text("recipe")),
                stated_from=entry.number("stated_from", needed=True),
                links=read_links(entry.object("links")),
                kinds={word: read_kinds(entry.object("kinds").object(word)) for word in entry.object("kinds").content},
                told=told,
            )
        )
    return tuple(one for one in found if one.links or one.kinds)


def read_links(entry: Entry) -> LinkTable | None:
    if not entry.content:
        return None
    joints = entry.texts("joints", needed=True)
    rows = entry.get("table", list, needed=True)
    size = len(joints)
    square = len(rows) == size and all(isinstance(row, list) and len(row) == size for row in rows)
    if not square or not all(type(count) is int for row in rows for count in row):
        raise ConfigError(f"{entry.place}: 'table' must be {size} lists of {size} counts, one a link")
    counts = ("collisions", "first", "first_two", "stated", "stated_right")
    return LinkTable(
        joints, tuple(tuple(row) for row in rows), **{key: entry.get(key, int, needed=True) for key in counts}
    )


def read_kinds(entry: Entry) -> dict[str, int]:
    return {kind: entry.get(kind, int, needed=True) for kind in entry.content}


def read_told(entry: Entry) -> Told:
    kind, links = entry.text("kind"), entry.entries("links")
    if not links:
        return Told(kind)
    return Told(kind, links[0].text("joint", needed=True), links[0].number("probability"), entry.number("force_n"))


def links_table(touches: Sequence[BundleTouches]) -> Table | None:
    """A row a bundle and touched link; None where no link was told."""
    placing = [(one, one.links) for one in touches if one.links is not None]
    if not placing:
        return None
    joints = placing[0][1].joints
    rows = []
    for one, links in placing:
        opens = True
        for joint, counts in zip(links.joints, links.table, strict=True):
            if not sum(counts):
                continue
            right = counts[links.joints.index(joint)] / sum(counts)
            cells = (one.label if opens else "", joint, *(str(count) if count else "" for count in counts))
            rows.append(Row((*cells, f"{right:.0%}"), one.name if opens else None, opens=opens))
            opens = False
    groups = (("", 1), ("touched", 1), ("said to be on the link of", len(joints)), ("", 1))
    return Table(groups, ("model", "link of", *joints, "right"), tuple(rows), words=2)


def links_worth(one: BundleTouches) -> str:
    """`exact: the right link first in 6 of 8 collisions, among the first two in 7; stated with 90% or more in 3`."""
    links = one.links
    if links is None:
        return ""
    stated = f"stated with {one.stated_from:.0%} or more in {links.stated}"
    right = f", right in {links.stated_right} of them" if links.stated else ""
    return (
        f"{one.label}: the right link first in {links.first} of {links.collisions} collisions, among the first two in "
        f"{links.first_two}; {stated}{right}"
    )


def kinds_table(touches: Sequence[BundleTouches]) -> Table | None:
    """A row a bundle and the recordings' word for their contacts; None where no kind was told."""
    rows = []
    for one in touches:
        opens = True
        for word, counts in sorted(one.kinds.items()):
            cells = (str(counts[kind]) if counts.get(kind) else "" for kind in KINDS)
            rows.append(Row((one.label if opens else "", word, *cells), one.name if opens else None, opens=opens))
            opens = False
    return (
        Table((("", 2), ("said to be", len(KINDS))), ("model", "contacts", *KINDS), tuple(rows), words=2)
        if rows
        else None
    )


def told_table(results: Results, touches: Sequence[BundleTouches]) -> Table:
    """A row a collision: what each bundle said of it."""
    rows = []
    for collision in results.collisions.values():
        link = results.joints[collision.link] if 0 <= collision.link < len(results.joints) else NONE
        cells = [collision.recording, number(collision.start_s, 2), collision.kind, link]
        rows.append(Row((*cells, *(told_words(one.told.get(collision.id)) for one in touches))))
    columns = ("recording", "onset, s", "kind", "link of", *(one.label for one in touches))
    groups = (("", 2), ("labelled", 2), ("said: link, newtons, kind", len(touches)))
    return Table(groups, columns, tuple(rows), words=1)


def told_words(told: Told | None) -> str:
    """`joint4 83%, 34 N, push`; a dash where no alarm was raised."""
    if told is None:
        return NONE
    parts = [] if told.joint is None else [f"{told.joint} {told.probability or 0:.0%}"]
    parts += [] if told.force_n is None else [f"{told.force_n:.0f} N"]
    return ", ".join([*parts, *([told.kind] if told.kind not in (None, "none") else [])]) or NONE
