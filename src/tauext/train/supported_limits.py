"""Limits from minutes of motion: raised for what minutes do not show, and tested in recordings of other motion."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tauext._core import Bundle, MotionFeature
from tauext.data.free_motion import total_s
from tauext.data.recording import Recording
from tauext.errors import TrainingError
from tauext.fit.prior_facts import friction_nm
from tauext.fit.prior_terms import PriorFit
from tauext.fit.tail import TooFewPeaks, duration
from tauext.train.error_scale import FEATURES, ErrorRows, HeldOut, add_friction, limit_weights, whole_recordings
from tauext.train.held_peaks import (
    Moment,
    PeakConfig,
    Peaks,
    collect_peaks,
    held_minimum,
    hold_lengths,
    peak_indices,
)
from tauext.train.paper_limits import LimitMotion, change_limits, paper_limits, set_limits
from tauext.train.promised_limits import (
    LimitsConfig,
    PromisedLimits,
    joint_tails,
    limits_of,
    note_moments,
    promised_limits,
)


@dataclass(frozen=True)
class SupportedConfig:
    """How limits from minutes of one day allow for what such a time does not show."""

    decay_s: float = 240.0
    """Decay time of the friction reserve with the length T of the recordings, exp(-T / this), [s]. One minute contains
    one state of the gears; ten contain the warm-up (5 to 7 minutes)."""
    unpromised_factor: float = 1.6
    """Factor on the largest errors if the motion is too short for any budget, so that false alarms are unbounded."""
    least_reserve: float = 0.02
    """Least share of the friction used as a reserve; it is smaller from nine minutes on."""
    near_memory: float = 2.0
    """Time near stiction after a joint began to slide, in 1/K0: r still contains the breakaway, and minutes have few of
    them."""
    confidence: float = 0.5
    """Confidence with which the limits keep the supported budget, which itself already has the promise's confidence."""


@dataclass(frozen=True)
class Raised:
    """Limits from minutes of motion as they were set."""

    promised: PromisedLimits | None
    """None: the motion is too short for any budget, and the limits are its largest errors."""
    facts: dict
    words: str
    factor: float = 1.0
    """Factor on the limits of `promised`, which follow the error."""
    reserve_nm: tuple[np.ndarray, np.ndarray] | None = None
    """Share of the friction that was added to them, see other_motion."""


def put_supported(bundle: Bundle, motion: LimitMotion, config: SupportedConfig = SupportedConfig()) -> dict:
    """Limits for the smallest budget of false alarms that this motion supports; see raised()."""
    found = raised(bundle, motion, config)
    motion.note(found.words)
    put_other_motion(bundle, motion, found)
    note_moments(bundle, [Moment(**one) for one in found.facts.get("one_moment", [])], motion.note)
    return found.facts


def raised(bundle: Bundle, motion: LimitMotion, config: SupportedConfig = SupportedConfig()) -> Raised:
    """Set limits for the smallest budget that this motion supports.

    If the motion is too short for that, the largest errors are used. Both are raised, since minutes do not contain all
    changes of friction with temperature and time: limits that follow the error by `factor_after` and a share of the
    friction, constant ones by a share of the friction at the 95 % quantile of a joint's speed.
    """
    alarm, follows, promised = motion.alarm, bundle.error_scale.follows, None
    try:
        peaks = collect_peaks(bundle, motion.held_out, alarm.holds_s, motion.threads, motion.margins)
        promised = promised_limits(bundle, peaks, alarm, limits_config(follows, config), motion.poses)
        promised = replace(promised, suspects=motion.suspects)
        promised.put(bundle, alarm)
        words, facts = f"no calibration recordings. {promised.sentence()}", promised.facts()
    except TrainingError as error:
        set_limits(bundle, paper_limits(bundle, motion.held_out, motion.threads, motion.margins), alarm)
        words = f"thresholds are the largest errors seen, with no target false alarm rate ({error})"
        facts = {"sentence": words}
    factor, by_nm, reserve_nm = 1.0, np.zeros(bundle.joints), None
    if follows:
        factor, reserve_nm = raise_following(bundle, motion, promised, config, facts)
        words += f" They are {factor:.3g} times what these minutes show."
        if "friction_reserve" in facts:
            words += f" {facts['friction_reserve']:.1%} of the friction is added: so short a time shows little of its"
            words += " changes."
    else:
        by_nm = constant_reserve_nm(bundle, motion)
        change_limits(bundle, lambda limit_nm: limit_nm + by_nm)
        if by_nm.any():
            facts["friction_reserve_nm"] = dict(zip(names_of(bundle), by_nm.tolist(), strict=True))
            words += f" They are raised by {alarm.friction_reserve:.0%} of the friction."
    if promised is not None and promised.moments:
        added = dict(zip(names_of(bundle), by_nm.tolist(), strict=True))
        facts["one_moment"] = [moment.scaled(factor, added[moment.joint]).facts() for moment in promised.moments]
    return Raised(promised, facts, words, factor, reserve_nm)


def limits_config(follows: bool, config: SupportedConfig = SupportedConfig()) -> LimitsConfig:
    """How limits follow from the peaks of minutes."""
    return LimitsConfig(confidence=config.confidence, at_most_seen=follows)


def put_other_motion(
    bundle: Bundle,
    motion: LimitMotion,
    found: Raised,
    times: float = 1.0,
    rate_per_hour: float | None = None,
    floors_nm: np.ndarray | None = None,
) -> None:
    """Test limits that follow the error in each recording by limits from the others, and add it to the facts.

    Args:
        found: the limits; its facts receive the test.
        times: factor on the limits after they were raised.
        rate_per_hour: false alarms that they are set for, [1/h]; None: those of the budget that is proved.
        floors_nm: least limits after the factor, sliding and at rest, (2, joints), [N m]; None: there are none.
    """
    if motion.rows is None or found.promised is None or not bundle.error_scale.follows:
        return
    other = left_out_in_turn(bundle, motion, found, None if floors_nm is None else floors_nm / times)
    if other is not None:
        other = replace(other, times=times, rate_per_hour=rate_per_hour or other.rate_per_hour)
    found.facts["other_motion"] = NOT_MEASURED if other is None else other.facts()
    motion.note(found.facts["other_motion"]["sentence"])
    if other is not None and other.broken:
        found.facts["sentence"] += f" {other.broken}: expect {other.factor:.2g} times as many."


def left_out_in_turn(
    bundle: Bundle, motion: LimitMotion, found: Raised, floors_nm: np.ndarray | None = None
) -> OtherMotion | None:
    """False alarms of each recording by limits from the others, see other_motion."""
    assert motion.rows is not None and found.promised is not None
    watched = np.flatnonzero(bundle.monitored)
    names = [names_of(bundle)[j] for j in watched]
    added = None if motion.added_weights is None else motion.added_weights[watched]
    config = limits_config(follows=True)
    floors_nm = None if floors_nm is None else floors_nm[:, watched]
    return other_motion(
        motion.rows.of_joints(watched), names, found.promised, config, found.factor, found.reserve_nm, added, floors_nm
    )


def names_of(bundle: Bundle) -> list[str]:
    """Names of the joints."""
    return [link.joint_name for link in bundle.links]


def raise_following(
    bundle: Bundle, motion: LimitMotion, promised: PromisedLimits | None, config: SupportedConfig, facts: dict
) -> tuple[float, tuple[np.ndarray, np.ndarray] | None]:
    """Raise limits that follow the error; returns the factor, and what was added of the monitored joints' friction.

    Args:
        promised: None: the limits are the largest errors.
        facts: receives factor and reserve.
    """
    seen_s = total_s(whole_recordings(motion.held_out))
    factor = round(factor_after(seen_s, motion.alarm.minutes_factor, config.decay_s), 3)
    if promised is None:
        factor = max(factor, config.unpromised_factor)
    change_limits(bundle, lambda limit_nm: factor * limit_nm)
    facts["minutes_factor"] = factor
    share = motion.alarm.friction_reserve * math.exp(-seen_s / config.decay_s)
    if motion.fit is None or share <= config.least_reserve:
        return factor, None
    at_rest, per_speed = friction_line(motion.fit, usual_speed_rad_s(motion.held_out))
    add_friction(bundle, share, at_rest, per_speed)
    facts["friction_reserve"] = share
    watched = np.array(bundle.monitored)
    return factor, (share * at_rest[watched], share * per_speed[watched])


def constant_reserve_nm(bundle: Bundle, motion: LimitMotion) -> np.ndarray:
    """Share of each joint's friction that is added to constant limits, (n,), [N m]; 0 without a prior."""
    share = motion.alarm.friction_reserve
    if motion.fit is None or not share:
        return np.zeros(bundle.joints)
    return share * friction_nm(motion.fit, usual_speed_rad_s(motion.held_out))


def factor_after(seen_s: float, most: float, decay_s: float = SupportedConfig.decay_s) -> float:
    """Factor on limits that follow the error, for T seconds of motion: 1 + (most - 1)(1 - exp(-T/decay_s)).

    It grows as the friction reserve decays; for a single minute the reserve suffices.
    """
    return 1 - (most - 1) * math.expm1(-seen_s / decay_s)


def usual_speed_rad_s(recordings: Sequence[Recording | HeldOut]) -> np.ndarray:
    """Largest 95 % quantile of each joint's speed over the recordings, (n,), [rad/s]."""
    speeds = [np.quantile(np.abs(recording.dq), 0.95, axis=0) for recording in whole_recordings(recordings)]
    return np.max(speeds, axis=0)


def friction_line(fit: PriorFit, speed_rad_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Friction at rest and its growth with speed, (n,) [N m] and [N m s/rad], from a line through two points.

    Args:
        speed_rad_s: usual speed of each joint, (n,); the other point is at a tenth of it.
    """
    usual, slow = friction_nm(fit, speed_rad_s), friction_nm(fit, speed_rad_s / 10)
    slope = np.maximum((usual - slow) / np.maximum(0.9 * speed_rad_s, 1e-9), 0)
    return np.maximum(usual - slope * speed_rad_s, 0), slope


# --- Limits from minutes of data in other motion: each recording is evaluated with limits from the others.


NOT_MEASURED = {
    "sentence": "The false alarm rate in other kinds of motion is unknown: it takes 3 recordings or more, each long "
    "enough to be left out in turn."
}


@dataclass(frozen=True)
class OtherMotion:
    """False alarms in recordings whose limits follow from the others."""

    peaks: dict[str, np.ndarray]
    """Of the worst ratio of an error to its limit, a second or more apart, (peaks,), by recording."""
    hours: float
    rate_per_hour: float
    """False alarms an hour that the budget of these limits allows."""
    times: float = 1.0
    """Factor on the limits."""

    @property
    def false(self) -> dict[str, int]:
        """Number of false alarms by recording."""
        return {name: int((peaks > self.times).sum()) for name, peaks in self.peaks.items()}

    @property
    def promised(self) -> float:
        """False alarms that the budget allows in the same time."""
        return self.rate_per_hour * self.hours

    @property
    def falling(self) -> np.ndarray:
        """The peaks of all recordings, descending."""
        return np.sort(np.concatenate(list(self.peaks.values())))[::-1]

    @property
    def kept_by(self) -> float:
        """Factor on the limits that would have kept the promise in these recordings."""
        peaks, allowed = self.falling, int(self.promised)
        return max(float(peaks[allowed]) / self.times, 1.0) if len(peaks) > allowed else 1.0

    @property
    def factor(self) -> float:
        """Ratio of false alarms to promised ones."""
        return sum(self.false.values()) / self.promised

    @property
    def at_most(self) -> float:
        """Upper bound of the factor (95 %, one-sided), by the spread between recordings, not the number of alarms."""
        counts = np.array(list(self.false.values()), dtype=float)
        return self.factor + 1.645 * math.sqrt(len(counts)) * float(counts.std(ddof=1)) / self.promised

    @property
    def broken(self) -> str:
        """Words on the promise, which it does not keep; empty: it keeps it."""
        return "The target false alarm rate is exceeded in motion unlike any recording" if self.factor > 1 else ""

    def sentence(self) -> str:
        """Text for the user."""
        some = {name: count for name, count in self.false.items() if count}
        words = (
            f"Each recording was evaluated with thresholds from the others. False alarms in {duration(self.hours)}: "
            f"{sum(some.values())}, in {len(some)} of {len(self.false)} recordings; target: {self.promised:.2g}."
        )
        if self.at_most <= 1:
            return f"{words} The target false alarm rate also holds from one recording to the next."
        words += f" {self.broken}: " if self.broken else " In motion unlike any recording, "
        words += f"expect {self.factor:.2g} times as many false alarms (up to {self.at_most:.2g} times, at 95 % "
        words += "confidence)."
        if self.factor <= 1:
            return words
        most = max(some, key=lambda name: some[name])
        return (
            f"{words} Most, {some[most]}, came in {most}: more recordings of such motion help. Thresholds "
            f"{self.kept_by:.2g} times as high (alarm.minutes_factor) would have met the target, and detect less."
        )

    def facts(self) -> dict:
        """All of it for JSON."""
        names = ("false", "promised", "hours", "kept_by", "factor", "at_most")
        return {name: getattr(self, name) for name in names} | {"sentence": self.sentence()}


def other_motion(
    rows: ErrorRows,
    joints: Sequence[str],
    promised: PromisedLimits,
    config: LimitsConfig,
    factor: float,
    reserve_nm: tuple[np.ndarray, np.ndarray] | None = None,
    added_weights: np.ndarray | None = None,
    floors_nm: np.ndarray | None = None,
) -> OtherMotion | None:
    """Count false alarms in each recording by limits from the others, found as `put_supported` finds them.

    The error scale is also fitted to the other recordings and bounded by their largest value. Only the prior may still
    depend on the recording itself.

    Args:
        rows: errors on free motion, of all recordings.
        joints: their names.
        promised: budget and hold time of the limits from all recordings.
        config: as of these limits.
        factor: factor on the limits.
        reserve_nm: reserve added to the limits at rest [N m], and for each rad/s, (joints,) each.
        added_weights: what other programs add to the scale, (joints, features).
        floors_nm: least limits sliding and at rest, (2, joints), [N m].

    Returns:
        None if there are fewer than three recordings, since with two, one would have to contain every error of the
        other, or if they are too short to find limits without one of them.
    """
    numbers = np.unique(rows.recording)
    if len(numbers) < 3:
        return None
    rows = rows.only(np.lexsort((rows.t_ns, rows.recording)))
    peaks = dict[str, np.ndarray]()
    for turn in np.array_split(numbers, min(len(numbers), 10)):  # several at a time where there are many
        left_out = np.isin(rows.recording, turn)
        own, others = rows.only(left_out), rows.only(~left_out)
        try:
            limit_nm = factor * limits_from(others, own, joints, promised, config, added_weights)
        except TooFewPeaks:
            return None
        if reserve_nm is not None:
            at_rest, per_speed = reserve_nm
            limit_nm += at_rest + per_speed * own.features[:, :, FEATURES.index(MotionFeature.speed)]
        if floors_nm is not None:
            at_rest = own.features[:, :, FEATURES.index(MotionFeature.standstill)]
            limit_nm = np.maximum(limit_nm, np.maximum(floors_nm[0], floors_nm[1] * at_rest))
        ratio = own.error_nm / limit_nm
        for number in turn:
            at = own.recording == number
            t_ns, healthy = own.t_ns[at], np.ones(int(at.sum()), dtype=bool)
            held = held_minimum(ratio[at], healthy, hold_lengths(t_ns, promised.hold_s)).max(axis=1)
            found = held[peak_indices(held, t_ns, gap_s=PeakConfig.moment_s)]
            peaks[rows.recordings[number]] = found
    return OtherMotion(peaks, rows.hours, promised.budget.rate_per_hour)


def limits_from(
    others: ErrorRows,
    own: ErrorRows,
    joints: Sequence[str],
    promised: PromisedLimits,
    config: LimitsConfig,
    added_weights: np.ndarray | None = None,
) -> np.ndarray:
    """Collision limits on these rows that follow from other rows, (own rows, joints), [N m].

    Raises:
        TooFewPeaks: the other rows have too few.
    """
    weights = np.array([limit_weights(others, j) for j in range(len(joints))])
    if added_weights is not None:
        weights += added_weights
        weights /= np.median(others.scale(weights), axis=0)[:, None]
    scale = others.scale(weights)
    peaks = Peaks(joints, promised.hold_s)
    for number in np.unique(others.recording):
        at = others.recording == number
        healthy = np.ones(int(at.sum()), dtype=bool)
        peaks.add("", others.t_ns[at], others.error_nm[at] / scale[at], others.near_stiction[at], healthy)
    tails = [joint_tails(nm, peaks.hours, config) for nm in peaks.nm]
    confidence = config.confidence or promised.promise.confidence
    found, _ = limits_of(joints, tails, promised.rates_per_hour, confidence, config)
    own_scale = np.minimum(own.scale(weights), scale.max(axis=0))
    return own_scale * np.where(own.near_stiction, found[1], found[0])
