"""Bundles of all methods that tauext is compared with, from one dataset."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path

from tauext.check.before_training import expect_codes
from tauext.config import PAPER_CASES, CaseName, LimitsKind, ModelCase, TrainConfig
from tauext.data.dataset import Dataset
from tauext.errors import ConfigError
from tauext.files.plain_file import json_of, read_text
from tauext.progress import SILENT, Reporter
from tauext.recipes import baselines, recipe_of
from tauext.robot.model_case import chosen_case
from tauext.train.data_check import check_data
from tauext.train.preparation import TrainingInput, training_settings, why_impossible
from tauext.train.stage import train_on_recordings


def chosen_baselines(names: Collection[str] | None, skip: Collection[str]) -> dict[str, str]:
    """Recipes of these baselines by name, None: of all, without those to skip.

    Raises:
        ConfigError: an unknown name.
    """
    known = baselines()
    for name in (*(names or ()), *skip):
        if name not in known:
            raise ConfigError(f"baseline '{name}' does not exist; they are {', '.join(known)}")
    return {name: recipe for name, recipe in known.items() if name not in skip and (names is None or name in names)}


def train_baselines(
    dataset: Dataset,
    robot: Path | None,
    case_name: CaseName | None,
    folder: Path,
    seed: int,
    threads: int,
    names: Collection[str] | None = None,
    skip: Collection[str] = (),
    report: Reporter = SILENT,
    accept: Sequence[str] = (),
) -> dict[str, Path]:
    """Train the baselines into folder/NAME.tauext; returns the bundles by name, simplest first.

    With calibration recordings all limits keep the same promise; else they are the paper's. Bundles already finished
    with these settings are kept. Baselines that the case does not allow are left out, and the reason is reported.

    Args:
        robot: URDF or MJCF; None: the dataset's own.
        case_name: None: see chosen_case().
        names: train only these; None: all.
        skip: leave these out.
        accept: see train_bundle().

    Raises:
        FaultyDataError: recordings or robot file have a fault that is not accepted.
        ConfigError: an unknown name, a bundle with other settings in the folder, no training recording, or a case that
            needs a model that the dataset lacks.
    """
    chosen = chosen_baselines(names, skip)
    expect_codes(accept)
    robot_file = dataset.robot_file(robot)
    case_name, note = chosen_case(case_name, robot_file)
    if note:
        report.say(note)
    case, calibration = PAPER_CASES[case_name], dataset.stretches("calibration")
    bundles: dict[str, Path] = {}
    missing: dict[str, TrainConfig] = {}
    for name, recipe in chosen.items():
        if impossible := why_impossible(recipe_of(recipe), case):
            report.say(f"{name} is left out: {impossible}")
            continue
        bundles[name] = folder / f"{name}.tauext"
        limits: LimitsKind = "promised" if calibration else "supported"
        config = TrainConfig(recipe=recipe, seed=seed, threads=threads, limits=limits)
        if not finished(bundles[name], case, config):
            missing[name] = config
    if missing:
        training, validation = dataset.training(), dataset.recordings("validation")
        given = TrainingInput(robot_file, case, training, validation, calibration)
        # One check for all: none of them uses more data than promised limits.
        checked = check_data(dataset, given, TrainConfig(seed=seed, threads=threads), accept, report)
        # A baseline is compared whatever its limits are: their findings are in the bundle.
        accepted = [*accept, "limit-wide", "limit-fine"]
        for name, config in missing.items():
            train_on_recordings(given, config, bundles[name], report, checked, accept=accepted)
    return bundles


def finished(bundle: Path, case: ModelCase, config: TrainConfig) -> bool:
    """Whether this bundle was already trained with these settings.

    Raises:
        ConfigError: a bundle with other settings exists there.
    """
    run = bundle.with_suffix(".run.json")
    if not bundle.exists() or not run.exists():
        return False
    settings = run_settings(run)
    if settings == training_settings(case, config):
        return True
    raise ConfigError(f"{bundle}: it was trained with other settings; choose another --out or remove it")


def run_settings(run: Path) -> dict:
    """Read the settings in a run file.

    Raises:
        ConfigError: it is damaged.
    """
    try:
        return json_of(read_text(run))["settings"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(
            f"{run}: not a readable run file ({error}); remove it and the bundle, or train elsewhere"
        ) from error
