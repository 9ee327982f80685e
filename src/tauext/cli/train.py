"""`tauext train`: a bundle from recordings of free motion."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from tauext.config import CaseName, TrainConfig
from tauext.errors import ConfigError


def train(
    data: Path,
    out: Path,
    case: CaseName | None = None,
    robot: Path | None = None,
    config: Annotated[TrainConfig, tyro.conf.arg(name="")] = TrainConfig(),  # noqa: B008
) -> None:
    """Train on a dataset's free motion, find the limits on its validation recordings, write one bundle.

    Args:
        data: dataset folder (`tauext simulate` makes one).
        out: bundle to write, NAME.tauext. An interrupted run goes on from its checkpoint beside it.
        case: the estimated model: the robot file as it is (exact), mass and/or centre of mass halved, or no model at
            all (none). Left out: exact, or none where the dataset was imported without a model.
        robot: URDF or MJCF of the arm; default: the dataset's own.
        config: recipe, seed and sizes.
    """
    from tauext.cli.reporter import Terminal
    from tauext.data import load_dataset
    from tauext.train import train_bundle

    if out.suffix != ".tauext":
        raise ConfigError(f"{out}: a bundle's name ends in .tauext")
    train_bundle(load_dataset(data), out, case, robot, config, Terminal())
    print(out)
