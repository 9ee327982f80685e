"""`tauext calibrate`: the limits of a bundle anew, from a dataset's calibration recordings."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from tauext.config import AlarmConfig
from tauext.errors import ConfigError


def calibrate(
    bundle: Path,
    data: Path,
    out: Path,
    alarm: Annotated[AlarmConfig, tyro.conf.arg(name="")] = AlarmConfig(),  # noqa: B008
    threads: int = 0,
    refit_error_scale: bool = False,
) -> None:
    """Set the limits and hold times of a bundle for another promise or on other recordings; nothing is trained.

    Args:
        bundle: bundle (*.tauext) to begin with; it stays as it is.
        data: dataset folder; its calibration recordings are used.
        out: bundle to write, NAME.tauext.
        alarm: what is promised.
        threads: threads that estimate; 0: one a core. The result does not depend on it.
        refit_error_scale: find anew how errors grow with the motion, on the first fifth of the calibration recordings;
            limits follow from the others.
    """
    from tauext.calibrate import recalibrate
    from tauext.cli.reporter import Terminal
    from tauext.data import load_dataset

    if out.suffix != ".tauext":
        raise ConfigError(f"{out}: a bundle's name ends in .tauext")
    if bundle.exists() and out.exists() and out.samefile(bundle):
        raise ConfigError(f"{out}: it is the bundle to begin with, which stays as it is; choose another --out")
    promised = recalibrate(bundle, load_dataset(data), out, alarm, threads, Terminal(), refit_error_scale)
    print(promised.sentence())
    print(out)
