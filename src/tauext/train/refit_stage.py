"""A new bundle from an old one and some motion of today: look, cut, fit, say what changed, write."""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import cast

import numpy as np

from tauext import _core
from tauext.bundle.bundle_file import load_bundle, write_bundle
from tauext.bundle.bundle_fit import expect_fit
from tauext.bundle.loss_history import read_loss_history
from tauext.check.rejected import Rejected
from tauext.check.verdict import expect_codes, judge
from tauext.check.viewing import look_at_calibration
from tauext.config import FreeMotionConfig
from tauext.data.cut import within
from tauext.data.dataset import load_dataset
from tauext.data.free_motion import free_samples
from tauext.data.impossible import LeftOut, SignalBounds, possible_parts
from tauext.data.recording import Recording, TorqueTiming
from tauext.data.recording_file import load_recording
from tauext.data.stretches import FOR_LIMITS
from tauext.errors import ConfigError, TrainingError
from tauext.files.fetching import local_file
from tauext.files.place import Place
from tauext.files.provenance import provenance
from tauext.files.room import expect_new_file
from tauext.fit.fleet_prior import FleetPrior
from tauext.progress import SILENT, Reporter
from tauext.train.fleet import expect_days, expectations, settings_with
from tauext.train.report import JointReport, Refitted, Touch
from tauext.train.standing import STANDS, sentence, standing

MARGINS = FreeMotionConfig()


@dataclass(frozen=True)
class Span:
    """Which part of each recording is used, [s] after its first sample.

    Raises:
        ConfigError: a time that is not finite, or an end that is not behind the beginning.
    """

    from_s: float = 0.0
    to_s: float | None = None
    """None: to the end."""

    def __post_init__(self) -> None:
        end = np.inf if self.to_s is None else self.to_s
        if not 0 <= self.from_s < end or self.to_s == np.inf:
            raise ConfigError(f"from = {self.from_s:g} s to {end:g} s must be a time of the recording, from 0 on")

    def of(self, recording: Recording) -> Recording | None:
        """That part; None where the recording ends before."""
        start_s = recording.provenance.get("start_s", 0.0)
        end_s = np.inf if self.to_s is None else self.to_s
        return within(recording, self.from_s + start_s, end_s + start_s, recording.name)


def refit_bundle(
    bundle: Place,
    data: Place,
    out: Place,
    span: Span = Span(),
    threads: int = 0,
    report: Reporter = SILENT,
    accept: Sequence[str] = (),
    like: FleetPrior | None = None,
) -> Refitted:
    """Write a bundle like this one whose friction is that of the arm in today's recordings.

    First the doctor's cheap checks look at them (tauext.check): faults refuse, warnings are told and kept.

    Args:
        data: a recording, or a dataset folder, whose training recordings are used.
        accept: codes of the doctor that are no fault on your word, CODE or CODE:joint; they stand in the bundle.
        like: what a fleet of arms of this type knows; None: joints that hardly moved stay as they were.

    Raises:
        FaultyDataError: a recording has a fault that is not accepted.
        ConfigError: no recording, or no sample of it in the span.
        BundleError: there is no such bundle; joints, rate or timing of a recording are not the bundle's.
        TrainingError: the bundle has no prior; too little motion, or motion that no friction explains or the
            bundle's monitor rejects.
    """
    started = time.monotonic()
    expect_codes(accept)
    expect_new_file(out)
    loaded = load_bundle(bundle)
    expect_prior(loaded, bundle)
    expect_codes(accept, [link.joint_name for link in loaded.links])
    if like is not None:
        expect_days(like, loaded)
    files = recording_files(data)
    recordings = [load_recording(file, FOR_LIMITS) for file in files]
    for recording in recordings:
        expect_fit(loaded, recording)
    in_nm = all(unit == "N m" for unit in loaded.torque_units)
    look = look_at_calibration(files, np.array(loaded.torque_limit_nm) if in_nm else None, threads, report)
    judge([look], str(data), accept, report)
    spans = [part for recording in recordings if (part := span.of(recording)) is not None]
    if not spans:
        raise ConfigError(f"{data}: no recording has a sample from {span.from_s:g} s on")
    rejected = Rejected.of(loaded, spans, threads or os.cpu_count() or 1)
    if words := rejected.warning("today's motion", accept):
        report.say(words)
    refitted = refit_recordings(loaded, spans, threads, report, like)
    facts = json.loads(loaded.provenance or "{}")
    history = read_loss_history(loaded, bundle) or []
    settings = {
        "bundle": bundle.name,
        "bundle_sha256": file_sha256(bundle),
        "data": {file.name: file_sha256(file) for file in files},
        "span": asdict(span),
    }
    facts["look"] = facts.get("look", {}) | {"refit": look.facts(accept)}
    facts["refitted"] = provenance("tauext refit", settings, seed=None) | refitted.facts()
    if like is not None:
        facts["refitted"]["like"] = {"sha256": like.sha256, "arms": [one["name"] for one in like.facts.get("arms", [])]}
    if words:
        facts["refitted"]["rejected"] = rejected.facts()
    refitted.bundle.name = out.stem
    refitted.bundle.provenance = json.dumps(facts, sort_keys=True)
    run = facts | {"loss_history": history}
    write_bundle(refitted.bundle, out, run, {"refit_s": time.monotonic() - started})
    return refitted


def refit_recordings(
    bundle: _core.Bundle,
    recordings: Sequence[Recording],
    threads: int = 0,
    report: Reporter = SILENT,
    like: FleetPrior | None = None,
) -> Refitted:
    """The same in memory, and nothing is looked at: what a monitor's buffer recorded, for example.

    Labelled contacts are cut out with the margins of training. The provenance stays the old one's.

    Raises:
        ConfigError: a fleet prior of another arm, or one that knows no days.
        TrainingError: as refit_bundle.
    """
    days = None if like is None else expect_days(like, bundle)
    left_out = LeftOut("refit")
    parts = possible_parts(recordings, bundle.observer, SignalBounds.of(bundle), left_out)
    if said := left_out.sentence():
        report.say(said)
    sources = [(r.t_ns, r.q, r.dq, r.tau, free_samples(r, MARGINS).astype(np.uint8)) for r in parts]
    follows = np.zeros(bundle.joints, dtype=bool)
    try:
        found = _core.refit(bundle, sources, threads=threads or os.cpu_count() or 1)
        if days is not None and (told := expected_of(found, days)) is not None:
            follows = told[2]
            found = _core.refit(bundle, sources, settings_with(*told), threads=threads or os.cpu_count() or 1)
    except _core.CoreError as error:
        raise TrainingError(str(error)) from error
    limits = json.loads(bundle.provenance or "{}").get("limits", {})
    joints = [
        JointReport.of(bundle, j, one, standing(found, bundle, limits, j), bool(follows[j]))
        for j, one in enumerate(found.joints)
    ]
    touches = [touch_of(touch, parts) for touch in found.touches]
    for touch in touches:
        report.say(touch.sentence())
    still_open = [one.joint for one in joints if one.promise != STANDS]
    words = sentence(limits, found.used_s, still_open)
    return Refitted(found.bundle, joints, touches, found.used_s, found.memory_s, words)


def expected_of(found: _core.Refit, days: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """What the joints that moved say of the others; see expectations."""
    factor, error = np.array([one.coulomb for one in found.joints]).T
    return expectations(factor, error, np.array([one.moved_s for one in found.joints]), days)


def refit_motion(
    bundle: _core.Bundle,
    motion: Mapping[str, np.ndarray],
    report: Reporter = SILENT,
    like: FleetPrior | None = None,
) -> Refitted:
    """The same of what `Monitor.finish_refit` gives.

    Raises:
        TrainingError: as refit_bundle.
    """
    observer = bundle.observer
    recording = Recording(
        name="morning",
        joints=tuple(link.joint_name for link in bundle.links),
        t_ns=motion["t_ns"],
        q=motion["q"],
        dq=motion["dq"],
        tau=motion["tau"],
        rate_hz=1e9 / observer.sample_period_ns,
        torque_timing=cast(TorqueTiming, observer.timing.name),
        source="a monitor's refit",
        robot_sha256="",
    )
    return refit_recordings(bundle, [recording], report=report, like=like)


def touch_of(touch: _core.RefitTouch, recordings: Sequence[Recording]) -> Touch:
    """With names, and times from the recording's first sample on."""
    recording = recordings[touch.source]
    start_ns = int(recording.t_ns[0]) - round(1e9 * recording.provenance.get("part", {}).get("from_s", 0.0))
    from_s, to_s = 1e-9 * (touch.from_ns - start_ns), 1e-9 * (touch.to_ns - start_ns)
    return Touch(recording.name, recording.joints[touch.joint], from_s, to_s, touch.share, touch.counted)


def expect_prior(bundle: _core.Bundle, path: Place) -> None:
    """Raise TrainingError where there is nothing that could be brought up to date."""
    if not bundle.prior.terms:
        raise TrainingError(
            f"{path}: the bundle has no prior, whose friction could be brought up to date; train one with recipe "
            "tauext or prior, or train this one anew on today's recordings"
        )


def recording_files(data: Place) -> list[Place]:
    """A recording's file, or those of a dataset's training recordings.

    Raises:
        ConfigError: there are none.
    """
    if data.is_file():
        return [data]
    files = load_dataset(data).files("train")
    if not files:
        raise ConfigError(f"{data}: split.json lists no training recording, of which refit takes today's motion")
    return files


def file_sha256(path: Place) -> str:
    """Of a file's bytes."""
    with local_file(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
