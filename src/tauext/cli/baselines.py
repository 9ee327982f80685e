"""Every method that tauext is compared with, as bundles of one dataset."""

from __future__ import annotations

import sys
from collections.abc import Collection
from pathlib import Path

from tauext.cli.dataset import Dataset
from tauext.cli.model_case import CaseName, chosen_case, estimated_model, why_impossible
from tauext.cli.train import train_bundle
from tauext.cli.train_settings import finished
from tauext.config import PAPER_CASES, Recipe, TrainConfig
from tauext.errors import ConfigError

BASELINES: tuple[tuple[str, Recipe], ...] = (
    ("observer", "observer"),
    ("friction", "friction"),
    ("highpass", "highpass"),
    ("bandpass", "bandpass"),
    ("velocity", "velocity"),
    ("energy", "energy"),
    ("direct", "direct"),
    ("feedforward", "feedforward"),
    # The paper's network by the dense recipe: its errors are below the published ones at a fraction of the time. A
    # bundle of the paper's whole recipe can be given beside it.
    ("paper-lstm", "dense"),
    ("prior", "prior"),
    ("tauext", "tauext"),
)
"""(name, recipe), simplest first; tauext itself is the last."""


def train_baselines(
    dataset: Dataset,
    robot: Path | None,
    case_name: CaseName | None,
    folder: Path,
    seed: int,
    threads: int,
    names: Collection[str] | None = None,
    skip: Collection[str] = (),
) -> dict[str, Path]:
    """Train the baselines into folder/NAME.tauext; their bundles by name, in the order of BASELINES.

    Limits keep one and the same promise where the dataset has calibration recordings; else they are the paper's. What
    is finished with these settings is kept. What cannot exist for the case is left out, and stderr says why.

    Args:
        robot: URDF or MJCF; None: the dataset's own.
        case_name: None: as chosen_case.
        names: train only these; None: all.
        skip: leave these out.

    Raises:
        ConfigError: a name that is none of BASELINES, a bundle of other settings in the folder, no training recording,
            or a case that the dataset has no model for.
    """
    known = [name for name, _ in BASELINES]
    for name in (*(names or ()), *skip):
        if name not in known:
            raise ConfigError(f"baseline '{name}' does not exist; they are {', '.join(known)}")
    robot_file = dataset.robot_file(robot)
    case_name = chosen_case(case_name, robot_file)
    case, calibration = PAPER_CASES[case_name], dataset.loaders("calibration")
    bundles: dict[str, Path] = {}
    missing: dict[str, TrainConfig] = {}
    for name, recipe in BASELINES:
        if name in skip or (names is not None and name not in names):
            continue
        if impossible := why_impossible(recipe, case):
            print(f"{name} is left out: {impossible}", file=sys.stderr)
            continue
        bundles[name] = folder / f"{name}.tauext"
        limits = "promised" if calibration else "supported"
        config = TrainConfig(recipe=recipe, seed=seed, threads=threads, limits=limits)
        if not finished(bundles[name], case_name, config):
            missing[name] = config
    if missing:
        training, validation = dataset.training(), dataset.recordings("validation")
        tree = estimated_model(robot_file, training[0], case)
        for name, config in missing.items():
            train_bundle(tree, robot_file, case, training, validation, config, bundles[name], calibration)
    return bundles
