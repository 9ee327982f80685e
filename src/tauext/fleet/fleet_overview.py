"""One row an arm: date, state, promise, tool, findings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from tauext.fleet.fleet_cells import NONE, Cell, likelier, number, outness

Content = Mapping[str, Any]


@dataclass(frozen=True)
class Head:
    text: str
    word: bool = False


@dataclass(frozen=True)
class OverviewRow:
    arm: str
    link: str
    failed: bool
    cells: tuple[Cell, ...]


@dataclass(frozen=True)
class Overview:
    heads: tuple[Head, ...]
    rows: tuple[OverviewRow, ...]


def overview(arms: Sequence[Content], link: Mapping[str, str]) -> Overview:
    """Every arm at its last date, the failed ones too; types only where there are several."""
    typed = len({arm["type"] for arm in arms}) > 1
    heads = [Head("arm"), *([Head("type", True)] if typed else []), Head("last date", True), Head("state", True)]
    heads += [Head("dates"), Head("minutes"), Head("promise, false/h"), Head("false (minutes)")]
    heads += [Head("tool beside fleet, kg"), Head("tool since, kg"), Head("findings", True)]
    promises = outness([arm["visits"][-1].get("promised_per_hour") for arm in arms])
    rows = []
    for arm, out in zip(arms, promises, strict=True):
        visit, to = arm["visits"][-1], link.get(arm["serial"], "")
        cells = [Cell(arm["type"] or "–", word=True)] if typed else []
        cells += [Cell(visit["label"], word=True), Cell(visit["state"], word=True, title=visit["reason"] or "")]
        cells += [Cell(str(len(arm["visits"])), float(len(arm["visits"])))]
        cells += [plain(visit.get("minutes"), to), promise(visit, out, to), false(visit, to)]
        cells += [tool(visit, "fleet", to), tool(visit, "own", to), findings(visit)]
        rows.append(OverviewRow(arm["serial"], to, visit["state"] != "done", tuple(cells)))
    return Overview(tuple(heads), tuple(rows))


def plain(value: float | None, link: str) -> Cell:
    return NONE if value is None else Cell(number(value), value, link=link)


def promise(visit: Content, out: float, link: str) -> Cell:
    value = visit.get("promised_per_hour")
    return NONE if value is None else Cell(number(value), value, out, link=link, title=visit.get("promise") or "")


def false(visit: Content, link: str) -> Cell:
    count, hours = visit.get("false_collisions"), visit.get("hours")
    return NONE if count is None or not hours else Cell(f"{count} ({number(60 * hours, 2)})", count, link=link)


def tool(visit: Content, against: str, link: str) -> Cell:
    """Kilograms at the flange."""
    told = (visit.get(against) or {}).get("tool")
    value = told["value"][0] if told else None
    if told is None or value is None:
        return NONE
    probability, sign = likelier(told, 0)
    out = 3 * sign if probability is not None and probability >= 0.1 else 0.0
    return Cell(f"{value:+.2f} ± {told['error'][0]:.2f}", value, out, probability, link)


def findings(visit: Content) -> Cell:
    """Codes of the doctor, faults first."""
    listed = sorted(visit["findings"], key=lambda one: one["severity"] != "fault")
    if not listed:
        return Cell("–", 0.0, word=True)
    codes = dict.fromkeys(f"{one['code']}{' (fault)' if one['severity'] == 'fault' else ''}" for one in listed)
    title = "\n".join(f"{one['code']} {one['joint'] or ''}: {one['evidence']}" for one in listed)
    return Cell(", ".join(codes), word=True, long=True, title=title)
