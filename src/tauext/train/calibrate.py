"""Limits from calibration recordings, for a bundle in training or a copy of a bundle."""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

from tauext import _core
from tauext.bundle.bundle_file import load_bundle, write_bundle
from tauext.bundle.history_file import expect_journal
from tauext.bundle.loss_history import read_loss_history
from tauext.bundle.match import expect_fit
from tauext.check.before_training import Rejected, check_for_bundle, expect_codes
from tauext.check.finding import Finding
from tauext.config import AlarmConfig, FreeMotionConfig, checked
from tauext.data.dataset import Dataset, ahead
from tauext.data.free_motion import LeftOut, SignalBounds
from tauext.data.labels import labels_key, read_labels
from tauext.data.recording import Recording
from tauext.errors import ConfigError
from tauext.files.checkpoint import Checkpoint
from tauext.files.kind import is_simulated
from tauext.files.preflight import expect_new_file
from tauext.files.provenance import VERSION, provenance
from tauext.progress import SILENT, Reporter, WallTimes
from tauext.train.declared_spread import Contacts, SpreadFound, put_spread, with_tool_forces
from tauext.train.error_scale import collect_rows, fit_error_scale
from tauext.train.held_peaks import KeptPeaks, PeakStore, collect_peaks
from tauext.train.promised_limits import (
    PromisedLimits,
    apply_promised,
    promised_limits,
    put_limit_findings,
    refuse_limits,
    worse_promise,
)
from tauext.train.suspects import HeldStore, find_suspects, forget, suspect_facts, suspect_sentences

SCALE_SHARE = 0.2
"""Share of the calibration recordings for refitting the error scale."""


def no_calibration(folder: Path | None) -> str:
    """End of a message: a dataset without calibration recordings, and how to get some.

    Args:
        folder: of the dataset; None: its recordings are in memory.
    """
    more = (
        "`tauext simulate --calibration-hours 24` makes some"
        if folder is not None and is_simulated(folder)
        else "record more of the arm's motion without touches, list the recordings as calibration in [split] of the "
        "description, and import them"
    )
    return f"needs calibration recordings, which the dataset has none of; {more}"


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
) -> PromisedLimits:
    """Write a copy of a bundle with limits for another promise or from other recordings; nothing is trained.

    The quick checks (tauext.check) run first on every recording: faults are refused, warnings are reported and stored.
    An interrupted run resumes after its last finished recording.

    Its run file, with the first one's content, and its wall time are written beside it.

    Args:
        dataset: dataset with calibration recordings.
        refit_error_scale: refit the error scale to the first SCALE_SHARE of the recordings; limits follow from the
            others, since errors of a fit are too small on its own data.
        accept: codes of findings that are accepted, CODE or CODE:joint; they are stored in the bundle.

    Raises:
        FaultyDataError: a recording, a limit or the promise has a fault that is not accepted; nothing is written.
        ConfigError: the dataset has no calibration recordings, or too few for refit_error_scale.
        BundleError: the bundle does not exist.
        BundleError, TrainingError: see calibrate_bundle().
    """
    started = time.monotonic()
    expect_codes(accept)
    loaders, loaded, history, facts = opened(bundle, dataset, out)
    files, where = dataset.files("calibration"), str(dataset.folder)
    checked = check_for_bundle(loaded, "calibration", files, where, accept, threads, report)
    facts["checks"] = facts.get("checks", {}) | checked
    if refit_error_scale:
        loaders, facts["error_scale"] = refit_scale(loaded, loaders, threads, report)
    rejected = Rejected.of(loaded, fitting(loaded, loaders), threads or os.cpu_count() or 1)
    if words := rejected.warning("the calibration recordings", accept):
        report.say(words)
        facts["rejected_in_calibration"] = asdict(rejected.summary())
    before = facts.get("limits") or {}
    promised, facts["limits"] = calibrate_bundle(loaded, out.stem, loaders, alarm, threads, report=report, out=out)
    compared, worse = worse_promise(before, promised, bundle.name)
    if compared:
        report.say(compared)
        facts["limits"]["replaces"] = compared
    if not _core.WrenchModel(loaded).refused:
        with report.progress("inject tool forces"):
            spread = put_spread(loaded, with_tool_forces(loaded, loaders), injected=True, threads=threads)
        facts["declared_spread"] = spread.facts()
        report.say(spread.sentence())
    settings: dict = {"bundle": bundle.name, "dataset": dataset.folder.resolve().name, "alarm": asdict(alarm)}
    if refit_error_scale:
        settings["refit_error_scale"] = True
    facts["calibrated"] = provenance("tauext calibrate", settings, seed=None)
    write_calibrated(loaded, out, facts, started, history, report, accept, worse)
    remove_checkpoint(out)
    return promised


def opened(
    bundle: Path, dataset: Dataset, out: Path
) -> tuple[Sequence[Callable[[], Recording]], _core.Bundle, Sequence[Any], dict]:
    """Calibration recordings, the bundle, its loss history and provenance, before anything is done."""
    loaders: Sequence[Callable[[], Recording]] = dataset.stretches("calibration")
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


def fitting(bundle: _core.Bundle, loaders: Sequence[Callable[[], Recording]]) -> Iterator[Recording]:
    """Load the recordings one by one and check that they have the bundle's robot, rate and timing."""
    for recording in ahead(loaders):
        expect_fit(bundle, recording)
        yield recording


def refit_scale(
    bundle: _core.Bundle, loaders: Sequence[Callable[[], Recording]], threads: int, report: Reporter = SILENT
) -> tuple[Sequence[Callable[[], Recording]], dict]:
    """Fit the error scale to the first recordings; returns the other loaders and facts for provenance.

    Raises:
        ConfigError: there is only one recording.
        TrainingError: no free motion, or too much that is impossible.
    """
    if len(loaders) < 2:
        raise ConfigError("refit-error-scale needs 2 calibration recordings or more: one to fit to, one for the limits")
    apart = max(1, round(SCALE_SHARE * len(loaders)))
    names: list[str] = []
    left_out = LeftOut("calibration")

    def load_some() -> Iterator[Recording]:
        for recording in ahead(loaders[:apart]):
            yield counted(bundle, recording, names, left_out)

    bundle.error_scale = _core.ErrorScaleSettings()
    with no_freeze(bundle):
        facts = fit_error_scale(bundle, collect_rows(bundle, load_some(), threads))
    return loaders[apart:], facts | {"recordings": names} | left_out_facts(left_out, report)


def counted(bundle: _core.Bundle, recording: Recording, names: list[str], left_out: LeftOut) -> Recording:
    """Return the recording after noting its name and counting impossible samples, which the bundle refuses itself."""
    expect_fit(bundle, recording)
    names.append(recording.name)
    left_out.find(recording, bundle.observer, SignalBounds.of(bundle))
    return recording


def left_out_facts(left_out: LeftOut, report: Reporter) -> dict:
    """Report impossible samples of the recordings; returns facts for provenance.

    Raises:
        TrainingError: too many samples are impossible.
    """
    left_out.expect_few()
    if not left_out.found:
        return {}
    report.say(left_out.sentence())
    return {"impossible": left_out.facts()}


@contextmanager
def no_freeze(bundle: _core.Bundle) -> Iterator[None]:
    """Keep limits to be replaced from freezing the drift tracker while new ones are found."""
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
    out: Path | None = None,
    poses: Sequence[Sequence[float]] | None = None,
) -> tuple[PromisedLimits, dict]:
    """Set the bundle's limits from the recordings; returns their promise and facts for provenance.

    A checkpoint beside `out`, the bundle to write, lets an interrupted run resume. The caller that writes the bundle
    calls `remove_checkpoint`.

    Args:
        poses: of the arm's motion; None: those that the bundle keeps.

    Raises:
        BundleError: a recording of another robot, rate or torque timing.
        TrainingError: no free motion, too few peaks, or too many impossible samples.
    """
    kept = kept_peaks(out, bundle, loaders, [asdict(alarm), asdict(margins)])
    names = list(kept.names) if kept else []
    for folder in folders_of(loaders):
        expect_journal(folder)
    left_out = LeftOut("calibration")
    with report.progress(f"calibrate {name}") as show:

        def load_all() -> Iterator[Recording]:
            for recording in ahead(loaders[: len(names)]):  # their impossible samples are reported again
                left_out.find(recording, bundle.observer, SignalBounds.of(bundle))
            for recording in ahead(loaders[len(names) :]):
                yield counted(bundle, recording, names, left_out)
                show(len(names), len(loaders), "recordings")

        with no_freeze(bundle):
            store = HeldStore(kept)
            found = collect_peaks(bundle, load_all(), alarm.holds_s, threads, margins=margins, kept=store)
            labels = [label for folder in folders_of(loaders) for label in read_labels(folder)]
            suspects = find_suspects(bundle, found[-1], lambda k: loaders[k](), labels, threads)
            forget(store.collectors, suspects)
    promised = set_limits(bundle, store, alarm, threads, len(suspects), margins, poses)
    for words in suspect_sentences(suspects):
        report.say(words)
    units = dict(zip((link.joint_name for link in bundle.links), bundle.estimate_units, strict=True))
    for moment in promised.moments:
        report.say(moment.sentence(units[moment.joint]))
    facts = promised.facts() | {"recordings": names} | left_out_facts(left_out, report)
    return promised, facts | ({"suspected": suspect_facts(suspects)} if suspects else {})


def set_limits(
    bundle: _core.Bundle,
    peaks: PeakStore,
    alarm: AlarmConfig,
    threads: int,
    suspects: int,
    margins: FreeMotionConfig = FreeMotionConfig(),  # noqa: B008
    poses: Sequence[Sequence[float]] | None = None,
) -> PromisedLimits:
    """Set the bundle's limits by the peaks of its errors; returns their promise.

    Args:
        suspects: number of suspects that were left out of the peaks.
        poses: see calibrate_bundle().

    Raises:
        TrainingError: no free motion, or too few peaks.
    """
    with no_freeze(bundle):
        promised = promised_limits(bundle, lambda: [], alarm, threads, margins, kept=peaks, poses=poses)
    promised = replace(promised, suspects=suspects)
    apply_promised(bundle, promised, alarm)
    return promised


def kept_peaks(
    out: Path | None, bundle: _core.Bundle, loaders: Sequence[Callable[[], Recording]], settings: list
) -> KeptPeaks | None:
    """Checkpoint of an interrupted run for these files and this bundle; None: none."""
    if out is None or not all(isinstance(load, partial) for load in loaders):
        return None
    files = [(path.name, path.stat().st_size, path.stat().st_mtime_ns) for path in map(file_of, loaders)]
    labels = sorted({labels_key(folder) for folder in folders_of(loaders)} - {""})
    out.parent.mkdir(parents=True, exist_ok=True)
    work = json.dumps([VERSION, hashlib.sha256(bundle.to_bytes()).hexdigest(), files, settings, *labels])
    return KeptPeaks(Checkpoint(checkpoint_file(out), hashlib.sha256(work.encode()).hexdigest()))


def folders_of(loaders: Sequence[Callable[[], Recording]]) -> list[Path]:
    """Folders of the files that a dataset's loaders read; none for recordings in memory."""
    folders = [file_of(load).parent for load in loaders if isinstance(load, partial)]
    return list({str(one): one for one in folders}.values())


def file_of(load: Callable[[], Recording]) -> Path:
    """File that a dataset's loader reads."""
    assert isinstance(load, partial)
    return Path(load.args[0])


def checkpoint_file(out: Path) -> Path:
    """Path of the checkpoint for a bundle's limits."""
    return out.with_suffix(".limits.half-done")


def remove_checkpoint(out: Path) -> None:
    """Delete the checkpoint after the bundle is written."""
    checkpoint_file(out).unlink(missing_ok=True)
