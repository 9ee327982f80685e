"""`tauext simulate`, `evaluate`, `report` and `bench`: datasets of the rig, results of methods, and pages of them."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro

from tauext.cli.arguments import AcceptArg, print_replaced
from tauext.cli.commands import folders_like, loaded
from tauext.cli.progress import ProgressBar, Terminal
from tauext.config import CaseName, require, require_seed, require_threads
from tauext.errors import ConfigError
from tauext.files.kind import why_no_bundle
from tauext.files.preflight import expect_folder
from tauext.recipes import baselines as known_baselines
from tauext_lab.evaluate.config import OTHER_METHODS, EventsConfig

# --- The command as typed, for what it writes.


def command_line() -> str:
    """The command as typed, without the path of the program."""
    return " ".join(["tauext", *sys.argv[1:]])


# --- `tauext simulate`: a dataset from the virtual rig.


def simulate(
    out: Path,
    minutes: float = 90.0,
    collision_recordings: int = 10,
    seed: int = 0,
    calibration_hours: float = 0.0,
    test_hours: float = 0.0,
    encoder_bits: int = 17,
    friction: float = 1.0,
) -> None:
    """Simulate the rig, a model of the paper's arm: free motion and collisions, recorded at 1 kHz.

    Args:
        out: dataset folder to write: recordings, robot.xml, split.json.
        minutes: minutes of free motion in all, cut into at least 20 recordings of at most 90 s.
        collision_recordings: number of recordings with about ten collisions each.
        seed: seed of motions, noise and collisions.
        calibration_hours: additional hours of free motion, for thresholds alone; 24 prove 1 false alarm in 8 hours.
        test_hours: additional hours of free motion, to test on.
        encoder_bits: resolution of the joint encoders, as a power of two: counts in one turn.
        friction: factor on Coulomb, static and viscous friction of every joint.
    """
    from tauext_lab.sim.collect import simulate_dataset
    from tauext_lab.sim.config import changed_rig

    require(0 < minutes < math.inf, "minutes", minutes, "> 0")
    require(0 <= calibration_hours < math.inf, "calibration_hours", calibration_hours, ">= 0")
    require(0 <= test_hours < math.inf, "test_hours", test_hours, ">= 0")
    require_seed(seed)
    require(collision_recordings >= 0, "collision_recordings", collision_recordings, ">= 0")
    require(12 <= encoder_bits <= 24, "encoder_bits", encoder_bits, "12 to 24")
    require(0.1 <= friction <= 10, "friction", friction, "0.1 to 10")
    with ProgressBar("simulate") as bar:
        simulate_dataset(
            out,
            changed_rig(encoder_bits, friction),
            seed,
            minutes,
            collision_recordings,
            lambda what, done, total: bar.update(done, total, what),
            calibration_hours,
            test_hours,
        )
    print(out)


# --- `tauext evaluate`: bundles on test free motion and on collisions.


METHODS = (
    f"methods of --baselines to train and compare; default all: {', '.join(known_baselines())}. Only where named: "
    f"{', '.join(OTHER_METHODS)}, which need commanded positions and are compared with labels alone."
)


def evaluate(
    data: Path,
    out: Path,
    bundles: tuple[Path, ...] = (),
    baselines: bool = False,
    methods: Annotated[tuple[str, ...], tyro.conf.arg(help=METHODS)] = (),
    case: CaseName | None = None,
    robot: Path | None = None,
    seed: int = 0,
    threads: int = 0,
    keep_free_estimates: int = 20,
    accept: AcceptArg = (),
    inject: bool = False,
    events: Annotated[EventsConfig, tyro.conf.arg(name="")] = EventsConfig(),  # noqa: B008
) -> None:
    """Measure bundles on a dataset: errors and false alarms in free motion, detected collisions and delays.

    Args:
        data: dataset folder; its test and collision recordings are used.
        out: results folder to write: results.json and estimates/; existing results are replaced, and named on stderr.
        bundles: bundles (*.tauext) to compare; the results name them by their file names.
        baselines: also train every known method on the dataset into OUT/bundles, with thresholds for the same target
            false alarm rate, and compare them and trivial detectors; existing bundles are used again.
        case: model case of the baselines, as in train.
        robot: URDF or MJCF of the baselines; default: the dataset's own.
        seed: seed of the baselines' training and of the choice of the ten collisions.
        threads: threads that train and estimate; 0: one a core. The result does not depend on it.
        keep_free_estimates: number of free test recordings, from the first one, whose estimates are written for
            figures.
        accept: codes of faults to accept in the training data of the baselines, as in train.
        inject: add simulated hits, ramps and presses to the free test motion, at the end of each link in random
            directions, and count how many are detected; useful where no contacts were recorded.
        events: rules that match alarms with labels.
    """
    from tauext.data.dataset import load_dataset
    from tauext_lab.evaluate.results_folder import evaluate_bundles

    require_seed(seed)
    require_threads(threads)
    require(keep_free_estimates >= 0, "keep_free_estimates", keep_free_estimates, ">= 0")
    expect_folder(out)
    expect_something(bundles, baselines, methods)
    print_replaced(out / "results.json")
    dataset = load_dataset(data)
    paths = list(bundles)
    if baselines:
        from tauext_lab.baselines import train_baselines

        own, kinds = out / "bundles", [name for name in methods if name not in OTHER_METHODS] if methods else None
        trained = train_baselines(dataset, robot, case, own, seed, threads, kinds, (), Terminal(), accept)
        paths = [*trained.values(), *paths]
    others = {}
    if named := [name for name in methods if name in OTHER_METHODS]:
        from tauext_lab.other_methods import train_other_methods

        others = train_other_methods(named, dataset.training(), seed, Terminal())
    evaluate_bundles(
        dataset, by_names(paths), out, seed, threads, command_line(), keep_free_estimates=keep_free_estimates,
        sanity=baselines, events=events, report=Terminal(), inject=inject, others=others,
    )  # fmt: skip
    print(out / "results.json")


def expect_something(bundles: Sequence[Path], baselines: bool, methods: Sequence[str]) -> None:
    """Raise ConfigError unless there is something to evaluate; before baselines are trained for minutes."""
    for path in bundles:
        if not path.is_file():
            raise ConfigError(f"{path}: {why_no_bundle(path) or 'is no file'}")
    if methods and not baselines:
        raise ConfigError("--methods chooses among the baselines; give --baselines, too")
    if not bundles and not baselines:
        raise ConfigError("there is nothing to evaluate: give --bundles, or --baselines to train every known method")


def by_names(paths: Sequence[Path]) -> dict[str, Path]:
    """Bundles by their file names.

    Raises:
        ConfigError: two have the same.
    """
    names = [path.stem for path in paths]
    if len(set(names)) < len(names):
        raise ConfigError(f"bundles must differ in their file names, not only in their folders: {', '.join(names)}")
    return dict(zip(names, paths, strict=True))


# --- `tauext report`: figures and one self-contained page from results, or of one flight.


def report(
    folders: tyro.conf.Positional[tuple[Path, ...]] = (),
    *,
    out: Path,
    results: Path | None = None,
    data: Path | None = None,
    flight: Path | None = None,
    page_mb: float = 9.5,
    trace_methods: tuple[str, ...] = (),
) -> None:
    """Draw Table I and the paper's figures from results, or one event log: an HTML page and PNG figures.

    Give --results and --data, or --flight. The page holds traces that can be zoomed; it is one file and needs no
    network. Or give a folder of `tauext commission` for a page of its history, or several for one table of the arms.

    Args:
        folders: folder of `tauext commission`, whose history is drawn; of several, a table is printed and drawn.
        out: folder to write the page and its figures to; an existing page is replaced, and named on stderr.
        results: results folder to draw, made by `tauext evaluate`.
        data: dataset folder that was evaluated.
        flight: event log to draw (LOG.parquet, `tauext run --flights` writes them), or a folder of them: each
            gets a page, and index.html lists them.
        page_mb: largest size of the page, [MB]; traces take the space that is left. 0: no traces.
        trace_methods: names of the bundles whose traces the page holds; default: the best five.
    """
    from tauext.data.dataset import load_dataset
    from tauext_lab.report.page import write_report

    if folders:
        if results is not None or data is not None or flight is not None or trace_methods:
            raise ConfigError(f"give either {folders[0]}, or --results and --data, or --flight; not both")
        if (made := folders_like(folders[0])) is None:
            raise ConfigError(
                f"{folders[0]}: is no folder of `tauext commission`; for results give --results and --data"
            )
        loaded(made.report)(folders, out)
        return
    if flight is not None:
        if results is not None or data is not None:
            raise ConfigError("give either --results and --data, or --flight; not both")
        if trace_methods:
            raise ConfigError("--trace-methods chooses among the methods of --results; an event log has one")
        report_flight(flight, out, page_mb)
    elif results is not None and data is not None:
        print_replaced(out / "report.html")
        print(write_report(results, load_dataset(data).folder, out, page_mb, trace_methods))
    else:
        missing = "--results" if results is None else "--data"
        raise ConfigError(
            f"{missing} is missing: give --results and --data for a report of results, --flight for one event log, or "
            "a folder of `tauext commission`"
        )


def report_flight(flight: Path, out: Path, page_mb: float) -> None:
    """Draw a flight, or each one of a folder and the page that lists them."""
    from tauext_lab.report.flight import write_flight_report, write_flights_report

    there = {page.name for page in out.glob("*.html")}
    if flight.is_dir():
        with Terminal().progress("draw the event logs") as show:
            page = write_flights_report(flight, out, page_mb, show)
    else:
        page = write_flight_report(flight, out, page_mb)
    if page.name in there:
        print(f"tauext: {page} was there already and is replaced", file=sys.stderr)
    print(page)


# --- `tauext bench`: methods of anybody's on tracks.


def bench(
    method: tuple[str, ...],
    out: Path,
    track: tuple[Path, ...] = (),
    data: Path | None = None,
    false_alarms_per_hour: float = 1.0,
    case: CaseName | None = None,
    seed: int = 0,
    threads: int = 0,
) -> None:
    """Compare methods of collision detection on tracks, at equal measured false alarms an hour.

    Writes OUT/bench.json and the page OUT/bench.html. What is finished is kept: the same command continues after an
    interruption. A track or method that cannot be run is named with its reason, and the others are run.

    Args:
        method: recipes and methods of `tauext evaluate --baselines`, those with a network also in fewer steps
            (dense@10000); FILE.py:FUNCTION of a function fit(recordings) that returns an estimator of a recording's
            tau_ext; or estimates in a CSV or Parquet file.
        out: folder to write; results in it are continued.
        track: folders with a track.toml, or names of the package's tracks: lugre, maxwell-slip and belt (simulated),
            mocca, panda-touches, ur3, so101-stalls; default: all of these.
        data: folder that holds the tracks' files at any depth; those that it lacks are fetched by git.
        false_alarms_per_hour: measured rate of false alarms at which methods are compared.
        case: model case of recipes, as in train.
        seed: seed of trainings.
        threads: threads that train and estimate; 0: one a core. The result does not depend on it.
    """
    from tauext_lab.bench.run import Settings, run_bench

    require_seed(seed)
    require_threads(threads)
    require(0 <= false_alarms_per_hour <= 120, "false_alarms_per_hour", false_alarms_per_hour, "0 to 120")
    expect_folder(out)
    print_replaced(out / "bench.html")
    settings = Settings(false_alarms_per_hour, case, seed, threads)
    run_bench(track, method, out, data, settings, Terminal(), command_line())
    print(out / "bench.html")
