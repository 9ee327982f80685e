"""Corrections of order, sign and zero of the joints: each is tried, and one that fits far better is a finding."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from operator import itemgetter

import numpy as np

from tauext import _core
from tauext.check.examination import Examination
from tauext.check.finding import Finding, Severity
from tauext.check.joint_fit import RESISTS, FitRows, gravity_of, rms, robust_error, robust_spread, rows_of
from tauext.check.motion import PADDED_ROWS, SIGNALS, Stretch
from tauext.check.robot_file import fit_load, tilted_tree

# --- Corrections that are tried one by one: what each leaves unexplained by a fit, and which one is far better.


GAIN, ZERO_GAIN = 1.0, 2.0
"""Least gain, [nats]: sum over joints of log(error before / after). A shift of a zero of position, torque or time gains
up to 1.3 by chance, for example if a tool is missing in the model."""
HALVED, WORSE = 0.6, 1.15  # the error of some joint must fall below this ratio, and that of none rise above the other


@dataclass(frozen=True)
class Correction:
    """A change that makes torque and motion agree better."""

    what: str
    joint: int | None
    errors_nm: np.ndarray  # (joints,) that it leaves of each torque
    severity: Severity = "fault"
    parameters: int = 0  # number of free parameters; of two equally good corrections the one with fewer wins
    moves: bool = False  # whether it changes positions
    shifts: bool = False  # whether it shifts a zero of position, torque or time
    rough: bool = False  # whether it corrects only a part: a load's mass and centre, without inertia and added friction
    change: Change | None = None

    def gain(self, before_nm: np.ndarray) -> float:
        return -float(np.log(self.errors_nm / before_nm).sum()) - 0.15 * self.parameters

    def falls(self, before_nm: np.ndarray) -> str:
        """Words on the model's error with this correction."""
        return (
            f"the model's error falls to {(self.errors_nm / before_nm).min():.0%} at one joint and rises at none "
            f"({self.gain(before_nm):.1f} nats)"
        )


def best(
    tried: Iterable[Correction],
    before_nm: np.ndarray,
    suits: Callable[[Correction], bool] = lambda one: True,
    times: float = 1.0,
) -> Correction | None:
    """The correction that gains most, if it is far better than none: `times` the least gain, for little motion."""
    found, most = None, 0.0
    for one in tried:
        ratio, gain = one.errors_nm / before_nm, one.gain(before_nm)
        least = max(most, times * (ZERO_GAIN if one.shifts else GAIN))
        if gain > least and ratio.min() < HALVED and ratio.max() < WORSE and suits(one):
            found, most = one, gain
    return found


@dataclass(frozen=True)
class Change:
    """Another order and other signs of the joints, in some signals."""

    joints: tuple[int, ...]  # the joints that change
    order: np.ndarray  # present index of each joint in the new order
    sign: np.ndarray
    signals: tuple[str, ...] = SIGNALS

    def of(self, stretch: Stretch) -> Stretch:
        """The changed stretch."""
        return stretch.changed(lambda x: np.ascontiguousarray(self.sign * x[:, self.order]), self.signals)

    def of_rows(self, rows: FitRows, stretches: Sequence[Stretch], tree: _core.Tree | None) -> FitRows:
        """`rows_of` of the changed stretches: all columns of friction but the constant are odd in the motion."""
        friction = rows.friction[:, self.order].copy()
        friction[:, :, 1:] *= self.sign[:, None]
        names = ["q", "dq", "acceleration", *(["tau"] if "tau" in self.signals else [])]
        changed = {name: self.sign * getattr(rows, name)[:, self.order] for name in names}
        rows = replace(rows, friction=friction, **changed)
        return rows if tree is None else rows.with_model([self.of(s) for s in stretches], tree)

    def tried(
        self,
        rows: FitRows,
        stretches: Sequence[Stretch],
        tree: _core.Tree | None,
        errors: Callable[[FitRows], np.ndarray],
        what: str = "",
    ) -> Correction:
        """The correction by this change; `errors`: (joints,) of a fit of rows."""
        after = errors(self.of_rows(rows, stretches, tree))
        if "tau" in self.signals:
            after = after[self.order]  # each torque against itself
        several = len(self.joints) > 1 and (self.sign < 0).any()
        return Correction(what, None if several else self.joints[0], after, moves=True, change=self)


def negated(joints: Sequence[int], count: int, signals: tuple[str, ...] = SIGNALS) -> Change:
    """These of `count` joints with the opposite direction."""
    return Change(tuple(joints), np.arange(count), np.where(np.isin(np.arange(count), joints), -1.0, 1.0), signals)


def exchanged(count: int, signals: tuple[str, ...] = SIGNALS) -> Iterator[Change]:
    """Each two of `count` joints exchanged."""
    for a, b in combinations(range(count), 2):
        order = np.arange(count)
        order[[a, b]] = b, a
        yield Change((a, b), order, np.ones(count), signals)


def best_zero(size: Callable[[float], float]) -> tuple[float, float]:
    """The shift of a position, within half a turn, that makes `size` least, [rad]; and that size."""
    from scipy.optimize import minimize_scalar

    step = math.radians(15.0)
    middle = min(np.arange(-math.pi, math.pi - 1e-9, step).tolist(), key=size)
    found = minimize_scalar(size, bounds=(middle - step, middle + step), method="bounded", options={"xatol": 1e-3})
    return math.remainder(float(found.x), 2 * math.pi), float(found.fun)


REST_SHARE = 0.125
"""Of a second at rest, in the time of the motion that is searched: friction holds a part of gravity in it."""


def search_stretches(stretches: Sequence[Stretch], seconds: float = 60.0, least_s: float = 2.0) -> list[Stretch]:
    """The motion on which corrections are tried, since dozens are: about so many seconds of the whole, of which rests
    count little; the begin of each stretch, or of every few if they are short. A part below `least_s` has no turn, and
    uncertain differences at its ends; if no stretch is longer, the longest one whole."""
    long = [s for s in stretches if s.seconds > least_s and len(s.q) > PADDED_ROWS]
    if not long:
        return [max(stretches, key=lambda s: s.seconds)]
    counted_s = [np.cumsum(np.where(s.moves, 1.0, REST_SHARE)) / s.rate_hz for s in long]
    total, parts = sum(float(so_far[-1]) for so_far in counted_s), list[Stretch]()
    passed = used = 0.0
    for stretch, so_far in zip(long, counted_s, strict=True):
        passed += float(so_far[-1])
        part_s = passed * min(1.0, seconds / total) - used
        rows = min(len(so_far), int(np.searchsorted(so_far, part_s)) + 1)
        if rows > max(least_s * stretch.rate_hz, PADDED_ROWS):
            parts.append(stretch.changed(itemgetter(slice(rows))))
            used += float(so_far[rows - 1])
    return parts or [max(long, key=lambda s: s.seconds)]


# --- A joint whose zero differs from the robot file's: gravity fits far better with its position shifted.


LEAST_RAD = 0.05
"""Least offset. A calibrated arm's zero is right within 0.01 rad; smaller offsets may be errors of the model's
masses."""


@dataclass(frozen=True)
class Offset:
    """Offset to be added to a joint's position."""

    joint: int
    by_rad: float

    def of(self, stretch: Stretch) -> Stretch:
        """The stretch with the joint's positions shifted."""
        by = self.by_rad * np.eye(stretch.q.shape[1])[self.joint]
        return stretch.changed(lambda q: q + by, ("q", "q_raw"))

    def tried(self, rows: FitRows, stretches: Sequence[Stretch], tree: _core.Tree) -> Correction:
        moved = rows.with_model([self.of(s) for s in stretches], tree)
        return Correction("", self.joint, _errors(moved), moves=True, shifts=True)


def best_offset(rows: FitRows, tree: _core.Tree) -> Offset | None:
    """Find the shift of one joint with the best fit of gravity, with one factor a joint on torque; inertia changes
    little compared with friction. None if no shift of LEAST_RAD or more is better."""
    others = [_rest(rows, j) for j in range(rows.joints)]
    zero, most = float(_log_errors(rows.gravity, others).sum()), 0.0
    found: Offset | None = None
    for j in range(rows.joints):

        def total(by: float, j: int = j) -> float:
            q = rows.q.copy()
            q[:, j] += by
            return float(_log_errors(gravity_of(tree, q), others).sum())

        by, size = best_zero(total)
        if abs(by) > LEAST_RAD and zero - size > most:
            found, most = Offset(j, by), zero - size
    return found


def _rest(rows: FitRows, j: int) -> tuple[np.ndarray, np.ndarray, float]:
    """A basis of a joint's columns but gravity, the torque orthogonal to it, and the torque's sign, with which gravity
    must agree, by friction of a tenth of the torque's spread; 0: unknown."""
    columns, y = rows.columns(j)[:, 1:], rows.tau[:, j]
    own = columns / rms(columns)
    u, size, v = np.linalg.svd(own, full_matrices=False)
    kept = size > 1e-3 * size[0]
    basis = u[:, kept]
    weights = v[kept].T @ ((basis.T @ y) / size[kept])
    resists = slice(RESISTS.start - 1, RESISTS.stop - 1)  # gravity is left out
    friction = own[:, resists] @ weights[resists]
    has_sign = friction.std() > 0.1 * max(float(y.std()), 1e-12)
    sign = float(np.sign((friction * rows.dq[:, j]).mean())) if has_sign else 0.0
    return basis, y - basis @ (basis.T @ y), sign


def _log_errors(gravity: np.ndarray, others: Sequence[tuple[np.ndarray, np.ndarray, float]]) -> np.ndarray:
    """Log of each joint's robust error with this gravity, (joints,)."""
    errors = np.empty(len(others))
    for j, (basis, y, sign) in enumerate(others):
        x = gravity[:, j] - basis @ (basis.T @ gravity[:, j])
        power = float(x @ x)
        factor = float(x @ y) / power if power > 1e-9 * len(x) else 0.0
        if sign * factor < 0:
            factor = 0.0
        errors[j] = math.log(robust_spread(y - factor * x) + 1e-9 + 1e-3 * float(np.abs(y).mean()))
    return errors


# --- Other orders, reversed axes and shifted zeros that fit far better.


def exchanged_efforts(x: Examination) -> Iterator[Finding]:
    """Find torques that fit another joint's motion; puts them in order."""
    from scipy.optimize import linear_sum_assignment

    rows, joints = x.rows.thinned(5000), range(x.rows.joints)
    spread = [max(rows.tau[:, k].std(), 1e-12) for k in joints]
    own = [rows.columns(j) for j in joints]
    left = np.array([[robust_error(own[j], rows.tau[:, k]) / spread[k] for k in joints] for j in joints])
    errors = np.log(left + 1e-9)  # of torque column k as that of joint j
    mine, column = linear_sum_assignment(errors)
    gain = errors.diagonal().sum() - errors[mine, column].sum()
    wrong = [j for j in joints if column[j] != j]
    if not wrong or gain < GAIN or min(errors[j, j] - errors[j, column[j]] for j in wrong) < 0.2:
        return
    if max(1 - np.exp(2 * errors[j, column[j]]) for j in wrong) < 0.5:  # some effort must explain another's motion
        return
    for j in wrong:
        error, of_own = (100 * np.exp(errors[j, k]) for k in (column[j], j))
        evidence = (
            f"its motion explains the effort of '{x.joints[column[j]]}' except {error:.0f} % of its spread, "
            f"its own effort except {of_own:.0f} %"
        )
        yield Finding("joint-order", "fault", x.joints[j], evidence, "map efforts by name at import")
    order = column.tolist()
    x.correct(motion=[s.changed(lambda tau: np.ascontiguousarray(tau[:, order]), ("tau",)) for s in x.motion])


def rearranged(x: Examination) -> Iterator[Finding]:
    """Findings of order, axes and zeros of the joints; the motion gets the robot file's. A shift of a zero must lead an
    arrangement, a load and a tilted base by 0.15 nats a joint."""
    few, n, tree = search_stretches(x.motion), len(x.joints), x.model
    motion, rows = x.motion, rows_of(few, tree)
    changes = [*(negated([j], n) for j in range(n)), *exchanged(n)]
    now, lead = _errors(rows), 0.15 * n
    for _ in range(3):
        chosen = best((change.tried(rows, few, tree, _errors) for change in changes), now)
        shift = best_offset(rows, tree)
        shifted = None if shift is None else best([shift.tried(rows, few, tree)], now)
        gain = shifted.gain(now) - lead if shifted is not None else -math.inf
        moved: Offset | Change
        if (
            shift is not None
            and shifted is not None
            and (chosen is None or gain > chosen.gain(now))
            and gain > _gain_otherwise(few, tree, rows, now)
        ):
            yield _offset_finding(shift, x.joints, shifted, now)
            moved = shift
        elif chosen is None or chosen.change is None:
            break
        else:
            yield from _order_findings(chosen.change, x.joints, chosen.falls(now))
            moved, shifted = chosen.change, None
        motion, few = [moved.of(s) for s in motion], [moved.of(s) for s in few]
        rows = rows_of(few, tree)
        now = _errors(rows) if shifted is None else shifted.errors_nm
    if motion is not x.motion:
        x.correct(motion=motion)


def _offset_finding(shift: Offset, joints: Sequence[str], shifted: Correction, before_nm: np.ndarray) -> Finding:
    evidence = (
        f"with {shift.by_rad:+.2f} rad ({math.degrees(shift.by_rad):+.0f} degrees) added to its positions "
        f"{shifted.falls(before_nm)}"
    )
    advice = "its zero differs from the robot file's: add that offset at import, or correct the file's joint origin"
    return Finding("position-offset", "fault", joints[shift.joint], evidence, advice)


def _order_findings(change: Change, joints: Sequence[str], falls: str) -> list[Finding]:
    names = [joints[j] for j in change.joints]
    if len(names) == 1:
        code, what, advice = "joint-axis", "its axis reversed", "negate q, dq and tau of it at import"
    else:
        code, what, advice = "joint-order", f"'{names[0]}' and '{names[1]}' exchanged", "map joints by name at import"
    return [Finding(code, "fault", name, f"with {what} {falls}", advice) for name in names]


def _gain_otherwise(stretches: Sequence[Stretch], tree: _core.Tree, rows: FitRows, now: np.ndarray) -> float:
    """Gain of a missing load or another direction of gravity."""
    tilted = tilted_tree(stretches, tree, rows)
    trees = (fit_load(stretches, tree, rows).on(tree), tree if tilted is None else tilted[1])
    return max(-float(np.log(_errors(rows.with_model(stretches, other)) / now).sum()) for other in trees)


def _errors(rows: FitRows) -> np.ndarray:
    """Robust error of each joint [N m] in its judged rows, with one factor for the whole model: an arrangement must fit
    as a whole."""
    errors = np.empty(rows.joints)
    for j in range(rows.joints):
        judged = rows.judged(j)
        columns = np.column_stack([rows.model[:, j], 0 * rows.time_s, rows.columns(j)[:, 2:]])
        errors[j] = robust_error(columns[judged], rows.tau[judged, j])
    return np.maximum(errors, 1e-9)
