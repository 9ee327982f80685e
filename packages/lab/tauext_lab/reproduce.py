"""`tauext reproduce`: the paper's experiment in its five steps, at three scales."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Literal

from tauext.cli.arguments import print_replaced
from tauext.cli.progress import Terminal
from tauext.config import PAPER_CASES, CaseName, ModelCase, TrainConfig, require_seed
from tauext.files.preflight import expect_folder
from tauext.progress import SILENT, Reporter, Show, WallTimes
from tauext_lab.commands import command_line

if TYPE_CHECKING:
    from tauext.data.dataset import Dataset


@dataclass(frozen=True)
class Beside:
    """Bundles beside those of every case: what the same data gives by another recipe; named CASE-RECIPE."""

    training: TrainConfig
    cases: tuple[str, ...]


@dataclass(frozen=True)
class Scale:
    """How much data and how many steps: never a time limit, so the result is the same on a slow machine."""

    minutes: float
    """Free motion in all."""
    collision_recordings: int
    """Recordings with about ten collisions each."""
    training: TrainConfig
    """How every model case is trained."""
    beside: Beside | None = None


SCALES = {
    "smoke": Scale(
        minutes=2.0, collision_recordings=1, training=TrainConfig(recipe="paper", epochs=1, batch=64, max_steps=20)
    ),
    "quick": Scale(
        minutes=45.0,
        collision_recordings=20,
        training=TrainConfig(recipe="dense", max_steps=20_000),
        # Minutes of motion are all that it needs, and its fit takes as long as what it is fitted to.
        beside=Beside(TrainConfig(minutes=10.0), ("exact",)),
    ),
    "full": Scale(
        minutes=90.0,
        collision_recordings=20,
        training=TrainConfig(recipe="dense"),
        beside=Beside(TrainConfig(recipe="paper"), tuple(PAPER_CASES)),
    ),
}


def trainings(scale: Scale, cases: Sequence[str], seed: int) -> dict[str, tuple[ModelCase, TrainConfig]]:
    """Trainings by the names of their bundles: every case, then those by another recipe, one after the other."""
    jobs = {case: (PAPER_CASES[case], replace(scale.training, seed=seed)) for case in cases}
    if scale.beside is not None:
        other = replace(scale.beside.training, seed=seed)
        chosen = [case for case in scale.beside.cases if case in cases]
        jobs |= {f"{case}-{other.recipe}": (PAPER_CASES[case], other) for case in chosen}
    return jobs


def reproduce_paper(
    out: Path,
    scale_name: str,
    scale: Scale,
    cases: Sequence[str],
    seed: int,
    command: str,
    report: Reporter = SILENT,
) -> Path:
    """Simulate, train, evaluate, report; returns the report. What is done with these settings is not repeated.

    Trainings run at the same time, one a core; no result depends on it. The wall time of each phase is reported and
    written to wall_time_s.json, that of a training by its own reports and files.

    Args:
        command: what is run, for the report.
        report: receives the progress.
    """
    from tauext.data.dataset import load_dataset
    from tauext.files.provenance import write_json
    from tauext_lab.baselines import finished
    from tauext_lab.evaluate.results_folder import evaluate_bundles
    from tauext_lab.report.page import write_report
    from tauext_lab.sim.collect import simulate_dataset
    from tauext_lab.sim.config import RigConfig

    data, times = out / "data", WallTimes()
    with times.phase("simulate"), report.progress("simulate") as show:
        simulate_dataset(
            data,
            RigConfig(),
            seed,
            scale.minutes,
            scale.collision_recordings,
            lambda what, done, total: show(done, total, what),
        )
    dataset = load_dataset(data)
    jobs = trainings(scale, cases, seed)
    bundles = {name: out / "bundles" / f"{name}.tauext" for name in jobs}
    missing = {name: job for name, job in jobs.items() if not finished(bundles[name], *job)}
    if missing:
        train_missing(dataset, missing, bundles, times, report)
    with times.phase("evaluate"):
        evaluate_bundles(dataset, bundles, out / "results", seed, 0, command, scale_name, report=report)
    with times.phase("report"):
        page = write_report(out / "results", data, out / "report")
    write_json(times.facts(), out / "wall_time_s.json")
    report.say(times.sentence())
    return page


def train_missing(
    dataset: Dataset,
    jobs: Mapping[str, tuple[ModelCase, TrainConfig]],
    bundles: Mapping[str, Path],
    times: WallTimes,
    report: Reporter,
) -> None:
    """Read and check the data, then train all of these at the same time."""
    from tauext.train.data_check import check_data
    from tauext.train.preparation import TrainingInput
    from tauext.train.stage import train_on_recordings

    robot = dataset.robot_file(None)
    with times.phase("read"):
        training, validation = dataset.recordings("train"), dataset.recordings("validation")
    # One check for all cases with a model, and one without: findings about the model are not those of both.
    kinds = {case.no_model: (case, config) for case, config in jobs.values()}
    with times.phase("check"):
        checked = {
            no_model: check_data(dataset, TrainingInput(robot, case, training, validation), config, (), report)
            for no_model, (case, config) in kinds.items()
        }
    cores = os.cpu_count() or 1
    threads = max(1, cores // len(jobs))

    def train(name: str, report: Reporter) -> None:
        case, config = jobs[name]
        given = TrainingInput(robot, case, training, validation)
        settings, found = replace(config, threads=threads), checked[case.no_model]
        train_on_recordings(given, settings, bundles[name], report=report, checked=found)

    with times.phase("train"):
        together(train, list(jobs), min(cores, len(jobs)), report)


# --- Trainings at the same time: a step of one network is too short to be worth several threads.


class Together:
    """Reporter of trainings in several threads: one bar for all of them, and a way to stop them.

    Args:
        trainings: how many there are.
    """

    def __init__(self, report: Reporter, show: Show, trainings: int):
        self._report, self._show, self._trainings = report, show, trainings
        self._lock = Lock()
        self.stopped_by: BaseException | None = None
        self._done: dict[str, float] = {}

    def stop(self, reason: BaseException) -> None:
        """Interrupt every training at its next report, so that it writes its checkpoint; the first reason counts."""
        with self._lock:
            self.stopped_by = self.stopped_by or reason

    def expect_running(self) -> None:
        """Raise KeyboardInterrupt if the trainings are to stop."""
        if self.stopped_by is not None:
            raise KeyboardInterrupt

    def say(self, sentence: str) -> None:
        self.expect_running()
        with self._lock:
            self._report.say(sentence)

    @contextmanager
    def progress(self, title: str) -> Iterator[Show]:
        def show(done: int, total: int, note: str) -> None:
            self.expect_running()
            if title.startswith("train "):
                with self._lock:
                    self._done[title] = done / total
                    percent = round(100 * sum(self._done.values()))
                    self._show(percent, 100 * self._trainings, f"% ({title.removeprefix('train ')}: {note})")

        yield show


def together(train: Callable[[str, Reporter], None], names: Sequence[str], workers: int, report: Reporter) -> None:
    """Call train for every name, so many at a time. The first error, or Ctrl-C, stops all and is raised."""
    with report.progress("train") as show, ThreadPoolExecutor(workers) as pool:
        reporter = Together(report, show, len(names))

        def run(name: str) -> None:
            reporter.expect_running()
            try:
                train(name, reporter)
            except BaseException as error:
                reporter.stop(error)
                raise

        futures = [pool.submit(run, name) for name in names]
        try:
            for future in as_completed(futures):
                future.result()
        except BaseException as error:
            reporter.stop(error)
    if reporter.stopped_by is not None:
        raise reporter.stopped_by


# --- The command.


def reproduce(
    out: Path,
    scale: Literal["smoke", "quick", "full"] = "quick",
    cases: tuple[CaseName, ...] = ("exact", "mass", "com", "mass+com", "none"),
    seed: int = 0,
) -> None:
    """Simulate, train five models, evaluate and report: the paper's experiment in one command.

    After an interruption, the same command continues; finished steps are kept. Existing results and an existing report
    are replaced, and named on stderr.

    Args:
        out: folder for data, bundles, results and report.
        scale: amount of data and training. smoke: seconds; the numbers have no meaning. quick: three minutes on two
            cores; every model case with 20,000 steps of recipe dense, the exact model also with recipe prior from 10
            minutes of motion. full: every model case with recipe dense (5 minutes), then with recipe paper (15
            minutes each on two idle cores, one after another).
        cases: model cases to train.
        seed: seed of all random numbers.
    """
    require_seed(seed)
    expect_folder(out)
    print_replaced(out / "results" / "results.json", out / "report" / "report.html")
    page = reproduce_paper(out, scale, SCALES[scale], cases, seed, command_line(), Terminal())
    print(page)
