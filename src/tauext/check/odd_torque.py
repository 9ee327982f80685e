"""Recordings that differ from the others in torque: clock, zeros, load, sign."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from tauext import _core
from tauext.check import corrections, joint_fit
from tauext.check.corrections import Change, Correction, best, exchanged, negated
from tauext.check.effort import sign_vote
from tauext.check.examination import Examination
from tauext.check.finding import Finding, Severity
from tauext.check.joint_fit import FitRows
from tauext.check.motion import FIT, SIGNALS, Stretch
from tauext.check.robot_file import LEAST_KG, load_columns
from tauext.data.recording import Recording
from tauext.data.servo import makes_torque


def medians(error: np.ndarray) -> np.ndarray:
    """Median of each column, or of one; NaN is left out, and of nothing else it is 0."""
    if not len(error):
        return np.zeros(error.shape[1:])
    if np.isfinite(error).all():
        return np.asarray(np.median(error, axis=0))
    return np.array([np.median(x[np.isfinite(x)]) if np.isfinite(x).any() else 0.0 for x in error.T])


def spread_about_zero(error: np.ndarray) -> np.ndarray:
    """Robust magnitude of each column, offset included; NaN is left out."""
    return np.maximum(1.4826 * medians(np.abs(error)), 1e-9)


# --- Recordings whose torque the others' fit does not explain, and the simple correction that makes them agree.


SUSPECT = 2.2
"""Multiple of the others' usual error that makes a joint suspect; friction, temperature and other motion cause less."""
MATTERS = 0.1  # errors below this share of the torque's spread are ignored


@dataclass(frozen=True)
class Pool:
    """Fits of all joints on some recordings, and the leverage from which a row's motion is new to them.

    A joint that rests in half of all rows is fitted and compared where it moves, and so is one that rests in half of a
    recording: in a rest, friction holds an unknown part of gravity, in one recording another part than in the next.
    """

    rests: np.ndarray  # (joints,) bool: it rests in half of the rows
    least_rad_s: np.ndarray  # (joints,) speed from which a joint moves
    weights: list[np.ndarray]
    usual_nm: np.ndarray  # (joints,) median of the recordings' errors; at least that of motion left out of the fit
    spread_nm: np.ndarray  # (joints,) of the torque
    whiten: list[np.ndarray]
    reach: list[float]

    @staticmethod
    def of(parts: Sequence[FitRows]) -> Pool:
        count = sum(len(part.time_s) for part in parts)
        stride = max(1, count // 4000)  # errors of neighbouring rows are correlated
        rows = FitRows.joined([part.taken(slice(None, None, stride)) for part in parts])
        rests, weights, left_nm, whiten, reach = [], [], [], [], []
        for j in range(rows.joints):
            judged = rows.judged(j)
            rests.append(not judged.all())
            x, torque = rows.columns(j)[judged], rows.tau[judged, j]
            solved, trust = joint_fit.robust_solve(x, torque)
            weights.append(solved)
            left_nm.append(spread_about_zero(joint_fit.left_out_error(x, torque, trust)))
            size = joint_fit.rms(x)
            values, vectors = np.linalg.eigh((x / size).T @ (x / size) / len(x))
            kept = values > 1e-4 * values[-1]
            whiten.append(vectors[:, kept] / np.sqrt(values[kept]) / size[:, None])
            reach.append(3.0 * float(np.percentile(((x @ whiten[-1]) ** 2).sum(axis=1), 99)))
        least_rad_s, spread_nm = rows.least_speeds(), rows.tau.std(axis=0)
        pool = Pool(np.array(rests), least_rad_s, weights, np.zeros(rows.joints), spread_nm, whiten, reach)
        known_nm = np.median([pool.errors(part) for part in parts], axis=0)
        return replace(pool, usual_nm=np.maximum(known_nm, left_nm))

    def predicted(self, rows: FitRows) -> np.ndarray:
        return np.column_stack([rows.columns(j) @ w for j, w in enumerate(self.weights)])

    def judged(self, rows: FitRows, error: np.ndarray) -> np.ndarray:
        """The error (rows, joints), NaN where a joint that mostly rests does not move, or moves for less than 4 s. A
        recording in which a joint never moves counts, if it does not rest in the others: its positions may be wrong."""
        moves = np.abs(rows.dq) > self.least_rad_s
        counts = moves | ~(self.rests | (moves.mean(axis=0) < 0.5))
        period_s = float(np.median(np.diff(rows.time_s)))
        enough = counts.sum(axis=0) * period_s >= joint_fit.LEAST_ROWS / FIT.rows_hz
        counts = np.where(self.rests, counts & enough, counts | ~enough)
        return np.where(counts, error, np.nan)

    def errors(self, rows: FitRows) -> np.ndarray:
        return spread_about_zero(self.judged(rows, rows.tau - self.predicted(rows)))

    def comparable(self, rows: FitRows, joints: np.ndarray) -> float:
        """Share of the rows within the motion that these joints (n,) bool were fitted on."""
        known = np.ones(len(rows.time_s), dtype=bool)
        for j in np.flatnonzero(joints).tolist():
            known &= ((rows.columns(j) @ self.whiten[j]) ** 2).sum(axis=1) <= self.reach[j]
        return float(known.mean())

    def score(self, errors_nm: np.ndarray, usual_nm: np.ndarray) -> float:
        """How odd a recording with these errors is."""
        return float((errors_nm / np.maximum(usual_nm, MATTERS * self.spread_nm)).max())


@dataclass(frozen=True)
class Comparison:
    """Recordings that are compared, and the fit of those that agree."""

    x: Examination
    parts: dict[int, FitRows]  # rows of each recording, by its number
    pool: Pool

    def finding(self, k: int, severity: Severity, joint: int | None, evidence: str, advice: str) -> Finding:
        name, of = self.x.recordings[k].name, None if joint is None else self.x.joints[joint]
        return Finding("odd-recording", severity, of, f"'{name}': {evidence}", advice, name)

    def left(self, j: int, error_nm: np.ndarray) -> str:
        """Words on the error that the common fit leaves at a joint."""
        return (
            f"what explains the other recordings' torque but for {self.pool.usual_nm[j]:.3g} {self.x.unit} at "
            f"'{self.x.joints[j]}' leaves {error_nm[j]:.3g} {self.x.unit}"
        )

    def stretches(self, k: int) -> list[Stretch]:
        return [s for s in self.x.motion if s.recording == k]

    def corrected(self, k: int) -> Finding | None:
        """Finding of the correction that makes recording k agree with the others."""
        few = corrections.search_stretches(self.stretches(k), 30.0)
        one = Suspect(joint_fit.rows_of(few, self.x.tree), few, self)
        correction = one.best_correction()
        if correction is None:
            return None
        sure = self.x.tree is not None or not correction.moves  # sums of angles do not depend on axes
        severity, after = correction.severity if sure else "warning", correction.errors_nm
        j = int(np.argmin(after / one.before_nm))
        evidence = f"{self.left(j, one.before_nm)}; with {correction.what} {after[j]:.3g} {self.x.unit}"
        advice = (
            "correct it at import, or leave it out" if severity == "fault" else
            "was it recorded with another load or sensor zero? leave it out, or train on both kinds alike"
        )  # fmt: skip
        return self.finding(k, severity, correction.joint, evidence, advice)

    def unlike(self, k: int) -> Finding | None:
        """Finding of a recording that no correction repairs, although its motion is comparable to the others'. A cold
        arm's friction stays below 3.2 times the usual error, and below 0.4 of the torque's spread."""
        part, pool = self.parts[k], self.pool
        error, usual = pool.errors(part), np.maximum(pool.usual_nm, 1e-9)
        off = (error > 3.2 * usual) & (error > 0.4 * pool.spread_nm)
        if not off.any() or len(part.time_s) < 8.0 * FIT.rows_hz or pool.comparable(part, off) < 0.8:
            return None
        j = int(np.argmax(np.where(off, error / usual, 0)))
        evidence = f"{self.left(j, error)}, {error[j] / usual[j]:.2g} times as much"
        advice = (
            "another tool, friction, timing or calibration? check it, and leave it out if the arm has changed since"
        )
        return self.finding(k, "warning", j, evidence, advice)

    def driven(self, left: Collection[int]) -> Iterator[Finding]:
        """Findings of torques that friction seems to drive, which the other checks miss in unusual poses or long rests.
        The other recordings' fit decides between an inverted torque and one of another scale."""
        inverse: dict[int, list[int]] = {}
        for k in left:
            part = self.parts[k]
            made = makes_torque(self.x.recordings[k])  # a drive's signal reverses before the joint moves
            if len(part.time_s) >= 20.0 * FIT.rows_hz and not made:  # [s], for a joint's friction
                driving = np.flatnonzero((part.tau * part.dq).mean(axis=0) < 0).tolist()
                inverse[k] = [j for j in driving if sign_vote(part, j, joint_fit.fit_joint(part, j)).inverted]
        for k, wrong in inverse.items():
            only = [j for j in wrong if sum(j in other for other in inverse.values()) < len(inverse) / 2]
            predicted = self.pool.predicted(self.parts[k])
            ratios = {j: _factor(self.parts[k].tau[:, j], predicted[:, j]) for j in only}
            negated = [j for j in only if ratios[j] <= 0]
            if negated:
                names = ", ".join(self.x.joints[j] for j in negated)
                evidence = f"with the torque of {names} negated friction resists, as it does in the other recordings"
                joint = negated[0] if len(negated) == 1 else None
                yield self.finding(k, "fault", joint, evidence, "negate it at import")
            elif only and abs(ratios[j := max(only, key=lambda j: abs(math.log(ratios[j])))] - 1) > 0.03:
                evidence = (
                    f"the torque of {self.x.joints[j]} is {ratios[j]:.3g} times what the other recordings predict, "
                    "with their sign"
                )
                advice = (
                    f"if the torque constant of this joint differed, divide its torque by {ratios[j]:.3g} at import; "
                    "else leave the recording out"
                )
                yield self.finding(k, "warning", j, evidence, advice)

    def shifted(self, left: Collection[int], tree: _core.Tree) -> list[Finding]:
        """Findings of recordings with small offsets: at most one warning a recording."""
        parts = {k: self.parts[k] for k in left}
        errors_nm = {k: self.pool.judged(part, part.tau - self.pool.predicted(part)) for k, part in parts.items()}
        judged_s = {k: float(np.isfinite(x).sum(axis=0).mean()) / FIT.rows_hz for k, x in errors_nm.items()}
        left = {k for k in left if judged_s[k] >= LEAST_S}
        errors_nm = {k: errors_nm[k] for k in left}
        usual_nm = np.maximum(self.pool.usual_nm, joint_fit.SEEN * self.pool.spread_nm)
        numbers = [
            (number, {k: _estimate(number.columns[k], errors_nm[k], usual_nm) for k in left})
            for number in (self.numbers(errors_nm, tree) if len(left) >= LEAST_RECORDINGS else ())
        ]
        found: list[Finding] = []
        advice = "recorded in another way, or with another tool? correct it at import, or leave it out"
        while len(left) >= LEAST_RECORDINGS:  # largest deviation first: it would widen the others' spread
            odd = [odd for number, values in numbers for k in left if (odd := number.odd(values, k, left))]
            if not odd:
                break
            _, k, joint, evidence = max(odd, key=lambda one: one[0])
            found.append(self.finding(k, "warning", joint, evidence, advice))
            left.remove(k)
        return found

    def numbers(self, errors_nm: dict[int, np.ndarray], tree: _core.Tree) -> Iterator[Number]:
        parts = {k: self.parts[k] for k in errors_nm}
        late = {k: _late(part, self.pool.predicted(part)) for k, part in parts.items()}
        yield Number("its torque comes late", "ms", 1e3, None, 0.01, 0.2, late)
        largest = np.max([part.gravity.std(axis=0).max() for part in parts.values()])
        for j, joint in enumerate(self.x.joints):
            turned = {k: _turned(part, tree, j)[:, :, None] for k, part in parts.items()}
            if max(float(np.abs(x).max()) for x in turned.values()) > 1e-3 * largest:
                yield Number(f"the zero of '{joint}' is off", "rad", 1, j, 0.03, 0.4, turned)
        loads = {k: load_columns(self.stretches(k), tree, p) for k, p in parts.items()}
        yield Number(f"its load at '{self.x.joints[-1]}' differs", "kg", 1, None, 0.15, 50.0, loads)


def odd_torques(x: Examination) -> list[Finding]:
    """Findings of recordings whose torque disagrees with the others, at most one each, and of half of them."""
    parts = {k: x.rows.taken(x.rows.recording == k) for k in np.unique(x.rows.recording).astype(int).tolist()}
    parts = {k: part for k, part in parts.items() if len(part.time_s) >= joint_fit.LEAST_ROWS}
    if len(parts) < 2:
        return []
    members, pool = _consensus(parts)
    others = Comparison(x, parts, pool)
    found: list[Finding] = []

    def agreeing() -> list[int]:
        return [k for k in parts if x.recordings[k].name not in {f.recording for f in found}]

    score = {k: pool.score(pool.errors(parts[k]), pool.usual_nm) for k in set(parts) - set(members)}
    for k in sorted((k for k in score if score[k] >= SUSPECT), key=lambda k: -score[k]):
        one = others.corrected(k) or (others.unlike(k) if x.tree is not None else None)
        found += [] if one is None else [one]
    driven = others.driven(agreeing())
    # without a model, gravity that the sines of the angles do not fit may pass for friction
    found += driven if x.tree is not None else [replace(one, severity="warning") for one in driven]
    if x.tree is not None:
        found += others.shifted(agreeing(), x.tree)
    return of_servos(found, x.recordings) if 2 * len(found) <= len(parts) else []


def of_servos(found: list[Finding], recordings: Sequence[Recording]) -> list[Finding]:
    """Warnings where servo signals give the torque: a position controller without integral action rests anywhere within
    its friction, so that recordings of few poses seem shifted, scaled or inverted."""
    made = {r.name for r in recordings if makes_torque(r)}
    return [replace(one, severity="warning") if one.recording in made else one for one in found]


def _consensus(parts: dict[int, FitRows]) -> tuple[list[int], Pool]:
    """Recordings that agree, and the fit on them; of two, the one whose torque does work, else the longer one."""
    members = list(parts)
    if len(parts) == 2:
        # Torque moves an arm against its friction, so that it does work.
        works = {k: float((part.tau * part.dq).mean(axis=0).sum()) > 0 for k, part in parts.items()}
        members = [max(parts, key=lambda k: (works[k], len(parts[k].time_s)))]
        return members, Pool.of([parts[k] for k in members])
    for _ in range(3):
        pool = Pool.of([parts[k] for k in members])
        errors = {k: pool.errors(part) for k, part in parts.items()}
        usual = np.median(list(errors.values()), axis=0)
        score = {k: pool.score(e, usual) for k, e in errors.items()}
        ranked = sorted(parts, key=lambda k: score[k])
        least = max(2, (len(parts) + 1) // 2)
        members = ranked[:least] + [k for k in ranked[least:] if score[k] < SUSPECT]
    return members, Pool.of([parts[k] for k in members])


# --- Corrections of one recording's torques or positions, each with its remaining error.


class Suspect:
    """A recording that the others' fit does not explain."""

    def __init__(self, rows: FitRows, stretches: Sequence[Stretch], others: Comparison) -> None:
        self.rows, self.stretches, self.others = rows, stretches, others
        pool, predicted = others.pool, others.pool.predicted(rows)
        self.predicted = pool.judged(rows, predicted)
        """(rows, joints), NaN where it is not judged."""
        self.before_nm = pool.errors(rows)
        """(joints,) error of the others' fit."""
        self.off = self.before_nm > SUSPECT * np.maximum(pool.usual_nm, 1e-9)
        """(joints,) bool: joints whose torque is off."""
        self.off &= self.before_nm > MATTERS * pool.spread_nm

    def best_correction(self) -> Correction | None:
        """The best sufficient correction, of the torques if there is one."""
        pool, before, off = self.others.pool, self.before_nm, self.off
        if not off.any():
            return None
        same = pool.comparable(self.rows, off) >= 0.3

        def suits(one: Correction) -> bool:
            """Whether half of the suspect joints then agree, and the motion is comparable or another one."""
            share = corrections.HALVED if one.rough else 0.35  # of the error before, where the others' is very small
            back = one.errors_nm <= np.maximum(2.0 * np.maximum(pool.usual_nm, 1e-9), share * before)
            return bool(back[off].mean() >= 0.5) and (same or (one.moves and self.others.x.tree is not None))

        times = max(1.0, 30.0 / sum(s.seconds for s in self.stretches))
        found = best(self.torque_corrections(), before, suits, times)
        return found or best(self.motion_corrections(), before, suits, times)

    def torque_corrections(self) -> Iterator[Correction]:
        """Corrections of sign, factor, offset, order and delay of the torques, and of a load."""
        yield from self.signs_and_factors()
        yield from self.offsets_and_order()
        for lag_s in (sign * lag for lag in (0.02, 0.04, 0.06, 0.08, 0.1, 0.12) for sign in (1, -1)):
            after = spread_about_zero(joint_fit.torque_rows(self.stretches, lag_s) - self.predicted)
            yield Correction(f"its torque taken {1e3 * lag_s:+.0f} ms later", None, after, "warning", 1, shifts=True)
        if self.others.x.tree is not None:
            yield from self.loads(self.others.x.tree)

    def motion_corrections(self) -> Iterator[Correction]:
        """Corrections of sign, order and zero of the positions, with and without the torques."""
        names, n = self.others.x.joints, len(self.others.x.joints)
        of_motion = tuple(name for name in SIGNALS if name != "tau")
        for chosen in (*([j] for j in range(n)), list(range(n))):
            of = repr(names[chosen[0]]) if len(chosen) == 1 else "all joints"
            for signals, what in ((of_motion, "positions and velocities"), (SIGNALS, "all signals")):
                yield self.changed(negated(chosen, n, signals), f"{what} negated of {of}")
        for signals, what in ((of_motion, "the positions and velocities"), (SIGNALS, "all signals")):
            for change in exchanged(n, signals):
                if self.off[list(change.joints)].any():
                    a, b = change.joints
                    yield self.changed(change, f"{what} of '{names[a]}' and '{names[b]}' exchanged")
        yield from self.zeros()

    def changed(self, change: Change, what: str) -> Correction:
        return change.tried(self.rows, self.stretches, self.others.x.tree, self.others.pool.errors, what)

    def groups(self, of: Sequence[int]) -> list[tuple[list[int], int | None, str]]:
        """Each joint, and all together, with its index and words."""
        alone = [([j], j, "its torque") for j in of]
        together = f"the torque of {', '.join(self.others.x.joints[j] for j in of)}"
        return [*alone, *([(list(of), None, together)] if len(of) > 1 else [])]

    def only(self, chosen: Sequence[int], errors_nm: np.ndarray) -> np.ndarray:
        """Errors where these joints alone are corrected."""
        return np.where(np.isin(np.arange(len(self.before_nm)), chosen), errors_nm, self.before_nm)

    def signs_and_factors(self) -> Iterator[Correction]:
        tau, predicted, off = self.rows.tau, self.predicted, np.flatnonzero(self.off).tolist()
        for chosen, joint, named in self.groups(off):
            yield Correction(f"{named} negated", joint, self.only(chosen, spread_about_zero(tau + predicted)))
        factors = np.array([_factor(tau[:, j], predicted[:, j]) for j in range(tau.shape[1])])
        divided_by = np.where(factors == 0, 1, factors)
        scaled = np.maximum(
            spread_about_zero(tau / divided_by - predicted),
            spread_about_zero(tau - factors * predicted) / np.abs(divided_by),
        )
        # factors between 0.65 and 1.5 come from temperature and wear
        for chosen, joint, named in self.groups([j for j in off if factors[j] > 0 and not 0.65 < factors[j] < 1.5]):
            divisor = f"{factors[chosen].min():.3g}" + (f" to {factors[chosen].max():.3g}" if joint is None else "")
            # without a model, other poses may have another gravity; a factor of more than 8 is another unit
            of_unit = bool((np.abs(np.log(factors[chosen])) > math.log(8.0)).all())
            severity: Severity = "fault" if self.others.x.tree is not None or of_unit else "warning"
            what = f"{named} divided by {divisor}"
            yield Correction(what, joint, self.only(chosen, scaled), severity, len(chosen))

    def offsets_and_order(self) -> Iterator[Correction]:
        tau, predicted, off = self.rows.tau, self.predicted, np.flatnonzero(self.off).tolist()
        middle = medians(tau - predicted)
        centred = spread_about_zero(tau - predicted - middle)
        for j in off:
            what = f"{-middle[j]:+.3g} {self.others.x.unit} added to its torque"
            yield Correction(what, j, self.only([j], centred), "warning", 1, shifts=True)
        for a, b in combinations(off, 2):
            after = self.only([], centred)
            after[[a, b]] = spread_about_zero(tau[:, [b, a]] - predicted[:, [a, b]])
            what = f"the torques of '{self.others.x.joints[a]}' and '{self.others.x.joints[b]}' exchanged"
            yield Correction(what, a, after)

    def zeros(self) -> Iterator[Correction]:
        """The best position offset of each joint; inertia is left unchanged."""
        rows, tree = self.rows.thinned(250), self.others.x.tree
        for j in range(rows.joints):

            def after(by: float, j: int = j) -> np.ndarray:
                q = rows.q + by * np.eye(rows.joints)[j]
                gravity = rows.gravity if tree is None else joint_fit.gravity_of(tree, q)
                return self.others.pool.errors(replace(rows, q=q, gravity=gravity))

            by, _ = corrections.best_zero(lambda by, after=after: float(np.log(after(by)).sum()))  # type: ignore[misc]
            if abs(by) > corrections.LEAST_RAD:
                change = f"{by:+.2f} rad ({math.degrees(by):+.0f} degrees) added to its position"
                severity: Severity = "fault" if abs(by) > 0.5 else "warning"  # a smaller one may be a rough model's
                yield Correction(change, j, after(by), severity, 1, moves=True, shifts=True)

    def loads(self, tree: _core.Tree) -> Iterator[Correction]:
        """Correction of the load's mass at the last link against the others'."""
        shared, error = load_columns(self.stretches, tree, self.rows), self.rows.tau - self.predicted
        known = [_known(x, y) for x, y in zip(np.moveaxis(shared, 1, 0), error.T, strict=True)]
        columns, errors = [x for x, _ in known], [y for _, y in known]
        load, left, _ = joint_fit.shared_numbers(columns, errors, spread_about_zero(error), spread=spread_about_zero)
        if abs(load[0]) > LEAST_KG:
            way = "more" if load[0] > 0 else "less"
            change = (
                f"{abs(load[0]):.2g} kg {way} at '{self.others.x.joints[-1]}' than in the others taken into account"
            )
            yield Correction(change, None, left, "warning", 4, rough=True)


def _known(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows of both in which y is not NaN."""
    at = np.isfinite(y)
    return x[at], y[at]


def _factor(torque: np.ndarray, predicted: np.ndarray) -> float:
    """Factor from prediction to torque, from the rows with the least error."""
    torque, predicted = _known(torque, predicted)
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


# --- Recordings with small differences of clock, zeros or load, which their own error does not reveal.


LEAST_RECORDINGS, LEAST_S = 4, 11.0
"""Least number of recordings, and least time of each that is judged, mean of its joints, [s], to estimate a number."""


@dataclass(frozen=True)
class Number:
    """A quantity, of a load its mass, that is estimated for each recording from the common fit's error. A recording is
    odd if its number is far from the others' and reduces the error."""

    name: str
    unit: str
    scale: float  # scale to the unit in messages
    joint: int | None
    least: float  # smaller differences come from wear, temperature and rough models
    furthest: float  # ... and larger ones are outside the linear range of the estimate
    columns: dict[int, np.ndarray]
    """For each recording, torque per unit of the number, (rows, joints, 1 or more); NaN: unknown."""

    def odd(
        self, values: dict[int, tuple[float, float]], k: int, left: Collection[int]
    ) -> tuple[float, int, int | None, str] | None:
        """Gain, recording, joint and evidence, if recording k is far from the others left: by six of their spreads."""
        value, gain = values[k]
        others = np.array([values[i][0] for i in left if i != k])
        spread, off = joint_fit.robust_spread(others), value - float(np.median(others))
        if gain <= 0.4 or not max(self.least, 6.0 * spread) < abs(off) < self.furthest:
            return None
        evidence = (
            f"{self.name} by {off * self.scale:+.3g} {self.unit} against the other recordings, which differ by "
            f"{spread * self.scale:.2g} {self.unit}; with that the error falls to {np.exp(-gain):.0%}"
        )
        return gain, k, self.joint, evidence


def _late(part: FitRows, predicted: np.ndarray) -> np.ndarray:
    """Torque per second of delay; NaN where rows are not consecutive."""
    steps = np.gradient(part.time_s)
    slope = -np.gradient(predicted, axis=0) / steps[:, None]
    slope[steps > 1.5 / FIT.rows_hz] = np.nan
    return slope[:, :, None]


def _turned(part: FitRows, tree: _core.Tree, j: int) -> np.ndarray:
    """Torque per radian of position offset, from gravity alone."""
    step_rad, q = 0.05, part.q.copy()
    q[:, j] += step_rad
    return np.asarray((joint_fit.gravity_of(tree, q) - joint_fit.gravity_of(tree, part.q)) / step_rad)


def _estimate(columns: np.ndarray, error_nm: np.ndarray, usual_nm: np.ndarray) -> tuple[float, float]:
    """The first number of a robust fit of the columns to the error, an offset of each joint left out; and its gain,
    [nats]: sum over joints of log(error before / after). For a load, errors above the others' count."""
    known = np.isfinite(columns).all(axis=(1, 2))
    if known.sum() < LEAST_S * FIT.rows_hz / 2:
        return 0.0, 0.0
    columns, error = columns[known], error_nm[known] - medians(error_nm[known])
    judged = np.isfinite(error)
    weight = judged / usual_nm
    value = np.zeros(columns.shape[2])
    for _ in range(4):
        x = (columns * weight[:, :, None]).reshape(-1, columns.shape[2])
        value = np.linalg.lstsq(x, (np.where(judged, error, 0.0) * weight).ravel(), rcond=1e-6)[0]
        off = np.where(judged, np.abs(error - columns @ value), 0.0) / usual_nm
        weight = np.sqrt(np.minimum(1.0, joint_fit.HUBER / np.maximum(off, 1e-9))) * judged / usual_nm
    least_nm = usual_nm if len(value) > 1 else 0.0 * usual_nm  # a fit of several numbers always gains something
    before, after = (np.maximum(spread_about_zero(x), least_nm) for x in (error, error - columns @ value))
    return float(value[0]), float(np.log(before / after).sum())
