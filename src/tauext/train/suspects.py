r"""Touches that nobody reported, found in the errors of free motion.

Peaks of a joint's held error over the level u that a quarter of them exceeds are a mixture,

.. math:: f(y) = (1 - \pi)\,g(y; \xi, \sigma) + \pi\,\frac{[y > Y_0]}{(1 + y) \ln((1 + Y_1)/(1 + Y_0))}, \qquad
    y = \text{peak}/u - 1,

of a generalised Pareto tail g, the errors of free motion, and touches, whose size has no scale. Since touches have
their own term, they hardly move the tail: with 60 touches an hour, shape and scale are those of the untouched arm.
Peaks beyond the level that the tail exceeds a tenth of a time in all of this motion are suspects.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from tauext import _core
from tauext.config import FreeMotionConfig
from tauext.data.free_motion import cut
from tauext.data.labels import SUSPECT_MARGINS, Label, epoch_of
from tauext.data.recording import Recording
from tauext.train.error_scale import FOR_ERRORS, judge, judge_all
from tauext.train.held_peaks import Peaks


@dataclass(frozen=True)
class SuspectConfig:
    """Which errors of free motion are suspected to be touches; fewer suspects mean higher limits, more shorten them."""

    hold_s: float = 0.02
    """Least duration of a suspect, [s]: a touch outlasts it behind the observer, the spike of an abrupt stop does
    not."""
    upper_share: float = 0.25
    """Share of the peaks to which the mixture is fitted ..."""
    least_peaks: int = 40
    """... but at least so many of them, or all but the lower half; with fewer, nothing is suspected."""
    chance: float = 0.1
    """Expected number of peaks of free motion beyond a joint's level in a region, however long the motion is."""
    span: tuple[float, float] = (1.0, 50.0)
    """Y_0 and Y_1: smallest touch that matters and largest one, as multiples of u above u."""
    shape: float = -0.05
    """Prior of the shape, and its standard deviation. Fits to untouched motion of simulated arms lie between -0.35 and
    0.2; with a heavier tail, the touches themselves would be one."""
    shape_error: float = 0.1
    shares: tuple[float, ...] = (0.0, 0.001, 0.003, 0.01, 0.02, 0.04, 0.08, 0.15, 0.25, 0.35)
    """Values of pi that are tried."""
    join_s: float = 1.0
    """Peaks less than this apart belong to one suspect, [s]."""
    most_share: float = 0.1
    """A larger share of suspects is an error of the model and no touches; nothing is then suspected."""
    warm_s: float = 20.0
    """Motion before a candidate from which the drift tracker and the filters start, [s]."""
    near_s: float = 0.05
    """Errors so long before the largest peak are compared between joints, [s]."""
    lone: float = 1.5
    """A joint is alone if all others are below this multiple of the peak that a quarter of their peaks exceed."""
    most_friction: float = 2.5
    """Friction stays below this multiple of the level that free motion exceeds once in ten such motions."""
    turned_s: float = 1.0
    """A joint that both rested and moved in so short a time has started, stopped or turned, [s]; by its commanded
    positions where they are recorded."""
    rests_rad_s: float = 0.02
    moves_rad_s: float = 0.03
    edge: float = 0.5
    """A suspect reaches as far as the mean of its joints' errors exceeds this share of their levels ..."""
    gap_s: float = 0.1
    """... with gaps up to this, [s] ..."""
    reach_s: float = 5.0
    """... at most so far from its largest peak, [s]."""
    least_times: float = 1.5
    """A suspect exceeds its level by this factor: free motion of another kind often errs by less."""
    same_rad: float = 0.05
    """Candidates with the same joints in poses this close, [rad] ..."""
    same_times: int = 3
    """... so often, are an error that the motion repeats. So often in one recording, joints that turned alone err by
    their friction, and joints that no force explains err by that motion."""


# --- Levels beyond which a peak is a suspect.


def suspect_level(peaks_nm: np.ndarray, config: SuspectConfig = SuspectConfig()) -> float:
    """Level that free motion exceeds config.chance times, infinite for too few peaks.

    Args:
        peaks_nm: descending, (peaks,).
    """
    peaks = peaks_nm[peaks_nm > 0]
    count = max(int(config.upper_share * len(peaks)), min(config.least_peaks, len(peaks) // 2))
    if count < config.least_peaks // 2:
        return np.inf
    u = float(peaks[count])
    excess = peaks[:count] / u - 1
    excess = excess[excess > 0]
    if len(excess) < config.least_peaks // 2:
        return np.inf
    # Peaks in classes of 2 %: the likelihood then costs the same for a minute and a day.
    least, most = np.log1p(config.span)
    edges = np.expm1(np.arange(0.0, most, 0.02))
    counts = np.bincount(np.searchsorted(edges, np.minimum(excess, edges[-1])), minlength=len(edges) + 1)[1:]
    y, counts = edges[counts > 0], counts[counts > 0]
    scales = np.median(excess) / np.log(2) * np.exp(np.linspace(-1.0, 0.7, 35))
    shape, scale = (one[:, :, None] for one in np.meshgrid(np.linspace(-0.5, 0.25, 16), scales, indexing="ij"))
    shape = np.where(np.abs(shape) < 1e-9, 1e-9, shape)
    inside = np.maximum(1 + shape * y / scale, 1e-12)
    tail = np.where(1 + shape * y / scale > 0, inside ** (-1 / shape - 1) / scale, 0.0)
    touch = np.where(y > config.span[0], 1 / ((1 + y) * (most - least)), 0.0)
    prior = -0.5 * ((shape[:, :, 0] - config.shape) / config.shape_error) ** 2
    best, found = -np.inf, (0.0, 1.0, 0.0)
    for share in config.shares:
        likely = prior + np.log((1 - share) * tail + share * touch + 1e-300) @ counts
        at = np.unravel_index(int(np.argmax(likely)), likely.shape)
        if likely[at] > best:
            best, found = float(likely[at]), (float(shape[at[0], 0, 0]), float(scale[0, at[1], 0]), float(share))
    xi, sigma, share = found
    rarity = (1 - share) * len(excess) / config.chance
    return u * (1 + sigma * np.expm1(xi * np.log(rarity)) / xi)


def usual_peak(peaks_nm: np.ndarray, config: SuspectConfig = SuspectConfig()) -> float:
    """u, infinite without peaks."""
    peaks = peaks_nm[peaks_nm > 0]
    return float(np.quantile(peaks, 1 - config.upper_share)) if len(peaks) else np.inf


# --- Suspects: peaks beyond a level, and the time around them that belongs to the touch.


@dataclass(frozen=True)
class Suspect:
    """One interval that looks like a touch."""

    recording: str
    number: int
    """Number of the recording in the peaks."""
    from_ns: int
    """First and last moment after the recording's first sample, [ns]."""
    to_ns: int
    at_ns: int
    """Its largest peak."""
    joints: tuple[str, ...]
    """Joints whose error is beyond their level."""
    times: float
    """Its largest peak, in multiples of its level."""
    link: str = ""
    """Joint of the link on which a force would explain it best; empty: unknown, or no force does."""
    begin_ns: int = 0
    """First stamp of the recording."""
    epoch: int | None = None
    """Clock of the recording in a folder of `tauext commission`; None: another recording."""

    @property
    def span(self) -> tuple[int, int]:
        """First and last stamp, [ns]."""
        return self.begin_ns + self.from_ns, self.begin_ns + self.to_ns

    @property
    def is_evident(self) -> bool:
        """Whether it is called a touch: several joints err at once, or one by more than friction does."""
        return len(self.joints) > 1 or self.times >= SuspectConfig.most_friction

    @property
    def widened(self) -> tuple[int, int]:
        """First and last moment with the margins that are left out, after the recording's first sample, [ns]."""
        margins = SUSPECT_MARGINS
        return self.from_ns - round(1e9 * margins.before_s), self.to_ns + round(1e9 * margins.after_s)

    def meets(self, label: Label) -> bool:
        """Whether the label concerns some of this time."""
        from_ns, to_ns = self.span
        return self.epoch == label.epoch and from_ns <= label.to_ns and to_ns >= label.from_ns

    def sentence(self) -> str:
        """One line for the user."""
        fits = f", fits a force on the link of {self.link}" if self.link else ""
        return (
            f"'{self.recording}' at {1e-9 * self.from_ns:.1f} to {1e-9 * self.to_ns:.1f} s: error of "
            f"{', '.join(self.joints)} up to {self.times:.2g} times the largest of free motion{fits}"
        )


def are_same(some: Sequence[Suspect], others: Sequence[Suspect]) -> bool:
    """Whether two searches of the same recordings, in order of time, found the same touches."""
    return len(some) == len(others) and all(
        one.recording == other.recording and one.span[0] <= other.span[1] and one.span[1] >= other.span[0]
        for one, other in zip(some, others, strict=True)
    )


def suspect_facts(suspects: Sequence[Suspect]) -> dict:
    """Number and time of the suspects and the first 100, for provenance."""
    names = ("recording", "from_ns", "to_ns", "joints", "times", "link")
    listed = [{name: asdict(one)[name] for name in names} for one in suspects[:100]]
    return {"count": len(suspects), "seconds": round(_seconds(suspects), 3), "listed": listed}


def suspect_sentences(suspects: Sequence[Suspect], remedy: str = "set `contact` to 0 there") -> list[str]:
    """Lines for the user: how many, and the strongest of them.

    Args:
        remedy: keeps an interval in which nothing touched the arm.
    """
    if not suspects:
        return []
    several = len(suspects) > 1
    words = (
        f"{len(suspects)} unlabelled contact{'s' * several}, {_seconds(suspects):.1f} s in all, "
        f"{'are' if several else 'is'} left out; if nothing touched the arm, {remedy}"
    )
    strongest = sorted(suspects, key=lambda one: -one.times)
    more = len(suspects) - 3
    return [words, *(one.sentence() for one in strongest[:3]), *([f"and {more} more"] if more > 0 else [])]


def _seconds(suspects: Sequence[Suspect]) -> float:
    """Time that the suspects leave out, [s]."""
    return sum(1e-9 * (one.widened[1] - one.widened[0]) for one in suspects)


def is_unreported(recording: Recording) -> bool:
    """Whether nobody reported the touches of a recording: it has no labels, or labels of alarms alone."""
    contact = recording.contact
    return contact is None or epoch_of(recording.provenance) is not None


def find_suspects(
    bundle: _core.Bundle,
    peaks: Peaks,
    load: Callable[[int], Recording],
    labels: Sequence[Label] = (),
    threads: int = 1,
    since: int = 0,
    config: SuspectConfig = SuspectConfig(),
) -> list[Suspect]:
    """Intervals that look like touches, in order of recording and time.

    Errors of friction and of the model are none, even where they stand out: those of a lone joint that has just
    started, stopped or turned, since a force on a link turns all joints before it; those that return in the same
    motion; and several of one recording that no force explains. They stay in the motion, and limits contain them.

    Args:
        peaks: of errors held for about config.hold_s.
        load: the recording of a number in the peaks.
        labels: of the recordings' folder; an interval that was answered with `nothing` is no suspect.
        since: recordings with smaller numbers were searched before.
    """
    levels, usual = (
        np.array([[of(nm, config) for nm in of_joint] for of_joint in peaks.nm]) for of in (suspect_level, usual_peak)
    )
    levels[~np.array(bundle.monitored)] = np.inf
    candidates = _candidates(peaks, levels, config)
    if not candidates or _seconds(candidates) > config.most_share * 3600 * peaks.hours:
        return []
    nothing = [one for one in labels if one.answer == "nothing"]
    places, shown = _core.PlaceModel(bundle), []
    for number in sorted({one.number for one in candidates if one.number >= since}):
        if is_unreported(recording := load(number)):
            of_this = [one for one in candidates if one.number == number]
            shown += [_Shown.of(bundle, places, one, recording, levels, usual, threads, config) for one in of_this]
    kinds = _Shown.is_friction, _Shown.is_repeated, _Shown.is_of_the_motion
    found = [one.suspect for one in shown if not any(of_kind(one, shown, config) for of_kind in kinds)]
    found = [one for one in found if one.is_evident and one.times >= config.least_times]
    return _merged([one for one in found if not any(one.meets(label) for label in nothing)])


def _merged(suspects: Sequence[Suspect]) -> list[Suspect]:
    """Suspects in order of recording and time, overlapping ones as one."""
    merged: list[Suspect] = []
    for one in sorted(suspects, key=lambda one: (one.number, one.from_ns)):
        last = merged[-1] if merged else None
        if last is None or last.number != one.number or last.to_ns < one.from_ns:
            merged.append(one)
            continue
        larger = max(last, one, key=lambda one: one.times)
        joints = tuple(dict.fromkeys((*last.joints, *one.joints)))
        merged[-1] = replace(larger, from_ns=last.from_ns, to_ns=max(last.to_ns, one.to_ns), joints=joints)
    return merged


def search(
    bundle: _core.Bundle,
    recordings: Sequence[Recording],
    labels: Sequence[Label] = (),
    threads: int = 1,
    margins: FreeMotionConfig = FreeMotionConfig(),  # noqa: B008
    config: SuspectConfig = SuspectConfig(),
) -> list[Suspect]:
    """Suspects in recordings in memory, by their own errors alone; the bundle may be trained on them.

    Args:
        labels: see find_suspects.
    """
    searched = [one for one in recordings if is_unreported(one)]
    peaks = Peaks([link.joint_name for link in bundle.links], config.hold_s)
    for motion, estimates, error, counted in judge_all(bundle, searched, threads, margins):
        peaks.add(motion.name, motion.t_ns, error, estimates["near_stiction"], counted)
    return find_suspects(bundle, peaks, searched.__getitem__, labels, threads, config=config)


def forget(peaks: Sequence[Peaks], suspects: Sequence[Suspect]) -> None:
    """Leave the peaks of suspects, with their margins, out."""
    for one in suspects:
        for some in peaks:
            some.forget(one.number, *one.widened)


def without_suspects(recordings: Sequence[Recording], suspects: Sequence[Suspect]) -> list[Recording]:
    """The recordings with unknown contact at the suspects and their margins."""
    changed = []
    for recording in recordings:
        here = [one for one in suspects if one.recording == recording.name]
        here = [one for one in here if one.span[0] <= recording.t_ns[-1] and one.span[1] >= recording.t_ns[0]]
        if here:
            contact = np.zeros(recording.samples, dtype=np.int8)
            if recording.contact is not None:
                contact[:] = recording.contact
            for one in here:
                first, last = one.widened
                around = slice(*np.searchsorted(recording.t_ns - one.begin_ns, (first, last + 1)))
                contact[around] = np.where(contact[around] == 1, 1, -1)
            recording = replace(recording, contact=contact)
        changed.append(recording)
    return changed


def _candidates(peaks: Peaks, levels: np.ndarray, config: SuspectConfig) -> list[Suspect]:
    """Peaks beyond their levels, those less than config.join_s apart together."""
    columns = []
    for j, (of_nm, of_at) in enumerate(zip(peaks.nm, peaks.at, strict=True)):
        for nm, at, level in zip(of_nm, of_at, levels[j], strict=True):
            beyond = nm > level
            columns.append(np.column_stack([at[beyond], np.full(int(beyond.sum()), j), 1e6 * nm[beyond] / level]))
    rows = np.concatenate(columns).astype(np.int64)  # recording, time, joint, millionths of the level
    if not len(rows):
        return []
    rows = rows[np.lexsort((rows[:, 1], rows[:, 0]))]
    apart = (np.diff(rows[:, 0]) != 0) | (np.diff(rows[:, 1]) >= config.join_s * 1e9)
    found = []
    for group in np.split(rows, 1 + np.flatnonzero(apart)):
        number, first, last = int(group[0, 0]), int(group[0, 1]), int(group[-1, 1])
        names = tuple(peaks.joints[j] for j in np.unique(group[:, 2]))
        largest = group[np.argmax(group[:, 3])]
        name = peaks.recordings[number] if peaks.recordings else ""
        found.append(Suspect(name, number, first, last, int(largest[1]), names, 1e-6 * float(largest[3])))
    return found


# --- What the motion around a candidate shows.


@dataclass(frozen=True)
class _Shown:
    """A candidate with the state at its largest peak."""

    suspect: Suspect
    q: np.ndarray
    signs: np.ndarray
    """Signs of the errors of its joints and of their speeds."""
    turned_alone: bool
    """Whether one joint alone errs that has just started, stopped or turned."""

    def is_friction(self, others: Sequence[_Shown], config: SuspectConfig) -> bool:
        """Whether it turned alone and errs by no more than friction does, or does so too often in the recording."""
        mine = self.suspect.number, self.suspect.joints
        same = [one.turned_alone and (one.suspect.number, one.suspect.joints) == mine for one in others]
        return self.turned_alone and (self.suspect.times < config.most_friction or sum(same) >= config.same_times)

    def is_repeated(self, others: Sequence[_Shown], config: SuspectConfig) -> bool:
        """Whether config.same_times candidates, itself included, have its joints, pose and signs."""
        same = [
            one.suspect.joints == self.suspect.joints
            and bool((np.abs(one.q - self.q) < config.same_rad).all())
            and bool((one.signs == self.signs).all())
            for one in others
        ]
        return sum(same) >= config.same_times

    def is_of_the_motion(self, others: Sequence[_Shown], config: SuspectConfig) -> bool:
        """Whether no force explains it, nor config.same_times candidates of this recording with one of its joints."""
        mine = set(self.suspect.joints)
        same = [
            one.suspect.number == self.suspect.number and not one.suspect.link and bool(mine & set(one.suspect.joints))
            for one in others
        ]
        return not self.suspect.link and sum(same) >= config.same_times

    @classmethod
    def of(
        cls,
        bundle: _core.Bundle,
        places: _core.PlaceModel,
        one: Suspect,
        recording: Recording,
        levels: np.ndarray,
        usual: np.ndarray,
        threads: int,
        config: SuspectConfig,
    ) -> _Shown:
        """Run the bundle on the motion around a candidate."""
        start, reach_ns = int(recording.t_ns[0]), round(1e9 * config.reach_s)
        wanted = start + one.from_ns - reach_ns - round(1e9 * config.warm_s), start + one.to_ns + reach_ns
        motion = cut(recording, slice(*np.searchsorted(recording.t_ns, wanted)))
        margins = FreeMotionConfig()
        motion, estimates, error, counted = judge(bundle, motion, threads, margins, (*FOR_ERRORS, "sigma_nm"))
        stuck, t_ns = estimates["near_stiction"].astype(bool), motion.t_ns - start
        times, beside = (
            np.where(counted[:, None], error / np.where(stuck, of[:, 1], of[:, 0]), 0.0) for of in (levels, usual)
        )
        at = int(np.searchsorted(t_ns, one.at_ns))

        joints = [motion.joints.index(name) for name in one.joints]
        since = int(np.searchsorted(t_ns, one.at_ns - config.near_s * 1e9))
        most = motion.joints.index(one.joints[int(np.argmax(times[since : at + 1, joints].max(axis=0)))])
        others = np.delete(np.median(beside[since : at + 1], axis=0), most)
        before = slice(int(np.searchsorted(t_ns, one.at_ns - config.turned_s * 1e9)), at + 1)
        if motion.q_des is None:
            speed = np.abs(motion.dq[before, most])
        else:  # a push moves a joint that is to rest
            speed = np.abs(np.gradient(motion.q_des[:, most], motion.time_s))[before]
        turned = speed.min() < config.rests_rad_s and speed.max() > config.moves_rad_s
        turned_alone = bool(turned and len(others) and others.max() < config.lone)

        epoch = epoch_of(recording.provenance)
        grown = replace(one, times=round(one.times, 3), begin_ns=start, epoch=epoch)
        over = np.flatnonzero((times[:, joints].mean(axis=1) > config.edge) & (np.abs(t_ns - one.at_ns) < reach_ns))
        if len(over):
            gaps = np.flatnonzero(np.diff(t_ns[over]) > config.gap_s * 1e9)
            begins, ends = t_ns[over[np.r_[0, gaps + 1]]], t_ns[over[np.r_[gaps, len(over) - 1]]]
            meet = (ends >= one.from_ns - round(1e9 * config.hold_s)) & (begins <= one.to_ns)
            grown = replace(
                grown,
                from_ns=min([one.from_ns, *begins[meet].tolist()]),
                to_ns=max([one.to_ns, *ends[meet].tolist()]),
                link=link_of(places, motion, estimates, at),
            )
        signs = np.sign(np.r_[estimates["tau_ext"][at, joints], motion.dq[at, joints]])
        return cls(grown, motion.q[at], signs, turned_alone)


def link_of(places: _core.PlaceModel, motion: Recording, estimates: dict[str, np.ndarray], at: int) -> str:
    """Joint of the link on which a force explains the errors of a sample; empty: unknown, or no force does."""
    sigma = estimates["sigma_nm"][at]
    if places.refused or not (np.isfinite(sigma).all() and (sigma > 0).all()):
        return ""
    found = places.find(
        motion.q[at].tolist(), estimates["tau_ext"][at].tolist(), sigma.tolist(), dq=motion.dq[at].tolist()
    )
    if not found.known or not found.consistent >= 0.01:
        return ""
    return str(motion.joints[found.ranked[0]])
