"""What could be wrong with one recording's torques or positions: each mend with the error that it leaves."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from tauext import _core
from tauext.check.finding import Severity
from tauext.check.motion import Stretch
from tauext.check.regressors import Rows, rows_of, torque_rows
from tauext.robot.inertial import inertial_parameters, with_inertial_parameters

GRID_RAD = math.radians(15.0)
ZERO_ROWS = 250
LEAST_RAD = 0.05
"""A smaller shift of the zero is what friction and rough models look like."""
WRONG_RAD = 0.5
"""A larger one is no doubt wrong; of smaller ones a rough model or another trajectory may look like one."""
SCALES = (0.65, 1.5)
"""Factors between these are what warmth and wear make of friction."""
LAGS_S = tuple(sign * lag for lag in (0.02, 0.04, 0.06, 0.08, 0.1, 0.12) for sign in (1, -1))
OF_UNITS = 8.0
"""A larger factor is that of a unit; a smaller one is certain where a model knows what the torque should be: without,
other poses may have another gravity."""
LEAST_KG = 0.3

Errors = Callable[[Rows], np.ndarray]
"""Of rows: the robust error of each joint [N m], by what fits the other recordings."""


@dataclass(frozen=True)
class Mend:
    """A change after which the recording is like the others."""

    what: str
    joint: int | None
    errors_nm: np.ndarray  # (joints,) that it leaves
    severity: Severity
    parameters: int
    """Free numbers of it: of two that mend as much, the one with fewer is it."""
    moves: bool = False
    """Changes positions."""
    shifts: bool = False
    """A zero, of position, torque or time."""
    rough: bool = False
    """Not all of what is wrong: a load by its mass and centre, without its inertia and the friction under it."""


def spread_about_zero(error: np.ndarray) -> np.ndarray:
    """Robust size, an offset included; columns apart."""
    return np.maximum(1.4826 * np.median(np.abs(error), axis=0), 1e-9)


def mends_of_torque(
    rows: Rows,
    predicted: np.ndarray,
    stretches: Sequence[Stretch],
    tree: _core.Tree | None,
    suspects: np.ndarray,
    joints: Sequence[str],
) -> Iterator[Mend]:
    """Sign, factor, offset and order of the torques, and a load.

    Args:
        rows: of the recording.
        predicted: (rows, joints) torque by the others' fit, [N m].
        suspects: (joints,) bool, whose torque is off.
    """
    yield from _of_torque(rows, predicted, suspects, joints, certain=tree is not None)
    yield from _of_time(predicted, stretches, suspects)
    if tree is not None:
        yield from _of_load(rows, predicted, stretches, tree, joints)


def mends_of_motion(
    rows: Rows,
    stretches: Sequence[Stretch],
    tree: _core.Tree | None,
    errors: Errors,
    suspects: np.ndarray,
    joints: Sequence[str],
) -> Iterator[Mend]:
    """Sign, order and zero of the positions; the torques go with them, or do not."""
    yield from _of_arrangement(stretches, tree, errors, suspects, joints)
    yield from _of_zero(rows, tree, errors)


def _of_torque(
    rows: Rows, predicted: np.ndarray, suspects: np.ndarray, joints: Sequence[str], certain: bool
) -> Iterator[Mend]:
    now = spread_about_zero(rows.tau - predicted)
    off = np.flatnonzero(suspects).tolist()
    negated = spread_about_zero(rows.tau + predicted)
    for chosen in [[j] for j in off] + ([off] if len(off) > 1 else []):
        after = now.copy()
        after[chosen] = negated[chosen]
        joint = chosen[0] if len(chosen) == 1 else None
        named = "its torque" if joint is not None else f"the torque of {', '.join(joints[j] for j in chosen)}"
        yield Mend(f"{named} negated", joint, after, "fault", 0)
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
        told = f"{factors[chosen].min():.3g}" + (f" to {factors[chosen].max():.3g}" if joint is None else "")
        of_unit = bool((np.abs(np.log(factors[chosen])) > math.log(OF_UNITS)).all())
        severity: Severity = "fault" if certain or of_unit else "warning"
        yield Mend(f"{named} divided by {told}", joint, after, severity, len(chosen))
    middle = np.median(rows.tau - predicted, axis=0)
    centred = spread_about_zero(rows.tau - predicted - middle)
    for j in off:
        after = now.copy()
        after[j] = centred[j]
        yield Mend(f"{-middle[j]:+.3g} Nm added to its torque", j, after, "warning", 1, shifts=True)
    for a, b in combinations(off, 2):
        after = now.copy()
        after[[a, b]] = spread_about_zero(rows.tau[:, [b, a]] - predicted[:, [a, b]])
        yield Mend(f"the torques of '{joints[a]}' and '{joints[b]}' exchanged", a, after, "fault", 0)


def _of_time(predicted: np.ndarray, stretches: Sequence[Stretch], suspects: np.ndarray) -> Iterator[Mend]:
    """All torques later or earlier."""
    for lag_s in LAGS_S:
        after = spread_about_zero(torque_rows(stretches, lag_s) - predicted)
        yield Mend(f"its torque taken {1e3 * lag_s:+.0f} ms later", None, after, "warning", 1, shifts=True)


def _factor(torque: np.ndarray, predicted: np.ndarray) -> float:
    """Torque = factor times prediction, by rows that are off by least."""
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


def _of_arrangement(
    stretches: Sequence[Stretch],
    tree: _core.Tree | None,
    errors: Errors,
    suspects: np.ndarray,
    joints: Sequence[str],
) -> Iterator[Mend]:
    n = len(joints)
    motion, all_of_it = ("q", "dq", "q_raw", "dq_raw"), ("q", "dq", "tau", "q_raw", "dq_raw")
    for chosen in (*range(n), None):
        sign = np.where([chosen is None or j == chosen for j in range(n)], -1.0, 1.0)
        for names, what in ((motion, "positions and velocities"), (all_of_it, "all signals")):
            changed = [replace(s, **{name: getattr(s, name) * sign for name in names}) for s in stretches]
            told = f"{what} negated of {'all joints' if chosen is None else repr(joints[chosen])}"
            yield Mend(told, chosen, errors(rows_of(changed, tree)), "fault", 0, moves=True)
    for a, b in combinations(range(n), 2):
        if not suspects[a] and not suspects[b]:
            continue
        order = list(range(n))
        order[a], order[b] = b, a
        for names, what in ((motion, "the positions and velocities"), (all_of_it, "all signals")):
            changed = [
                replace(s, **{name: np.ascontiguousarray(getattr(s, name)[:, order]) for name in names})  # type: ignore[arg-type]
                for s in stretches
            ]
            after = errors(rows_of(changed, tree))
            if names is all_of_it:
                after = after[order]  # each torque against itself
            yield Mend(f"{what} of '{joints[a]}' and '{joints[b]}' exchanged", a, after, "fault", 0, moves=True)


def _of_zero(whole: Rows, tree: _core.Tree | None, errors: Errors) -> Iterator[Mend]:
    """The best shift of each joint: gravity at the shifted positions, inertia as it is."""
    stride = max(1, len(whole.time_s) // ZERO_ROWS)
    rows = Rows(*(getattr(whole, name)[::stride] for name in whole.__dataclass_fields__))
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
            told = f"{best:+.2f} rad ({math.degrees(best):+.0f} degrees) added to its position"
            severity: Severity = "fault" if abs(math.remainder(best, 2 * math.pi)) > WRONG_RAD else "warning"
            yield Mend(told, j, after(best), severity, 1, moves=True, shifts=True)


def _of_load(
    rows: Rows, predicted: np.ndarray, stretches: Sequence[Stretch], tree: _core.Tree, joints: Sequence[str]
) -> Iterator[Mend]:
    """A mass at the last link more or less than the others carry."""
    shared, error = load_columns(stretches, tree, rows), rows.tau - predicted
    scale = 1 / spread_about_zero(error)
    for _ in range(3):
        x = (shared * scale[:, None]).reshape(-1, 4)
        load = np.linalg.lstsq(x, (error * scale).ravel(), rcond=1e-6)[0]
        scale = 1 / spread_about_zero(error - shared @ load)
    if abs(load[0]) > LEAST_KG:
        way = "more" if load[0] > 0 else "less"
        told = f"{abs(load[0]):.2g} kg {way} at '{joints[-1]}' than in the others taken into account"
        yield Mend(told, None, spread_about_zero(error - shared @ load), "warning", 4, rough=True)


def load_columns(stretches: Sequence[Stretch], tree: _core.Tree, rows: Rows) -> np.ndarray:
    """Torque a kg, and a kg m of first moment, at the last link: (rows, joints, 4).

    Args:
        rows: of these stretches with this tree.
    """
    columns = []
    for k in range(4):
        links = list(tree.links)
        parameters = inertial_parameters(links[-1])
        parameters[k] += 1.0
        links[-1] = with_inertial_parameters(links[-1], parameters)
        columns.append(rows_of(stretches, _core.Tree(links, tree.gravity)).model - rows.model)
    return np.stack(columns, axis=2)
