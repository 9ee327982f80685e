"""Corrections that are tried one by one: what each leaves unexplained by a fit, and which one is far better."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from operator import itemgetter

import numpy as np

from tauext import _core
from tauext.check.finding import Severity
from tauext.check.joint_fit import FitRows, robust_spread, with_model
from tauext.check.motion import PADDED_ROWS, SIGNALS, Stretch

GAIN, ZERO_GAIN = 1.0, 2.0
"""Least gain, [nats]: sum over joints of log(error before / after). A shift of a zero of position, torque or time gains
up to 1.3 by chance, for example if a tool is missing in the model."""
HALVED, WORSE = 0.6, 1.15
"""The error of some joint must fall below this ratio, and that of none rise above the other."""


@dataclass(frozen=True)
class Correction:
    """A change that makes torque and motion agree better."""

    what: str
    joint: int | None
    errors_nm: np.ndarray
    """(joints,) that it leaves of each torque."""
    severity: Severity = "fault"
    parameters: int = 0
    """Number of free parameters; of two equally good corrections the one with fewer wins."""
    moves: bool = False
    """Whether it changes positions."""
    shifts: bool = False
    """Whether it shifts a zero of position, torque or time."""
    rough: bool = False
    """Whether it corrects only a part: a load's mass and centre, without inertia and added friction."""
    change: Change | None = None

    def gain(self, before_nm: np.ndarray) -> float:
        return -float(np.log(self.errors_nm / before_nm).sum()) - 0.15 * self.parameters


def best(
    tried: Iterable[Correction],
    before_nm: np.ndarray,
    suits: Callable[[Correction], bool] = lambda one: True,
    times: float = 1.0,
) -> Correction | None:
    """The correction that gains most, if it is far better than none.

    Args:
        before_nm: (joints,) errors without a correction.
        suits: further condition.
        times: factor on the least gain, for little motion.
    """
    found, most = None, 0.0
    for one in tried:
        ratio, gain = one.errors_nm / before_nm, one.gain(before_nm)
        least = max(most, times * (ZERO_GAIN if one.shifts else GAIN))
        if gain > least and ratio.min() < HALVED and ratio.max() < WORSE and suits(one):
            found, most = one, gain
    return found


# --- Order and signs of the joints.


MOTION = ("q", "dq", "q_raw", "dq_raw")
"""Signals of a stretch without its torque."""


@dataclass(frozen=True)
class Change:
    """Another order and other signs of the joints, in some signals."""

    joints: tuple[int, ...]
    """The joints that change."""
    order: np.ndarray
    """Present index of each joint in the new order."""
    sign: np.ndarray
    signals: tuple[str, ...] = SIGNALS

    def of(self, stretch: Stretch) -> Stretch:
        """The changed stretch."""
        return stretch.changed(lambda x: np.ascontiguousarray(self.sign * x[:, self.order]), self.signals)

    def of_rows(self, rows: FitRows, stretches: Sequence[Stretch], tree: _core.Tree | None) -> FitRows:
        """`rows_of` of the changed stretches: all columns of friction but the constant are odd in the motion."""
        friction = rows.friction[:, self.order].copy()
        friction[:, :, 1:] *= self.sign[:, None]
        names = ("q", "dq", "acceleration", "tau") if "tau" in self.signals else ("q", "dq", "acceleration")
        changed = {name: self.sign * getattr(rows, name)[:, self.order] for name in names}
        rows = replace(rows, friction=friction, **changed)
        return rows if tree is None else with_model(rows, [self.of(s) for s in stretches], tree)

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
        joint = None if several else self.joints[0]
        return Correction(what, joint, after, moves=True, change=self)


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


# --- Numbers common to all joints: a load, the direction of gravity.


def shared_numbers(
    columns: Sequence[np.ndarray],
    torques: Sequence[np.ndarray],
    floor_nm: np.ndarray,
    rcond: float = 1e-9,
    spread: Callable[[np.ndarray], float | np.ndarray] = robust_spread,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Least squares of all joints together, each weighted by its robust error: the numbers, the errors that they leave
    and the weights.

    Args:
        columns: of each joint, (rows, numbers).
        torques: of each joint, (rows,).
        floor_nm: (joints,) error for the first weights; a thousandth of it is the least of all.
    """
    floor_nm = np.maximum(floor_nm, 1e-9)
    weights = 1 / floor_nm
    for _ in range(3):
        numbers = weighted_solve(columns, torques, weights, rcond)
        errors = np.array([spread(y - x @ numbers) for x, y in zip(columns, torques, strict=True)])
        weights = 1 / np.maximum(errors, 1e-3 * floor_nm)
    return numbers, errors, weights


def weighted_solve(
    columns: Sequence[np.ndarray], torques: Sequence[np.ndarray], weights: np.ndarray, rcond: float = 1e-9
) -> np.ndarray:
    gram = sum(w**2 * x.T @ x for x, w in zip(columns, weights, strict=True))
    moment = sum(w**2 * x.T @ y for x, y, w in zip(columns, torques, weights, strict=True))
    return np.linalg.lstsq(gram, moment, rcond=rcond)[0]


# --- The motion on which corrections are tried.


SEARCH_S = 60.0
"""Motion used, spread evenly, [s]: the search fits dozens of corrections."""
LEAST_PART_S = 2.0
"""Least part of a stretch, [s]: the differences of its ends are uncertain, and a shorter one has no turn."""


def search_stretches(stretches: Sequence[Stretch], seconds: float = SEARCH_S) -> list[Stretch]:
    """About so many seconds of the whole motion: the begin of each stretch, or of every few if they are
    short, since less than LEAST_PART_S of one shows nothing. If none is that long, the longest one whole."""
    long = [s for s in stretches if s.seconds > LEAST_PART_S and len(s.q) > PADDED_ROWS]
    if not long:
        return [max(stretches, key=lambda s: s.seconds)]
    total, parts = sum(s.seconds for s in long), list[Stretch]()
    passed = used = 0.0
    for stretch in long:
        passed += stretch.seconds
        part_s = min(stretch.seconds, passed * min(1.0, seconds / total) - used)
        if part_s > LEAST_PART_S:
            rows = max(PADDED_ROWS + 1, round(part_s / stretch.seconds * len(stretch.q)))
            parts.append(stretch.changed(itemgetter(slice(rows))))
            used += part_s
    return parts or [max(long, key=lambda s: s.seconds)]
