"""`tauext evaluate`: bundles on test free motion and on collisions."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import tyro

from tauext.cli.dataset import Dataset
from tauext.cli.model_case import CaseName
from tauext.config import EventsConfig
from tauext.errors import ConfigError


def evaluate(
    data: Path,
    out: Path,
    bundles: tuple[Path, ...] = (),
    baselines: bool = False,
    methods: tuple[str, ...] = (),
    case: CaseName | None = None,
    robot: Path | None = None,
    seed: int = 0,
    threads: int = 0,
    keep_free_estimates: int = 20,
    events: Annotated[EventsConfig, tyro.conf.arg(name="")] = EventsConfig(),  # noqa: B008
) -> None:
    """Errors and false alarms on test free motion, collisions found and delays, and the estimates behind them.

    Args:
        data: dataset folder; its test and collision recordings are used.
        out: results folder to write: results.json and estimates/.
        bundles: bundles (*.tauext) to compare, named in the results by their file names.
        baselines: also train every known method on the dataset, with limits for the same promise, into OUT/bundles, and
            compare them; those that are there are used again. Beside them detectors that know nothing.
        methods: of the baselines these alone: observer, friction, highpass, bandpass, velocity, energy, direct,
            feedforward, paper-lstm, prior, tauext.
        case: estimated model of the baselines, as in train.
        robot: URDF or MJCF of the baselines; default: the dataset's own.
        seed: of the baselines' training and of the choice of the ten collisions.
        threads: 0: one a core. The result does not depend on it.
        keep_free_estimates: write the estimates of so many test recordings of free motion, the first, for figures.
        events: how alarms are held against labels.
    """
    for path in bundles:
        if not path.is_file():
            raise ConfigError(f"{path}: there is no such bundle; `tauext train` makes one")
    if methods and not baselines:
        raise ConfigError("--methods chooses among the baselines; give --baselines, too")
    if not bundles and not baselines:
        raise ConfigError("there is nothing to evaluate: give --bundles, or --baselines to train every known method")
    dataset = Dataset.open(data)
    paths = list(bundles)
    if baselines:
        from tauext.cli.baselines import train_baselines

        trained = train_baselines(dataset, robot, case, out / "bundles", seed, threads, names=methods or None)
        paths = [*trained.values(), *paths]
    names = [path.stem for path in paths]
    if len(set(names)) < len(names):
        raise ConfigError(f"bundles must differ in their file names, not only in their folders: {', '.join(names)}")
    named = dict(zip(names, paths, strict=True))
    evaluate_bundles(
        dataset, named, out, seed, threads, keep_free_estimates=keep_free_estimates, sanity=baselines, events=events
    )
    print(out / "results.json")


def evaluate_bundles(
    dataset: Dataset,
    bundles: Mapping[str, Path],
    out: Path,
    seed: int,
    threads: int,
    scale: str | None = None,
    keep_free_estimates: int = 20,
    sanity: bool = False,
    events: EventsConfig = EventsConfig(),  # noqa: B008
) -> None:
    """Write results.json, estimates, run.json and wall times for bundles by the name of their case.

    With sanity, detectors that know nothing (always, never, random) are judged beside them.
    Where a bundle's NAME.run.json stands beside it, the loss history of its training goes into results.json too.
    """
    import os
    import time

    from tauext import _core
    from tauext import evaluate as evaluation
    from tauext.cli.progress import ProgressBar
    from tauext.cli.run_files import command_line, provenance, write_json

    started = time.monotonic()
    loaded = {name: _core.Bundle.load(str(path)) for name, path in bundles.items()}
    histories = {name: evaluation.read_loss_history(loaded[name], path) for name, path in bundles.items()}
    with ProgressBar("evaluate") as bar:
        results = evaluation.evaluate(
            loaded,
            dataset.loaders("test"),
            dataset.loaders("collisions"),
            out / "estimates",
            seed,
            threads or os.cpu_count() or 1,
            lambda what, done, total: bar.update(done, total, "recordings"),
            histories,
            keep_free_estimates,
            sanity,
            events,
            dataset.loaders("calibration") or dataset.loaders("validation") or dataset.loaders("train"),
        )
    run = provenance("tauext evaluate", {"bundles": list(bundles)}, seed)
    source = {"command": command_line(), "dataset": dataset.folder.name, "scale": scale}
    keep = {key: run[key] for key in ("version", "seed", "machine")}
    write_json(run, out / "run.json")
    write_json({"evaluate_s": time.monotonic() - started}, out / "wall_time_s.json")
    write_json({"format": 2, "provenance": source | keep} | results, out / "results.json")
