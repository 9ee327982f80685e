"""Limits with a stated rate of false alarms, from calibration recordings."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tauext import _core
from tauext.bundle.match import expect_fit
from tauext.config import AlarmConfig
from tauext.data.dataset import ahead
from tauext.data.free_motion import LeftOut, NotFree, SignalBounds
from tauext.data.labels import labels_key, read_labels
from tauext.data.recording import Recording
from tauext.files.checkpoint import Checkpoint
from tauext.files.provenance import VERSION
from tauext.fit.limits_together import ShareConfig, TailCurve, rates_together
from tauext.fit.stable_choice import simplest
from tauext.fit.tail import FalseAlarmBudget, Promise, Tail, TailConfig, TooFewPeaks, duration, fit_tail, upper_rate
from tauext.train.held_peaks import REGIONS, Moment, Peaks, carrying_moments, collect_peaks
from tauext.train.hits import hits
from tauext.train.paper_limits import LimitMotion, Loaders, set_limits
from tauext.train.suspects import Suspect, find_suspects, forget, suspect_facts, suspect_sentences

# --- Limits for a budget of false alarms, as far as the recordings support it.


@dataclass(frozen=True)
class LimitsConfig:
    """How limits follow from peaks of the error."""

    tail: TailConfig = TailConfig()
    """Fit of the tails."""
    share: ShareConfig = ShareConfig()
    """How joints and regions share the budget."""
    confidence: float | None = None
    """Confidence with which the limits together keep the budget; None: the promise's."""
    at_most_seen: bool = False
    """Bound limits by `most_seen` of the largest peaks, even if the fitted tail reaches further."""
    most_beyond: float = 2.0
    """Largest limit, as a multiple of the largest error seen: the recordings are long enough to bound the rate over
    that error itself, and a tail that reaches further is one that a touch or another fault has bent."""
    hard_push: float = 3.0
    """Push for comparing hold times, as a multiple of the limit without hold time; a harder one favours short ones."""
    hold_worth: float = 0.01
    """Share by which a longer hold time must detect that push sooner; tail fits are no more precise."""


@dataclass(frozen=True)
class PromisedLimits:
    """Limits of both levels, their hold time, and their promise."""

    collision: np.ndarray
    """(regions, joints), [N m]; infinite for joints that are not monitored."""
    contact: np.ndarray
    hold_s: float
    contact_hold_s: float
    promise: Promise
    budget: FalseAlarmBudget
    """Budget of the limits: the requested one, or the smallest that the recordings support."""
    tails: dict
    """Facts of each fit, by joint and region."""
    rates_per_hour: np.ndarray
    """Mean rate that each collision limit is allowed, (monitored joints, regions), [1/h]."""
    moments: list[Moment] = field(default_factory=list)
    """Moments that alone determine a collision limit."""
    suspects: int = 0
    """Number of suspected touches left out of the peaks."""
    peaks: Peaks | None = None
    """Of the monitored joints, at the hold time of a collision."""

    @property
    def misfits(self) -> list[str]:
        """Joints and regions whose tail is no generalised Pareto distribution, so that their limits are uncertain."""
        return [name for name, tail in self.tails.items() if not tail["fits"]]

    def sentence(self) -> str:
        """Sentences on the promise, the budget of the limits, and tails that do not fit."""
        words = self.promise.sentence()
        if not self.promise.is_supported:
            words += f" The thresholds are set for {self.budget}."
        if self.suspects:
            words += f" {self.suspected()}"
        if self.misfits:
            words += (
                f" The tail of {', '.join(self.misfits)} fits no known shape; its threshold is a conservative guess."
            )
        return words

    @property
    def bound_per_hour(self) -> float:
        """Upper bound of the false alarm rate if all suspects were free motion, [1/h]: the budget's and theirs."""
        hours, confidence = self.promise.hours, self.promise.confidence
        of_suspects = upper_rate(self.suspects, hours, confidence) - upper_rate(0, hours, confidence)
        return self.budget.rate_per_hour + of_suspects

    def suspected(self) -> str:
        """Sentence on the promise with and without the suspects."""
        several = self.suspects > 1
        return (
            f"{self.suspects} unlabelled contact{'s are' if several else ' is'} left out: at most {self.budget}; if "
            f"{'they were' if several else 'it was'} none, 1 in {duration(1 / self.bound_per_hour, 'down')}."
        )

    def put(self, bundle: _core.Bundle, alarm: AlarmConfig) -> None:
        """Set limits and hold times of a bundle."""
        set_limits(bundle, self.collision, alarm, self.contact, (self.hold_s, self.contact_hold_s))

    def facts(self) -> dict:
        """All of it for JSON."""
        suspected = {"suspects": self.suspects, "bound_per_hour": self.bound_per_hour} if self.suspects else {}
        return {
            "sentence": self.sentence(),
            "promise": self.promise.summary(),
            "set_for": str(self.budget),
            **suspected,
            "hold_s": self.hold_s,
            "tails": self.tails,
            **({"one_moment": [moment.facts() for moment in self.moments]} if self.moments else {}),
        }


def promised_limits(
    bundle: _core.Bundle,
    peaks: Sequence[Peaks],
    alarm: AlarmConfig,
    config: LimitsConfig = LimitsConfig(),
    poses: Sequence[Sequence[float]] | None = None,
) -> PromisedLimits:
    """Find limits from the tail of the error on calibration recordings, not used in training or validation.

    The budget is the arm's: peaks of the held error exceed all limits together at most at its rate, with the confidence
    of the promise. How much of it each joint and region gets is chosen so that hits on the links are detected from the
    smallest force on (rates_together). No limit is below a peak that its own share does not allow. If the recordings
    are too short, the limits are set for the smallest supported budget, and the promise states how much is missing.

    Args:
        peaks: one for each of alarm.holds_s (collect_peaks).
        poses: of the arm's motion, in which the links are hit; None: those that the bundle keeps.

    Raises:
        TrainingError: too few peaks.
        ConfigError: the peaks are of no time.
    """
    watched = np.flatnonzero(bundle.monitored)
    peaks = [one.of_joints(watched) for one in peaks]
    asked = FalseAlarmBudget(alarm.false_alarms, alarm.in_hours)
    promise = Promise(asked, peaks[0].hours, confidence=alarm.confidence)
    budget = asked if promise.is_supported else promise.supported
    hits_nm = hits(bundle, poses)[:, watched]

    def limits(peaks: Peaks, budget: FalseAlarmBudget, confidence: float) -> tuple[np.ndarray, dict, np.ndarray]:
        tails = [joint_tails(nm, peaks.hours, config) for nm in peaks.nm]
        rates = rates_together(tails, budget, confidence, hits_nm, peaks.region_hours, config.share)
        return *limits_of(peaks.joints, tails, rates, confidence, config), rates

    confidence = alarm.confidence if config.confidence is None else config.confidence
    choices = [limits(one, budget, confidence) for one in peaks]
    best = soonest([one[0][0] for one in choices], alarm.holds_s, bundle.observer.gain_per_s, config)
    collision, tails, rates = choices[best]
    # A contact's hold time is at least a collision's: its limits are no higher, so short errors would cross them at
    # once.
    held = next(k for k, hold in enumerate(alarm.holds_s) if hold >= alarm.contact_hold_s or k == len(peaks) - 1)
    held = max(held, best)
    contact = np.minimum(limits(peaks[held], FalseAlarmBudget(alarm.contacts_an_hour, 1.0), 0.5)[0], collision)
    moments = decisive_moments(peaks[best], rates, confidence, config)
    of_arm = np.full((2, len(REGIONS), bundle.joints), np.inf)
    of_arm[:, :, watched] = collision, contact
    holds_s = alarm.holds_s[best], alarm.holds_s[held]
    return PromisedLimits(of_arm[0], of_arm[1], *holds_s, promise, budget, tails, rates, moments, peaks=peaks[best])


def soonest(sliding_nm: Sequence[np.ndarray], holds_s: Sequence[float], gain_per_s: float, config: LimitsConfig) -> int:
    """Which of these hold times detects a hard push first; a longer one lowers the limits and delays every alarm.

    With an observer output of S (1 - exp(-K0 t)), on the mean over joints in the sliding region,

        t = -ln(1 - limit(hold) / S) / K0 + hold,     S = hard_push limit(0)

    Args:
        sliding_nm: limits of each hold time, (joints,) each.
    """

    def delay_s(choice: int) -> float:
        share = np.minimum(sliding_nm[choice] / (config.hard_push * sliding_nm[0]), 0.999)
        return float(np.mean(-np.log1p(-share)) / gain_per_s + holds_s[choice])

    return simplest(range(len(holds_s)), delay_s, config.hold_worth)


def decisive_moments(peaks: Peaks, rates: np.ndarray, confidence: float, config: LimitsConfig) -> list[Moment]:
    """Moments that alone determine a limit at these rates; none if there are too few peaks without them."""

    def of_joint(joint: int, nm: Sequence[np.ndarray]) -> np.ndarray:
        tails = joint_tails(nm, peaks.hours, config)
        return np.maximum.accumulate(joint_levels(tails, joint, rates[joint], confidence, config))

    try:
        return carrying_moments(peaks, of_joint)
    except TooFewPeaks:
        return []


def limits_of(
    joints: Sequence[str],
    tails: Sequence[Sequence[Tail]],
    rates: np.ndarray,
    confidence: float,
    config: LimitsConfig,
) -> tuple[np.ndarray, dict]:
    """Find limits that these tails exceed at these mean rates, (joints, regions); returns them, (regions, joints), and
    facts of each by joint and region."""
    found = np.array([joint_levels(own, j, rates[j], confidence, config) for j, own in enumerate(tails)])
    facts = {
        f"{joint} {region}": tails[j][r].summary()
        | {"limit_nm": float(found[j, r]), "allowed_per_hour": float(rates[j, r])}
        for j, joint in enumerate(joints)
        for r, region in enumerate(REGIONS)
    }
    return np.maximum.accumulate(found, axis=1).T, facts


def joint_levels(
    tails: Sequence[Tail], joint: int, rates: np.ndarray, confidence: float, config: LimitsConfig
) -> np.ndarray:
    """Levels of a joint's regions, (regions,)."""
    levels = []
    for region, (tail, rate) in enumerate(zip(tails, rates.tolist(), strict=True)):
        level = TailCurve(tail, joint * len(REGIONS) + region).level(rate)
        level = min(max(level, tail.seen(rate, confidence)), config.most_beyond * float(tail.peaks_nm[0]))
        levels.append(min(level, most_seen(tail.peaks_nm)) if config.at_most_seen else level)
    return np.array(levels)


def most_seen(peaks_nm: np.ndarray) -> float:
    """Geometric mean of the two largest peaks, [N m]: an event twice as large as any other counts 1.4 times.

    Args:
        peaks_nm: descending, (peaks,), two or more.
    """
    return float(np.sqrt(peaks_nm[0] * peaks_nm[1]))


def joint_tails(nm: Sequence[np.ndarray], hours: float, config: LimitsConfig) -> list[Tail]:
    """Fit the tails of a joint's regions; one that the joint hardly enters uses the peaks of all.

    Raises:
        TooFewPeaks: there are too few in all.
    """

    def of(region: int) -> Tail:
        try:
            return fit_tail(nm[region], hours, config.tail)
        except TooFewPeaks:
            return fit_tail(np.concatenate(nm), hours, config.tail)

    return [of(region) for region in range(len(REGIONS))]


# --- The strategy: calibration recordings, their peaks without suspected touches, and a checkpoint of them.


def put_promised(bundle: _core.Bundle, motion: LimitMotion, config: LimitsConfig = LimitsConfig()) -> dict:
    """Limits with a stated rate of false alarms, from calibration recordings; see calibrated()."""
    promised, facts = calibrated(bundle, motion, config)
    note_moments(bundle, promised.moments, motion.note)
    return facts


def calibrated(
    bundle: _core.Bundle, motion: LimitMotion, config: LimitsConfig = LimitsConfig()
) -> tuple[PromisedLimits, dict]:
    """Set the limits of the budget that calibration recordings support; returns them and their facts.

    An interrupted run resumes from its checkpoint. The caller that writes the bundle calls `remove_checkpoint`.

    Raises:
        BundleError: a recording of another robot, rate or torque timing.
        TrainingError: no free motion, too few peaks, or too many impossible samples.
    """
    peaks, suspects, facts = motion.peaks, motion.suspects, dict[str, Any]()
    with no_freeze(bundle):
        if peaks is None:
            peaks, found, left_out = calibration_peaks(bundle, motion)
            suspects, facts = len(found), {"recordings": peaks[0].recordings} | left_out_facts(left_out, motion.note)
            facts |= {"suspected": suspect_facts(found)} if found else {}
        promised = promised_limits(bundle, peaks, motion.alarm, config, motion.poses)
    promised = replace(promised, suspects=suspects)
    promised.put(bundle, motion.alarm)
    return promised, promised.facts() | facts


def calibration_peaks(bundle: _core.Bundle, motion: LimitMotion) -> tuple[list[Peaks], list[Suspect], LeftOut]:
    """Peaks of the calibration recordings without suspected touches, these suspects, and impossible samples."""
    loaders, folders, left_out = motion.calibration, folders_of(motion.calibration), LeftOut("calibration")
    not_free = NotFree(motion.margins)
    checkpoint = checkpoint_of(bundle, motion)
    before = (checkpoint and checkpoint.load(list[Peaks])) or []
    done = len(before[0].recordings) if before else 0
    labels = [label for folder in folders for label in read_labels(folder, to_train=True)]
    with motion.report.progress(f"calibrate {motion.name}") as show:

        def not_done() -> Iterator[Recording]:
            for number, recording in enumerate(counted(bundle, loaders, left_out)):
                not_free.add([recording])
                if number >= done:  # the impossible samples of the others are reported again
                    yield recording
                    show(number + 1, len(loaders), "recordings")

        holds_s, threads, margins = motion.alarm.holds_s, motion.threads, motion.margins
        peaks = collect_peaks(bundle, not_done(), holds_s, threads, margins, before, checkpoint)
        suspects = find_suspects(bundle, peaks[-1], lambda number: loaders[number](), labels, threads)
        forget(peaks, suspects)
    if words := not_free.sentence():
        motion.note(f"calibration: {words}")
    for words in suspect_sentences(suspects):
        motion.note(words)
    return peaks, suspects, left_out


def fitting(bundle: _core.Bundle, loaders: Loaders) -> Iterator[Recording]:
    """Load the recordings one by one.

    Raises:
        BundleError: a recording of another robot, rate or torque timing.
    """
    for recording in ahead(loaders):
        expect_fit(bundle, recording)
        yield recording


def counted(bundle: _core.Bundle, loaders: Loaders, left_out: LeftOut) -> Iterator[Recording]:
    """Load the recordings one by one and count impossible samples, which the bundle refuses itself."""
    for recording in fitting(bundle, loaders):
        left_out.find(recording, bundle.observer, SignalBounds.of(bundle))
        yield recording


def left_out_facts(left_out: LeftOut, note: Callable[[str], None]) -> dict:
    """Facts on impossible samples of recordings, with a note.

    Raises:
        TrainingError: too many samples are impossible.
    """
    left_out.expect_few()
    if not left_out.found:
        return {}
    note(left_out.sentence())
    return {"impossible": left_out.facts()}


@contextmanager
def no_freeze(bundle: _core.Bundle) -> Iterator[None]:
    """Keep limits to be replaced from freezing the drift tracker while new ones are found."""
    share, bundle.drift.freeze_share = bundle.drift.freeze_share, 0.0
    try:
        yield
    finally:
        bundle.drift.freeze_share = share


def note_moments(bundle: _core.Bundle, moments: Sequence[Moment], note: Callable[[str], None]) -> None:
    """Ask the user to inspect moments that alone determine a limit."""
    units = dict(zip((link.joint_name for link in bundle.links), bundle.estimate_units, strict=True))
    for moment in moments:
        note(moment.sentence(units[moment.joint]))


def checkpoint_of(bundle: _core.Bundle, motion: LimitMotion) -> Checkpoint | None:
    """Checkpoint of an interrupted run for these files and this bundle; None: recordings are in memory."""
    if motion.out is None or not all(isinstance(load, partial) for load in motion.calibration):
        return None
    files = [(path.name, path.stat().st_size, path.stat().st_mtime_ns) for path in map(file_of, motion.calibration)]
    labels = sorted({labels_key(folder) for folder in folders_of(motion.calibration)} - {""})
    motion.out.parent.mkdir(parents=True, exist_ok=True)
    settings = [asdict(motion.alarm), asdict(motion.margins)]
    work = json.dumps([VERSION, hashlib.sha256(bundle.to_bytes()).hexdigest(), files, settings, *labels])
    return Checkpoint(checkpoint_file(motion.out), hashlib.sha256(work.encode()).hexdigest())


def folders_of(loaders: Loaders) -> list[Path]:
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
