"""`tauext calibrate`: the limits of a bundle anew, from a dataset's calibration recordings."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from tauext.cli.dataset import Dataset
from tauext.config import AlarmConfig, FreeMotionConfig
from tauext.errors import ConfigError

if TYPE_CHECKING:
    from tauext._core import Bundle
    from tauext.calibrate import PromisedLimits
    from tauext.data import Recording

NO_CALIBRATION = (
    "needs calibration recordings, which the dataset has none of; `tauext simulate --calibration-hours 24` makes some"
)


def calibrate(
    bundle: Path,
    data: Path,
    out: Path,
    alarm: Annotated[AlarmConfig, tyro.conf.arg(name="")] = AlarmConfig(),  # noqa: B008
    threads: int = 0,
) -> None:
    """Set the limits and hold times of a bundle for another promise or on other recordings; nothing is trained.

    Args:
        bundle: bundle (*.tauext) to begin with; it stays as it is.
        data: dataset folder; its calibration recordings are used.
        out: bundle to write, NAME.tauext.
        alarm: what is promised.
        threads: 0: one a core. The result does not depend on it.
    """
    import time

    from tauext import _core
    from tauext.cli.run_files import provenance, write_json
    from tauext.evaluate import read_loss_history

    if not bundle.is_file():
        raise ConfigError(f"{bundle}: there is no such bundle; `tauext train` makes one")
    if out.suffix != ".tauext":
        raise ConfigError(f"{out}: a bundle's name ends in .tauext")
    if out.exists() and out.samefile(bundle):
        raise ConfigError(f"{out}: it is the bundle to begin with, which stays as it is; choose another --out")
    started = time.monotonic()
    loaders = Dataset.open(data).loaders("calibration")
    if not loaders:
        raise ConfigError(f"{data}: calibrate {NO_CALIBRATION}")
    loaded = _core.Bundle.load(str(bundle))
    history = read_loss_history(loaded, bundle) or []
    facts = json.loads(loaded.provenance or "{}")
    promised, facts["limits"] = calibrate_bundle(loaded, out.stem, loaders, alarm, threads)
    settings = {"bundle": bundle.name, "dataset": data.resolve().name, "alarm": asdict(alarm)}
    facts["calibrated"] = provenance("tauext calibrate", settings, seed=None)
    loaded.provenance = json.dumps(facts, sort_keys=True)
    out.parent.mkdir(parents=True, exist_ok=True)
    write_json(facts | {"loss_history": history}, out.with_suffix(".run.json"))
    write_json({"calibrate_s": time.monotonic() - started}, out.with_suffix(".wall_time_s.json"))
    loaded.save(str(out))
    print(promised.sentence())
    print(out)


def calibrate_bundle(
    bundle: Bundle,
    name: str,
    loaders: Sequence[Callable[[], Recording]],
    alarm: AlarmConfig,
    threads: int,
    margins: FreeMotionConfig = FreeMotionConfig(),  # noqa: B008
) -> tuple[PromisedLimits, dict]:
    """Put the limits into the bundle that the recordings support; what they promise, and the facts for its provenance.

    Raises:
        BundleError: a recording of another robot, rate or torque timing.
        TrainingError: no free motion, or too few peaks to say anything.
    """
    from tauext.calibrate import apply_promised, promised_limits
    from tauext.cli.progress import ProgressBar
    from tauext.data import scaled_torque, torque_constants_of
    from tauext.evaluate.estimating import expect_fit

    constants = torque_constants_of(bundle.provenance)  # none yet while training, which scales by itself
    names: list[str] = []
    with ProgressBar(f"calibrate {name}") as bar:

        def load_all() -> Iterator[Recording]:
            for load in loaders:
                recording = scaled_torque(load(), constants)
                expect_fit(bundle, recording)
                names.append(recording.name)
                yield recording
                bar.update(len(names), len(loaders), "recordings")

        # Limits that are to be replaced must not freeze the drift tracker while the new ones are found.
        freeze_share, bundle.drift.freeze_share = bundle.drift.freeze_share, 0.0
        promised = promised_limits(bundle, load_all, alarm, threads, margins)
        bundle.drift.freeze_share = freeze_share
    apply_promised(bundle, promised, alarm)
    return promised, promised.facts() | {"recordings": names}
