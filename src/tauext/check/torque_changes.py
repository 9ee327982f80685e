"""Torque that the motion does not explain: friction that warms up, a zero that grows, steps that repeat, contacts."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tauext import _core
from tauext.check import joint_fit
from tauext.check.examination import Examination
from tauext.check.finding import Finding
from tauext.check.joint_fit import RESISTS, FitRows, JointFit
from tauext.check.motion import FIT, MOVING_RAD_S, RowFilter, Stretch, smooth, some_known, stretches
from tauext.config import FreeMotionConfig
from tauext.data.free_motion import total_s, unknown_s
from tauext.data.recording import Recording, runs_of
from tauext.data.servo import torque_unit

# --- Torque that changes slowly, or by steps.


def friction_findings(x: Examination) -> Iterator[Finding]:
    """Findings of friction that changes with time, for example while a gear warms up."""
    for j, fit in enumerate(x.fits):
        times_s, shares = friction_by_time(x.rows, j, fit)
        # the standard error of five or six windows is too uncertain, and so is friction that is little of the torque
        if len(times_s) < 7 or fit.friction_nm < 0.15 * fit.torque_nm:
            continue
        from scipy.stats import linregress  # takes 0.3 s to import

        line, minutes = linregress(times_s, shares), np.ptp(times_s) / 60
        change = float(line.slope) * 60 * minutes
        if abs(change) < 0.1 or abs(line.slope) < 5.0 * line.stderr:
            continue
        evidence = f"friction changes by {change:+.0%} in {minutes:.3g} minutes"
        warm = [r.temperature[:, j] for r in x.recordings if r.temperature is not None]
        if warm:
            evidence += f", while the motor goes from {warm[0][0]:.1f} to {warm[-1][-1]:.1f} degrees Celsius"
        advice = (
            "train on warm and on cold motion, or warm the arm up first; the monitor's adaptive bias follows the rest"
        )
        yield Finding("torque-changes", "warning", x.joints[j], evidence, advice)


def friction_by_time(rows: FitRows, joint: int, fit: JointFit) -> tuple[np.ndarray, np.ndarray]:
    """Middle of each minute [s], and its friction relative to all data."""
    friction = rows.columns(joint)[:, RESISTS] @ fit.weights[RESISTS]
    error = rows.tau[:, joint] - fit.predicted
    minute = ((rows.time_s - rows.time_s[0]) // 60.0).astype(int)
    times, shares = [], []
    for k in np.unique(minute):
        at = minute == k
        power = float((friction[at] ** 2).sum())
        if at.sum() > 200 and power > 0.1 * at.sum() * float((friction**2).mean()):
            times.append(float(rows.time_s[at].mean()))
            shares.append(1 + float(friction[at] @ error[at]) / power)
    return np.array(times), np.array(shares)


def half_seconds(rows: FitRows) -> tuple[np.ndarray, np.ndarray]:
    """First row of each half second, and whether each joint moves in it, (half seconds, joints).

    Of a joint at rest, friction holds a part of the torque, and another one after each stop.
    """
    starts = np.r_[0, 1 + np.flatnonzero(np.diff((rows.time_s // 0.5).astype(int)))]
    return starts, np.maximum.reduceat(np.abs(rows.dq) > MOVING_RAD_S, starts)


def growth_findings(x: Examination) -> Iterator[Finding]:
    """Findings of torques with an offset that grows steadily within the recordings.

    The fit of motion and friction gets a term in time; the rests of a joint that mostly rests are left out, since
    friction holds another part of the torque in each. Each recording has an offset of its own, so that motion which
    differs between recordings is no growth. Blocks of five seconds of the errors give the standard error: a program
    repeats its motion at such times. Without a model, motion resembles growth for a minute, so that the recordings, or
    thirds of the time, must agree as well.
    """
    for j, fit in enumerate(x.fits):
        judged = x.rows.judged(j)
        rows = x.rows.taken(judged)
        recording = np.unique(rows.recording, return_inverse=True)[1]
        rows_of_each = np.bincount(recording)
        lengths_s = [float(np.ptp(rows.time_s[recording == k])) for k in range(len(rows_of_each))]
        block = np.unique(recording * 10**6 + (rows.time_s // 5.0).astype(int), return_inverse=True)[1]
        if block.max() + 1 < 12:
            continue
        part = recording if len(lengths_s) > 2 else block * 3 // int(block.max() + 1)
        parts = int(part.max()) + 1
        time_s = _centred(rows.time_s, recording)
        starts, moves = half_seconds(rows)
        columns = np.column_stack([_centred(column, recording) for column in rows.columns(j).T])
        columns[:, joint_fit.CONSTANT] = 1.0
        torque = _centred(rows.tau[:, j], recording)
        weights, trust = joint_fit.robust_solve(np.column_stack([columns, time_s]), torque)
        growth, error = float(weights[-1]), torque - columns @ weights[:-1] - weights[-1] * time_s
        root = np.sqrt(trust)
        alone = time_s - columns @ np.linalg.lstsq(root[:, None] * columns, root * time_s, rcond=None)[0]
        power = float(trust @ alone**2)
        sigma, of_parts = (
            np.sqrt(float((np.bincount(group, trust * alone * error) ** 2).sum())) / max(power, 1e-12)
            for group in (block, part)
        )
        if not rows.has_model:  # all parts add up to zero, so that one of them is not free
            sigma = max(sigma, of_parts * np.sqrt(parts / max(parts - 1, 1)))
        # in the longest recording it must exceed the usual error, and in all a quarter of the explained torque's
        # spread: a gear that warms up, with a wrong model, reaches 0.06
        usual = float(np.median(np.maximum.reduceat(np.abs(error), starts)[moves.any(axis=1)]))
        predicted_nm = float(fit.predicted[judged].std())
        is_large = abs(growth) * max(lengths_s) > usual and abs(growth) * sum(lengths_s) > 0.25 * predicted_nm
        if is_large and abs(growth) > 6.0 * sigma and not rows.has_model and not judged.all():
            # sines of seven joints follow few moves so closely that the errors are too small: it reaches 8 by these,
            # and 4 by the spread of what is found without a tenth of the time
            tenth = block * joint_fit.BLOCKS // int(block.max() + 1)
            kept = [tenth != k for k in range(joint_fit.BLOCKS)]
            regressors = np.column_stack([columns, time_s])
            found = [joint_fit.solve(regressors[at], torque[at], trust[at])[-1] for at in kept]
            sigma = max(sigma, joint_fit.spread_of(np.array(found)))
        if is_large and abs(growth) > 6.0 * sigma:  # without a model, motion that changes with time reaches 4
            evidence = f"the torque's zero changes by {60 * growth:+.3g} ± {60 * sigma:.2g} {x.unit} a minute"
            advice = (
                "let electronics and arm warm up, repair or zero the sensor, then record again; a load that is filled "
                "or emptied while recording does the same"
            )
            yield Finding("torque-changes", "fault", x.joints[j], evidence, advice)


def _centred(signal: np.ndarray, group: np.ndarray) -> np.ndarray:
    """The signal without the mean of each group of rows, (rows,)."""
    return np.asarray(signal - (np.bincount(group, signal) / np.bincount(group))[group])


def step_findings(x: Examination) -> Iterator[Finding]:
    """Findings of torques that are off in a tenth of the time or more by far more than in the rest of it."""
    rows, (starts, moves) = x.rows, half_seconds(x.rows)
    # friction at reversals reaches 5.3 usual errors with a model; without one the usual error is that of gravity, and
    # friction reaches 2.7
    times = 6.0 if rows.has_model else 4.0
    for j, fit in enumerate(x.fits):
        predicted = closest_fit(rows, j, fit.predicted) if rows.has_model else fit.predicted
        error, judged = rows.tau[:, j] - predicted, rows.judged(j)
        off = np.where(judged, np.abs(error - np.median(error[judged])), 0.0)
        largest, moving = np.maximum.reduceat(off, starts), moves[:, j]
        if moving.sum() < 120:
            continue
        # without a model, the torque that moves the other links is an error, too
        steady = moving if rows.has_model else moving & calm_half(rows, starts, moving)
        usual, step = float(np.median(largest[moving])), float(np.percentile(largest[steady], 90))
        if step > times * usual and step > 0.5 * float(predicted[judged].std()):
            share = float((largest[moving] > 0.5 * step).mean())
            evidence = f"off by {step:.3g} {x.unit} in {share:.0%} of the motion, by {usual:.2g} {x.unit} usually"
            advice = (
                "pushes, a second load or a faulty signal that no label names: label or cut these times, or record "
                "motion that nothing touches"
            )
            yield Finding("torque-changes", "fault", x.joints[j], evidence, advice)


def calm_half(rows: FitRows, starts: np.ndarray, moving: np.ndarray) -> np.ndarray:
    """Half of the moving half seconds, (half seconds,) bool: in which no joint accelerates or turns as fast as else."""
    powers = (rows.acceleration**2, rows.dq**2)
    sizes = [x / np.maximum((x**2).mean(axis=0), 1e-12) ** 0.5 for x in powers]
    liveliest = np.maximum.reduceat(np.maximum(*sizes).max(axis=1), starts)
    calm: np.ndarray = liveliest <= np.median(liveliest[moving])
    return calm


def closest_fit(rows: FitRows, joint: int, predicted: np.ndarray) -> np.ndarray:
    """Torque of a fit to 60 % of the judged rows, those closest to this one, (rows,): steps in a third of the time
    distort a fit to all of them."""
    columns, torque, judged = rows.columns(joint), rows.tau[:, joint], rows.judged(joint)
    for _ in range(10):
        error = np.abs(torque - predicted)
        trust = np.where(judged & (error <= np.quantile(error[judged], 0.6)), 1.0, 1e-9)
        predicted = columns @ joint_fit.solve(columns, torque, trust)
    return predicted


# --- Contacts in free motion, found from labels or from torque that the motion does not explain.


@dataclass(frozen=True)
class ContactRules:
    """When an error of the torque is a disturbance. Good recordings reached 4.1 times the usual error."""

    usual: float = 90.0  # percentile of the half seconds' largest errors that is usual: friction at reversals
    alone: tuple[float, float] = (5.0, 8.0)  # multiples of the usual error and of the spread, at one joint
    together: tuple[float, float] = (4.0, 6.0)  # at two: a contact also acts on the joints before its link
    least_windows: int = 60  # half seconds of motion
    # An impact lasts 50 to 200 ms, and the low-pass of the fits would halve it. Four filter time constants are left
    # out at the ends: a longer margin would hide an impact that ends a program.
    rows: RowFilter = RowFilter(10.0, 50.0, 0.1)


def contact_findings(x: Examination) -> Iterator[Finding]:
    """Recordings that are called free, by `called_free` or by what made them, and hold samples labelled contact. No
    fault: what is labelled is left out of training and limits; what the label misses at its ends is not. A note states
    how much is of unknown contact."""
    if unknown := unknown_s(x.recordings):
        evidence = f"contact = -1, unknown, in {unknown:.1f} s of {total_s(x.recordings):.1f} s"
        advice = "training, thresholds and these checks leave that time out; label it if it is free motion"
        if not some_known(x.recordings):
            advice = "no motion is known to be free, so training refuses it: label it, or import it without the contact"
        yield Finding("contact-unknown", "note", None, evidence, advice)
    for r in x.recordings:
        free = r.name in x.called_free or r.provenance.get("contacts") == "none"
        if not free or r.contact is None or not (r.contact == 1).any():
            continue
        touched = r.contact == 1
        first = r.time_s[int(touched.argmax())]
        evidence = f"'{r.name}': {touched.mean():.1%} of the samples are labelled contact, the first at {first:.2f} s"
        advice = (
            "they are left out of training and thresholds; list the recording with the collisions, or exclude the "
            "interval, if the labels may begin late or end early"
        )
        yield Finding("contact-in-free-motion", "warning", None, evidence, advice, r.name)


def unlabelled_findings(
    recordings: Sequence[Recording], tree: _core.Tree | None, lag_s: float = 0.0, rules: ContactRules = ContactRules()
) -> list[Finding]:
    """Find disturbances far beyond the usual error that training would use as free motion; one finding for all.

    The surroundings of a label are excluded, as in training; a label that comes later is found. Without a model nothing
    is found, since an error of gravity at a rare pose resembles a push (but see contacts_at_rest); nor are pushes below
    a few times the error at friction reversals.

    Args:
        recordings: without faults of their signals.
        lag_s: delay of the torque, [s].
    """
    # the torque through the positions' own filter, or steps of acceleration would appear in the torque alone
    motion = [replace(s, tau=smooth(s.tau, s.rate_hz)) for s in stretches(recordings, contacts=True)]
    if not motion or tree is None:
        return []
    rows = joint_fit.rows_of(motion, tree, lag_s, rules.rows)
    free = ~near_label(rows, recordings)
    # the joint has moved far enough to determine the direction of friction
    gone = [np.maximum.accumulate(np.abs(s.q - s.q[0]), axis=0) > 2 * max(joint_fit.PRESLIDING_RAD) for s in motion]
    known = np.concatenate([rules.rows.picked(moved, s.rate_hz) for moved, s in zip(gone, motion, strict=True)])
    if free.sum() < joint_fit.LEAST_ROWS:
        return []
    if often := often_disturbed(rows.taken(free), recordings[0].joints, torque_unit(recordings)):
        return often
    errors, friction = np.zeros_like(rows.tau), np.zeros_like(rows.tau)
    for j in range(rows.joints):
        columns = rows.columns(j)
        weights = joint_fit.robust_solve(columns[free], rows.tau[free, j])[0]
        errors[:, j] = rows.tau[:, j] - columns @ weights
        friction[:, j] = columns[:, RESISTS] @ weights[RESISTS]
    errors -= np.median(errors[free], axis=0)
    spread = np.maximum([joint_fit.robust_spread(x) for x in errors[free].T], 1e-12)
    errors[~(known & free[:, None])] = 0.0
    starts, moves = half_seconds(rows)
    moving = moves.any(axis=1)
    if moving.sum() < rules.least_windows:
        return []
    largest = np.maximum.reduceat(np.abs(errors), starts)
    usual = np.maximum(np.percentile(largest[moving], rules.usual, axis=0), 1e-12)
    swings = np.maximum.reduceat(rows.tau, starts) - np.minimum.reduceat(rows.tau, starts)
    slowest, fastest = (way.reduceat(np.abs(rows.dq), starts) for way in (np.minimum, np.maximum))
    # steps of acceleration leave errors, too; slow joints may stick and slip by half of their friction, and of one at
    # rest friction holds any part
    least = 0.1 * np.maximum(swings, rows.tau.std(axis=0))
    held = np.where(fastest < MOVING_RAD_S, 1.0, 0.5 * (slowest < 0.05))
    seen = largest > least + held * np.percentile(np.abs(friction), rules.usual, axis=0)
    times, spreads = largest / usual, largest / spread
    alone, together = (seen & (times > a) & (spreads > b) for a, b in (rules.alone, rules.together))
    touched = alone.any(axis=1) | (together.sum(axis=1) >= 2)
    if not touched.any():
        return []
    begins = runs_of(touched)[:, 0]
    strongest = begins[np.argsort(-times[begins].max(axis=1))][:3]
    windows = np.split(np.arange(len(errors)), starts[1:])
    listed = [_described(errors, rows, windows[k], times[k], recordings) for k in strongest]
    what = "disturbance" if len(begins) == 1 else "disturbances"
    evidence = f"{len(begins)} {what} of the torque that the motion does not explain: {'; '.join(listed)}"
    advice = "inspect these times: keep contacts out of training and thresholds, by a label or by cutting the recording"
    return [Finding("contact-in-free-motion", "warning", None, evidence, advice)]


@dataclass(frozen=True)
class OftenRules:
    """When a torque is off in so much of the time that its usual error is that of a disturbance."""

    fitted: float = 0.35  # share of the half seconds, those that agree best, to which the torque is fitted
    quiet: float = 20.0  # percentiles of the half seconds' errors: one that a disturbance does not reach,
    off: float = 75.0  # and one that it does
    times: float = 15.0  # ratio of the two; good recordings, rough models included, reach 8
    least: float = 0.1  # and least error, as a share of the torque's spread: friction of a standing arm reaches 0.08
    rows_hz: float = 10.0
    steps: int = 12


def often_disturbed(rows: FitRows, joints: Sequence[str], unit: str, rules: OftenRules = OftenRules()) -> list[Finding]:
    """Finding of torques that are off in a quarter to two thirds of the time; a fit to all of it follows both states.

    The fit is to the half seconds that agree best among themselves. Errors are means over half seconds, of which noise
    and reversals of friction are a small part.
    """
    thin = rows.thinned(max(1, round(len(rows.time_s) * rules.rows_hz / ContactRules().rows.rows_hz)))
    starts, moves = half_seconds(thin)
    half = np.repeat(np.arange(len(starts)), np.diff(np.r_[starts, len(thin.time_s)]))
    size, parts = np.bincount(half), []
    for j in range(thin.joints):
        if moves[:, j].sum() < 2 * ContactRules().least_windows:
            continue
        of_load = np.abs(thin.gravity[:, j]) * np.tanh(thin.dq[:, j] / MOVING_RAD_S)  # friction that grows with gravity
        columns, torque = np.column_stack([thin.columns(j), of_load]), thin.tau[:, j]
        predicted = columns @ joint_fit.robust_solve(columns, torque)[0]
        for _ in range(rules.steps):
            error = np.bincount(half, np.abs(torque - predicted)) / size
            trust = np.where(error <= np.quantile(error, rules.fitted), 1.0, 1e-9)[half]
            predicted = columns @ joint_fit.solve(columns, torque, trust)
        error = np.abs(np.bincount(half, torque - predicted) / size)[moves[:, j]]
        quiet, off = np.percentile(error, (rules.quiet, rules.off))
        if off > rules.times * quiet and off > rules.least * float(torque.std()):
            share = float((error > 0.5 * off).mean())
            parts.append(f"'{joints[j]}' by {off:.3g} {unit} in {share:.0%} of the motion, by {quiet:.2g} {unit} else")
    if not parts:
        return []
    advice = (
        "contacts, or a load that comes and goes: thresholds found on this motion are as wide as these torques; label "
        "or cut these times, or record motion that nothing touches"
    )
    evidence = f"the torque is often off, which the motion does not explain: {'; '.join(parts)}"
    return [Finding("contact-in-free-motion", "warning", None, evidence, advice)]


# --- Contacts without a model: an arm at rest.


@dataclass(frozen=True)
class RestRules:
    """When the torque of an arm at rest changes by a contact. Good recordings have one such change in 30 s of rest."""

    settled_s: float = 0.5  # left out after motion, in which vibration and integral action decay ...
    before_s: float = 0.3  # ... and before it: the torque rises before a joint leaves stiction
    travel_rad: float = 5e-4  # a longer way turns friction round
    over_s: float = 0.32  # time over which a change counts
    median_s: float = 0.36  # length of the median filter before, which removes spikes
    share: float = 0.25  # least change, as a share of the torque's spread ...
    times: float = 8.0  # ... and as a multiple of the usual change
    joints: int = 2  # that change together: a single joint may hunt, or its sensor fail
    off: float = 0.1  # torque below this share of its spread at all joints: brakes hold the arm
    least: int = 4  # changes in all ...
    least_per_s: float = 0.1  # ... and in a second of rest


def contacts_at_rest(
    motion: Sequence[Stretch], recordings: Sequence[Recording], rules: RestRules = RestRules()
) -> list[Finding]:
    """Find contacts without a model: while all joints rest, nothing else changes gravity and friction.

    Torques pass a low-pass and a median filter. Changes from or to torques of 0 are those of brakes.

    Args:
        motion: of these recordings, without labelled contacts.
    """
    if not motion:
        return []
    spread = np.concatenate([FIT.rows(s.tau, s.rate_hz) for s in motion]).std(axis=0)
    found = [part for s in motion if (part := _AtRest.of(s, rules)) is not None]
    if not found:
        return []
    usual = np.median(np.abs(np.concatenate([part.changes for part in found])), axis=0)
    least = np.maximum(rules.share * spread, rules.times * usual)
    joints, rests_s = min(rules.joints, len(spread)), sum(part.seconds for part in found)
    touched: list[tuple[int, float, np.ndarray]] = []
    for part in found:
        hits = np.flatnonzero((np.abs(part.changes) > least).sum(axis=1) >= joints)
        for run in np.split(hits, np.flatnonzero(np.diff(part.rows[hits]) > 1) + 1) if len(hits) else ():
            sides = part.before[run[0]], part.before[run[-1]] + part.changes[run[-1]]
            if not any((np.abs(side) < rules.off * spread).all() for side in sides):
                touched.append((part.recording, float(part.time_s[run[0]]), sides[1] - sides[0]))
    if len(touched) < max(rules.least, rules.least_per_s * rests_s):
        return []
    number, start_s, change = max(touched, key=lambda one: float((np.abs(one[2]) / spread).max()))
    j, r = int(np.argmax(np.abs(change) / spread)), recordings[number]
    since_s = start_s - sum(one.duration_s for one in recordings[:number])
    evidence = (
        f"{len(touched)} changes of the torque in {rests_s:.0f} s in which all joints rest, the largest by "
        f"{change[j]:.3g} {torque_unit(recordings)} at '{r.joints[j]}' at {since_s:.1f} s of '{r.name}'"
    )
    advice = (
        "at rest only contacts, and drives that are switched, change the torque: thresholds found on this motion are "
        "as wide as these torques; label or cut the contacts, or record motion that nothing touches"
    )
    return [Finding("contact-in-free-motion", "warning", None, evidence, advice)]


@dataclass(frozen=True)
class _AtRest:
    """Changes of the torque over a short time in which all joints rest, (changes, joints), in one stretch."""

    recording: int
    rows: np.ndarray  # (changes,) rows at which they begin
    time_s: np.ndarray  # (changes,)
    before: np.ndarray  # torque there
    changes: np.ndarray
    seconds: float

    @staticmethod
    def of(s: Stretch, rules: RestRules) -> _AtRest | None:
        """Those of a stretch; None: the arm never rests for long enough."""
        q, dq = (FIT.rows(x, s.rate_hz) for x in (s.q, s.dq))
        rate_hz, rows = s.rate_hz / max(1, round(s.rate_hz / FIT.rows_hz)), np.arange(len(q))
        over = max(1, round(rules.over_s * rate_hz))
        moves = (np.abs(dq) > MOVING_RAD_S).any(axis=1)
        moves[[0, -1]] = True
        last = np.maximum.accumulate(np.where(moves, rows, 0))
        after = np.minimum.accumulate(np.where(moves, rows, len(rows))[::-1])[::-1]
        rests = (rows - last >= rules.settled_s * rate_hz) & (after - rows >= rules.before_s * rate_hz)
        same = (last[over:] == last[:-over]) & rests[over:] & rests[:-over]
        at = np.flatnonzero(same & (np.abs(q[over:] - q[:-over]) < rules.travel_rad).all(axis=1))
        if not len(at):
            return None
        from scipy.ndimage import median_filter  # takes 0.1 s to import

        tau = median_filter(FIT.rows(s.tau, s.rate_hz), (max(1, round(rules.median_s * rate_hz)), 1))
        time_s = s.start_s + FIT.end_s + at / rate_hz
        return _AtRest(s.recording, at, time_s, tau[at], tau[at + over] - tau[at], len(at) / rate_hz)


def is_unlabelled_contact(finding: Finding) -> bool:
    """Whether `unlabelled_findings` made this finding."""
    return finding.code == "contact-in-free-motion" and finding.recording is None


def near_label(rows: FitRows, recordings: Sequence[Recording]) -> np.ndarray:
    """Rows (rows,) bool that training leaves out, as a labelled contact is near, and those near unknown contact."""
    margins, start_s = FreeMotionConfig(), 0.0
    near = np.zeros(len(rows.time_s), dtype=bool)
    for r in recordings:
        for first, after in [] if r.contact is None else runs_of(r.contact != 0).tolist():
            begin, end = start_s + r.time_s[first] - margins.before_s, start_s + r.time_s[after - 1] + margins.after_s
            near |= (rows.time_s >= begin) & (rows.time_s <= end)
        start_s += r.duration_s
    return near


def _described(
    errors: np.ndarray, rows: FitRows, window: np.ndarray, times: np.ndarray, recordings: Sequence[Recording]
) -> str:
    joint = int(np.argmax(times))
    peak = window[int(np.argmax(np.abs(errors[window, joint])))]
    recording = int(rows.recording[peak])
    since = rows.time_s[peak] - sum(r.duration_s for r in recordings[:recording])
    r = recordings[recording]
    where = f"'{r.joints[joint]}' at {since:.1f} s of '{r.name}'"
    return f"{errors[peak, joint]:.3g} {torque_unit(recordings)} at {where}, {times.max():.0f} times the usual error"
