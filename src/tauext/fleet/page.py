"""The page of a fleet, and each arm's own page beside it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tauext.errors import ConfigError
from tauext.files.atomic_write import atomic_write
from tauext.files.places import Place
from tauext.fleet.measures import NONE, ArmRow, Cell, likelier, measures, number, outness, percent, trends
from tauext.fleet.odds import NAMED
from tauext.report.tables import plural, render_template

# --- One row an arm: date, state, promise, tool, findings.


Content = Mapping[str, Any]


@dataclass(frozen=True)
class Head:
    text: str
    word: bool = False


def overview(arms: Sequence[Content], link: Mapping[str, str]) -> dict[str, Any]:
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
        rows.append(ArmRow(arm["serial"], to, tuple(cells), failed=visit["state"] != "done"))
    return {"heads": heads, "rows": rows}


def plain(value: float | None, link: str) -> Cell:
    return NONE if value is None else Cell(number(value), value, link=link)


def promise(visit: Content, out: float, link: str) -> Cell:
    value = visit.get("promised_per_hour")
    return NONE if value is None else Cell(number(value), value, out, link=link, title=visit.get("promise") or "")


def false(visit: Content, link: str) -> Cell:
    count, hours = visit.get("false_collisions"), visit.get("hours")
    return NONE if count is None or not hours else Cell(f"{count} ({number(60 * hours, 2)})", count, link=link)


def tool(visit: Content, against: str, link: str) -> Cell:
    """Text of the mass at the flange, [kg]."""
    entries = (visit.get(against) or {}).get("tool")
    value = entries["value"][0] if entries else None
    if entries is None or value is None:
        return NONE
    probability, sign = likelier(entries, 0)
    out = 3 * sign if probability is not None and probability >= 0.1 else 0.0
    return Cell(f"{value:+.2f} ± {entries['error'][0]:.2f}", value, out, probability, link)


def findings(visit: Content) -> Cell:
    """Codes of the check's findings, faults first."""
    listed = sorted(visit["findings"], key=lambda one: one["severity"] != "fault")
    if not listed:
        return Cell("–", 0.0, word=True)
    codes = dict.fromkeys(f"{one['code']}{' (fault)' if one['severity'] == 'fault' else ''}" for one in listed)
    title = "\n".join(f"{one['code']} {one['joint'] or ''}: {one['evidence']}" for one in listed)
    return Cell(", ".join(codes), word=True, long=True, title=title)


# --- The page of a fleet, from the content of fleet-report.json; one file without requests to any host.


TEMPLATE = Path(__file__).with_name("fleet_page.html.j2")


@dataclass(frozen=True)
class FleetGlance:
    value: str
    means: str
    alert: bool = False


def render_fleet_page(content: Content, links: Mapping[tuple[int, str], str]) -> str:
    """The whole page.

    Args:
        content: of fleet-report.json.
        links: of each arm's own page, by fleet and the arm's name in it; none where it has no page.
    """
    arms, labels = with_places(content)
    link = {arm["serial"]: links.get((arm["visits"][-1]["run"], arm["visits"][-1]["name"]), "") for arm in arms}
    groups = [
        {
            "number": k,
            "type": group["type"],
            "measures": measures(group, members(k, arms), link),
            "trends": trends(group, members(k, arms), labels),
        }
        for k, group in enumerate(content["groups"])
    ]
    return render_template(
        TEMPLATE,
        title=title(arms, labels),
        lead=lead(content, arms),
        glances=glances(content, arms),
        named=[named(one, link) for one in content["named"]],
        failed=[failed(arm, one) for arm in arms for one in arm["visits"] if one["state"] != "done"],
        overview=overview(arms, link),
        groups=groups,
        most_measures=max((len(group["measures"]) for group in groups), default=1),
        reading=reading(content),
        command=content["command"],
        version=content["version"],
        fleets=content["fleets"],
    )


def with_places(content: Content) -> tuple[list[dict[str, Any]], list[str]]:
    """The arms, each visit with the index of its date; and the labels of the dates."""

    def key(visit: Content) -> tuple[str, int]:
        return (visit["date"] or "", visit["run"])

    visits = [visit for arm in content["arms"] for visit in arm["visits"]]
    if all(visit["date"] for visit in visits):
        days = sorted({visit["date"] for visit in visits})
        at = {key(visit): days.index(visit["date"]) for visit in visits}
        labels = days
    else:
        at = {key(visit): visit["run"] for visit in visits}
        labels = [f"run {k + 1}" for k in range(len(content["fleets"]))]
    arms = [
        {**arm, "visits": [{**visit, "at": at[key(visit)], "label": labels[at[key(visit)]]} for visit in arm["visits"]]}
        for arm in content["arms"]
    ]
    return arms, labels


def members(group: int, arms: Sequence[Content]) -> list[Content]:
    """Arms whose last date is in this group, without the dates that are in another: their joints or units differ."""
    return [
        {**arm, "visits": [visit for visit in arm["visits"] if visit.get("group", group) == group]}
        for arm in arms
        if arm["visits"][-1].get("group") == group
    ]


def title(arms: Sequence[Content], labels: Sequence[str]) -> str:
    dates = f", {labels[0]} to {labels[-1]}" if len(labels) > 1 else f", {labels[0]}"
    return f"{plural(len(arms), 'arm')}{dates}"


def lead(content: Content, arms: Sequence[Content]) -> str:
    """The summary sentence."""
    own = {one["arm"] for one in content["named"] if one["against"] == "own"}
    fleet = {one["arm"] for one in content["named"]} - own
    bad = sum(arm["visits"][-1]["state"] != "done" for arm in arms)
    parts = [
        f"{plural(len(own), 'arm')} changed since {'its' if len(own) == 1 else 'their'} first date" if own else "",
        f"{plural(len(fleet), 'arm')} {'is' if len(fleet) == 1 else 'are'} unlike the others of the type"
        if fleet
        else "",
        f"{plural(bad, 'arm')} failed" if bad else "",
    ]
    present = [part for part in parts if part]
    text = "; ".join(present) if present else "no arm stands out, and none failed"
    return f"{text[:1].upper()}{text[1:]}. Each arm's name leads to its own page."


def glances(content: Content, arms: Sequence[Content]) -> list[FleetGlance]:
    """The key numbers of the page."""
    done = sum(arm["visits"][-1]["state"] == "done" for arm in arms)
    wearing = [one for one in content["named"] if one["kind"] == "wearing"]
    others = [one for one in content["named"] if one["kind"] != "wearing"]
    found = [
        FleetGlance(f"{done} of {len(arms)}", "arms have all their stages done", done < len(arms)),
        FleetGlance(str(len(wearing)), "joints are wearing: friction beside the arm's own first date", bool(wearing)),
        FleetGlance(str(len(others)), "other findings: tools, constants, arms unlike the others", bool(others)),
    ]
    for start, means in (
        ("own friction", "friction of a joint from which it would be named, beside its own first date"),
        ("fleet friction", "friction from which it would be named beside the other arms alone"),
    ):
        named_from = [table["named_from"] for name, table in tables(content) if name.startswith(start)]
        if named_from:
            last = named_from[-1]
            found.append(FleetGlance("never" if last is None else f"× {np.exp(last):.2f}", means))
    return found


def tables(content: Content) -> list[tuple[str, Content]]:
    return [pair for group in content["groups"] for pair in group["tables"].items()]


def named(one: Content, link: Mapping[str, str]) -> Content:
    """One line of the list of findings to check first."""
    beside = "its own first date" if one["against"] == "own" else "the fleet"
    return {**one, "beside": beside, "percent": percent(one["probability"]), "link": link.get(one["arm"], "")}


def failed(arm: Content, visit: Content) -> Content:
    reason = visit["reason"] or visit["state"]
    return {"arm": arm["serial"], "date": visit["label"], "stage": visit["stage"] or "", "reason": reason}


def reading(content: Content) -> list[str]:
    """Meaning of the probabilities, with the variation learned from the fleet."""
    lines = [
        f"A probability measures how far a number is from what healthy arms do; {percent(NAMED)} and more is named. "
        "It rests on this fleet: how much healthy joints differ is learned from all of them, and a joint stands out "
        "only beside the other joints of its arm and the same joint of the other arms. So a cold day of an arm, or a "
        "winter of all arms, is no wear of a joint."
    ]
    for name, table in tables(content):
        if name.startswith("own friction"):
            lines.append(
                f"From one date to the other friction of a healthy arm moved by {share(table['arm_spread'])} in all "
                f"joints together and by {share(table['joint_spread'])} in each by itself (standard deviations, "
                f"{table['arms']} arms)."
            )
        elif name == "fleet friction":
            lines.append(
                f"Healthy arms differ among each other by {share(table['joint_spread'])} in a joint's friction. So "
                "the fleet alone shows little of wear: an arm's own earlier date shows far more."
            )
    lines.append(
        "Wear is one reason for more friction; a new gear, stiff grease, a tight seal or brake, or a drive of another "
        "scale at a joint that carries no weight are others. Less friction may be a repaired gear, or one that lost "
        "its preload."
    )
    lines.append(
        "A tool is distinguished from a torque constant by where it shows: a tool at all joints that carry it, a "
        "constant at its own. Joints that gravity does not turn (a vertical base) do not show their constant."
    )
    return lines


def share(spread: float) -> str:
    return f"{100 * spread:.1f} %" if spread < 0.1 else f"{100 * spread:.0f} %"


# --- Writes the page of a fleet, and beside it each arm's own.


PAGE = "fleet.html"


def write_fleet_page(content: Mapping[str, Any], out: Path) -> Path:
    """Write PAGE from the content of fleet-report.json; arms whose pages are in `out` are linked. Returns its path.

    Raises:
        ConfigError: it cannot be written.
    """
    visits = [visit for arm in content["arms"] for visit in arm["visits"]]
    links = {}
    for visit in visits:
        place = arm_folder(visit["run"], visit["name"])
        if (out / place / "report.html").is_file():
            links[visit["run"], visit["name"]] = f"{place}/report.html"
    page = out / PAGE
    try:
        out.mkdir(parents=True, exist_ok=True)
        with atomic_write(page) as part:
            part.write_text(render_fleet_page(content, links), encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{page}: cannot be written ({error.strerror or error})") from error
    return page


def arm_folder(fleet: int, name: str) -> str:
    """Path of an arm's own page in the folder of the fleet page."""
    return f"arms/{fleet + 1}/{name}"


def is_newer(page: Path, results: Place) -> bool:
    """Whether the page is at least as new as these results, by file times."""
    try:
        return page.stat().st_mtime >= (results / "results.json").stat().st_mtime
    except OSError:
        return False
