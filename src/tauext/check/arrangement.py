"""Joints in another order, axes that turn the other way, zeros that are elsewhere: what fits far better than given."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from tauext import _core
from tauext.check.finding import Finding
from tauext.check.fit import columns_of, robust_solve, robust_spread
from tauext.check.gravity import gravity_finding
from tauext.check.motion import PADDED_ROWS, Stretch
from tauext.check.offset import Offset, best_offset
from tauext.check.payload import fit_load, loaded
from tauext.check.regressors import Rows, model_of, rows_of

SEARCH_S = 60.0
"""Of motion, spread over all of it: the search fits dozens of arrangements."""
SEARCH_ROWS = 5000
"""Of all pairs of joints, spread over all of the data."""
GAIN = 1.0
"""Sum over joints of the logarithm of how much the error falls: two joints by 40 % each, say. Chance: hundredths."""
HALVED = 0.6
"""At least one joint's error falls to this share ..."""
WORSE = 1.15
"""... and none rises by more than this."""
LEAST_EXPLAINED = 0.5
"""What an effort explains of another joint's motion before the two can be called exchanged."""
MOST_CHANGES = 3
OFFSET_GAIN = 2.0
"""As GAIN: a shift of one joint, the best of all, gains up to 1.3 by chance where a tool is missing in the model ..."""
OFFSET_LEAD = 0.15
"""... and it gains so much more for each joint than an arrangement, a load or a tilted base."""


@dataclass(frozen=True)
class Change:
    """Of what the joints are called and which way they turn."""

    code: str
    told: str
    names: list[str]
    """Of the joints that it changes."""
    order: list[int]
    """Of the joints as they are, by what they become."""
    sign: np.ndarray

    def of(self, stretch: Stretch) -> Stretch:
        """The stretch as it would be."""
        names = ("q", "dq", "tau", "q_raw", "dq_raw")
        signals: dict[str, Any] = {
            n: np.ascontiguousarray(self.sign * getattr(stretch, n)[:, self.order]) for n in names
        }
        return replace(stretch, **signals)

    def of_rows(self, rows: Rows) -> Rows:
        """Rows of such stretches, but for the model's torques: all else is odd in the motion, or constant."""
        friction = rows.friction[:, self.order].copy()
        friction[:, :, 1:] *= self.sign[:, None]
        names = ("q", "dq", "tau", "acceleration")
        return replace(rows, **{n: self.sign * getattr(rows, n)[:, self.order] for n in names}, friction=friction)


Best = tuple[float, Change | None, np.ndarray, np.ndarray]
"""Gain of a change, itself, None: there is none, the ratio of errors and the errors."""


def search_stretches(stretches: Sequence[Stretch], seconds: float = SEARCH_S) -> list[Stretch]:
    """A share of every stretch, so many seconds in all; where that leaves too few rows the longest one, whole."""
    share = min(1.0, seconds / max(1e-9, sum(s.seconds for s in stretches)))

    def part(s: Stretch) -> Stretch:
        rows = slice(0, max(1, round(share * len(s.q))))
        return replace(s, **{name: getattr(s, name)[rows] for name in ("q", "dq", "tau", "q_raw", "dq_raw")})

    parts = [part(s) for s in stretches]
    enough = [s for s in parts if s.seconds > 2.0 and len(s.q) > PADDED_ROWS]
    return enough or [max(stretches, key=lambda s: s.seconds)]


def exchanged_efforts(rows: Rows, joints: Sequence[str]) -> tuple[list[Finding], list[int]]:
    """Torques that fit the motion of another joint; and for each joint the column that holds its torque."""
    n, every = rows.joints, max(1, len(rows.time_s) // SEARCH_ROWS)
    rows = Rows(*(getattr(rows, name)[::every] for name in rows.__dataclass_fields__))
    errors = np.empty((n, n))  # log error of torque column k as that of joint j
    for k in range(n):
        y = rows.tau[:, k]
        for j in range(n):
            columns = columns_of(rows, j)
            errors[j, k] = np.log(robust_spread(y - columns @ robust_solve(columns, y)[0]) / max(y.std(), 1e-12) + 1e-9)
    mine, column = linear_sum_assignment(errors)
    gain = errors.diagonal().sum() - errors[mine, column].sum()
    wrong = [j for j in range(n) if column[j] != j]
    if not wrong or gain < GAIN or min(errors[j, j] - errors[j, column[j]] for j in wrong) < 0.2:
        return [], list(range(n))
    if max(1 - np.exp(2 * errors[j, column[j]]) for j in wrong) < LEAST_EXPLAINED:
        return [], list(range(n))
    found = []
    for j in wrong:
        error, own = (100 * np.exp(errors[j, k]) for k in (column[j], j))
        evidence = (
            f"its motion explains the effort of '{joints[column[j]]}' but for {error:.0f} % of its spread, "
            f"its own effort but for {own:.0f} %"
        )
        found.append(Finding("joint-order", "fault", joints[j], evidence, "map efforts by name at import"))
    return found, [int(k) for k in column]


def rearranged(
    stretches: Sequence[Stretch], tree: _core.Tree, joints: Sequence[str]
) -> tuple[list[Finding], list[Stretch]]:
    """Findings, and the stretches as the robot file would have them."""
    found, few = [], search_stretches(stretches)
    stretches = list(stretches)
    rows = rows_of(few, tree)
    now, lead = _errors(rows), OFFSET_LEAD * len(joints)
    for _ in range(MOST_CHANGES):
        best: Best = (GAIN, None, now, now)
        for change in _changes(joints):
            then = _errors(_with_model(change.of_rows(rows), [change.of(s) for s in few], tree))
            ratio = then / now[change.order]  # each torque signal against itself
            gain = -float(np.log(ratio).sum())
            if gain > best[0] and ratio.min() < HALVED and ratio.max() < WORSE:
                best = (gain, change, ratio, then)
        shift = best_offset(rows, tree)
        if shift is not None:
            moved = [shifted(s, shift) for s in few]
            then = _errors(_with_model(rows, moved, tree))
            ratio = then / now
            gain = -float(np.log(ratio).sum())
            leads = best[1] is None or gain > best[0] + lead
            if gain > OFFSET_GAIN and leads and ratio.min() < HALVED and ratio.max() < WORSE:
                if gain - _gain_otherwise(few, tree, rows, now) > lead:
                    found.append(_offset_finding(shift, joints, float(ratio.min()), gain))
                    stretches, few, now = [shifted(s, shift) for s in stretches], moved, then
                    rows = rows_of(few, tree)
                    continue
        gain, chosen, ratio, then = best
        if chosen is None:
            break
        evidence = (
            f"{chosen.told} the model's error falls to {ratio.min():.0%} at one joint and rises at none ({gain:.1f} "
            "nats)"
        )
        reordered = chosen.code == "joint-order"
        advice = "map joints by name at import" if reordered else "negate q, dq and tau of it at import"
        found += [Finding(chosen.code, "fault", name, evidence, advice) for name in chosen.names]
        stretches, few, now = [chosen.of(s) for s in stretches], [chosen.of(s) for s in few], then
        rows = rows_of(few, tree)
    return found, stretches


def shifted(stretch: Stretch, shift: Offset) -> Stretch:
    """The stretch with a joint's positions shifted."""
    by = shift.by_rad * np.eye(stretch.q.shape[1])[shift.joint]
    return replace(stretch, q=stretch.q + by, q_raw=stretch.q_raw + by)


def _offset_finding(shift: Offset, joints: Sequence[str], ratio: float, gain: float) -> Finding:
    evidence = (
        f"with {shift.told()} added to its positions the model's error falls to {ratio:.0%} at one joint and rises "
        f"at none ({gain:.1f} nats)"
    )
    advice = (
        "its zero is elsewhere than the robot file's: add that offset at import, or correct the file's joint origin"
    )
    return Finding("position-offset", "fault", joints[shift.joint], evidence, advice)


def _gain_otherwise(stretches: Sequence[Stretch], tree: _core.Tree, rows: Rows, now: np.ndarray) -> float:
    """What a load that the model lacks, or another direction of gravity, gains."""
    trees = (loaded(tree, fit_load(stretches, tree, rows)), gravity_finding(stretches, tree, rows)[1])
    return max(-float(np.log(_errors(_with_model(rows, stretches, other)) / now).sum()) for other in trees)


def _with_model(rows: Rows, stretches: Sequence[Stretch], tree: _core.Tree) -> Rows:
    """The rows with the model's torques of this motion."""
    gravity, inertial = model_of(stretches, tree)
    return replace(rows, gravity=gravity, inertial=inertial)


def _errors(rows: Rows) -> np.ndarray:
    """Robust error of each joint [N m], with one factor for the whole model: an arrangement must fit as a whole."""
    errors = np.empty(rows.joints)
    for j in range(rows.joints):
        columns = np.column_stack([rows.model[:, j], 0 * rows.time_s, columns_of(rows, j)[:, 2:]])
        errors[j] = robust_spread(rows.tau[:, j] - columns @ robust_solve(columns, rows.tau[:, j])[0])
    return np.maximum(errors, 1e-9)


def _changes(joints: Sequence[str]) -> list[Change]:
    n = len(joints)
    none, found = np.ones(n), []
    for j in range(n):
        sign = np.where(np.arange(n) == j, -1.0, 1.0)
        found.append(Change("joint-axis", "with its axis reversed", [joints[j]], list(range(n)), sign))
    for a, b in combinations(range(n), 2):
        order = list(range(n))
        order[a], order[b] = b, a
        told = f"with '{joints[a]}' and '{joints[b]}' exchanged"
        found.append(Change("joint-order", told, [joints[a], joints[b]], order, none))
    return found
