"""`tauext evaluate`: bundles on test free motion and on collisions."""

from __future__ import annotations

import re
import sys
from typing import Annotated

import tyro

from tauext.cli.place_argument import AcceptArg, PlaceArg
from tauext.config import CaseName, EventsConfig, require, require_seed, require_threads
from tauext.errors import ConfigError
from tauext.files.copies import staged
from tauext.files.room import expect_folder
from tauext.recipes import baselines as known_baselines

# --- The command as typed, for what it writes.


QUERY = re.compile(r"((?:^|[=:])(?:s3|gs|abfss?)://[^?]*)\?.*", re.I)


def command_line() -> str:
    """The command as typed, without the path of the program and the queries of URLs."""
    return " ".join(["tauext", *(QUERY.sub(r"\1", word) for word in sys.argv[1:])])


# --- The command.


METHODS = f"train and compare only these of the baselines: {', '.join(known_baselines())}."


def evaluate(
    data: PlaceArg,
    out: PlaceArg,
    bundles: tuple[PlaceArg, ...] = (),
    baselines: bool = False,
    methods: Annotated[tuple[str, ...], tyro.conf.arg(help=METHODS)] = (),
    case: CaseName | None = None,
    robot: PlaceArg | None = None,
    seed: int = 0,
    threads: int = 0,
    keep_free_estimates: int = 20,
    accept: AcceptArg = (),
    inject: bool = False,
    events: Annotated[EventsConfig, tyro.conf.arg(name="")] = EventsConfig(),  # noqa: B008
) -> None:
    """Errors and false alarms on test free motion, collisions found and delays, and the estimates behind them.

    Args:
        data: dataset folder; its test and collision recordings are used.
        out: results folder to write: results.json and estimates/; results that are there are replaced, and said to be.
        bundles: bundles (*.tauext) to compare, named in the results by their file names.
        baselines: also train every known method on the dataset, with limits for the same promise, into OUT/bundles, and
            compare them, beside detectors that know nothing; those that are there are used again.
        case: model case of the baselines, as in train.
        robot: URDF or MJCF of the baselines; default: the dataset's own.
        seed: seed of the baselines' training and of the choice of the ten collisions.
        threads: threads that train and estimate; 0: one a core. The result does not depend on it.
        keep_free_estimates: how many test recordings of free motion, the first ones, have their estimates written, for
            figures.
        accept: codes of findings that are no fault of the baselines' training data on your word, as of train.
        inject: add simulated hits, ramps and presses to the free test motion, at the end of each link and in random
            directions, and count what is detected of them; where no contacts were recorded, this shows what would be.
        events: how alarms are held against labels.
    """
    from tauext.cli.place_argument import tell_replaced
    from tauext.cli.progress import Terminal
    from tauext.data.dataset import load_dataset
    from tauext.evaluate.results_folder import evaluate_bundles

    require_seed(seed)
    require_threads(threads)
    require(keep_free_estimates >= 0, "keep_free_estimates", keep_free_estimates, ">= 0")
    expect_folder(out)
    for path in bundles:
        if not path.is_file():  # before baselines are trained for minutes
            raise ConfigError(f"{path}: there is no such bundle; `tauext train` makes one")
    if methods and not baselines:
        raise ConfigError("--methods chooses among the baselines; give --baselines, too")
    if not bundles and not baselines:
        raise ConfigError("there is nothing to evaluate: give --bundles, or --baselines to train every known method")
    tell_replaced(out / "results.json")
    dataset = load_dataset(data)
    with staged(out) as folder:
        paths = list(bundles)
        if baselines:
            from tauext.train.baselines import train_baselines

            own, kinds = folder / "bundles", methods or None
            trained = train_baselines(dataset, robot, case, own, seed, threads, kinds, (), Terminal(), accept)
            paths = [*trained.values(), *paths]
        names = [path.stem for path in paths]
        if len(set(names)) < len(names):
            raise ConfigError(f"bundles must differ in their file names, not only in their folders: {', '.join(names)}")
        named = dict(zip(names, paths, strict=True))
        evaluate_bundles(
            dataset,
            named,
            folder,
            seed,
            threads,
            command_line(),
            keep_free_estimates=keep_free_estimates,
            sanity=baselines,
            events=events,
            report=Terminal(),
            inject=inject,
        )
    print(out / "results.json")
