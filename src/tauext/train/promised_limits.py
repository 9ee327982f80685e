"""Limits with a stated rate of false alarms, and their check on held-out motion."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field

import numpy as np

from tauext import _core
from tauext._core import MotionFeature
from tauext.check.before_training import expect_accepted
from tauext.check.finding import Finding, Severity
from tauext.check.sensors import torque_step_nm
from tauext.config import AlarmConfig, FreeMotionConfig
from tauext.data.recording import Recording
from tauext.fit.limits_together import TailCurve, rates_together
from tauext.fit.tail import (
    FalseAlarmBudget,
    Promise,
    Tail,
    TooFewPeaks,
    duration,
    fit_tail,
    held_minimum,
    hold_lengths,
    promised_per_hour,
    upper_rate,
)
from tauext.fit.ties import simplest
from tauext.train.error_scale import FEATURES, ErrorRows, Judged, LevelLimits, limit_weights
from tauext.train.held_peaks import (
    REGIONS,
    Moment,
    PeakCollector,
    Peaks,
    PeakStore,
    carrying_moments,
    cluster_peaks,
    collect_peaks,
    separate_peaks,
)
from tauext.train.hits import hits

# --- Limits for a budget of false alarms, as far as the recordings support it.


MOST_BEYOND = 2.0
"""Largest limit, as a multiple of the largest error seen: the recordings are long enough to bound the rate over that
error itself, and a tail that reaches further is one that a touch or another fault has bent."""
HARD_PUSH = 3.0
"""Push for comparing hold times, as a multiple of the limit without hold time."""

ROUNDED = 1e-9
"""Share by which equal rates may differ."""
HOLD_WORTH = 0.01
"""Share by which a longer hold time must detect that push sooner; tail fits are no more precise."""


@dataclass(frozen=True)
class PromisedLimits:
    """Limits of both levels, their hold time, and their promise."""

    collision: LevelLimits
    contact: LevelLimits
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

    @property
    def misfits(self) -> list[str]:
        """Joints and regions whose tail is no generalised Pareto distribution, so that their limits are uncertain."""
        return [name for name, tail in self.tails.items() if not tail["fits"]]

    def sentence(self) -> str:
        """Sentences on the promise, the budget of the limits, and tails that do not fit."""
        words = self.promise.sentence()
        if not self.promise.is_supported:
            words += f" The limits are set for {self.budget}."
        if self.suspects:
            words += f" {self.suspected()}"
        if self.misfits:
            words += f" The tail of {', '.join(self.misfits)} fits no known shape; its limit is a conservative guess."
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
            f"{self.suspects} suspected touch{'es are' if several else ' is'} left out: at most {self.budget}; if "
            f"{'they were' if several else 'it was'} none, 1 in {duration(1 / self.bound_per_hour, 'down')}."
        )

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
    recordings: Callable[[], Iterable[Recording | Judged]],
    alarm: AlarmConfig,
    threads: int,
    margins: FreeMotionConfig = FreeMotionConfig(),  # noqa: B008
    level_confidence: float | None = None,
    at_most_seen: bool = False,
    kept: PeakStore | None = None,
    poses: Sequence[Sequence[float]] | None = None,
) -> PromisedLimits:
    """Find limits from the tail of the error on calibration recordings, not used in training or validation.

    The budget is the arm's: peaks of the held error exceed all limits together at most at its rate, with the confidence
    of the promise. How much of it each joint and region gets is chosen so that hits on the links are detected from the
    smallest force on (rates_together). No limit is below a peak that its own share does not allow. A longer hold time
    lowers the limits and delays every alarm. The chosen one detects a hard push first, with an observer output of S (1
    - exp(-K0 t)):

        t = -ln(1 - limit(hold) / S) / K0 + hold,     S = HARD_PUSH limit(0)

    on the mean over joints in the sliding region. If the recordings are too short, the limits are set for the smallest
    supported budget, and the promise states how much is missing.

    Args:
        recordings: loads them one at a time; called once.
        level_confidence: confidence with which the limits together keep the budget; None: the promise's.
        kept: results of an interrupted process; `recordings` begins after them.
        at_most_seen: bound limits by `most_seen` of the largest peaks, even if the fitted tail reaches further.
        poses: of the arm's motion, in which the links are hit; None: those that the bundle keeps.

    Raises:
        TrainingError: no free motion, or too few peaks.
    """
    watched = np.flatnonzero(bundle.monitored)
    found = collect_peaks(bundle, recordings(), alarm.holds_s, threads, margins=margins, kept=kept)
    found = tuple(peaks.of_joints(watched) for peaks in found)
    asked = FalseAlarmBudget(alarm.false_alarms, alarm.in_hours)
    promise = Promise(asked, found[0].hours, confidence=alarm.confidence)
    budget = asked if promise.is_supported else promise.supported
    contact_budget = FalseAlarmBudget(alarm.contacts_an_hour, 1.0)
    level_confidence = alarm.confidence if level_confidence is None else level_confidence
    hits_nm = hits(bundle, poses)[:, watched]

    def limits(peaks: Peaks, budget: FalseAlarmBudget, confidence: float) -> tuple[LevelLimits, dict, np.ndarray]:
        tails = _tails(peaks)
        rates = rates_together(tails, budget, confidence, hits_nm, peaks.region_hours)
        return *limits_of(peaks.joints, tails, rates, confidence, at_most_seen), rates

    choices = [limits(peaks, budget, level_confidence) for peaks in found]
    first = choices[0][0].sliding_nm

    def delay_s(choice: int) -> float:
        share = np.minimum(choices[choice][0].sliding_nm / (HARD_PUSH * first), 0.999)
        return float(np.mean(-np.log1p(-share)) / bundle.observer.gain_per_s + alarm.holds_s[choice])

    best = simplest(range(len(found)), delay_s, HOLD_WORTH)
    collision, tails, rates = choices[best]
    # A contact's hold time is at least a collision's: its limits are no higher, so short errors would cross them at
    # once.
    held = next(k for k, hold in enumerate(alarm.holds_s) if hold >= alarm.contact_hold_s or k == len(found) - 1)
    held = max(held, best)
    contact = limits(found[held], contact_budget, 0.5)[0]
    contact = LevelLimits(
        np.minimum(contact.sliding_nm, collision.sliding_nm),
        np.minimum(contact.near_stiction_nm, collision.near_stiction_nm),
    )
    moments = _moments(found[best], rates, level_confidence, at_most_seen)
    holds_s = alarm.holds_s[best], alarm.holds_s[held]
    collision, contact = (one.of_arm(watched, bundle.joints) for one in (collision, contact))
    return PromisedLimits(collision, contact, *holds_s, promise, budget, tails, rates, moments)


def _moments(peaks: Peaks, rates: np.ndarray, confidence: float, at_most_seen: bool) -> list[Moment]:
    def of_joint(joint: int, nm: Sequence[np.ndarray]) -> np.ndarray:
        levels = _of_joint(_joint_tails(nm, peaks.hours), joint, rates[joint], confidence, at_most_seen)
        return np.maximum.accumulate(levels)

    try:
        return carrying_moments(peaks, of_joint)
    except TooFewPeaks:  # none to spare
        return []


def limits_of(
    joints: Sequence[str], tails: Sequence[Sequence[Tail]], rates: np.ndarray, confidence: float, at_most_seen: bool
) -> tuple[LevelLimits, dict]:
    """Find limits that these tails exceed at these mean rates, (joints, regions), and facts of each by joint and
    region."""
    facts: dict = {}
    levels = []
    for j, (joint, own) in enumerate(zip(joints, tails, strict=True)):
        of_joint = _of_joint(own, j, rates[j], confidence, at_most_seen)
        levels.append(of_joint)
        for region, tail, level, rate in zip(REGIONS, own, of_joint.tolist(), rates[j].tolist(), strict=True):
            facts[f"{joint} {region}"] = tail.summary() | {"limit_nm": level, "allowed_per_hour": rate}
    found = np.array(levels)
    return LevelLimits(found[:, 0], np.maximum(found[:, 1], found[:, 0])), facts


def _of_joint(
    tails: Sequence[Tail], joint: int, rates: np.ndarray, confidence: float, at_most_seen: bool
) -> np.ndarray:
    """Levels of a joint's regions, (regions,)."""
    levels = []
    for region, (tail, rate) in enumerate(zip(tails, rates.tolist(), strict=True)):
        level = TailCurve(tail, joint * len(REGIONS) + region).level(rate)
        level = min(max(level, tail.seen(rate, confidence)), MOST_BEYOND * float(tail.peaks_nm[0]))
        levels.append(min(level, most_seen(tail.peaks_nm)) if at_most_seen else level)
    return np.array(levels)


def most_seen(peaks_nm: np.ndarray) -> float:
    """Geometric mean of the two largest peaks, [N m]: an event twice as large as any other counts 1.4 times.

    Args:
        peaks_nm: descending, (peaks,), two or more.
    """
    return float(np.sqrt(peaks_nm[0] * peaks_nm[1]))


def _tails(peaks: Peaks) -> list[list[Tail]]:
    """Tails of each joint's regions.

    Raises:
        TooFewPeaks: a joint has too few.
    """
    return [_joint_tails(nm, peaks.hours) for nm in peaks.nm]


def _joint_tails(nm: Sequence[np.ndarray], hours: float) -> list[Tail]:
    """Fit the tails of a joint's regions; one that the joint hardly enters uses the peaks of all."""

    def of(region: int) -> Tail:
        try:
            return fit_tail(nm[region], hours)
        except TooFewPeaks:
            return fit_tail(np.concatenate(nm), hours)

    return [of(region) for region in range(len(REGIONS))]


def apply_promised(bundle: _core.Bundle, found: PromisedLimits, alarm: AlarmConfig) -> None:
    """Set limits and hold times of a bundle."""
    found.collision.put(bundle, "")
    found.contact.put(bundle, "contact_")
    bundle.hold_s = found.hold_s
    bundle.contact_hold_s = found.contact_hold_s
    bundle.contact_release_s = alarm.contact_release_s


# --- Limits from minutes of data in other motion: each recording is evaluated with limits from the others.


FEWEST = 3
"""Fewest recordings. With two, one would have to contain every error of the other."""
NOT_MEASURED = (
    f"The false alarm rate in other kinds of motion is unknown: it takes {FEWEST} recordings or more, each long "
    "enough to be left out in turn."
)
MOST_TURNS = 10
"""More recordings than this are left out several at a time."""
UPPER = 1.645
"""One-sided 95 % of a normal distribution, in standard deviations."""


@dataclass(frozen=True)
class OtherMotion:
    """False alarms in recordings whose limits follow from the others."""

    false: dict[str, int]
    """Number of false alarms by recording."""
    promised: float
    """False alarms allowed by the budget of these limits in the same time."""
    hours: float
    kept_by: float
    """Factor on the limits that would have kept the promise in these recordings."""

    @property
    def factor(self) -> float:
        """Ratio of false alarms to promised ones."""
        return sum(self.false.values()) / self.promised

    @property
    def at_most(self) -> float:
        """Upper bound of the factor at 95 %, from the spread between recordings, not the number of alarms."""
        counts = np.array(list(self.false.values()), dtype=float)
        return self.factor + UPPER * math.sqrt(len(counts)) * float(counts.std(ddof=1)) / self.promised

    @property
    def broken(self) -> str:
        """Words on the promise, which it does not keep; empty: it keeps it."""
        return "The promise does not hold in motion unlike any recording" if self.factor > 1 else ""

    def sentence(self) -> str:
        """Text for the user."""
        some = {name: count for name, count in self.false.items() if count}
        words = (
            f"Each recording was evaluated with limits from the others. False alarms in {duration(self.hours)}: "
            f"{sum(some.values())}, in {len(some)} of {len(self.false)} recordings; promised: {self.promised:.2g}."
        )
        if self.at_most <= 1:
            return f"{words} The promise also holds from one recording to the next."
        words += f" {self.broken}: " if self.broken else " In motion unlike any recording, "
        words += f"expect {self.factor:.2g} times the promised false alarms (up to {self.at_most:.2g} times, at 95 % "
        words += "confidence)."
        if self.factor <= 1:
            return words
        most = max(some, key=lambda name: some[name])
        return (
            f"{words} Most, {some[most]}, came in {most}: more recordings of such motion help. Limits "
            f"{self.kept_by:.2g} times as high (alarm.minutes_factor) would have kept the promise, and detect less."
        )

    def facts(self) -> dict:
        """All of it for JSON."""
        return asdict(self) | {"factor": self.factor, "at_most": self.at_most, "sentence": self.sentence()}


def other_motion(
    rows: ErrorRows,
    joints: Sequence[str],
    promised: PromisedLimits,
    level_confidence: float,
    factor: float,
    reserve_nm: tuple[np.ndarray, np.ndarray] | None = None,
) -> OtherMotion | None:
    """Count false alarms in each recording by limits from the others, found as set_supported_limits finds them.

    The error scale is also fitted to the other recordings and bounded by their largest value. Only the prior may still
    depend on the recording itself.

    Args:
        rows: errors on free motion, of all recordings.
        joints: their names.
        promised: budget and hold time of the limits from all recordings.
        level_confidence: confidence of the limits.
        factor: factor on the limits.
        reserve_nm: reserve added to the limits at rest [N m], and for each rad/s, (joints,) each.

    Returns:
        None if the recordings are too few or too short to find limits without one of them.
    """
    numbers = np.unique(rows.recording)
    if len(numbers) < FEWEST:
        return None
    rows = rows.only(np.lexsort((rows.t_ns, rows.recording)))
    counts = dict.fromkeys(rows.recordings, 0)
    peaks: list[np.ndarray] = []
    for turn in np.array_split(numbers, min(len(numbers), MOST_TURNS)):
        left_out = np.isin(rows.recording, turn)
        own, others = rows.only(left_out), rows.only(~left_out)
        try:
            limit_nm = factor * _limits(others, own, joints, promised, level_confidence)
        except TooFewPeaks:
            return None
        if reserve_nm is not None:
            at_rest, per_speed = reserve_nm
            limit_nm += at_rest + per_speed * own.features[:, :, FEATURES.index(MotionFeature.speed)]
        ratio = own.error_nm / limit_nm
        for number in turn:
            at = own.recording == number
            held = _held(ratio[at], own.t_ns[at], promised.hold_s)
            counts[rows.recordings[number]] = len(cluster_peaks(held, 1e-9 * (own.t_ns[at] - own.t_ns[at][0]), floor=1))
            peaks.append(separate_peaks(held, own.t_ns[at], floor=1))
    allowed = promised.budget.rate_per_hour * rows.hours
    over = np.sort(np.concatenate(peaks))[::-1]
    kept_by = float(over[int(allowed)]) if len(over) > allowed else 1.0
    return OtherMotion(counts, allowed, rows.hours, kept_by)


def _limits(
    others: ErrorRows, own: ErrorRows, joints: Sequence[str], promised: PromisedLimits, level_confidence: float
) -> np.ndarray:
    """Collision limits on these rows that follow from other rows, (own rows, joints), [N m].

    Raises:
        TooFewPeaks: the other rows have too few.
    """
    weights = np.array([limit_weights(others, j) for j in range(len(joints))])
    scale = np.einsum("rjf,jf->rj", others.features, weights)
    collector = PeakCollector(joints, promised.hold_s)
    for number in np.unique(others.recording):
        at = others.recording == number
        healthy = np.ones(int(at.sum()), dtype=bool)
        collector.add(others.t_ns[at], others.error_nm[at] / scale[at], others.near_stiction[at], healthy)
    tails = _tails(collector.peaks())
    found, _ = limits_of(joints, tails, promised.rates_per_hour, level_confidence, at_most_seen=True)
    own_scale = np.minimum(np.einsum("rjf,jf->rj", own.features, weights), scale.max(axis=0))
    return own_scale * np.where(own.near_stiction, found.near_stiction_nm, found.sliding_nm)


def _held(ratio: np.ndarray, t_ns: np.ndarray, hold_s: float) -> np.ndarray:
    """Largest held minimum over the joints, (rows,), of errors divided by limits, (rows, joints)."""
    hold, healthy = hold_lengths(t_ns, hold_s), np.ones(len(t_ns), dtype=bool)
    return np.max([held_minimum(of_joint, healthy, hold) for of_joint in ratio.T], axis=0)


# --- Limits that are of little use.


WIDE = 1 / 3
"""Share of a joint's largest torque in training above which its limit is a finding. Good recordings of ten minutes give
0.02 to 0.2, and up to 1 at single joints that turn about the vertical or are light."""
TOO_WIDE = 1 / 2
"""A fault if the limits of half of the joints or more are above this share."""


def limit_findings(bundle: _core.Bundle, step_nm: Mapping[str, float]) -> list[Finding]:
    """Findings of limits that are far too wide, or finer than the torque is known.

    Args:
        step_nm: step of which each torque is a whole multiple, by joint; those without one are left out.
    """
    found, watched = [], np.array(bundle.monitored)
    limits = np.maximum(bundle.sliding_limit_nm, bundle.near_stiction_limit_nm)
    shares = (limits / bundle.largest_torque_nm)[watched]
    severity: Severity = "fault" if 2 * (shares > TOO_WIDE).sum() >= len(shares) else "warning"
    for j in np.flatnonzero(watched).tolist():
        limit, largest = float(limits[j]), bundle.largest_torque_nm[j]
        name, unit = bundle.links[j].joint_name, bundle.estimate_units[j]
        step = step_nm.get(name, 0.0)
        if limit > WIDE * largest:
            evidence = f"{limit:.3g} {unit}, {limit / largest:.0%} of the largest torque that it gave"
            advice = (
                "few touches are found there: remove touches and odd recordings from the training, check unit and "
                "robot file, or train on more motion, in which the joint moves faster and carries more"
            )
            found.append(Finding("limit-wide", severity, name, evidence, advice))
        if (finest := min(bundle.sliding_limit_nm[j], bundle.near_stiction_limit_nm[j])) < step:
            evidence = f"{finest:.3g} {unit}, where the torque has steps of {step:.3g} {unit}"
            advice = "one step of the torque raises an alarm: train on motion in which the joint moves as in its work"
            found.append(Finding("limit-fine", "fault", name, evidence, advice))
    return found


def put_limit_findings(bundle: _core.Bundle, facts: dict, promise: Sequence[Finding] = ()) -> list[str]:
    """Set `limit_findings` in a bundle's provenance by its `torque_step_nm`; returns a line each for the user.

    Args:
        promise: findings of the promise (worse_promise), stored beside those of the limits.
    """
    found = [*limit_findings(bundle, facts.get("torque_step_nm", {})), *promise]
    facts["limit_findings"] = [asdict(one) for one in found]
    return [
        f"{one.severity}: {': '.join(filter(None, (one.code, one.joint)))}: {one.evidence}; {one.advice}"
        for one in found
    ]


def refuse_limits(facts: Mapping, where: str, accept: Sequence[str]) -> None:
    """Raise FaultyDataError if the limits have a fault, in `limit_findings`, that is not accepted.

    Args:
        where: name of the bundle to write, for the message.
    """
    found = [Finding(**one) for one in facts.get("limit_findings", [])]
    how = "No bundle is written. To write it all the same, accept the faults; the bundle records it:"
    expect_accepted(found, accept, where, "its limits", how)


def worse_promise(before: Mapping, promised: PromisedLimits, name: str) -> tuple[str, list[Finding]]:
    """The promise that limits replace beside theirs, in a sentence, and a fault if it is worse and not asked for.

    A budget that the recordings support was asked for; the smallest that they support, in place of it, was not.

    Args:
        before: facts of the limits that are replaced; without a promise, there is nothing to compare.
        name: of the bundle that has them.
    """
    rate = promised_per_hour(before)
    if rate is None:
        return "", []
    old_hours, new = before["promise"]["calibration_hours"], promised.promise
    then = f"1 in {duration(1 / rate)} from {duration(old_hours, 'down')} of calibration"
    now = f"1 in {duration(1 / promised.budget.rate_per_hour, 'down')} from {duration(new.hours, 'down')}"
    words = f"promise of false alarms: {now}, in place of {then} in {name}"
    if new.is_supported or promised.budget.rate_per_hour <= rate * (1 + ROUNDED):
        return words, []
    advice = (
        f"keep the bundle, record {duration(new.missing_hours, 'up')} more of free motion, or ask for a budget that "
        "these recordings support (--false-alarms, --in-hours)"
    )
    return words, [Finding("promise-worse", "fault", None, f"{now}, in place of {then} in {name}", advice)]


def torque_steps_nm(bundle: _core.Bundle, recordings: Sequence[Recording]) -> dict[str, float]:
    """Step of which each torque is a whole multiple in the unit of the estimates, by joint, where there is one."""
    found = {}
    for j, (link, factor) in enumerate(
        zip(bundle.links, bundle.observer.nm_per_unit or [1.0] * bundle.joints, strict=True)
    ):
        if (step := torque_step_nm(recordings, j)) is not None:
            found[link.joint_name] = abs(factor) * step
    return found
