"""`tauext fleet`: many arms, on every core of a machine or of many."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from tauext.cli.fleet_prior import prior
from tauext.cli.fleet_report import report
from tauext.cli.parsing import deferred
from tauext.cli.place_argument import PlaceArg
from tauext.config import FleetConfig


def run(
    fleet: tyro.conf.Positional[PlaceArg],
    out: PlaceArg,
    config: Annotated[FleetConfig, tyro.conf.arg(name="")] = FleetConfig(),  # noqa: B008
    dry_run: bool = False,
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> int:
    """Import, check, train, calibrate and evaluate every arm of a fleet; what is done is not done again.

    Each stage of each arm is a task of one thread, known by the hash of its inputs: contents of files, settings,
    version. An arm that fails does so alone, with its reason. Ctrl-C, a killed worker or a lost node cost the tasks
    that ran; the same command goes on with what is left, and a changed setting or file does again what depends on it.
    The same command writes the same bytes for any number of workers, wall times apart.

    Exit status: 0 all arms are done, 1 an arm failed, 2 bad input.

    Args:
        fleet: FLEET.toml: arms, files, settings; `tauext fleet example` prints one.
        out: folder to write: arms/NAME/STAGE, and fleet.json with the state of all. Workers on other machines must find
            it, and what FLEET.toml names, under the same paths, or URLs with the same keys in their environment.
        config: who works.
        dry_run: say what would be done, and why, and do nothing.
        as_json: print JSON lines, an object a task that begins or ends.
    """
    from tauext.cli.fleet_output import open_watcher, tell_plan
    from tauext.fleet.fleet_file import load_fleet
    from tauext.fleet.plan import plan_fleet
    from tauext.fleet.run import run_fleet

    read = load_fleet(fleet)
    if dry_run:
        tell_plan(plan_fleet(read, out), as_json)
        return 0
    with open_watcher(as_json) as watcher:
        try:
            end = run_fleet(read, out, config, watcher)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(
                "tasks that had ended are kept, and the same command goes on with the rest"
            ) from None
    watcher.finish(end)
    return 1 if end.book.failures() else 0


def example(out: Path | None = None) -> None:
    """Print a FLEET.toml with comments, to begin with.

    Args:
        out: file to write it to instead; one that is there is left as it is, and that is an error.
    """
    from tauext.fleet.example import EXAMPLE

    if out is None:
        print(EXAMPLE, end="")
        return
    from tauext.files.toml_file import write_template

    write_template(out, EXAMPLE)
    print(out)


HELP = "Many arms: all stages of every arm, on many cores; what they tell of the next one, and of each other."


def fleet_app() -> tyro.extras.SubcommandApp:
    """`tauext fleet VERB`."""
    app = tyro.extras.SubcommandApp()
    for command in (run, example, prior, report):
        app.command(deferred(command))
    return app
