"""`tauext train`: a bundle from recordings of free motion."""

from __future__ import annotations

from typing import Annotated

import tyro

from tauext.cli.place_argument import PlaceArg
from tauext.config import CaseName, TrainConfig
from tauext.errors import ConfigError


def train(
    data: PlaceArg,
    out: PlaceArg,
    case: CaseName | None = None,
    robot: PlaceArg | None = None,
    like: PlaceArg | None = None,
    accept: Annotated[tuple[str, ...], tyro.conf.arg(metavar="CODE[:JOINT] ...")] = (),
    config: Annotated[TrainConfig, tyro.conf.arg(name="")] = TrainConfig(),  # noqa: B008
) -> None:
    """Train on a dataset's free motion, find the limits on its validation recordings, write one bundle.

    First all that is used is looked at, as `tauext check` does; a second training of the same data does not look again.
    A fault refuses, unless it is accepted; warnings are told, and stand in the bundle.

    Args:
        data: dataset folder (`tauext simulate` makes one).
        out: bundle to write, NAME.tauext; one that is there is replaced, and said to be. While its network is trained,
            a checkpoint beside it is written every 20 s, and kept until the bundle is: after Ctrl-C, or whatever ends
            the process, the same command goes on from there. What comes before the network is done again.
        case: the estimated model: the robot file as it is (exact), mass and/or centre of mass halved, or no model at
            all (none). Left out: exact, or none where the dataset was imported without a model.
        robot: URDF or MJCF of the arm; default: the dataset's own.
        like: NAME.prior.json of a fleet of arms of this type (`tauext fleet prior`): a minute of this one is enough.
            None: the arm is by itself.
        accept: codes of findings that are no fault on your word, at all joints or at one; they stand in the bundle.
        config: recipe, seed and sizes.
    """
    from tauext.cli.place_argument import tell_replaced
    from tauext.cli.progress import Terminal
    from tauext.data.dataset import load_dataset
    from tauext.fit.fleet_prior import load_fleet_prior
    from tauext.train.stage import train_bundle

    if out.suffix != ".tauext":
        raise ConfigError(f"{out}: a bundle's name ends in .tauext")
    known = None if like is None else load_fleet_prior(like)
    tell_replaced(out)
    train_bundle(load_dataset(data), out, case, robot, config, Terminal(), accept, like=known)
    print(out)
