"""Recordings that differ from the others in torque: clock, zeros, load, sign."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations

import numpy as np

from tauext import _core
from tauext.check.arrangement import GRID_RAD, HALVED, LEAST_KG, LEAST_RAD, WORSE, load_columns, search_stretches
from tauext.check.effort import inverted, sign_vote
from tauext.check.finding import Finding, Severity
from tauext.check.joint_fit import LEAST_ROWS, SEEN, FitRows, columns_of, fit_joint, robust_solve, rows_of, torque_rows
from tauext.check.motion import FIT_ROWS_HZ, SIGNALS, Stretch

# --- Possible corrections of one recording's torques or positions, each with its remaining error.


ZERO_ROWS = 250
WRONG_RAD = 0.5
"""A larger one is a fault; a rough model or another trajectory may cause a smaller one."""
SCALES = (0.65, 1.5)
"""Factors in this range come from temperature and wear."""
LAGS_S = tuple(sign * lag for lag in (0.02, 0.04, 0.06, 0.08, 0.1, 0.12) for sign in (1, -1))
OF_UNITS = 8.0
"""A larger factor means another unit. A smaller factor is certain only with a model: without one, other poses may have
another gravity."""

Errors = Callable[[FitRows], np.ndarray]
"""Function from rows to the robust error of each joint, [N m], with the fit of the other recordings."""


@dataclass(frozen=True)
class Correction:
    """A change that makes a recording agree with the others."""

    what: str
    joint: int | None
    errors_nm: np.ndarray  # (joints,) that it leaves
    severity: Severity
    parameters: int
    """Number of free parameters; of two equally good corrections the one with fewer wins."""
    moves: bool = False
    """Whether it changes positions."""
    shifts: bool = False
    """Whether it shifts a zero of position, torque or time."""
    rough: bool = False
    """Whether it corrects only a part: a load's mass and centre, without inertia and added friction."""


def spread_about_zero(error: np.ndarray) -> np.ndarray:
    """Robust magnitude of each column, offset included."""
    return np.maximum(1.4826 * np.median(np.abs(error), axis=0), 1e-9)


def torque_corrections(
    rows: FitRows,
    predicted: np.ndarray,
    stretches: Sequence[Stretch],
    tree: _core.Tree | None,
    suspects: np.ndarray,
    joints: Sequence[str],
    unit: str,
) -> Iterator[Correction]:
    """Corrections of sign, factor, offset and order of the torques, and of a load.

    Args:
        rows: of the recording.
        predicted: (rows, joints) torque by the others' fit, [N m].
        suspects: joints whose torque is off, (joints,) bool.
    """
    yield from _of_torque(rows, predicted, suspects, joints, unit, certain=tree is not None)
    yield from _of_time(predicted, stretches, suspects)
    if tree is not None:
        yield from _of_load(rows, predicted, stretches, tree, joints)


def motion_corrections(
    rows: FitRows,
    stretches: Sequence[Stretch],
    tree: _core.Tree | None,
    errors: Errors,
    suspects: np.ndarray,
    joints: Sequence[str],
) -> Iterator[Correction]:
    """Corrections of sign, order and zero of the positions, with and without the torques."""
    n = len(joints)
    motion, all_of_it = ("q", "dq", "q_raw", "dq_raw"), SIGNALS
    for chosen in (*range(n), None):
        sign = np.where([chosen is None or j == chosen for j in range(n)], -1.0, 1.0)
        for names, what in ((motion, "positions and velocities"), (all_of_it, "all signals")):
            changed = [s.changed(partial(np.multiply, sign), names) for s in stretches]
            change = f"{what} negated of {'all joints' if chosen is None else repr(joints[chosen])}"
            yield Correction(change, chosen, errors(rows_of(changed, tree)), "fault", 0, moves=True)
    for a, b in combinations(range(n), 2):
        if not suspects[a] and not suspects[b]:
            continue
        order = list(range(n))
        order[a], order[b] = b, a
        for names, what in ((motion, "the positions and velocities"), (all_of_it, "all signals")):
            changed = [s.changed(partial(np.take, indices=order, axis=1), names) for s in stretches]
            after = errors(rows_of(changed, tree))
            if names is all_of_it:
                after = after[order]  # each torque against itself
            yield Correction(f"{what} of '{joints[a]}' and '{joints[b]}' exchanged", a, after, "fault", 0, moves=True)
    yield from _of_zero(rows, tree, errors)


def _of_torque(
    rows: FitRows, predicted: np.ndarray, suspects: np.ndarray, joints: Sequence[str], unit: str, certain: bool
) -> Iterator[Correction]:
    now = spread_about_zero(rows.tau - predicted)
    off = np.flatnonzero(suspects).tolist()
    negated = spread_about_zero(rows.tau + predicted)
    for chosen in [[j] for j in off] + ([off] if len(off) > 1 else []):
        after = now.copy()
        after[chosen] = negated[chosen]
        joint = chosen[0] if len(chosen) == 1 else None
        named = "its torque" if joint is not None else f"the torque of {', '.join(joints[j] for j in chosen)}"
        yield Correction(f"{named} negated", joint, after, "fault", 0)
    factors = np.array([_factor(rows.tau[:, j], predicted[:, j]) for j in range(rows.joints)])
    divided_by = np.where(factors == 0, 1, factors)
    scaled = spread_about_zero(rows.tau / divided_by - predicted)
    scalable = [j for j in off if factors[j] > 0 and not SCALES[0] < factors[j] < SCALES[1]]
    for chosen in [[j] for j in scalable] + ([scalable] if len(scalable) > 1 else []):
        after = now.copy()
        after[chosen] = np.maximum(scaled, spread_about_zero(rows.tau - factors * predicted) / np.abs(divided_by))[
            chosen
        ]
        joint = chosen[0] if len(chosen) == 1 else None
        named = "its torque" if joint is not None else f"the torque of {', '.join(joints[j] for j in chosen)}"
        divisor = f"{factors[chosen].min():.3g}" + (f" to {factors[chosen].max():.3g}" if joint is None else "")
        of_unit = bool((np.abs(np.log(factors[chosen])) > math.log(OF_UNITS)).all())
        severity: Severity = "fault" if certain or of_unit else "warning"
        yield Correction(f"{named} divided by {divisor}", joint, after, severity, len(chosen))
    middle = np.median(rows.tau - predicted, axis=0)
    centred = spread_about_zero(rows.tau - predicted - middle)
    for j in off:
        after = now.copy()
        after[j] = centred[j]
        yield Correction(f"{-middle[j]:+.3g} {unit} added to its torque", j, after, "warning", 1, shifts=True)
    for a, b in combinations(off, 2):
        after = now.copy()
        after[[a, b]] = spread_about_zero(rows.tau[:, [b, a]] - predicted[:, [a, b]])
        yield Correction(f"the torques of '{joints[a]}' and '{joints[b]}' exchanged", a, after, "fault", 0)


def _of_time(predicted: np.ndarray, stretches: Sequence[Stretch], suspects: np.ndarray) -> Iterator[Correction]:
    """Corrections of the delay of all torques."""
    for lag_s in LAGS_S:
        after = spread_about_zero(torque_rows(stretches, lag_s) - predicted)
        yield Correction(f"its torque taken {1e3 * lag_s:+.0f} ms later", None, after, "warning", 1, shifts=True)


def _factor(torque: np.ndarray, predicted: np.ndarray) -> float:
    """Factor from prediction to torque, from the rows with the least error."""
    keep = np.ones(len(torque), dtype=bool)
    factor = 0.0
    for _ in range(3):
        power = float(predicted[keep] @ predicted[keep])
        if power < 1e-12:
            return 0.0
        factor = float(predicted[keep] @ torque[keep]) / power
        error = np.abs(torque - factor * predicted)
        keep = error <= np.percentile(error, 90)
    return factor


def _of_zero(whole: FitRows, tree: _core.Tree | None, errors: Errors) -> Iterator[Correction]:
    """The best position offset of each joint; inertia is left unchanged."""
    stride = max(1, len(whole.time_s) // ZERO_ROWS)
    rows = whole.taken(slice(None, None, stride))
    for j in range(rows.joints):

        def after(by: float, j: int = j) -> np.ndarray:
            q = rows.q + by * np.eye(rows.joints)[j]
            gravity = rows.gravity if tree is None else tree.momentum(q, np.zeros_like(q))[1]
            return errors(replace(rows, q=q, gravity=gravity))

        def size(by: float, after: Callable[[float], np.ndarray] = after) -> float:
            return float(np.log(after(by)).sum())

        best = min(np.arange(-math.pi, math.pi - 1e-9, GRID_RAD).tolist(), key=size)
        for halving in range(1, 6):
            width = GRID_RAD / 2**halving
            best = min((best - width, best, best + width), key=size)
        if abs(math.remainder(best, 2 * math.pi)) > LEAST_RAD:
            change = f"{best:+.2f} rad ({math.degrees(best):+.0f} degrees) added to its position"
            severity: Severity = "fault" if abs(math.remainder(best, 2 * math.pi)) > WRONG_RAD else "warning"
            yield Correction(change, j, after(best), severity, 1, moves=True, shifts=True)


def _of_load(
    rows: FitRows, predicted: np.ndarray, stretches: Sequence[Stretch], tree: _core.Tree, joints: Sequence[str]
) -> Iterator[Correction]:
    """Correction of the load's mass at the last link against the others'."""
    shared, error = load_columns(stretches, tree, rows), rows.tau - predicted
    scale = 1 / spread_about_zero(error)
    for _ in range(3):
        x = (shared * scale[:, None]).reshape(-1, 4)
        load = np.linalg.lstsq(x, (error * scale).ravel(), rcond=1e-6)[0]
        scale = 1 / spread_about_zero(error - shared @ load)
    if abs(load[0]) > LEAST_KG:
        way = "more" if load[0] > 0 else "less"
        change = f"{abs(load[0]):.2g} kg {way} at '{joints[-1]}' than in the others taken into account"
        yield Correction(change, None, spread_about_zero(error - shared @ load), "warning", 4, rough=True)


# --- Recordings with small differences of clock, zeros or load, which their own error does not reveal.  Each difference
# is one number (a load: its mass), estimated for each recording from the common fit's error. A recording is odd if its
# number is far from the others' and reduces the error.


LATE_S, TURNED_RAD, LOADED_KG = 0.01, 0.03, 0.15
"""Smaller differences come from wear, temperature and rough models ..."""
FURTHEST_S, FURTHEST_RAD, FURTHEST_KG = 0.2, 0.4, 50.0
"""... and larger ones are outside the linear range of the estimate."""
SPREADS = 6.0
"""Multiple of the spread of the others' numbers (median magnitude)."""
SHIFT_GAIN = 0.4
"""Least gain, [nats]: sum over joints of log(error before / after); for a load, errors above the others' count."""
LEAST_RECORDINGS = 4
LEAST_S = 11.0
"""Least time of motion, [s], to estimate a number."""
STEP_RAD = 0.05
SHIFT_ROUNDS, HUBER = 4, 2.0


@dataclass(frozen=True)
class Number:
    """One estimated quantity for each recording."""

    name: str
    unit: str
    scale: float  # scale to the unit in messages
    joint: int | None
    least: float
    furthest: float
    columns: dict[int, np.ndarray]
    """For each recording, torque per unit of the number, (rows, joints, 1 or more); NaN: unknown."""


@dataclass(frozen=True)
class Estimate:
    """Estimate of one number in one recording."""

    value: float
    gain: float


@dataclass(frozen=True)
class Odd:
    """A recording whose number is far from those of the others."""

    number: Number
    recording: int
    off: float
    spread: float  # of the others
    gain: float

    def text(self) -> str:
        scale, unit = self.number.scale, self.number.unit
        return (
            f"{self.number.name} by {self.off * scale:+.3g} {unit} against the other recordings, which differ by "
            f"{self.spread * scale:.2g} {unit}; with that the error falls to {np.exp(-self.gain):.0%}"
        )


def odd_shifts(
    parts: dict[int, FitRows],
    errors_nm: dict[int, np.ndarray],
    usual_nm: np.ndarray,
    motion: Sequence[Stretch],
    tree: _core.Tree,
    joints: Sequence[str],
    names: Sequence[str],
) -> list[Finding]:
    """Find recordings with small offsets: at most one warning a recording.

    Args:
        parts: rows of each recording that agrees with the others, by its number.
        errors_nm: error of the common fit, (rows, joints), [N m].
        usual_nm: (joints,) median of the recordings' errors.
        names: of all recordings.
    """
    parts = {k: part for k, part in parts.items() if len(part.time_s) >= LEAST_S * FIT_ROWS_HZ}
    if len(parts) < LEAST_RECORDINGS:
        return []
    numbers = [
        (number, {k: _estimate(number.columns[k], errors_nm[k], usual_nm) for k in parts})
        for number in _numbers(parts, errors_nm, motion, tree, joints)
    ]
    found: list[Finding] = []
    left = set(parts)
    while len(left) >= LEAST_RECORDINGS:  # largest deviation first: it would widen the others' spread
        odd = [odd for number, values in numbers for k in left if (odd := _odd(number, values, k, left)) is not None]
        if not odd:
            break
        worst = max(odd, key=lambda one: one.gain)
        joint = None if worst.number.joint is None else joints[worst.number.joint]
        advice = "recorded in another way, or with another tool? correct it at import, or leave it out"
        name = names[worst.recording]
        found.append(Finding("odd-recording", "warning", joint, f"'{name}': {worst.text()}", advice, name))
        left.remove(worst.recording)
    return found


def _odd(number: Number, values: dict[int, Estimate], k: int, left: Collection[int]) -> Odd | None:
    """Whether the number of recording k is far from those of the others that are left."""
    others = np.array([values[i].value for i in left if i != k])
    spread = 1.4826 * float(np.median(np.abs(others - np.median(others))))
    off = values[k].value - float(np.median(others))
    far = max(number.least, SPREADS * spread) < abs(off) < number.furthest
    return Odd(number, k, off, spread, values[k].gain) if far and values[k].gain > SHIFT_GAIN else None


def _numbers(
    parts: dict[int, FitRows],
    errors_nm: dict[int, np.ndarray],
    motion: Sequence[Stretch],
    tree: _core.Tree,
    joints: Sequence[str],
) -> Iterator[Number]:
    late = {k: _late(part, part.tau - errors_nm[k]) for k, part in parts.items()}
    yield Number("its torque comes late", "ms", 1e3, None, LATE_S, FURTHEST_S, late)
    largest = np.max([part.gravity.std(axis=0).max() for part in parts.values()])
    for j in range(len(joints)):
        turned = {k: _turned(part, tree, j)[:, :, None] for k, part in parts.items()}
        if max(float(np.abs(x).max()) for x in turned.values()) > 1e-3 * largest:
            yield Number(f"the zero of '{joints[j]}' is off", "rad", 1, j, TURNED_RAD, FURTHEST_RAD, turned)
    loaded = {k: load_columns([s for s in motion if s.recording == k], tree, part) for k, part in parts.items()}
    yield Number(f"its load at '{joints[-1]}' differs", "kg", 1, None, LOADED_KG, FURTHEST_KG, loaded)


def _late(part: FitRows, predicted: np.ndarray) -> np.ndarray:
    """Torque per second of delay; NaN where rows are not consecutive."""
    steps = np.gradient(part.time_s)
    slope = -np.gradient(predicted, axis=0) / steps[:, None]
    slope[steps > 1.5 / FIT_ROWS_HZ] = np.nan
    return slope[:, :, None]


def _turned(part: FitRows, tree: _core.Tree, j: int) -> np.ndarray:
    """Torque per radian of position offset, from gravity alone."""
    q = part.q.copy()
    still = np.zeros_like(q)
    q[:, j] += STEP_RAD
    return np.asarray((tree.momentum(q, still)[1] - tree.momentum(part.q, still)[1]) / STEP_RAD)


def _estimate(columns: np.ndarray, error_nm: np.ndarray, usual_nm: np.ndarray) -> Estimate:
    """The first number of a robust fit of the columns to the error, an offset of each joint left out."""
    known = np.isfinite(columns).all(axis=(1, 2))
    if known.sum() < LEAST_S * FIT_ROWS_HZ / 2:
        return Estimate(0.0, 0.0)
    columns, error = columns[known], error_nm[known] - np.median(error_nm[known], axis=0)
    weight = np.ones_like(error) / usual_nm
    value = np.zeros(columns.shape[2])
    for _ in range(SHIFT_ROUNDS):
        x = (columns * weight[:, :, None]).reshape(-1, columns.shape[2])
        value = np.linalg.lstsq(x, (error * weight).ravel(), rcond=1e-6)[0]
        off = np.abs(error - columns @ value) / usual_nm
        weight = np.sqrt(np.minimum(1.0, HUBER / np.maximum(off, 1e-9))) / usual_nm
    least_nm = usual_nm if len(value) > 1 else 0.0 * usual_nm  # a fit of several numbers always gains something
    before, after = (np.maximum(spread_about_zero(x), least_nm) for x in (error, error - columns @ value))
    return Estimate(float(value[0]), float(np.log(before / after).sum()))


# --- Recordings whose torque the others' fit does not explain, and the simple correction that makes them agree.


FIT_ROWS = 4000
"""Rows of each fit, evenly spaced, since errors of neighbouring rows are correlated."""
CORRECTION_S = 30.0
"""Time of a suspect recording on which corrections are tried, [s]."""
ROUNDS = 3
SUSPECT = 2.2
"""Multiple of the others' usual error that makes a joint suspect; friction, temperature and other motion cause less."""
MATTERS = 0.1
"""Errors below this share of the torque's spread are ignored."""
GAIN, ENOUGH_S = 1.0, 30.0
"""Least gain of a correction, [nats]: sum over joints of log(error before / after); higher for short motion ..."""
ZERO_GAIN = 2.0
"""... and for a shift of a zero of position, torque or time, since some shift always gains by chance."""
BACK = 2.0
"""Largest error of a corrected joint, as a multiple of the others' error ..."""
BACK_SHARE = 0.35
"""... or as a share of its error before, where the others' is very small."""
MOST = 0.5
"""Share of the suspect joints that the correction must repair."""
SAME_SCALE = 0.03
"""Largest difference of a torque's scale from the other recordings' that needs no advice."""
LEAST_DRIVEN_S = 20.0
"""Time of motion that determines a joint's friction, [s]."""
PER_PARAMETER = 0.15
"""Reduction of the gain for each free parameter of a correction."""
UNLIKE, UNLIKE_MATTERS, MOSTLY_COMPARABLE, UNLIKE_S = 3.2, 0.4, 0.8, 8.0
"""Thresholds for a report without a correction: multiple of the usual error, share of the spread, share of comparable
motion, and time [s]. A cold arm's friction stays below them."""
REACH = 3.0
"""Multiple of the others' leverage from which a row's motion is new to the others ..."""
COMPARABLE = 0.3
"""... and least share of comparable rows for a conclusion."""


@dataclass(frozen=True)
class Pool:
    """Fits of all joints on some recordings."""

    weights: list[np.ndarray]
    usual_nm: np.ndarray  # (joints,) median of the recordings' errors
    spread_nm: np.ndarray  # (joints,) of the torque
    whiten: list[np.ndarray]
    reach: list[float]

    def predicted(self, rows: FitRows) -> np.ndarray:
        return np.column_stack([columns_of(rows, j) @ w for j, w in enumerate(self.weights)])

    def errors(self, rows: FitRows) -> np.ndarray:
        return spread_about_zero(rows.tau - self.predicted(rows))

    def comparable(self, rows: FitRows, joints: np.ndarray) -> float:
        """Share of the rows within the motion that these joints (n,) bool were fitted on."""
        known = np.ones(len(rows.time_s), dtype=bool)
        for j in np.flatnonzero(joints).tolist():
            known &= ((columns_of(rows, j) @ self.whiten[j]) ** 2).sum(axis=1) <= self.reach[j]
        return float(known.mean())


def odd_torques(
    rows: FitRows,
    motion: Sequence[Stretch],
    tree: _core.Tree | None,
    joints: Sequence[str],
    names: Sequence[str],
    unit: str,
) -> list[Finding]:
    """Find recordings whose torque disagrees with the others: at most one finding a recording.

    More than half of the recordings cannot be odd: then there are no findings.

    Args:
        rows: of this motion and tree.
        motion: of all recordings.
        names: of the recordings.
        unit: of the recordings' torque, for the evidence: Nm or A.
    """
    if len({s.recording for s in motion}) < 2:
        return []
    parts = {k: rows.taken(rows.recording == k) for k in np.unique(rows.recording).astype(int).tolist()}
    parts = {k: part for k, part in parts.items() if len(part.time_s) >= LEAST_ROWS}
    if len(parts) < 2:
        return []
    members, pool = _consensus(parts)
    found: list[Finding] = []
    for k in sorted(set(parts) - set(members), key=lambda k: -_score(pool, parts[k])):
        correction, before = _best_correction(
            parts[k], pool, [s for s in motion if s.recording == k], tree, joints, unit
        )
        if correction is not None:
            sure = tree is not None or not correction.moves  # sums of angles do not depend on axes
            severity = correction.severity if sure else "warning"
            found.append(_finding(replace(correction, severity=severity), before, pool, joints, names[k], unit))
        elif tree is not None and (unlike := _unlike(parts[k], pool, joints, names[k], unit)) is not None:
            found.append(unlike)
    left = {k: part for k, part in parts.items() if names[k] not in {f.recording for f in found}}
    driven = _driven(left, pool, joints, names)
    # without a model, gravity that the sines of the angles do not fit may pass for friction
    found += driven if tree is not None else [replace(one, severity="warning") for one in driven]
    if tree is not None:
        left = {k: part for k, part in left.items() if names[k] not in {f.recording for f in driven}}
        left_nm = {k: part.tau - pool.predicted(part) for k, part in left.items()}
        usual_nm = np.maximum(pool.usual_nm, SEEN * pool.spread_nm)
        found += odd_shifts(left, left_nm, usual_nm, motion, tree, joints, names)
    return found if 2 * len(found) <= len(parts) else []


def _driven(parts: dict[int, FitRows], pool: Pool, joints: Sequence[str], names: Sequence[str]) -> list[Finding]:
    """Findings of torques that friction seems to drive, while it resists motion in every recording. Unusual poses or
    long rests may hide the sign from the other checks. The prediction of the other recordings' fit decides between an
    inverted torque and one of another scale."""
    inverse: dict[int, list[int]] = {}
    for k, part in parts.items():
        work = (part.tau * part.dq).mean(axis=0)
        if len(part.time_s) >= LEAST_DRIVEN_S * FIT_ROWS_HZ:
            driving = np.flatnonzero(work < 0).tolist()
            inverse[k] = [j for j in driving if inverted(sign_vote(part, j, fit_joint(part, j)))]
    found = []
    for k, wrong in inverse.items():
        only = [j for j in wrong if sum(j in other for other in inverse.values()) < len(inverse) / 2]
        predicted = pool.predicted(parts[k])
        ratios = {j: _factor(parts[k].tau[:, j], predicted[:, j]) for j in only}
        negated = [j for j in only if ratios[j] <= 0]
        if negated:
            evidence = (
                f"'{names[k]}': with the torque of {', '.join(joints[j] for j in negated)} negated friction resists, "
                "as it does in the other recordings"
            )
            joint = joints[negated[0]] if len(negated) == 1 else None
            found.append(Finding("odd-recording", "fault", joint, evidence, "negate it at import", names[k]))
        elif only and abs(ratios[j := max(only, key=lambda j: abs(math.log(ratios[j])))] - 1) > SAME_SCALE:
            evidence = (
                f"'{names[k]}': the torque of {joints[j]} is {ratios[j]:.3g} times what the other recordings predict, "
                "with their sign"
            )
            advice = (
                f"if the torque constant of this joint differed, divide its torque by {ratios[j]:.3g} at import; else "
                "leave the recording out"
            )
            found.append(Finding("odd-recording", "warning", joints[j], evidence, advice, names[k]))
    return found


def _consensus(parts: dict[int, FitRows]) -> tuple[list[int], Pool]:
    """Recordings that agree, and the fit on them. Of two recordings, the one whose torque does work, else the longer
    one."""
    members = list(parts)
    if len(parts) == 2:
        # Torque moves an arm against its friction, so that it does work.
        works = {k: float((part.tau * part.dq).mean(axis=0).sum()) > 0 for k, part in parts.items()}
        members = [max(parts, key=lambda k: (works[k], len(parts[k].time_s)))]
        return members, _pool([parts[k] for k in members])
    for _ in range(ROUNDS):
        pool = _pool([parts[k] for k in members])
        errors = {k: pool.errors(part) for k, part in parts.items()}
        usual = np.median(list(errors.values()), axis=0)
        score = {k: float((e / np.maximum(usual, MATTERS * pool.spread_nm)).max()) for k, e in errors.items()}
        ranked = sorted(parts, key=lambda k: score[k])
        least = max(2, (len(parts) + 1) // 2)
        members = ranked[:least] + [k for k in ranked[least:] if score[k] < SUSPECT]
    return members, _pool([parts[k] for k in members])


def _pool(parts: Sequence[FitRows]) -> Pool:
    count = sum(len(part.time_s) for part in parts)
    stride = max(1, count // FIT_ROWS)
    rows = FitRows.joined([part.taken(slice(None, None, stride)) for part in parts])
    weights, whiten, reach = [], [], []
    for j in range(rows.joints):
        x = columns_of(rows, j)
        weights.append(robust_solve(x, rows.tau[:, j])[0])
        size = np.maximum(np.sqrt((x**2).mean(axis=0)), 1e-9)
        values, vectors = np.linalg.eigh((x / size).T @ (x / size) / len(x))
        kept = values > 1e-4 * values[-1]
        whiten.append(vectors[:, kept] / np.sqrt(values[kept]) / size[:, None])
        reach.append(REACH * float(np.percentile(((x @ whiten[-1]) ** 2).sum(axis=1), 99)))
    pool = Pool(weights, np.zeros(rows.joints), rows.tau.std(axis=0), whiten, reach)
    usual = np.median([pool.errors(part) for part in parts], axis=0)
    return Pool(weights, usual, pool.spread_nm, whiten, reach)


def _score(pool: Pool, part: FitRows) -> float:
    return float((pool.errors(part) / np.maximum(pool.usual_nm, MATTERS * pool.spread_nm)).max())


def _best_correction(
    part: FitRows, pool: Pool, stretches: Sequence[Stretch], tree: _core.Tree | None, joints: Sequence[str], unit: str
) -> tuple[Correction | None, np.ndarray]:
    """The best sufficient correction or None, and the errors before it, [N m]."""
    few = search_stretches(stretches, CORRECTION_S)
    rows = rows_of(few, tree)
    usual = np.maximum(pool.usual_nm, 1e-9)
    before = pool.errors(rows)
    suspects = (before > SUSPECT * usual) & (before > MATTERS * pool.spread_nm)
    if not suspects.any():
        return None, before
    same = pool.comparable(rows, suspects) >= COMPARABLE
    short = max(1.0, ENOUGH_S / sum(s.seconds for s in few))

    def best_of(tried: Iterable[Correction]) -> Correction | None:
        best: tuple[float, Correction | None] = 0.0, None
        for correction in tried:
            if not same and not (correction.moves and tree is not None):
                continue
            ratio = correction.errors_nm / before
            gain = -float(np.log(ratio).sum()) - PER_PARAMETER * correction.parameters
            share = HALVED if correction.rough else BACK_SHARE
            back = correction.errors_nm <= np.maximum(BACK * usual, share * before)
            enough = short * (ZERO_GAIN if correction.shifts else GAIN)
            good = gain > enough and ratio.min() < HALVED and ratio.max() < WORSE and back[suspects].mean() >= MOST
            if good and gain > best[0]:
                best = gain, correction
        return best[1]

    predicted = pool.predicted(rows)
    correction = best_of(torque_corrections(rows, predicted, few, tree, suspects, joints, unit))
    if correction is None:
        correction = best_of(motion_corrections(rows, few, tree, pool.errors, suspects, joints))
    return correction, before


def _unlike(part: FitRows, pool: Pool, joints: Sequence[str], name: str, unit: str) -> Finding | None:
    """Finding of a recording that no correction repairs, although its motion is comparable to the others'."""
    error, usual = pool.errors(part), np.maximum(pool.usual_nm, 1e-9)
    off = (error > UNLIKE * usual) & (error > UNLIKE_MATTERS * pool.spread_nm)
    if not off.any() or len(part.time_s) < UNLIKE_S * FIT_ROWS_HZ or pool.comparable(part, off) < MOSTLY_COMPARABLE:
        return None
    j = int(np.argmax(np.where(off, error / usual, 0)))
    evidence = (
        f"'{name}': what explains the other recordings' torque but for {pool.usual_nm[j]:.3g} {unit} at '{joints[j]}' "
        f"leaves {error[j]:.3g} {unit}, {error[j] / usual[j]:.2g} times as much"
    )
    advice = "another tool, friction, timing or calibration? check it, and leave it out if the arm has changed since"
    return Finding("odd-recording", "warning", joints[j], evidence, advice, name)


def _finding(
    correction: Correction, before: np.ndarray, pool: Pool, joints: Sequence[str], name: str, unit: str
) -> Finding:
    ratio = correction.errors_nm / before
    j = int(np.argmin(ratio)) if correction.joint is None else correction.joint
    k = int(np.argmin(ratio))
    evidence = (
        f"'{name}': what explains the other recordings' torque but for {pool.usual_nm[k]:.3g} {unit} at '{joints[k]}' "
        f"leaves {before[k]:.3g} {unit}; with {correction.what} {correction.errors_nm[k]:.3g} {unit}"
    )
    advice = (
        "correct it at import, or leave it out" if correction.severity == "fault" else
        "was it recorded with another load or sensor zero? leave it out, or train on both kinds alike"
    )  # fmt: skip
    joint = joints[j] if correction.joint is not None else None
    return Finding("odd-recording", correction.severity, joint, evidence, advice, name)
