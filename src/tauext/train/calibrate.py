"""Limits from calibration recordings, for a bundle in training or a copy of a bundle."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from tauext import _core
from tauext.bundle.bundle_file import load_bundle, write_bundle
from tauext.bundle.loss_history import read_loss_history
from tauext.check.before_training import Rejected, check_for_bundle, expect_codes
from tauext.check.finding import Finding
from tauext.config import AlarmConfig, checked
from tauext.data.dataset import Dataset
from tauext.data.free_motion import LeftOut
from tauext.errors import ConfigError
from tauext.files.preflight import expect_new_file
from tauext.files.provenance import provenance
from tauext.progress import SILENT, Reporter, WallTimes
from tauext.train.declared_spread import Contacts, SpreadFound, noticed_standing, put_spread, with_tool_forces
from tauext.train.error_scale import collect_rows, fit_error_scale, limit_scale, put_limit_scale
from tauext.train.limits import LIMITS, no_calibration, put_limit_findings, refuse_limits, worse_promise
from tauext.train.paper_limits import LimitMotion, Loaders
from tauext.train.promised_limits import counted, fitting, left_out_facts, no_freeze, remove_checkpoint


@checked
def recalibrate(
    bundle: Path,
    dataset: Dataset,
    out: Path,
    alarm: AlarmConfig,
    threads: int = 0,
    report: Reporter = SILENT,
    refit_error_scale: bool = False,
    accept: Sequence[str] = (),
) -> dict:
    """Write a copy of a bundle with thresholds for another target or from other recordings; nothing is trained.

    Returns facts of the limits, as the run file has them; `sentence` states the promise.

    The quick checks (tauext.check) run first on every recording: faults are refused, warnings are reported and stored.
    An interrupted run resumes after its last finished recording.

    The reserves of a training on minutes of motion are removed first (`remove_reserves`), so that the limits are those
    of a training with these calibration recordings.

    Its run file, with the first one's content, and its wall time are written beside it.

    Args:
        dataset: dataset with calibration recordings.
        refit_error_scale: refit the error scale to the first fifth of the recordings; limits follow from the others,
            since errors of a fit are too small on its own data.
        accept: codes of findings that are accepted, CODE or CODE:joint; they are stored in the bundle.

    Raises:
        FaultyDataError: a recording, a limit or the promise has a fault that is not accepted; nothing is written.
        ConfigError: the dataset has no calibration recordings, or too few for refit_error_scale.
        BundleError: the bundle does not exist.
        BundleError, TrainingError: see put_promised().
    """
    started = time.monotonic()
    expect_codes(accept)
    loaders, loaded, history, facts = opened(bundle, dataset, out)
    files, where = dataset.files("calibration"), str(dataset.folder)
    checked = check_for_bundle(loaded, "calibration", files, where, accept, threads, report)
    facts["checks"] = facts.get("checks", {}) | checked
    remove_reserves(loaded)
    if refit_error_scale:
        loaders, found = refit_scale(loaded, loaders, threads, report)
        facts["error_scale"] = found | {"of_limits": limit_scale(loaded)}
    rejected = Rejected.of(loaded, fitting(loaded, loaders), threads or os.cpu_count() or 1)
    if words := rejected.warning("the calibration recordings", accept):
        report.say(words)
        facts["rejected_in_calibration"] = asdict(rejected.summary())
    before = facts.get("limits") or {}
    motion = LimitMotion(
        out.stem, alarm, threads, report=report, note=report.say, calibration=loaders, out=out,
        rest_sigma_nm=rest_sigma_of(loaded, facts),
    )  # fmt: skip
    limits = facts["limits"] = LIMITS["asked"](loaded, motion)
    compared, worse = worse_promise(before, limits, bundle.name)
    if compared:
        report.say(compared)
        limits["replaces"] = compared
    if not _core.WrenchModel(loaded).refused:
        facts["declared_spread"] = put_injected_spread(loaded, loaders, threads, report)
    if found := noticed_standing(loaded):
        facts["standing"] = found
        report.say(found["sentence"])
    settings: dict = {"bundle": bundle.name, "dataset": dataset.folder.resolve().name, "alarm": asdict(alarm)}
    if refit_error_scale:
        settings["refit_error_scale"] = True
    facts["calibrated"] = provenance("tauext calibrate", settings, seed=None)
    write_calibrated(loaded, out, facts, started, history, report, accept, worse)
    remove_checkpoint(out)
    return limits


def rest_sigma_of(bundle: _core.Bundle, facts: dict) -> np.ndarray | None:
    """Standard errors at rest in the recorded motion, (joints,), [N m], as the training found them; None: the bundle's
    error scale is of another kind, or older than this entry."""
    known = facts.get("error_scale", {}).get("other_programs", {}).get("rest_sigma_nm")
    return None if known is None else np.array([known[link.joint_name] for link in bundle.links])


def remove_reserves(bundle: _core.Bundle) -> None:
    """Remove what minutes of motion added to a bundle's limits: floors, a share of friction, the time for which limits
    at rest outlast a rest.

    Limits from calibration follow, whose errors refer to the scale without them.
    """
    bundle.near_memory_s = 0.0
    put_limit_scale(bundle, json.loads(bundle.provenance or "{}").get("error_scale", {}).get("of_limits", {}))


def put_injected_spread(bundle: _core.Bundle, loaders: Loaders, threads: int, report: Reporter) -> dict:
    """Set the limits during declared contacts by tool forces that are added to the recordings; returns facts."""
    with report.progress("inject tool forces"):
        spread = put_spread(bundle, with_tool_forces(bundle, loaders), injected=True, threads=threads)
    report.say(spread.sentence())
    return spread.facts()


def opened(bundle: Path, dataset: Dataset, out: Path) -> tuple[Loaders, _core.Bundle, Sequence[Any], dict]:
    """Calibration recordings, the bundle, its loss history and provenance, before anything is done."""
    loaders: Loaders = dataset.stretches("calibration")
    if not loaders:
        raise ConfigError(f"{dataset.folder}: calibrate {no_calibration(dataset.folder)}")
    expect_new_file(out)
    loaded = load_bundle(bundle)
    return loaders, loaded, read_loss_history(loaded, bundle) or [], json.loads(loaded.provenance or "{}")


def calibrate_contacts(
    bundle: Path,
    dataset: Dataset,
    out: Path,
    contacts: Callable[[int], Contacts],
    threads: int = 0,
    report: Reporter = SILENT,
) -> SpreadFound:
    """Write a copy of a bundle whose limits during declared contacts fit recordings of them; other limits stay.

    Args:
        dataset: its calibration recordings are of the task, with its contacts and without collisions.
        contacts: those of a recording, by the stamp of its first sample.

    Raises:
        ConfigError: there are no such recordings, or one holds more than the contacts explain.
        BundleError: the bundle does not exist, or a recording is not for it.
    """
    started = time.monotonic()
    loaders, loaded, history, facts = opened(bundle, dataset, out)
    motion = ((recording, contacts(int(recording.t_ns[0]))) for recording in fitting(loaded, loaders))
    with report.progress(f"calibrate {out.stem}"):
        spread = put_spread(loaded, motion, injected=False, threads=threads)
    if not spread.hours:
        raise ConfigError(f"{dataset.folder}: {spread.sentence()}")
    facts["declared_spread"] = spread.facts()
    settings = {
        "bundle": bundle.name,
        "dataset": dataset.folder.resolve().name,
        "contacts": [repr(one) for one, *_ in contacts(0)],
    }
    facts["calibrated"] = provenance("tauext calibrate", settings, seed=None)
    write_calibrated(loaded, out, facts, started, history, report)
    return spread


def write_calibrated(
    bundle: _core.Bundle,
    out: Path,
    facts: dict,
    started: float,
    history: Sequence[Any] = (),
    report: Reporter = SILENT,
    accept: Sequence[str] | None = None,
    promise: Sequence[Finding] = (),
) -> None:
    """Write a bundle with other limits, and report what is wrong with them.

    Args:
        facts: its provenance; receives the findings.
        started: time.monotonic() when the work began.
        accept: codes of faults that are accepted; None: all, for a caller that judges the bundle itself.
        promise: findings of the promise (worse_promise).

    Raises:
        FaultyDataError: a fault is not accepted; nothing is written.
    """
    found = put_limit_findings(bundle, facts, promise)
    if accept is not None:
        refuse_limits(facts, str(out), accept)
    for words in found:
        report.say(words)
    write_bundle(bundle, out, facts, list(history), WallTimes({"calibrate": time.monotonic() - started}))


def refit_scale(
    bundle: _core.Bundle, loaders: Loaders, threads: int, report: Reporter = SILENT, share: float = 0.2
) -> tuple[Loaders, dict]:
    """Fit the error scale to the first recordings; returns the other loaders and facts for provenance.

    Args:
        share: of the recordings for the fit; the limits follow from the others.

    Raises:
        ConfigError: there is only one recording.
        TrainingError: no free motion, or too much that is impossible.
    """
    if len(loaders) < 2:
        raise ConfigError(
            "refit-error-scale needs 2 calibration recordings or more: one to fit to, one for the thresholds"
        )
    apart = max(1, round(share * len(loaders)))
    left_out = LeftOut("calibration")
    bundle.error_scale = _core.ErrorScaleSettings()
    with no_freeze(bundle):
        rows = collect_rows(bundle, counted(bundle, loaders[:apart], left_out), threads)
        facts = fit_error_scale(bundle, rows)
    return loaders[apart:], facts | {"recordings": list(rows.recordings)} | left_out_facts(left_out, report.say)
