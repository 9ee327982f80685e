"""Refit a bundle to recent motion."""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol, cast

import numpy as np

from tauext import _core
from tauext.bundle.bundle_file import load_bundle, write_bundle
from tauext.bundle.estimates import number
from tauext.bundle.loss_history import read_loss_history
from tauext.bundle.match import expect_fit
from tauext.check.before_training import Rejected, check_for_bundle, expect_codes
from tauext.config import FreeMotionConfig, checked
from tauext.data.dataset import FOR_LIMITS, load_dataset
from tauext.data.free_motion import LeftOut, SignalBounds, free_samples, possible_parts, within
from tauext.data.recording import Recording, TorqueTiming
from tauext.data.recording_file import load_recording
from tauext.errors import ConfigError, TooLittleMotionError, TrainingError
from tauext.files.preflight import expect_new_file
from tauext.files.provenance import provenance
from tauext.fit.tail import FalseAlarmBudget, Promise, duration, is_kept
from tauext.progress import SILENT, Reporter, WallTimes
from tauext.train.declared_spread import noticed_standing
from tauext.train.held_peaks import REGIONS, peak_indices

LEAST_MOVED_S = 10.0
"""Least motion of a joint for estimating its friction."""


class Like(Protocol):
    """What arms of one type have in common; a package reads it from the file of `tauext refit --like`."""

    def expect_bundle(self, bundle: _core.Bundle) -> None:
        """Raise ConfigError if it does not apply to this bundle."""

    def expected(self, found: _core.Refit) -> tuple[_core.RefitSettings, np.ndarray] | None:
        """Settings of a second refit, in which joints that hardly moved follow the others; which do, (n,) bool.

        Args:
            found: first refit, from the arm's motion alone.

        Returns: None: no joint follows.
        """

    def identity(self) -> dict:
        """Facts for provenance."""


# --- Whether the old promise still holds for each joint.
#
# A minute cannot confirm a promise of hours, but it can contradict one. The limits were found from a tail: peaks of the
# error over a threshold, at some rate. After the refit, peaks over that threshold, raised with the limits, must not be
# more frequent than then.


STANDS, NOT_MONITORED = "stands", "not monitored"


def standing(found: _core.Refit, bundle: _core.Bundle, limits: Mapping[str, Any], joint: int) -> str:
    """Return `stands`, `not monitored`, or the reason why the promise is open for this joint.

    Args:
        bundle: the old bundle.
        limits: the entry on limits in its provenance.
    """
    of_joint = found.joints[joint]
    if not bundle.monitored[joint]:
        return NOT_MONITORED
    if not promised(limits):
        return "none was made"
    if of_joint.moved_s < LEAST_MOVED_S:
        return f"open: it moved for {of_joint.moved_s:.1f} s, and {LEAST_MOVED_S:g} s are needed"
    if any(touch.counted and touch.joint == joint for touch in found.touches):
        return "open: its error is over its old threshold too often for touches"
    name = bundle.links[joint].joint_name
    usual_nm = (bundle.sliding_limit_nm[joint], bundle.near_stiction_limit_nm[joint])
    for region, limit_nm in zip(REGIONS, usual_nm, strict=True):
        tail = limits["tails"].get(f"{name} {region}")
        if tail is None:
            return "open: the bundle does not state the basis of its threshold"
        over = of_joint.limit_factor * tail["threshold_nm"] / limit_nm
        count, hours = peaks_over(found, joint, region, over), found.used_s / 3600
        if not is_kept(count, hours, tail["rate_per_hour"]):
            usual = tail["rate_per_hour"] * hours
            where = region.replace("_", " ")
            return f"open: {count} errors over {over:.0%} of its threshold {where}, and {usual:.2g} were usual"
    return STANDS


def promised(limits: Mapping[str, Any]) -> bool:
    """Whether the limits follow from a tail and a budget."""
    return bool(limits.get("tails")) and "promise" in limits


def peaks_over(found: _core.Refit, joint: int, region: str, share: float) -> int:
    """Separate peaks of the left-out error over this share of the limit, while the joint was in the region."""
    left_out = found.left_out
    inside = left_out["free"].astype(bool) & (left_out["near_stiction"][:, joint] == REGIONS.index(region))
    values = np.where(inside, left_out["share"][:, joint], 0.0)
    return len(peak_indices(values, left_out["t_ns"], floor=share))


def sentence(limits: Mapping[str, Any], used_s: float, open_joints: list[str]) -> str:
    """Message: which part of the old promise holds, and what a new promise needs."""
    if not promised(limits):
        return "The bundle's thresholds have no target false alarm rate, before and after."
    asked = limits["promise"]["asked"]
    budget = FalseAlarmBudget(asked["alarms"], asked["hours"])
    new = Promise(budget, used_s / 3600, confidence=limits["promise"]["confidence"])
    alone = f"{duration(used_s / 3600, 'down')} alone support 1 in {duration(new.supported.hours, 'down')}"
    take = f"to prove {budget} of today's arm by itself takes {duration(new.needed_hours, 'up')} of calibration"
    if open_joints:
        return (
            f"The target false alarm rate ({limits['set_for']}) is open at {', '.join(open_joints)}: {alone}; {take}."
        )
    words = f"The target false alarm rate ({limits['set_for']}) holds as far as the old errors are like today's"
    return f"{words}: {alone}; {take}."


# --- Results of a refit by joint, as text and as JSON.


@dataclass(frozen=True)
class JointReport:
    """Result of one joint. Factors are today's friction divided by the old one, with standard errors."""

    joint: str
    coulomb: tuple[float, float]
    """Factor of Coulomb, presliding and load-dependent friction."""
    viscous: tuple[float, float]
    constant: tuple[float, float]
    """Change of the constant, in the unit of the estimates."""
    unit: str
    moved_s: float
    error_ratio: float | None
    """Ratio of today's left-out error to the predicted standard error; None: unknown."""
    error_ratio_upper: float | None
    limit_factor: float
    sigma_factor: float
    promise: str
    follows: bool = False
    """Whether the joint hardly moved and its friction follows the other joints'."""

    @classmethod
    def of(
        cls, bundle: _core.Bundle, joint: int, found: _core.RefitJoint, promise: str, follows: bool = False
    ) -> JointReport:
        """Make the result of one joint of a refit."""
        return cls(
            joint=bundle.links[joint].joint_name,
            coulomb=found.coulomb,
            viscous=found.viscous,
            constant=(found.constant_nm, found.constant_error_nm),
            unit=bundle.estimate_units[joint],
            moved_s=found.moved_s,
            error_ratio=number(found.error_ratio),
            error_ratio_upper=number(found.error_ratio_upper),
            limit_factor=found.limit_factor,
            sigma_factor=found.sigma_factor,
            promise=promise,
            follows=follows,
        )


@dataclass(frozen=True)
class Touch:
    """A moment that no friction explains."""

    recording: str
    joint: str
    from_s: float
    """Begin, after the recording's first sample."""
    to_s: float
    limit_share: float
    """Largest error divided by the old collision limit."""
    counted: bool
    """Whether it counts as the joint's error and raised its limits, as moments are too many for touches."""

    def sentence(self) -> str:
        """Message that asks the user to inspect the moment."""
        what = "raised its thresholds" if self.counted else "was left out as a touch"
        return (
            f"{self.joint}: {self.from_s:.1f} to {self.to_s:.1f} s of '{self.recording}' is {self.limit_share:.1f} "
            f"times its threshold, which no friction explains, and {what}"
        )


@dataclass(frozen=True)
class Refitted:
    """A refitted bundle and its changes."""

    bundle: _core.Bundle
    joints: list[JointReport]
    touches: list[Touch]
    used_s: float
    memory_s: float
    """Correlation time of errors, [s]."""
    promise: str
    """Message on whether the old promise holds."""

    def facts(self) -> dict:
        """All values for JSON."""
        return {
            "used_s": round(self.used_s, 3),
            "memory_s": round(self.memory_s, 3),
            "joints": [asdict(joint) for joint in self.joints],
            "left_out": [asdict(touch) for touch in self.touches],
            "promise": self.promise,
        }

    def table(self) -> str:
        """Table for the terminal, one row a joint."""
        head = ["joint", "friction", "viscous", "constant", "thresholds", "false alarm rate"]
        rows = [head] + [
            [
                one.joint,
                f"x {one.coulomb[0]:.3f} ± {one.coulomb[1]:.3f}",
                f"x {one.viscous[0]:.3f} ± {one.viscous[1]:.3f}",
                f"{one.constant[0]:+.3g} ± {one.constant[1]:.1g} {one.unit}",
                f"x {one.limit_factor:.2f}",
                one.promise + "; its friction follows the other joints'" * one.follows,
            ]
            for one in self.joints
        ]
        widths = [max(len(row[k]) for row in rows) for k in range(len(head))]
        return "\n".join("  ".join(map(str.ljust, row, widths)).rstrip() for row in rows)


# --- A new bundle from an old one and today's motion: check, cut, fit, report changes, write.


@dataclass(frozen=True)
class Span:
    """Part of each recording that is used, [s] after its first sample.

    Raises:
        ConfigError: a time is not finite, or the end is not after the beginning.
    """

    from_s: float = 0.0
    to_s: float | None = None
    """None: to the end."""

    def __post_init__(self) -> None:
        end = np.inf if self.to_s is None else self.to_s
        if not 0 <= self.from_s < end or self.to_s == np.inf:
            raise ConfigError(f"from = {self.from_s:g} s to {end:g} s must be a time of the recording, from 0 on")

    def of(self, recording: Recording) -> Recording | None:
        """Return that part of a recording; None if the recording ends before."""
        start_s = recording.provenance.get("start_s", 0.0)
        end_s = np.inf if self.to_s is None else self.to_s
        return within(recording, self.from_s + start_s, end_s + start_s, recording.name)


@checked
def refit_bundle(
    bundle: Path,
    data: Path,
    out: Path,
    span: Span = Span(),
    threads: int = 0,
    report: Reporter = SILENT,
    accept: Sequence[str] = (),
    like: Like | None = None,
) -> Refitted:
    """Write a copy of a bundle with the friction of the arm in today's recordings.

    The quick checks (tauext.check) run first: faults are refused, warnings are reported and stored.

    Args:
        data: a recording, or a dataset folder, whose training recordings are used.
        accept: codes of findings that are accepted, CODE or CODE:joint; they are stored in the bundle.
        like: what arms of this type have in common; None: joints that hardly moved are unchanged.

    Raises:
        FaultyDataError: a recording has a fault that is not accepted.
        ConfigError: no recording, or no sample in the span.
        BundleError: no such bundle; joints, rate or timing of a recording differ from the bundle's.
        TrainingError: the bundle has no prior; too little motion, or motion that no friction explains or the bundle's
            monitor rejects.
    """
    started = time.monotonic()
    expect_codes(accept)
    expect_new_file(out)
    loaded = load_bundle(bundle)
    expect_prior(loaded, bundle)
    if like is not None:
        like.expect_bundle(loaded)
    files = recording_files(data)
    recordings = [load_recording(file, FOR_LIMITS) for file in files]
    for recording in recordings:
        expect_fit(loaded, recording)
    checked = check_for_bundle(loaded, "refit", files, str(data), accept, threads, report)
    spans = [part for recording in recordings if (part := span.of(recording)) is not None]
    if not spans:
        raise ConfigError(f"{data}: no recording has a sample from {span.from_s:g} s on")
    rejected = Rejected.of(loaded, spans, threads or os.cpu_count() or 1)
    if words := rejected.warning("today's motion", accept):
        report.say(words)
    refitted = refit_recordings(loaded, spans, threads, report, like)
    settings = {
        "bundle": bundle.name,
        "bundle_sha256": file_sha256(bundle),
        "data": {file.name: file_sha256(file) for file in files},
        "span": asdict(span),
    }
    made_by = provenance("tauext refit", settings, seed=None) | refitted.facts()
    made_by |= {"like": like.identity()} if like is not None else {}
    made_by |= {"rejected": asdict(rejected.summary())} if words else {}
    facts = json.loads(loaded.provenance or "{}")
    facts |= {"checks": facts.get("checks", {}) | checked, "refitted": made_by}
    if "standing" in facts:
        facts["standing"] = noticed_standing(refitted.bundle, facts.get("wrench", {}).get("poses", []))
    refitted.bundle.name = out.stem
    history = read_loss_history(loaded, bundle) or []
    write_bundle(refitted.bundle, out, facts, history, WallTimes({"refit": time.monotonic() - started}))
    return refitted


@checked
def refit_recordings(
    bundle: _core.Bundle,
    recordings: Sequence[Recording],
    threads: int = 0,
    report: Reporter = SILENT,
    like: Like | None = None,
) -> Refitted:
    """Refit a bundle in memory, without the data checks, for example on a monitor's buffer.

    Labelled contacts are cut out with the margins of training. Provenance stays unchanged.

    Raises:
        ConfigError: `like` does not apply to the bundle.
        TrainingError: see refit_bundle().
    """
    if like is not None:
        like.expect_bundle(bundle)
    left_out = LeftOut("refit")
    parts = possible_parts(recordings, bundle.observer, SignalBounds.of(bundle), left_out)
    if note := left_out.sentence():
        report.say(note)
    sources = [(r.t_ns, r.q, r.dq, r.tau, free_samples(r, FreeMotionConfig()).astype(np.uint8)) for r in parts]
    follows = np.zeros(bundle.joints, dtype=bool)
    try:
        found = _core.refit(bundle, sources, threads=threads or os.cpu_count() or 1)
        if like is not None and (expected := like.expected(found)) is not None:
            settings, follows = expected
            found = _core.refit(bundle, sources, settings, threads=threads or os.cpu_count() or 1)
    except _core.CoreError as error:
        kind = TooLittleMotionError if str(error).startswith("a refit needs ") else TrainingError
        raise kind(str(error)) from error
    limits = json.loads(bundle.provenance or "{}").get("limits", {})
    joints = [
        JointReport.of(bundle, j, one, standing(found, bundle, limits, j), bool(follows[j]))
        for j, one in enumerate(found.joints)
    ]
    touches = [touch_of(touch, parts) for touch in found.touches]
    for touch in touches:
        report.say(touch.sentence())
    still_open = [one.joint for one in joints if one.promise not in (STANDS, NOT_MONITORED)]
    words = sentence(limits, found.used_s, still_open)
    return Refitted(found.bundle, joints, touches, found.used_s, found.memory_s, words)


@checked
def refit_motion(
    bundle: _core.Bundle,
    motion: Mapping[str, np.ndarray],
    report: Reporter = SILENT,
    like: Like | None = None,
) -> Refitted:
    """Make the result of a refit from `Monitor.finish_refit`.

    Raises:
        ConfigError: a signal is missing.
        TrainingError: see refit_bundle().
    """
    observer, signals = bundle.observer, ("t_ns", "q", "dq", "tau")
    if missing := [signal for signal in signals if signal not in motion]:
        raise ConfigError(f"motion has no {', '.join(missing)}; it must be what Monitor.finish_refit() returned")
    kept: dict[str, Any] = {signal: motion[signal] for signal in signals}
    recording = Recording(
        name="morning",
        joints=tuple(link.joint_name for link in bundle.links),
        **kept,
        rate_hz=1e9 / observer.sample_period_ns,
        torque_timing=cast(TorqueTiming, observer.timing.name),
        source="a monitor's refit",
        robot_sha256="",
    )
    return refit_recordings(bundle, [recording], report=report, like=like)


def touch_of(touch: _core.RefitTouch, recordings: Sequence[Recording]) -> Touch:
    """Convert the core's touch, with names and times after the recording's first sample."""
    recording = recordings[touch.source]
    start_ns = int(recording.t_ns[0]) - round(1e9 * recording.provenance.get("part", {}).get("from_s", 0.0))
    from_s, to_s = 1e-9 * (touch.from_ns - start_ns), 1e-9 * (touch.to_ns - start_ns)
    return Touch(recording.name, recording.joints[touch.joint], from_s, to_s, touch.share, touch.counted)


def expect_prior(bundle: _core.Bundle, path: Path) -> None:
    """Raise TrainingError if the bundle has no prior to refit."""
    if not bundle.prior.terms:
        raise TrainingError(
            f"{path}: the bundle has no prior, whose friction could be refitted; train one with recipe "
            "tauext or prior, or retrain this one on today's recordings"
        )


def recording_files(data: Path) -> list[Path]:
    """Files of a recording or of a dataset's training recordings.

    Raises:
        ConfigError: there are none.
    """
    if data.is_file():
        return [data]
    files = load_dataset(data).files("train")
    if not files:
        raise ConfigError(f"{data}: split.json lists no training recording, from which refit takes today's motion")
    return files


def file_sha256(path: Path) -> str:
    """SHA-256 of a file's bytes."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
