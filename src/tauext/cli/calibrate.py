"""`tauext calibrate`: the limits of a bundle anew, from a dataset's calibration recordings."""

from __future__ import annotations

from typing import Annotated

import tyro

from tauext.cli.place_argument import PlaceArg
from tauext.config import AlarmConfig, require_threads
from tauext.errors import ConfigError
from tauext.files.places import same_place


def calibrate(
    bundle: PlaceArg,
    data: PlaceArg,
    out: PlaceArg,
    alarm: Annotated[AlarmConfig, tyro.conf.arg(name="")] = AlarmConfig(),  # noqa: B008
    threads: int = 0,
    refit_error_scale: bool = False,
    accept: Annotated[tuple[str, ...], tyro.conf.arg(metavar="CODE[:JOINT] ...")] = (),
) -> None:
    """Set the limits and hold times of a bundle for another promise or on other recordings; nothing is trained.

    First every calibration recording is looked at, by those checks of `tauext check` that are cheap: a fault refuses.

    Args:
        bundle: bundle (*.tauext) to begin with; it stays as it is.
        data: dataset folder; its calibration recordings are used.
        out: bundle to write, NAME.tauext; one that is there is replaced, and said to be.
        alarm: what is promised.
        threads: threads that estimate; 0: one a core. The result does not depend on it.
        refit_error_scale: find anew how errors grow with the motion, on the first fifth of the calibration recordings;
            limits follow from the others.
        accept: codes of findings that are no fault on your word, at all joints or at one; they stand in the bundle.
    """
    from tauext.cli.place_argument import tell_replaced
    from tauext.cli.progress import Terminal
    from tauext.data.dataset import load_dataset
    from tauext.train.calibrate import recalibrate

    require_threads(threads)
    if out.suffix != ".tauext":
        raise ConfigError(f"{out}: a bundle's name ends in .tauext")
    if same_place(out, bundle):
        raise ConfigError(f"{out}: it is the bundle to begin with, which stays as it is; choose another --out")
    tell_replaced(out)
    promised = recalibrate(bundle, load_dataset(data), out, alarm, threads, Terminal(), refit_error_scale, accept)
    print(promised.sentence())
    print(out)
