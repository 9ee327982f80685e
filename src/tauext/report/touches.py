"""Which link collisions were said to be on, and of what kind, beside the labels: from results.json, and as tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from tauext.errors import ConfigError
from tauext.report.entry import Entry
from tauext.report.naming import bundle_label
from tauext.report.results import Results
from tauext.report.tables import NONE, Row, Table, number

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
    """Of every bundle that told a link or a kind; none in results of older versions."""
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
