"""Limits of a bundle from calibration recordings: put into one that is being trained, or into a copy of one."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

from tauext import _core
from tauext.calibrate.error_scale import fit_error_scale
from tauext.calibrate.promised_limits import PromisedLimits, apply_promised, promised_limits
from tauext.config import AlarmConfig, FreeMotionConfig
from tauext.data import Dataset, Recording, expect_fit, load_bundle
from tauext.data.loss_history import read_loss_history
from tauext.errors import ConfigError
from tauext.progress import SILENT, Reporter
from tauext.provenance import provenance, write_json

SCALE_SHARE = 0.2
"""Of the calibration recordings, where the error scale is fitted anew."""
NO_CALIBRATION = (
    "needs calibration recordings, which the dataset has none of; `tauext simulate --calibration-hours 24` makes some"
)


def recalibrate(
    bundle: Path,
    dataset: Dataset,
    out: Path,
    alarm: AlarmConfig,
    threads: int = 0,
    report: Reporter = SILENT,
    refit_error_scale: bool = False,
) -> PromisedLimits:
    """Write a bundle like this one, with limits for another promise or from other recordings; nothing is trained.

    Its run file, with what the first one knew, and its wall time stand beside it.

    Args:
        dataset: its calibration recordings are used.
        refit_error_scale: find anew how errors grow with the motion, on the first SCALE_SHARE of the recordings; limits
            follow from the others, since what was fitted to a recording has no surprises there.

    Raises:
        ConfigError: the dataset has no calibration recordings, or too few to set some apart.
        BundleError: there is no such bundle.
        BundleError, TrainingError: as calibrate_bundle.
    """
    started = time.monotonic()
    loaders: Sequence[Callable[[], Recording]] = dataset.loaders("calibration")
    if not loaders:
        raise ConfigError(f"{dataset.folder}: calibrate {NO_CALIBRATION}")
    loaded = load_bundle(bundle)
    history = read_loss_history(loaded, bundle) or []
    facts = json.loads(loaded.provenance or "{}")
    if refit_error_scale:
        loaders, facts["error_scale"] = refit_scale(loaded, loaders, threads)
    promised, facts["limits"] = calibrate_bundle(loaded, out.stem, loaders, alarm, threads, report=report)
    settings: dict = {"bundle": bundle.name, "dataset": dataset.folder.resolve().name, "alarm": asdict(alarm)}
    if refit_error_scale:
        settings["refit_error_scale"] = True
    facts["calibrated"] = provenance("tauext calibrate", settings, seed=None)
    loaded.provenance = json.dumps(facts, sort_keys=True)
    out.parent.mkdir(parents=True, exist_ok=True)
    write_json(facts | {"loss_history": history}, out.with_suffix(".run.json"))
    write_json({"calibrate_s": time.monotonic() - started}, out.with_suffix(".wall_time_s.json"))
    loaded.save(str(out))
    return promised


def refit_scale(
    bundle: _core.Bundle, loaders: Sequence[Callable[[], Recording]], threads: int
) -> tuple[Sequence[Callable[[], Recording]], dict]:
    """Fit the error scale to the first recordings; the others' loaders, and the facts for the provenance.

    Raises:
        ConfigError: there is one recording only.
    """
    if len(loaders) < 2:
        raise ConfigError("refit-error-scale needs 2 calibration recordings or more: one to fit to, one for the limits")
    apart = max(1, round(SCALE_SHARE * len(loaders)))
    names: list[str] = []

    def load_some() -> Iterator[Recording]:
        for load in loaders[:apart]:
            recording = load()
            expect_fit(bundle, recording)
            names.append(recording.name)
            yield recording

    bundle.error_scale = _core.ErrorScaleSettings()
    with no_freeze(bundle):
        facts = fit_error_scale(bundle, load_some(), threads)
    return loaders[apart:], facts | {"recordings": names}


@contextmanager
def no_freeze(bundle: _core.Bundle) -> Iterator[None]:
    """Limits that are to be replaced must not freeze the drift tracker while the new ones are found."""
    share, bundle.drift.freeze_share = bundle.drift.freeze_share, 0.0
    try:
        yield
    finally:
        bundle.drift.freeze_share = share


def calibrate_bundle(
    bundle: _core.Bundle,
    name: str,
    loaders: Sequence[Callable[[], Recording]],
    alarm: AlarmConfig,
    threads: int,
    margins: FreeMotionConfig = FreeMotionConfig(),  # noqa: B008
    report: Reporter = SILENT,
) -> tuple[PromisedLimits, dict]:
    """Put the limits into the bundle that the recordings support; what they promise, and the facts for its provenance.

    Raises:
        BundleError: a recording of another robot, rate or torque timing.
        TrainingError: no free motion, or too few peaks to say anything.
    """
    names: list[str] = []
    with report.progress(f"calibrate {name}") as show:

        def load_all() -> Iterator[Recording]:
            for load in loaders:
                recording = load()
                expect_fit(bundle, recording)
                names.append(recording.name)
                yield recording
                show(len(names), len(loaders), "recordings")

        with no_freeze(bundle):
            promised = promised_limits(bundle, load_all, alarm, threads, margins)
    apply_promised(bundle, promised, alarm)
    return promised, promised.facts() | {"recordings": names}
