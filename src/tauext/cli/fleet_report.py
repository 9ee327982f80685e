"""`tauext fleet report`: one page of all arms, and beside it each arm's own."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from tauext.cli.place_argument import PlaceArg
from tauext.config import require
from tauext.errors import ConfigError
from tauext.files.fetching import local_folder
from tauext.files.place import place_of
from tauext.files.staging import staged

if TYPE_CHECKING:
    from tauext.progress import Reporter


def report(
    fleets: tyro.conf.Positional[tuple[PlaceArg, ...]],
    out: PlaceArg,
    arm_pages: bool = True,
    arm_page_mb: float = 2.0,
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> None:
    """Draw one page of all arms: friction, ripple, limits, errors and promises, and which arm or joint stands out.

    Each arm is held against its own first date and against the other arms of its type: which joint is wearing, which
    arm has another tool or torque constant, with the probability that it is so. Dates are those of FLEET.toml (date,
    serial), or of the recordings' clocks, or the order of the folders.

    Args:
        fleets: folders that `tauext fleet run` made, one or several: monday tuesday.
        out: folder to write: fleet.html, fleet-report.json with all numbers, arms/RUN/NAME/report.html of each arm.
        arm_pages: write each arm's own page, at its last date, where its results and recordings are there.
        arm_page_mb: largest size of an arm's own page, [MB]; traces fill it.
        as_json: print the content of fleet-report.json.
    """
    require(0 <= arm_page_mb <= 1000, "arm_page_mb", arm_page_mb, "0 to 1000")
    if not fleets:
        raise ConfigError("there is no fleet to report: give one folder or more that `tauext fleet run` made")
    from tauext.cli.reporter import Terminal
    from tauext.files.room import expect_folder
    from tauext.fleet.fleet_report_stage import make_fleet_report
    from tauext.fleet.fleet_write import write_fleet_page

    terminal = Terminal()
    expect_folder(out)
    with staged(out) as folder:
        content = make_fleet_report(fleets, folder, terminal)
        if arm_pages:
            write_arm_pages(content, folder, arm_page_mb, terminal)
        page = out / write_fleet_page(content, folder).name
    if as_json:
        print(json.dumps(content, indent=1, allow_nan=False))
        return
    for line in lines(content):
        print(line)
    print(page)


def write_arm_pages(content: dict[str, Any], out: Path, page_mb: float, reporter: Reporter) -> None:
    """Of every arm at its last date; one that cannot be drawn is told, and the others are."""
    from tauext.errors import TauextError
    from tauext.fleet.fleet_write import arm_folder, is_newer
    from tauext.report.write import write_report

    drawn = [(arm["visits"][-1], places) for arm in content["arms"] if (places := arm["visits"][-1].get("places"))]
    with reporter.progress("pages of the arms") as show:
        for done, (visit, places) in enumerate(drawn):
            folder = out / arm_folder(visit["run"], visit["name"])
            results, dataset = (place_of(places[key]) for key in ("results", "dataset"))
            if not is_newer(folder / "report.html", results):
                try:
                    write_report(local_folder(results), dataset, folder, page_mb)
                except TauextError as error:
                    reporter.say(f"{visit['name']}: its own page cannot be drawn: {error}")
            show(done + 1, len(drawn), visit["name"])


def lines(content: dict[str, Any]) -> list[str]:
    """What is named, then what failed."""
    found = []
    for one in content["named"]:
        where = f"{one['arm']} {one['joint']}" if one["joint"] else one["arm"]
        found.append(f"{where}: {one['kind']}, {100 * one['probability']:.0f} %: {one['words']}")
    for arm in content["arms"]:
        for visit in arm["visits"]:
            if visit["state"] != "done":
                found.append(f"{arm['serial']}: {visit['stage'] or visit['state']}: {visit['reason']}")
    return found or ["no arm stands out, and none failed"]
