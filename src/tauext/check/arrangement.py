"""Order, sign and zero of joints, direction of gravity, and a load missing in the robot file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from operator import itemgetter

import numpy as np
from scipy.optimize import linear_sum_assignment, minimize_scalar

from tauext import _core
from tauext.check.finding import Finding
from tauext.check.joint_fit import (
    BLOCKS,
    CONSTANT,
    FRICTION,
    FitRows,
    columns_of,
    model_of,
    robust_solve,
    robust_spread,
    rows_of,
    spread_of,
)
from tauext.check.motion import PADDED_ROWS, Stretch
from tauext.robot.inertial import point_inertia, six_of, with_more_at_end

# --- The direction of gravity according to the arm's own torques.


LEAST_DEG = 10.0
"""Least angle. A mounting plate is level within a degree or two; the rest covers model errors."""
GAIN = 1.0
"""Least gain: sum over joints of the log ratio of errors."""
HALVED = 0.6


def gravity_finding(stretches: Sequence[Stretch], tree: _core.Tree, rows: FitRows) -> tuple[list[Finding], _core.Tree]:
    """Find a direction of gravity that fits far better; returns findings and the tree with that direction.

    Gravity torque is linear in the vector of free fall: three columns common to all joints, beside each joint's own
    inertia and friction.
    """
    up = [_core.Tree(list(tree.links), axis) for axis in np.eye(3).tolist()]
    shared = np.stack([model_of(stretches, t)[0] for t in up], axis=2)
    left, rest, weights, known = [], [], [], []
    given = np.array(tree.gravity)
    for j in range(rows.joints):
        basis = np.linalg.qr(columns_of(rows, j)[:, 2:] + 0.0)[0]
        y = rows.tau[:, j] - rows.inertial[:, j]
        y, x = y - basis @ (basis.T @ y), shared[:, j] - basis @ (basis.T @ shared[:, j])
        left.append(x)
        rest.append(y)
        known.append(robust_spread(y - x @ given))
        weights.append(1 / max(known[-1], 1e-9))
    for _ in range(3):
        found = _solve(left, rest, weights, rcond=1e-6)
        errors = [robust_spread(y - x @ found) for x, y in zip(left, rest, strict=True)]
        weights = [1 / max(e, 1e-9) for e in errors]
    size, usual = float(np.linalg.norm(found)), float(np.linalg.norm(given))
    if size == 0 or usual == 0:
        return [], tree
    angle = float(np.degrees(np.arccos(np.clip(found @ given / size / usual, -1, 1))))
    ratio = np.maximum(errors, 1e-9) / np.maximum(known, 1e-9)
    far_better = -np.log(ratio).sum() > GAIN and ratio.min() < HALVED
    if angle < LEAST_DEG or not far_better or not 0.5 < size / usual < 2:
        return [], tree
    components = ", ".join(f"{x:.2f}" for x in found)
    evidence = (
        f"the torques indicate gravity of ({components}) m/s^2 in the base frame, {angle:.0f} degrees from the model's "
        f"({', '.join(f'{x:.2f}' for x in given)}); a joint's error falls to {ratio.min():.0%}"
    )
    advice = "the arm hangs or is tilted: give its gravity direction in the robot's description"
    unit = (found / size * usual).tolist()
    return [Finding("gravity-direction", "fault", None, evidence, advice)], _core.Tree(list(tree.links), unit)


# --- A rigid load at the last link that the arm has and the model lacks, or the reverse.


LEAST_KG = 0.3
"""Least mass; less is a cable or an error of the links."""
SURE = 5.0
"""Least mass in standard errors."""
LOAD_GAIN = 0.5
"""Least gain: sum over joints under gravity of the log ratio of errors."""
FURTHEST_M = 0.6
"""Largest distance of the load's centre of mass from the last joint; no tool is further out."""


@dataclass(frozen=True)
class Load:
    """Load to be added to the last link."""

    mass_kg: float
    mass_error_kg: float
    com_m: np.ndarray  # (3,), in the tree's frame of the last joint: z is its axis, x and y are any
    error_nm: np.ndarray  # (joints,), robust: with it
    error_without_nm: np.ndarray

    def gain(self, joints: Sequence[int]) -> float:
        return float(np.log(self.error_without_nm[joints] / self.error_nm[joints]).sum())


def with_load(tree: _core.Tree, by: np.ndarray) -> _core.Tree:
    """The tree with m and m com (4,) added to the last link."""
    com = by[1:] / by[0] if by[0] else np.zeros(3)
    return with_more_at_end(tree, np.r_[by, six_of(point_inertia(by[0], com))])


def load_columns(stretches: Sequence[Stretch], tree: _core.Tree, rows: FitRows) -> np.ndarray:
    """Torque of 1 kg, and of 1 kg m of first moment, at the last link: (rows, joints, 4).

    Args:
        rows: rows of these stretches with this tree.
    """
    with_units = (with_model(rows, stretches, with_more_at_end(tree, unit)) for unit in np.eye(4))
    return np.stack([one.model - rows.model for one in with_units], axis=2)


def fit_load(stretches: Sequence, tree: _core.Tree, rows: FitRows) -> Load:
    r"""Fit a load by least squares of all joints together.

    .. math:: \tau_i - \hat\tau_i = Z_i(m, m c) + J_i \ddot q_i + friction_i

    with m and m c common to all joints, and J_i and friction of each joint. The load's inertia about its centre of mass
    is neglected: for a hand it is a hundredth of m c^2 + rotor inertia.
    """
    shared = load_columns(stretches, tree, rows)
    target = rows.tau - rows.model
    left, rest, without = [], [], np.empty(rows.joints)
    for j in range(rows.joints):
        own = columns_of(rows, j)[:, 2:]
        own = own / np.maximum(own.std(axis=0), 1e-9)
        basis = np.linalg.qr(np.column_stack([own, np.ones(len(own))]))[0]
        left.append(shared[:, j] - basis @ (basis.T @ shared[:, j]))
        rest.append(target[:, j] - basis @ (basis.T @ target[:, j]))
        without[j] = robust_spread(rest[-1])
    weights = [1 / np.clip(without[j], 0.02 * max(rows.tau[:, j].std(), 1e-9), None) for j in range(rows.joints)]
    for _ in range(2):
        solution = _solve(left, rest, weights)
        errors = np.array([robust_spread(r - x @ solution) for x, r in zip(left, rest, strict=True)])
        weights = [1 / max(e, 1e-3 * max(w, 1e-9)) for e, w in zip(errors, without, strict=True)]
    keep = np.array_split(np.arange(len(rest[0])), BLOCKS)
    parts = [_solve([np.delete(x, b, 0) for x in left], [np.delete(r, b) for r in rest], weights) for b in keep]
    spread = spread_of(np.array([part[0] for part in parts]))
    return Load(float(solution[0]), spread, solution[1:] / (solution[0] or 1.0), np.maximum(errors, 1e-9), without)


def _solve(left: list[np.ndarray], rest: list[np.ndarray], weights: list[float], rcond: float = 1e-9) -> np.ndarray:
    """Weighted least squares of all joints together."""
    gram = sum(w**2 * x.T @ x for x, w in zip(left, weights, strict=True))
    moment = sum(w**2 * x.T @ r for x, r, w in zip(left, rest, weights, strict=True))
    return np.linalg.lstsq(gram, moment, rcond=rcond)[0]


def payload_of(
    stretches: Sequence[Stretch],
    tree: _core.Tree,
    rows: FitRows,
    joints: Sequence[str],
    strong: Sequence[int],
    unit: str,
) -> tuple[list[Finding], _core.Tree]:
    """Finding of a load, if it explains the torques of the joints under gravity, and the tree with the load."""
    load = fit_load(stretches, tree, rows)
    gain = load.gain(list(strong))
    sure = abs(load.mass_kg) > max(LEAST_KG, SURE * load.mass_error_kg)
    if not strong or not sure or gain < LOAD_GAIN or np.linalg.norm(load.com_m) > FURTHEST_M:
        return [], tree
    changes = ", ".join(f"'{joints[j]}' {load.error_without_nm[j]:.3g} to {load.error_nm[j]:.3g}" for j in strong)
    com = ", ".join(f"{x:.2f}" for x in load.com_m)
    evidence = (
        f"{abs(load.mass_kg):.2f} ± {load.mass_error_kg:.1g} kg at ({com}) m from '{joints[-1]}', z along its axis, "
        f"bring the error in {unit} from {changes}"
    )
    if load.mass_kg > 0:
        what, advice = "a load that the model lacks", "add the tool or payload to the model, fixed to the last link"
    else:
        what, advice = "less load than the model has", "remove the tool or hand that is not mounted from the model"
    return [Finding("payload", "warning", joints[-1], f"{what}: {evidence}", advice)], loaded(tree, load)


def loaded(tree: _core.Tree, load: Load) -> _core.Tree:
    """Return the tree with the load, if the last link keeps a positive mass."""
    mass = max(load.mass_kg, 0.1 * tree.links[-1].mass - tree.links[-1].mass)
    return with_load(tree, np.r_[mass, mass * load.com_m])


# --- A joint whose zero differs from the robot file's: gravity fits far better with its position shifted.


GRID_RAD = math.radians(15.0)
LEAST_RAD = 0.05
"""Least offset. A calibrated arm's zero is right within 0.01 rad; smaller offsets may be errors of the model's
masses."""
RESISTS = 0.1
"""Share of the torque's spread above which friction determines the torque's sign; gravity must then agree."""


@dataclass(frozen=True)
class Offset:
    """Offset to be added to a joint's position."""

    joint: int
    by_rad: float
    gain: float  # sum over joints of the logarithm of how much the error falls, by gravity alone

    def text(self) -> str:
        return f"{self.by_rad:+.2f} rad ({math.degrees(self.by_rad):+.0f} degrees)"


def best_offset(rows: FitRows, tree: _core.Tree) -> Offset | None:
    """Find the shift of one joint with the best fit of gravity, with one factor a joint on torque.

    Gravity is evaluated at the rows' own positions; inertia is unchanged, since a shift changes it little compared with
    friction. None if no shift of LEAST_RAD or more is better.
    """
    others, signs = _rest(rows)
    zero = _log_errors(rows.gravity, others, signs)
    best: Offset | None = None
    for j in range(rows.joints):

        def total(by: float, j: int = j) -> float:
            q = rows.q.copy()
            q[:, j] += by
            return float((_log_errors(tree.momentum(q, np.zeros_like(q))[1], others, signs)).sum())

        grid = np.arange(-math.pi, math.pi - 1e-9, GRID_RAD)
        middle = float(grid[np.argmin([total(by) for by in grid])])
        found = minimize_scalar(total, bounds=(middle - GRID_RAD, middle + GRID_RAD), method="bounded",
                                options={"xatol": 1e-3})  # fmt: skip
        by, gain = math.remainder(float(found.x), 2 * math.pi), float(zero.sum() - found.fun)
        if abs(by) > LEAST_RAD and gain > (best.gain if best else 0.0):
            best = Offset(j, by, gain)
    return best


def _rest(rows: FitRows) -> tuple[list[tuple[np.ndarray, np.ndarray]], list[float]]:
    """For each joint a basis without gravity and the torque orthogonal to it; and the torque's sign, 0: unknown."""
    parts, signs, resists = [], [], slice(CONSTANT, CONSTANT + FRICTION - 1)  # after the constant; gravity left out
    for j in range(rows.joints):
        columns, y = columns_of(rows, j), rows.tau[:, j]
        own = columns[:, 1:] / np.maximum(np.sqrt((columns[:, 1:] ** 2).mean(axis=0)), 1e-9)
        u, size, v = np.linalg.svd(own, full_matrices=False)
        kept = size > 1e-3 * size[0]
        basis = u[:, kept]
        weights = v[kept].T @ ((basis.T @ y) / size[kept])
        friction = own[:, resists] @ weights[resists]
        has_sign = friction.std() > RESISTS * max(float(y.std()), 1e-12)
        signs.append(float(np.sign((friction * rows.dq[:, j]).mean())) if has_sign else 0.0)
        parts.append((basis, y - basis @ (basis.T @ y)))
    return parts, signs


def _log_errors(gravity: np.ndarray, others: Sequence[tuple[np.ndarray, np.ndarray]], signs: list[float]) -> np.ndarray:
    """Log of each joint's robust error with this gravity, (joints,)."""
    errors = np.empty(len(others))
    for j, (basis, y) in enumerate(others):
        x = gravity[:, j] - basis @ (basis.T @ gravity[:, j])
        power = float(x @ x)
        factor = float(x @ y) / power if power > 1e-9 * len(x) else 0.0
        if signs[j] * factor < 0:
            factor = 0.0
        errors[j] = math.log(robust_spread(y - factor * x) + 1e-9 + 1e-3 * float(np.abs(y).mean()))
    return errors


# --- Other orders, reversed axes and shifted zeros that fit far better.


SEARCH_S = 60.0
"""Motion used, spread evenly, [s]: the search fits dozens of arrangements."""
LEAST_PART_S = 2.0
"""Least part of a stretch, [s]: the differences of its ends are uncertain, and a shorter one has no turn."""
SEARCH_ROWS = 5000
"""Rows used for all pairs of joints, spread evenly."""
WORSE = 1.15
"""... and none rises by more than this."""
LEAST_EXPLAINED = 0.5
"""Least share of another joint's motion that an effort must explain to count as exchanged."""
MOST_CHANGES = 3
OFFSET_GAIN = 2.0
"""Least gain of a shift: the best one gains up to 1.3 by chance if a tool is missing in the model ..."""
OFFSET_LEAD = 0.15
"""... and least excess, a joint, over the gain of an arrangement, a load or a tilted base."""


@dataclass(frozen=True)
class Change:
    """Change of the joints' order and signs."""

    code: str
    description: str
    names: list[str]
    """Names of the changed joints."""
    order: list[int]
    """Present index of each joint in the new order."""
    sign: np.ndarray

    def of(self, stretch: Stretch) -> Stretch:
        """Return the changed stretch."""
        return stretch.changed(lambda x: np.ascontiguousarray(self.sign * x[:, self.order]))

    def of_rows(self, rows: FitRows) -> FitRows:
        """Return the changed rows without the model's torques; all other columns are odd in the motion or constant."""
        friction = rows.friction[:, self.order].copy()
        friction[:, :, 1:] *= self.sign[:, None]
        names = ("q", "dq", "tau", "acceleration")
        return replace(rows, **{n: self.sign * getattr(rows, n)[:, self.order] for n in names}, friction=friction)


Best = tuple[float, Change | None, np.ndarray, np.ndarray]
"""Gain, change (None: none), ratio of errors, and errors."""


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


def exchanged_efforts(rows: FitRows, joints: Sequence[str]) -> tuple[list[Finding], list[int]]:
    """Find torques that fit another joint's motion; also returns for each joint the column of its torque."""
    n, every = rows.joints, max(1, len(rows.time_s) // SEARCH_ROWS)
    rows = rows.taken(slice(None, None, every))
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
            f"its motion explains the effort of '{joints[column[j]]}' except {error:.0f} % of its spread, "
            f"its own effort except {own:.0f} %"
        )
        found.append(Finding("joint-order", "fault", joints[j], evidence, "map efforts by name at import"))
    return found, [int(k) for k in column]


def rearranged(
    stretches: Sequence[Stretch], tree: _core.Tree, joints: Sequence[str]
) -> tuple[list[Finding], list[Stretch]]:
    """Return findings, and the stretches in the robot file's order and signs."""
    found, few = [], search_stretches(stretches)
    stretches = list(stretches)
    rows = rows_of(few, tree)
    now, lead = _errors(rows), OFFSET_LEAD * len(joints)
    for _ in range(MOST_CHANGES):
        best: Best = (GAIN, None, now, now)
        for change in _changes(joints):
            then = _errors(with_model(change.of_rows(rows), [change.of(s) for s in few], tree))
            ratio = then / now[change.order]  # each torque signal against itself
            gain = -float(np.log(ratio).sum())
            if gain > best[0] and ratio.min() < HALVED and ratio.max() < WORSE:
                best = (gain, change, ratio, then)
        shift = best_offset(rows, tree)
        if shift is not None:
            moved = [shifted(s, shift) for s in few]
            then = _errors(with_model(rows, moved, tree))
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
            f"{chosen.description} the model's error falls to {ratio.min():.0%} at one joint and rises at none "
            f"({gain:.1f} nats)"
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
        f"with {shift.text()} added to its positions the model's error falls to {ratio:.0%} at one joint and rises "
        f"at none ({gain:.1f} nats)"
    )
    advice = "its zero differs from the robot file's: add that offset at import, or correct the file's joint origin"
    return Finding("position-offset", "fault", joints[shift.joint], evidence, advice)


def _gain_otherwise(stretches: Sequence[Stretch], tree: _core.Tree, rows: FitRows, now: np.ndarray) -> float:
    """Gain of a missing load or another direction of gravity."""
    trees = (loaded(tree, fit_load(stretches, tree, rows)), gravity_finding(stretches, tree, rows)[1])
    return max(-float(np.log(_errors(with_model(rows, stretches, other)) / now).sum()) for other in trees)


def with_model(rows: FitRows, stretches: Sequence[Stretch], tree: _core.Tree) -> FitRows:
    """The rows with the model's torques of this motion."""
    gravity, inertial = model_of(stretches, tree)
    return replace(rows, gravity=gravity, inertial=inertial)


def _errors(rows: FitRows) -> np.ndarray:
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
        description = f"with '{joints[a]}' and '{joints[b]}' exchanged"
        found.append(Change("joint-order", description, [joints[a], joints[b]], order, none))
    return found
