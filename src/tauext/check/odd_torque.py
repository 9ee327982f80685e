"""Recordings that differ from the others in torque: clock, zeros, load, sign."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from tauext import _core
from tauext.check.arrangement import LEAST_KG, LEAST_RAD, load_columns
from tauext.check.corrections import (
    HALVED,
    MOTION,
    Change,
    Correction,
    best,
    best_zero,
    exchanged,
    negated,
    search_stretches,
    shared_numbers,
)
from tauext.check.effort import inverted, sign_vote
from tauext.check.finding import Finding, Severity
from tauext.check.joint_fit import (
    HUBER,
    LEAST_ROWS,
    SEEN,
    FitRows,
    columns_of,
    fit_joint,
    robust_solve,
    rows_of,
    torque_rows,
)
from tauext.check.motion import FIT_ROWS_HZ, SIGNALS, Stretch


def spread_about_zero(error: np.ndarray) -> np.ndarray:
    """Robust magnitude of each column, offset included."""
    return np.maximum(1.4826 * np.median(np.abs(error), axis=0), 1e-9)


# --- Recordings whose torque the others' fit does not explain, and the simple correction that makes them agree.


SUSPECT = 2.2
"""Multiple of the others' usual error that makes a joint suspect; friction, temperature and other motion cause less."""
MATTERS = 0.1
"""Errors below this share of the torque's spread are ignored."""


@dataclass(frozen=True)
class Pool:
    """Fits of all joints on some recordings, and the leverage from which a row's motion is new to them."""

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


@dataclass(frozen=True)
class Comparison:
    """Recordings that are compared, and the fit of those that agree."""

    parts: dict[int, FitRows]
    """Rows of each recording, by its number."""
    pool: Pool
    motion: Sequence[Stretch]
    tree: _core.Tree | None
    joints: Sequence[str]
    names: Sequence[str]
    """Names of all recordings."""
    unit: str
    """Unit of the torque: Nm or A."""

    def finding(self, k: int, severity: Severity, joint: int | None, evidence: str, advice: str) -> Finding:
        name = self.names[k]
        of = None if joint is None else self.joints[joint]
        return Finding("odd-recording", severity, of, f"'{name}': {evidence}", advice, name)

    def left(self, j: int, error_nm: np.ndarray) -> str:
        """Words on the error that the common fit leaves at a joint."""
        return (
            f"what explains the other recordings' torque but for {self.pool.usual_nm[j]:.3g} {self.unit} at "
            f"'{self.joints[j]}' leaves {error_nm[j]:.3g} {self.unit}"
        )

    def corrected(self, k: int) -> Finding | None:
        """Finding of the correction that makes recording k agree with the others."""
        few = search_stretches([s for s in self.motion if s.recording == k], 30.0)
        rows = rows_of(few, self.tree)
        one = Suspect(rows, few, self, self.pool.errors(rows))
        correction = one.best_correction()
        if correction is None:
            return None
        sure = self.tree is not None or not correction.moves  # sums of angles do not depend on axes
        severity, after = correction.severity if sure else "warning", correction.errors_nm
        j = int(np.argmin(after / one.before_nm))
        evidence = f"{self.left(j, one.before_nm)}; with {correction.what} {after[j]:.3g} {self.unit}"
        advice = (
            "correct it at import, or leave it out" if severity == "fault" else
            "was it recorded with another load or sensor zero? leave it out, or train on both kinds alike"
        )  # fmt: skip
        return self.finding(k, severity, correction.joint, evidence, advice)

    def unlike(self, k: int) -> Finding | None:
        """Finding of a recording that no correction repairs, although its motion is comparable to the others'.

        A cold arm's friction stays below 3.2 times the usual error, and below 0.4 of the torque's spread.
        """
        part, pool = self.parts[k], self.pool
        error, usual = pool.errors(part), np.maximum(pool.usual_nm, 1e-9)
        off = (error > 3.2 * usual) & (error > 0.4 * pool.spread_nm)
        if not off.any() or len(part.time_s) < 8.0 * FIT_ROWS_HZ or pool.comparable(part, off) < 0.8:
            return None
        j = int(np.argmax(np.where(off, error / usual, 0)))
        evidence = f"{self.left(j, error)}, {error[j] / usual[j]:.2g} times as much"
        advice = (
            "another tool, friction, timing or calibration? check it, and leave it out if the arm has changed since"
        )
        return self.finding(k, "warning", j, evidence, advice)

    def driven(self, left: Collection[int]) -> list[Finding]:
        """Findings of torques that friction seems to drive, while it resists motion in every recording. Unusual poses
        or long rests may hide the sign from the other checks. The prediction of the other recordings' fit decides
        between an inverted torque and one of another scale."""
        inverse: dict[int, list[int]] = {}
        for k in left:
            part = self.parts[k]
            if len(part.time_s) >= 20.0 * FIT_ROWS_HZ:  # [s], for a joint's friction
                driving = np.flatnonzero((part.tau * part.dq).mean(axis=0) < 0).tolist()
                inverse[k] = [j for j in driving if inverted(sign_vote(part, j, fit_joint(part, j)))]
        found = []
        for k, wrong in inverse.items():
            only = [j for j in wrong if sum(j in other for other in inverse.values()) < len(inverse) / 2]
            predicted = self.pool.predicted(self.parts[k])
            ratios = {j: _factor(self.parts[k].tau[:, j], predicted[:, j]) for j in only}
            negated = [j for j in only if ratios[j] <= 0]
            if negated:
                names = ", ".join(self.joints[j] for j in negated)
                evidence = f"with the torque of {names} negated friction resists, as it does in the other recordings"
                joint = negated[0] if len(negated) == 1 else None
                found.append(self.finding(k, "fault", joint, evidence, "negate it at import"))
            elif only and abs(ratios[j := max(only, key=lambda j: abs(math.log(ratios[j])))] - 1) > 0.03:
                evidence = (
                    f"the torque of {self.joints[j]} is {ratios[j]:.3g} times what the other recordings predict, with "
                    "their sign"
                )
                advice = (
                    f"if the torque constant of this joint differed, divide its torque by {ratios[j]:.3g} at import; "
                    "else leave the recording out"
                )
                found.append(self.finding(k, "warning", j, evidence, advice))
        return found

    def shifted(self, left: Collection[int], tree: _core.Tree) -> list[Finding]:
        """Findings of recordings with small offsets: at most one warning a recording."""
        left = {k for k in left if len(self.parts[k].time_s) >= LEAST_S * FIT_ROWS_HZ}
        errors_nm = {k: self.parts[k].tau - self.pool.predicted(self.parts[k]) for k in left}
        usual_nm = np.maximum(self.pool.usual_nm, SEEN * self.pool.spread_nm)
        numbers = [
            (number, {k: _estimate(number.columns[k], errors_nm[k], usual_nm) for k in left})
            for number in (self.numbers(errors_nm, tree) if len(left) >= LEAST_RECORDINGS else ())
        ]
        found: list[Finding] = []
        advice = "recorded in another way, or with another tool? correct it at import, or leave it out"
        while len(left) >= LEAST_RECORDINGS:  # largest deviation first: it would widen the others' spread
            odd = [odd for number, values in numbers for k in left if (odd := _odd(number, values, k, left))]
            if not odd:
                break
            worst = max(odd, key=lambda one: one.gain)
            found.append(self.finding(worst.recording, "warning", worst.number.joint, worst.text(), advice))
            left.remove(worst.recording)
        return found

    def numbers(self, errors_nm: dict[int, np.ndarray], tree: _core.Tree) -> Iterator[Number]:
        parts = {k: self.parts[k] for k in errors_nm}
        late = {k: _late(part, part.tau - errors_nm[k]) for k, part in parts.items()}
        yield Number("its torque comes late", "ms", 1e3, None, 0.01, 0.2, late)
        largest = np.max([part.gravity.std(axis=0).max() for part in parts.values()])
        for j, joint in enumerate(self.joints):
            turned = {k: _turned(part, tree, j)[:, :, None] for k, part in parts.items()}
            if max(float(np.abs(x).max()) for x in turned.values()) > 1e-3 * largest:
                yield Number(f"the zero of '{joint}' is off", "rad", 1, j, 0.03, 0.4, turned)
        loads = {k: load_columns([s for s in self.motion if s.recording == k], tree, p) for k, p in parts.items()}
        yield Number(f"its load at '{self.joints[-1]}' differs", "kg", 1, None, 0.15, 50.0, loads)


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
    parts = {k: rows.taken(rows.recording == k) for k in np.unique(rows.recording).astype(int).tolist()}
    parts = {k: part for k, part in parts.items() if len(part.time_s) >= LEAST_ROWS}
    if len(parts) < 2:
        return []
    members, pool = _consensus(parts)
    others = Comparison(parts, pool, motion, tree, joints, names, unit)
    found: list[Finding] = []
    for k in sorted(set(parts) - set(members), key=lambda k: -_score(pool, parts[k])):
        one = others.corrected(k)
        if one is None and tree is not None:
            one = others.unlike(k)
        found += [] if one is None else [one]
    left = [k for k in parts if names[k] not in {f.recording for f in found}]
    driven = others.driven(left)
    # without a model, gravity that the sines of the angles do not fit may pass for friction
    found += driven if tree is not None else [replace(one, severity="warning") for one in driven]
    if tree is not None:
        found += others.shifted([k for k in left if names[k] not in {f.recording for f in driven}], tree)
    return found if 2 * len(found) <= len(parts) else []


def _consensus(parts: dict[int, FitRows]) -> tuple[list[int], Pool]:
    """Recordings that agree, and the fit on them. Of two recordings, the one whose torque does work, else the longer
    one."""
    members = list(parts)
    if len(parts) == 2:
        # Torque moves an arm against its friction, so that it does work.
        works = {k: float((part.tau * part.dq).mean(axis=0).sum()) > 0 for k, part in parts.items()}
        members = [max(parts, key=lambda k: (works[k], len(parts[k].time_s)))]
        return members, _pool([parts[k] for k in members])
    for _ in range(3):
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
    stride = max(1, count // 4000)  # errors of neighbouring rows are correlated
    rows = FitRows.joined([part.taken(slice(None, None, stride)) for part in parts])
    weights, whiten, reach = [], [], []
    for j in range(rows.joints):
        x = columns_of(rows, j)
        weights.append(robust_solve(x, rows.tau[:, j])[0])
        size = np.maximum(np.sqrt((x**2).mean(axis=0)), 1e-9)
        values, vectors = np.linalg.eigh((x / size).T @ (x / size) / len(x))
        kept = values > 1e-4 * values[-1]
        whiten.append(vectors[:, kept] / np.sqrt(values[kept]) / size[:, None])
        reach.append(3.0 * float(np.percentile(((x @ whiten[-1]) ** 2).sum(axis=1), 99)))
    pool = Pool(weights, np.zeros(rows.joints), rows.tau.std(axis=0), whiten, reach)
    usual = np.median([pool.errors(part) for part in parts], axis=0)
    return Pool(weights, usual, pool.spread_nm, whiten, reach)


def _score(pool: Pool, part: FitRows) -> float:
    return float((pool.errors(part) / np.maximum(pool.usual_nm, MATTERS * pool.spread_nm)).max())


# --- Corrections of one recording's torques or positions, each with its remaining error.


@dataclass(frozen=True)
class Suspect:
    """A recording that the others' fit does not explain."""

    rows: FitRows
    stretches: Sequence[Stretch]
    others: Comparison
    before_nm: np.ndarray
    """(joints,) error of the others' fit."""

    @property
    def off(self) -> np.ndarray:
        """(joints,) bool: joints whose torque is off."""
        wrong = self.before_nm > SUSPECT * np.maximum(self.others.pool.usual_nm, 1e-9)
        return wrong & (self.before_nm > MATTERS * self.others.pool.spread_nm)

    def best_correction(self) -> Correction | None:
        """The best sufficient correction, of the torques if there is one."""
        pool, before, off = self.others.pool, self.before_nm, self.off
        if not off.any():
            return None
        same = pool.comparable(self.rows, off) >= 0.3

        def suits(one: Correction) -> bool:
            """Whether half of the suspect joints then agree, and the motion is comparable or another one."""
            share = HALVED if one.rough else 0.35  # of the error before, where the others' is very small
            back = one.errors_nm <= np.maximum(2.0 * np.maximum(pool.usual_nm, 1e-9), share * before)
            return bool(back[off].mean() >= 0.5) and (same or (one.moves and self.others.tree is not None))

        times = max(1.0, 30.0 / sum(s.seconds for s in self.stretches))
        found = best(self.torque_corrections(), before, suits, times)
        return found or best(self.motion_corrections(), before, suits, times)

    def torque_corrections(self) -> Iterator[Correction]:
        """Corrections of sign, factor, offset, order and delay of the torques, and of a load."""
        predicted = self.others.pool.predicted(self.rows)
        yield from _of_torque(self, predicted)
        for lag_s in (sign * lag for lag in (0.02, 0.04, 0.06, 0.08, 0.1, 0.12) for sign in (1, -1)):
            after = spread_about_zero(torque_rows(self.stretches, lag_s) - predicted)
            yield Correction(f"its torque taken {1e3 * lag_s:+.0f} ms later", None, after, "warning", 1, shifts=True)
        if self.others.tree is not None:
            yield from _of_load(self, predicted, self.others.tree)

    def motion_corrections(self) -> Iterator[Correction]:
        """Corrections of sign, order and zero of the positions, with and without the torques."""
        names, off = self.others.joints, np.flatnonzero(self.off)
        n = len(names)
        for chosen in (*([j] for j in range(n)), list(range(n))):
            of = repr(names[chosen[0]]) if len(chosen) == 1 else "all joints"
            for signals, what in ((MOTION, "positions and velocities"), (SIGNALS, "all signals")):
                yield self._changed(negated(chosen, n, signals), f"{what} negated of {of}")
        for signals, what in ((MOTION, "the positions and velocities"), (SIGNALS, "all signals")):
            for change in exchanged(n, signals):
                if np.isin(change.joints, off).any():
                    a, b = change.joints
                    yield self._changed(change, f"{what} of '{names[a]}' and '{names[b]}' exchanged")
        yield from _of_zero(self)

    def _changed(self, change: Change, what: str) -> Correction:
        return change.tried(self.rows, self.stretches, self.others.tree, self.others.pool.errors, what)


def _of_torque(one: Suspect, predicted: np.ndarray) -> Iterator[Correction]:
    tau, joints, off = one.rows.tau, one.others.joints, np.flatnonzero(one.off).tolist()
    now = spread_about_zero(tau - predicted)

    def only(chosen: list[int], errors_nm: np.ndarray) -> np.ndarray:
        return np.where(np.isin(np.arange(len(now)), chosen), errors_nm, now)

    def groups(of: list[int]) -> list[tuple[list[int], int | None, str]]:
        """Each joint, and all together, with its index and words."""
        alone = [([j], j, "its torque") for j in of]
        return [*alone, (of, None, f"the torque of {', '.join(joints[j] for j in of)}")] if len(of) > 1 else [*alone]

    for chosen, joint, named in groups(off):
        yield Correction(f"{named} negated", joint, only(chosen, spread_about_zero(tau + predicted)))
    factors = np.array([_factor(tau[:, j], predicted[:, j]) for j in range(len(joints))])
    divided_by = np.where(factors == 0, 1, factors)
    scaled = np.maximum(
        spread_about_zero(tau / divided_by - predicted),
        spread_about_zero(tau - factors * predicted) / np.abs(divided_by),
    )
    # factors between 0.65 and 1.5 come from temperature and wear
    for chosen, joint, named in groups([j for j in off if factors[j] > 0 and not 0.65 < factors[j] < 1.5]):
        divisor = f"{factors[chosen].min():.3g}" + (f" to {factors[chosen].max():.3g}" if joint is None else "")
        # without a model, other poses may have another gravity; a factor of more than 8 is another unit
        of_unit = bool((np.abs(np.log(factors[chosen])) > math.log(8.0)).all())
        severity: Severity = "fault" if one.others.tree is not None or of_unit else "warning"
        yield Correction(f"{named} divided by {divisor}", joint, only(chosen, scaled), severity, len(chosen))
    middle = np.median(tau - predicted, axis=0)
    centred = spread_about_zero(tau - predicted - middle)
    for j in off:
        what = f"{-middle[j]:+.3g} {one.others.unit} added to its torque"
        yield Correction(what, j, only([j], centred), "warning", 1, shifts=True)
    for a, b in combinations(off, 2):
        after = now.copy()
        after[[a, b]] = spread_about_zero(tau[:, [b, a]] - predicted[:, [a, b]])
        yield Correction(f"the torques of '{joints[a]}' and '{joints[b]}' exchanged", a, after)


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


def _of_zero(one: Suspect) -> Iterator[Correction]:
    """The best position offset of each joint; inertia is left unchanged."""
    rows, tree = one.rows.taken(slice(None, None, max(1, len(one.rows.time_s) // 250))), one.others.tree
    for j in range(rows.joints):

        def after(by: float, j: int = j) -> np.ndarray:
            q = rows.q + by * np.eye(rows.joints)[j]
            gravity = rows.gravity if tree is None else tree.momentum(q, np.zeros_like(q))[1]
            return one.others.pool.errors(replace(rows, q=q, gravity=gravity))

        by, _ = best_zero(lambda by, after=after: float(np.log(after(by)).sum()))  # type: ignore[misc]
        if abs(by) > LEAST_RAD:
            change = f"{by:+.2f} rad ({math.degrees(by):+.0f} degrees) added to its position"
            severity: Severity = "fault" if abs(by) > 0.5 else "warning"  # a smaller one may be a rough model's
            yield Correction(change, j, after(by), severity, 1, moves=True, shifts=True)


def _of_load(one: Suspect, predicted: np.ndarray, tree: _core.Tree) -> Iterator[Correction]:
    """Correction of the load's mass at the last link against the others'."""
    shared, error = load_columns(one.stretches, tree, one.rows), one.rows.tau - predicted
    load, left, _ = shared_numbers(
        list(np.moveaxis(shared, 1, 0)), list(error.T), spread_about_zero(error), spread=spread_about_zero
    )
    if abs(load[0]) > LEAST_KG:
        way = "more" if load[0] > 0 else "less"
        change = f"{abs(load[0]):.2g} kg {way} at '{one.others.joints[-1]}' than in the others taken into account"
        yield Correction(change, None, left, "warning", 4, rough=True)


# --- Recordings with small differences of clock, zeros or load, which their own error does not reveal.  Each difference
# is one number (a load: its mass), estimated for each recording from the common fit's error. A recording is odd if its
# number is far from the others' and reduces the error.


LEAST_RECORDINGS = 4
LEAST_S = 11.0
"""Least number of recordings, and least time of motion, [s], to estimate a number."""


@dataclass(frozen=True)
class Number:
    """One quantity that is estimated for each recording."""

    name: str
    unit: str
    scale: float  # scale to the unit in messages
    joint: int | None
    least: float
    """Smaller differences come from wear, temperature and rough models ..."""
    furthest: float
    """... and larger ones are outside the linear range of the estimate."""
    columns: dict[int, np.ndarray]
    """For each recording, torque per unit of the number, (rows, joints, 1 or more); NaN: unknown."""


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


def _odd(number: Number, values: dict[int, tuple[float, float]], k: int, left: Collection[int]) -> Odd | None:
    """Whether the number of recording k is far from those of the others that are left: by six of their spreads."""
    value, gain = values[k]
    others = np.array([values[i][0] for i in left if i != k])
    spread = 1.4826 * float(np.median(np.abs(others - np.median(others))))
    off = value - float(np.median(others))
    far = max(number.least, 6.0 * spread) < abs(off) < number.furthest
    return Odd(number, k, off, spread, gain) if far and gain > 0.4 else None


def _late(part: FitRows, predicted: np.ndarray) -> np.ndarray:
    """Torque per second of delay; NaN where rows are not consecutive."""
    steps = np.gradient(part.time_s)
    slope = -np.gradient(predicted, axis=0) / steps[:, None]
    slope[steps > 1.5 / FIT_ROWS_HZ] = np.nan
    return slope[:, :, None]


def _turned(part: FitRows, tree: _core.Tree, j: int) -> np.ndarray:
    """Torque per radian of position offset, from gravity alone."""
    step_rad, q, still = 0.05, part.q.copy(), np.zeros_like(part.q)
    q[:, j] += step_rad
    return np.asarray((tree.momentum(q, still)[1] - tree.momentum(part.q, still)[1]) / step_rad)


def _estimate(columns: np.ndarray, error_nm: np.ndarray, usual_nm: np.ndarray) -> tuple[float, float]:
    """The first number of a robust fit of the columns to the error, an offset of each joint left out; and its gain,
    [nats]: sum over joints of log(error before / after). For a load, errors above the others' count."""
    known = np.isfinite(columns).all(axis=(1, 2))
    if known.sum() < LEAST_S * FIT_ROWS_HZ / 2:
        return 0.0, 0.0
    columns, error = columns[known], error_nm[known] - np.median(error_nm[known], axis=0)
    weight = np.ones_like(error) / usual_nm
    value = np.zeros(columns.shape[2])
    for _ in range(4):
        x = (columns * weight[:, :, None]).reshape(-1, columns.shape[2])
        value = np.linalg.lstsq(x, (error * weight).ravel(), rcond=1e-6)[0]
        off = np.abs(error - columns @ value) / usual_nm
        weight = np.sqrt(np.minimum(1.0, HUBER / np.maximum(off, 1e-9))) / usual_nm
    least_nm = usual_nm if len(value) > 1 else 0.0 * usual_nm  # a fit of several numbers always gains something
    before, after = (np.maximum(spread_about_zero(x), least_nm) for x in (error, error - columns @ value))
    return float(value[0]), float(np.log(before / after).sum())
