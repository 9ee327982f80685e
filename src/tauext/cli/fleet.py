"""`tauext fleet`: many arms, on every core of a machine or of many."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import tyro

from tauext.cli.place_argument import AcceptArg, JsonArg, PlaceArg, print_replaced
from tauext.cli.progress import Terminal
from tauext.config import FleetConfig, TrainConfig, require_threads
from tauext.errors import ConfigError, TauextError
from tauext.files.copies import local_folder, staged
from tauext.files.places import place_of
from tauext.files.preflight import expect_folder
from tauext.files.toml_file import write_template
from tauext.progress import Reporter

# --- `tauext fleet prior`: what the data of several arms contributes to the next arm of their type.


def prior(
    arms: tyro.conf.Positional[tuple[str, ...]],
    out: PlaceArg,
    threads: int = 0,
    accept: AcceptArg = (),
) -> None:
    """Fit a prior for the next arm of a type; `tauext train --like` needs only a minute of that arm's motion.

    The command prints each arm's friction relative to the fleet's, a row an arm. * marks values that differ from the
    other arms and count for less. An arm that `tauext train` would refuse is left out, with the reason.

    Args:
        arms: three arms or more, each a dataset folder, or BUNDLE.tauext:DATA with the bundle trained on it, whose
            terms are used instead of a new search.
        out: file to write, NAME.prior.json.
        threads: number of threads; 0: one a core. The result does not depend on it.
        accept: codes of faults to accept, at all joints or at one.
    """
    require_threads(threads)
    from tauext.fleet.prior import make_fleet_prior, table
    from tauext.fleet.prior_arms import fleet_arms

    config = TrainConfig(recipe="prior", threads=threads)
    fleet = fleet_arms(arms)
    print_replaced(out)
    found = make_fleet_prior(fleet, out, config, accept, Terminal())
    print(table(dict(found.facts)))
    print(out)


# --- `tauext fleet report`: one page of all arms, and beside it each arm's own.


ARM_PAGE_MB = 2.0
"""Largest size of an arm's own page; traces fill it."""


def report(
    fleets: tyro.conf.Positional[tuple[PlaceArg, ...]],
    out: PlaceArg,
    arm_pages: bool = True,
    as_json: JsonArg = False,
) -> None:
    """Draw one page of all arms: friction, ripple, limits, errors and promises, and which arm or joint stands out.

    Each arm is compared with its own first date and with the other arms of its type. The page names joints that wear,
    and arms with another tool or torque constant, with the probability of each. Dates come from FLEET.toml (date,
    serial), from the recordings' clocks, or from the order of the folders.

    Args:
        fleets: folders that `tauext fleet run` made, one or several: monday tuesday.
        out: folder to write: fleet.html, fleet-report.json with all numbers, arms/RUN/NAME/report.html of each arm.
        arm_pages: write each arm's own page, at its last date, where its results and recordings are there.
        as_json: print the content of fleet-report.json.
    """
    if not fleets:
        raise ConfigError("there is no fleet to report: give one folder or more that `tauext fleet run` made")
    from tauext.fleet.page import write_fleet_page
    from tauext.fleet.report import make_fleet_report

    terminal = Terminal()
    expect_folder(out)
    with staged(out) as folder:
        content = make_fleet_report(fleets, folder, terminal)
        if arm_pages:
            write_arm_pages(content, folder, terminal)
        page = out / write_fleet_page(content, folder).name
    if as_json:
        print(json.dumps(content, indent=1, allow_nan=False))
        return
    for line in lines(content):
        print(line)
    print(page)


def write_arm_pages(content: dict[str, Any], out: Path, reporter: Reporter) -> None:
    """Write the page of every arm at its last date; an arm that cannot be drawn is reported and skipped."""
    from tauext.fleet.page import arm_folder, is_newer
    from tauext.report.page import write_report

    drawn = [(arm["visits"][-1], places) for arm in content["arms"] if (places := arm["visits"][-1].get("places"))]
    with reporter.progress("pages of the arms") as show:
        for done, (visit, places) in enumerate(drawn):
            folder = out / arm_folder(visit["run"], visit["name"])
            results, dataset = (place_of(places[key]) for key in ("results", "dataset"))
            if not is_newer(folder / "report.html", results):
                try:
                    write_report(local_folder(results), dataset, folder, ARM_PAGE_MB)
                except TauextError as error:
                    reporter.say(f"{visit['name']}: its own page cannot be drawn: {error}")
            show(done + 1, len(drawn), visit["name"])


def lines(content: dict[str, Any]) -> list[str]:
    """Lines about the named arms, then about the failed ones."""
    found = []
    for one in content["named"]:
        where = f"{one['arm']} {one['joint']}" if one["joint"] else one["arm"]
        found.append(f"{where}: {one['kind']}, {100 * one['probability']:.0f} %: {one['words']}")
    for arm in content["arms"]:
        for visit in arm["visits"]:
            if visit["state"] != "done":
                found.append(f"{arm['serial']}: {visit['stage'] or visit['state']}: {visit['reason']}")
    return found or ["no arm stands out, and none failed"]


# --- The command.


def run(
    fleet: tyro.conf.Positional[PlaceArg],
    out: PlaceArg,
    config: Annotated[FleetConfig, tyro.conf.arg(name="")] = FleetConfig(),  # noqa: B008
    dry_run: bool = False,
    as_json: JsonArg = False,
) -> int:
    """Import, check, train, calibrate and evaluate every arm of a fleet; finished tasks are not repeated.

    Each stage of each arm is a task of one thread, identified by the hash of its inputs: file contents, settings,
    version. An arm that fails does not stop the others; its reason is reported. After Ctrl-C, a killed worker or a lost
    node, run the same command again: only the running tasks are repeated. A changed setting or file repeats the tasks
    that depend on it. The output has the same bytes for any number of workers, except wall times.

    Exit status: 0 all arms are done, 1 an arm failed, 2 bad input.

    Args:
        fleet: FLEET.toml: arms, files, settings; `tauext fleet example` prints one.
        out: folder to write: arms/NAME/STAGE, and fleet.json with the state of all tasks. Workers on other machines
            need the same paths for this folder and for the files of FLEET.toml, or URLs with the same keys in their
            environment.
        config: workers of the tasks.
        dry_run: print the tasks and their reasons without running them.
        as_json: print JSON lines, an object for each start and end of a task.
    """
    from tauext.cli.fleet_output import open_watcher, print_plan
    from tauext.fleet.book import plan_fleet
    from tauext.fleet.fleet_file import load_fleet
    from tauext.fleet.run import run_fleet

    read = load_fleet(fleet)
    if dry_run:
        print_plan(plan_fleet(read, out), as_json)
        return 0
    with open_watcher(as_json) as watcher:
        try:
            end = run_fleet(read, out, config, watcher)
        except KeyboardInterrupt:
            raise KeyboardInterrupt("finished tasks are kept; the same command continues with the rest") from None
    watcher.finish(end)
    return 1 if end.book.failures() else 0


def example(out: Path | None = None) -> None:
    """Print a commented FLEET.toml.

    Args:
        out: write it to this file instead; an existing file is refused.
    """
    from tauext.fleet.fleet_file import EXAMPLE

    if out is None:
        print(EXAMPLE, end="")
        return
    write_template(out, EXAMPLE)
    print(out)
