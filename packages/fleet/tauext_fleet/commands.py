"""`tauext fleet`: many arms, on every core of a machine or of many."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from tauext.cli.arguments import AcceptArg, JsonArg, print_replaced
from tauext.cli.progress import Terminal
from tauext.config import TrainConfig, require_threads
from tauext.files.toml_file import write_template
from tauext_fleet.config import FleetConfig

# --- `tauext fleet prior`: what the data of several arms contributes to the next arm of their type.


def prior(
    arms: tyro.conf.Positional[tuple[str, ...]],
    out: Path,
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
    from tauext_fleet.prior import make_fleet_prior
    from tauext_fleet.prior_arms import fleet_arms
    from tauext_fleet.prior_content import table

    config = TrainConfig(recipe="prior", threads=threads)
    fleet = fleet_arms(arms)
    print_replaced(out)
    found = make_fleet_prior(fleet, out, config, accept, Terminal())
    print(table(dict(found.facts)))
    print(out)


# --- The command.


def run(
    fleet: tyro.conf.Positional[Path],
    out: Annotated[str, tyro.conf.arg(metavar="PATH|URL")],
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
            need the same paths for this folder and for the files of FLEET.toml, or URLs of an object store (s3://,
            gs://, abfs://) with the same keys in their environment.
        config: workers of the tasks.
        dry_run: print the tasks and their reasons without running them.
        as_json: print JSON lines, an object for each start and end of a task.
    """
    from tauext_fleet.book import plan_fleet
    from tauext_fleet.fleet_file import load_fleet
    from tauext_fleet.output import open_watcher, print_plan
    from tauext_fleet.run import run_fleet
    from tauext_fleet.store import Stored

    read, folder = load_fleet(fleet), Stored.of_url(out) if "://" in out else Path(out)
    if dry_run:
        print_plan(plan_fleet(read, folder), as_json)
        return 0
    with open_watcher(as_json) as watcher:
        try:
            end = run_fleet(read, folder, config, watcher)
        except KeyboardInterrupt:
            raise KeyboardInterrupt("finished tasks are kept; the same command continues with the rest") from None
    watcher.finish(end)
    return 1 if end.book.failures() else 0


def example(out: Path | None = None) -> None:
    """Print a commented FLEET.toml.

    Args:
        out: write it to this file instead; an existing file is refused.
    """
    from tauext_fleet.fleet_file import EXAMPLE

    if out is None:
        print(EXAMPLE, end="")
        return
    write_template(out, EXAMPLE)
    print(out)
