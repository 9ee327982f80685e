"""fleet-report.json: everything that the page of a fleet shows, from the folders that `tauext fleet run` made."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tauext.errors import TauextError
from tauext.files.places import Place
from tauext.files.plain_file import FORMAT
from tauext.files.provenance import VERSION, write_json
from tauext.fleet.compare import GroupNumbers, compare
from tauext.fleet.visits import SPEED_RAD_S, BundleFacts, Visit, named_of, read_bundle, visit_facts, visits_of
from tauext.progress import SILENT, Reporter

FILE = "fleet-report.json"
TABLES = ("friction", "constant", "tool")


def make_fleet_report(fleets: Sequence[Place], out: Path, report: Reporter = SILENT) -> dict[str, Any]:
    """Write the report of these fleets to FILE in `out`; returns its content.

    Args:
        fleets: folders of `tauext fleet run`, in the order of their dates.

    Raises:
        ConfigError: a folder is none of `tauext fleet run`, or nothing can be written.
    """
    visits = visits_of(fleets)
    facts: dict[Visit, BundleFacts] = {}
    broken: dict[Visit, str] = {}
    with report.progress("bundles of the fleet") as show:
        for done, visit in enumerate(visits):
            if visit.bundle is not None:
                try:
                    facts[visit] = read_bundle(visit.bundle)
                except (TauextError, ValueError, TypeError, KeyError) as error:
                    broken[visit] = " ".join(str(error).split())
            show(done + 1, len(visits), visit.name)
    arms: dict[str, dict[str, Any]] = {
        visit.serial: {"serial": visit.serial, "type": visit.type, "state": "", "visits": []} for visit in visits
    }
    groups, named, entries = [], [], dict[Visit, dict[str, Any]]()
    for kind, members in grouped(facts).items():
        serials = [visit.serial for visit in members]
        numbers = compare([facts[visit] for visit in members], serials, date_numbers(members))
        groups.append(group_facts(kind, members, facts[members[0]], numbers))
        for k, visit in enumerate(members):
            entries[visit] = visit_facts(visit, facts[visit], numbers.friction_nm[k], "")
            entries[visit] |= compared_facts(numbers, k, members) | {"group": len(groups) - 1}
            if visit.serial not in serials[k + 1 :]:
                centres = {name: table["centre"] for name, table in groups[-1]["tables"].items()}
                named += named_of(visit.serial, facts[visit].joints, entries[visit], centres)
    for visit in visits:
        one = entries.get(visit) or visit_facts(visit, None, None, broken.get(visit, ""))
        arms[visit.serial]["visits"].append(one)
        arms[visit.serial]["state"] = one["state"]
    content = {
        "format": FORMAT,
        "version": VERSION,
        "command": "tauext fleet report",
        "fleets": [str(fleet) for fleet in fleets],
        "speed_rad_s": SPEED_RAD_S,
        "groups": groups,
        "named": sorted(named, key=lambda one: (one["against"] != "own", -one["probability"], one["arm"])),
        "arms": [arms[serial] for serial in sorted(arms)],
    }
    write_json(content, out / FILE)
    return content


def grouped(facts: dict[Visit, BundleFacts]) -> dict[tuple, list[Visit]]:
    """Visits whose arms can be compared: one type, the same joints and units; in the order given."""
    groups: dict[tuple, list[Visit]] = {}
    for visit, one in facts.items():
        groups.setdefault((visit.type, one.joints, one.units), []).append(visit)
    return groups


def date_numbers(members: Sequence[Visit]) -> list[int]:
    """0 for an arm's first date; of later ones a number for each fleet folder, and for each date within one."""
    seen: dict[str, int] = {}
    in_run: dict[tuple[str, int], int] = {}
    keys: list[tuple[int, int] | None] = []
    for visit in members:
        first = visit.serial not in seen
        seen[visit.serial] = 1
        place = in_run[visit.serial, visit.run] = in_run.get((visit.serial, visit.run), -1) + 1
        keys.append(None if first else (visit.run, place))
    numbers = {key: k for k, key in enumerate(sorted({key for key in keys if key is not None}), 1)}
    return [0 if key is None else numbers[key] for key in keys]


def compared_facts(numbers: GroupNumbers, k: int, members: Sequence[Visit]) -> dict[str, Any]:
    """The rows of one visit in all tables."""
    found: dict[str, Any] = {"fleet": {}, "own": {}}
    for name, table in numbers.tables.items():
        row = table.at(k)
        if row is not None:
            against, what = name.split()[:2]
            found[against][what] = row
    if found["own"]:
        first = next(visit for visit in members if visit.serial == members[k].serial)
        found["own"]["since"] = first.date or f"run {first.run + 1}"
        found["own"]["number"] = number_of(numbers, k)
    return {key: value or None for key, value in found.items()}


def number_of(numbers: GroupNumbers, k: int) -> int:
    """Number of a later visit's date in the names of its tables."""
    return next(int(name.split()[2]) for name, table in numbers.tables.items() if name[:3] == "own" and k in table.rows)


def group_facts(kind: tuple, members: Sequence[Visit], facts: BundleFacts, numbers: GroupNumbers) -> dict[str, Any]:
    """Common properties of the arms of a group."""
    tables = {name: content for name, table in numbers.tables.items() if (content := table.facts()) is not None}
    return {
        "type": kind[0],
        "joints": list(facts.joints),
        "units": list(facts.units),
        "arms": len({visit.serial for visit in members}),
        "tables": tables,
    }
