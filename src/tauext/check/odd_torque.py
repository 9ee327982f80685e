"""A recording whose torques the others' motion does not explain, where a simple mend would bring it back to them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tauext import _core
from tauext.check.arrangement import search_stretches
from tauext.check.effort import inverted
from tauext.check.finding import Finding
from tauext.check.fit import LEAST_ROWS, SEEN, columns_of, fit_joint, robust_solve
from tauext.check.motion import FIT_ROWS_HZ, Stretch
from tauext.check.odd_mends import Mend, mends_of_motion, mends_of_torque, spread_about_zero
from tauext.check.odd_shift import odd_shifts
from tauext.check.regressors import Rows, rows_of
from tauext.check.sign import sign_vote

FIT_ROWS = 4000
"""Of each fit, evenly: errors of neighbouring rows are one error."""
MEND_S = 30.0
"""Of a suspect, on which mends are tried."""
ROUNDS = 3
SUSPECT = 2.2
"""Times the usual error of the others: friction, warmth and other motion make less, or a mend fails that would not."""
MATTERS = 0.1
"""An error below this share of the torque's spread is no matter."""
GAIN, ENOUGH_S = 1.0, 30.0
"""Sum over joints of the logarithm of how much the error falls by the mend; more of shorter motion ..."""
ZERO_GAIN = 2.0
"""... and for a shift of a zero, of position, torque or time: of all shifts of all joints one gains by chance."""
HALVED, WORSE = 0.6, 1.15
"""At least one joint's error falls to this share, and none rises by more than this."""
BACK = 2.0
"""Times the others' error, to which the mended joint comes back ..."""
BACK_SHARE = 0.35
"""... or to this share of what it was, where the others' is very small."""
MOST = 0.5
"""Share of the joints that are off that come back; without a model poses of its own leave gravity at the others."""
LEAST_DRIVEN_S = 20.0
"""Of motion, in which friction shows on a joint by itself."""
PER_PARAMETER = 0.15
"""Of the gain, for each free number of a mend."""
UNLIKE, UNLIKE_MATTERS, MOSTLY_COMPARABLE, UNLIKE_S = 3.2, 0.4, 0.8, 8.0
"""Told without a mend from so many times the usual error and such a share of the spread on, where so large a share
of the motion is the others', for so long: a cold arm's friction is less, and after rest it is unknown."""
REACH = 3.0
"""Rows of so many times the others' leverage are of motion that the others do not have ..."""
COMPARABLE = 0.3
"""... and less than this share of others: nothing can be said."""


@dataclass(frozen=True)
class Pool:
    """Fits of the joints on some recordings."""

    weights: list[np.ndarray]
    usual_nm: np.ndarray  # (joints,) median of the recordings' errors
    spread_nm: np.ndarray  # (joints,) of the torque
    whiten: list[np.ndarray]
    reach: list[float]

    def predicted(self, rows: Rows) -> np.ndarray:
        return np.column_stack([columns_of(rows, j) @ w for j, w in enumerate(self.weights)])

    def errors(self, rows: Rows) -> np.ndarray:
        return spread_about_zero(rows.tau - self.predicted(rows))

    def comparable(self, rows: Rows, joints: np.ndarray) -> float:
        """Share of the rows that lie within the motion that the fits of these joints (n,) bool have seen."""
        known = np.ones(len(rows.time_s), dtype=bool)
        for j in np.flatnonzero(joints).tolist():
            known &= ((columns_of(rows, j) @ self.whiten[j]) ** 2).sum(axis=1) <= self.reach[j]
        return float(known.mean())


def odd_torques(
    motion: Sequence[Stretch], tree: _core.Tree | None, joints: Sequence[str], names: Sequence[str]
) -> list[Finding]:
    """At most one a recording, and none where half of them would be odd.

    Args:
        motion: of all recordings.
        names: of the recordings.
    """
    if len({s.recording for s in motion}) < 2:
        return []
    rows = rows_of(motion, tree)
    parts = {k: taken(rows, rows.recording == k) for k in np.unique(rows.recording).astype(int).tolist()}
    parts = {k: part for k, part in parts.items() if len(part.time_s) >= LEAST_ROWS}
    if len(parts) < 2:
        return []
    members, pool = _consensus(parts)
    found: list[Finding] = []
    for k in sorted(set(parts) - set(members), key=lambda k: -_score(pool, parts[k])):
        mend, before = _mend(parts[k], pool, [s for s in motion if s.recording == k], tree, joints)
        if mend is not None:
            sure = tree is not None or not mend.moves  # sums of angles know no axes
            severity = mend.severity if sure else "warning"
            found.append(_finding(replace(mend, severity=severity), before, pool, joints, names[k]))
        elif tree is not None and (unlike := _unlike(parts[k], pool, joints, names[k])) is not None:
            found.append(unlike)
    left = {k: part for k, part in parts.items() if names[k] not in {f.recording for f in found}}
    found += (driven := _driven(left, joints, names))
    if tree is not None:
        left = {k: part for k, part in left.items() if names[k] not in {f.recording for f in driven}}
        left_nm = {k: part.tau - pool.predicted(part) for k, part in left.items()}
        usual_nm = np.maximum(pool.usual_nm, SEEN * pool.spread_nm)
        found += odd_shifts(left, left_nm, usual_nm, motion, tree, joints, names)
    return found if 2 * len(found) <= len(parts) else []


def _driven(parts: dict[int, Rows], joints: Sequence[str], names: Sequence[str]) -> list[Finding]:
    """Poses of its own may leave a recording's gravity open, and a joint that mostly rests a small error; friction
    resists in all of them."""
    inverse: dict[int, list[int]] = {}
    for k, part in parts.items():
        work = (part.tau * part.dq).mean(axis=0)
        if len(part.time_s) >= LEAST_DRIVEN_S * FIT_ROWS_HZ:
            asked = np.flatnonzero(work < 0).tolist()
            inverse[k] = [j for j in asked if inverted(sign_vote(part, j, fit_joint(part, j)))]
    found = []
    for k, wrong in inverse.items():
        only = [j for j in wrong if sum(j in other for other in inverse.values()) < len(inverse) / 2]
        if only:
            evidence = (
                f"'{names[k]}': with the torque of {', '.join(joints[j] for j in only)} negated friction resists, "
                "as it does in the other recordings"
            )
            joint = joints[only[0]] if len(only) == 1 else None
            found.append(Finding("odd-recording", "fault", joint, evidence, "negate it at import", names[k]))
    return found


def taken(rows: Rows, at: np.ndarray | slice) -> Rows:
    return Rows(*(getattr(rows, name)[at] for name in rows.__dataclass_fields__))


def _consensus(parts: dict[int, Rows]) -> tuple[list[int], Pool]:
    """Recordings that agree, and the fit on them: of two the one whose torque does work, or the longer one."""
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


def _pool(parts: Sequence[Rows]) -> Pool:
    count = sum(len(part.time_s) for part in parts)
    stride = max(1, count // FIT_ROWS)
    few = [taken(part, slice(None, None, stride)) for part in parts]
    rows = Rows(*(np.concatenate([getattr(p, name) for p in few]) for name in few[0].__dataclass_fields__))
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


def _score(pool: Pool, part: Rows) -> float:
    return float((pool.errors(part) / np.maximum(pool.usual_nm, MATTERS * pool.spread_nm)).max())


def _mend(
    part: Rows, pool: Pool, stretches: Sequence[Stretch], tree: _core.Tree | None, joints: Sequence[str]
) -> tuple[Mend | None, np.ndarray]:
    """The best mend that is good enough, None if there is none; and the errors before, [N m]."""
    few = search_stretches(stretches, MEND_S)
    rows = rows_of(few, tree)
    usual = np.maximum(pool.usual_nm, 1e-9)
    before = pool.errors(rows)
    suspects = (before > SUSPECT * usual) & (before > MATTERS * pool.spread_nm)
    if not suspects.any():
        return None, before
    same = pool.comparable(rows, suspects) >= COMPARABLE
    short = max(1.0, ENOUGH_S / sum(s.seconds for s in few))

    def best_of(tried: Iterable[Mend]) -> Mend | None:
        best: tuple[float, Mend | None] = 0.0, None
        for mend in tried:
            if not same and not (mend.moves and tree is not None):
                continue
            ratio = mend.errors_nm / before
            gain = -float(np.log(ratio).sum()) - PER_PARAMETER * mend.parameters
            share = HALVED if mend.rough else BACK_SHARE
            back = mend.errors_nm <= np.maximum(BACK * usual, share * before)
            enough = short * (ZERO_GAIN if mend.shifts else GAIN)
            good = gain > enough and ratio.min() < HALVED and ratio.max() < WORSE and back[suspects].mean() >= MOST
            if good and gain > best[0]:
                best = gain, mend
        return best[1]

    predicted = pool.predicted(rows)
    mend = best_of(mends_of_torque(rows, predicted, few, tree, suspects, joints))
    if mend is None:
        mend = best_of(mends_of_motion(rows, few, tree, pool.errors, suspects, joints))
    return mend, before


def _unlike(part: Rows, pool: Pool, joints: Sequence[str], name: str) -> Finding | None:
    """Where nothing mends a recording, and its motion is the others' all the same."""
    error, usual = pool.errors(part), np.maximum(pool.usual_nm, 1e-9)
    off = (error > UNLIKE * usual) & (error > UNLIKE_MATTERS * pool.spread_nm)
    if not off.any() or len(part.time_s) < UNLIKE_S * FIT_ROWS_HZ or pool.comparable(part, off) < MOSTLY_COMPARABLE:
        return None
    j = int(np.argmax(np.where(off, error / usual, 0)))
    evidence = (
        f"'{name}': what explains the other recordings' torque but for {pool.usual_nm[j]:.3g} Nm at '{joints[j]}' "
        f"leaves {error[j]:.3g} Nm, {error[j] / usual[j]:.2g} times as much"
    )
    advice = "another tool, friction, timing or calibration? look at it, and leave it out if the arm is not so any more"
    return Finding("odd-recording", "warning", joints[j], evidence, advice, name)


def _finding(mend: Mend, before: np.ndarray, pool: Pool, joints: Sequence[str], name: str) -> Finding:
    ratio = mend.errors_nm / before
    j = int(np.argmin(ratio)) if mend.joint is None else mend.joint
    k = int(np.argmin(ratio))
    evidence = (
        f"'{name}': what explains the other recordings' torque but for {pool.usual_nm[k]:.3g} Nm at '{joints[k]}' "
        f"leaves {before[k]:.3g} Nm; with {mend.what} {mend.errors_nm[k]:.3g} Nm"
    )
    advice = (
        "mend it at import, or leave it out" if mend.severity == "fault" else
        "was it recorded with another load or sensor zero? leave it out, or train on both kinds alike"
    )  # fmt: skip
    joint = joints[j] if mend.joint is not None else None
    return Finding("odd-recording", mend.severity, joint, evidence, advice, name)
