"""Order, sign and zero of joints, direction of gravity, and a load missing in the robot file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from tauext import _core
from tauext.check.corrections import (
    GAIN,
    HALVED,
    Correction,
    best,
    best_zero,
    exchanged,
    negated,
    search_stretches,
    shared_numbers,
    weighted_solve,
)
from tauext.check.finding import Finding
from tauext.check.joint_fit import (
    BLOCKS,
    CONSTANT,
    FRICTION,
    FitRows,
    basis_of,
    columns_of,
    model_of,
    robust_solve,
    robust_spread,
    rows_of,
    spread_of,
    with_model,
)
from tauext.check.motion import Stretch
from tauext.robot.inertial import point_inertia, six_of, with_more_at_end


def _without_own(rows: FitRows, j: int, *signals: np.ndarray) -> list[np.ndarray]:
    """The parts of the signals that the joint's own inertia and friction cannot explain."""
    own = columns_of(rows, j)[:, 2:]
    basis = basis_of(own / np.maximum(np.sqrt((own**2).mean(axis=0)), 1e-9))
    return [x - basis @ (basis.T @ x) for x in signals]


# --- The direction of gravity according to the arm's own torques.


def gravity_finding(stretches: Sequence[Stretch], tree: _core.Tree, rows: FitRows) -> tuple[list[Finding], _core.Tree]:
    """Find a direction of gravity that fits far better; returns findings and the tree with that direction.

    Gravity torque is linear in the vector of free fall: three columns common to all joints, beside each joint's own
    inertia and friction.
    """
    up = [_core.Tree(list(tree.links), axis) for axis in np.eye(3).tolist()]
    shared, given = np.stack([model_of(stretches, t)[0] for t in up], axis=2), np.array(tree.gravity)
    parts = [_without_own(rows, j, shared[:, j], rows.tau[:, j] - rows.inertial[:, j]) for j in range(rows.joints)]
    columns, torques = [part[0] for part in parts], [part[1] for part in parts]
    known = np.array([robust_spread(y - x @ given) for x, y in parts])
    found, errors, _ = shared_numbers(columns, torques, known, rcond=1e-6)
    size, usual = float(np.linalg.norm(found)), float(np.linalg.norm(given))
    if size == 0 or usual == 0:
        return [], tree
    angle = float(np.degrees(np.arccos(np.clip(found @ given / size / usual, -1, 1))))
    ratio = np.maximum(errors, 1e-9) / np.maximum(known, 1e-9)
    far_better = -np.log(ratio).sum() > GAIN and ratio.min() < HALVED
    # a mounting plate is level within a degree or two, and errors of the model turn gravity by a few more
    if angle < 10.0 or not far_better or not 0.5 < size / usual < 2:
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


@dataclass(frozen=True)
class Load:
    """Load to be added to the last link."""

    mass_kg: float
    mass_error_kg: float
    com_m: np.ndarray  # (3,), in the tree's frame of the last joint: z is its axis, x and y are any
    error_nm: np.ndarray  # (joints,), robust: with it
    error_without_nm: np.ndarray


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


def fit_load(stretches: Sequence[Stretch], tree: _core.Tree, rows: FitRows) -> Load:
    r"""Fit a load by least squares of all joints together.

    .. math:: \tau_i - \hat\tau_i = Z_i(m, m c) + J_i \ddot q_i + friction_i

    with m and m c common to all joints, and J_i and friction of each joint. The load's inertia about its centre of mass
    is neglected: for a hand it is a hundredth of m c^2 + rotor inertia.
    """
    shared, target = load_columns(stretches, tree, rows), rows.tau - rows.model
    parts = [_without_own(rows, j, shared[:, j], target[:, j]) for j in range(rows.joints)]
    columns, torques = [part[0] for part in parts], [part[1] for part in parts]
    without = np.array([robust_spread(y) for y in torques])
    numbers, errors, weights = shared_numbers(columns, torques, np.maximum(without, 0.02 * rows.tau.std(axis=0)))
    kept = [np.delete(np.arange(len(rows.time_s)), b) for b in np.array_split(np.arange(len(rows.time_s)), BLOCKS)]
    parts_kg = [weighted_solve([x[k] for x in columns], [y[k] for y in torques], weights)[0] for k in kept]
    com_m = numbers[1:] / (numbers[0] or 1.0)
    return Load(float(numbers[0]), spread_of(np.array(parts_kg)), com_m, np.maximum(errors, 1e-9), without)


def payload_of(
    stretches: Sequence[Stretch],
    tree: _core.Tree,
    rows: FitRows,
    joints: Sequence[str],
    strong: Sequence[int],
    unit: str,
) -> tuple[list[Finding], _core.Tree]:
    """Finding of a load, if it explains the torques of the joints under gravity, and the tree with the load."""
    load, strong = fit_load(stretches, tree, rows), list(strong)
    gain = np.log(load.error_without_nm[strong] / load.error_nm[strong]).sum()
    sure = abs(load.mass_kg) > max(LEAST_KG, 5.0 * load.mass_error_kg)
    if not strong or not sure or gain < 0.5 or np.linalg.norm(load.com_m) > 0.6:  # [m]; no tool is further out
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


LEAST_RAD = 0.05
"""Least offset. A calibrated arm's zero is right within 0.01 rad; smaller offsets may be errors of the model's
masses."""


@dataclass(frozen=True)
class Offset:
    """Offset to be added to a joint's position."""

    joint: int
    by_rad: float
    gain: float  # sum over joints of the logarithm of how much the error falls, by gravity alone

    def of(self, stretch: Stretch) -> Stretch:
        """The stretch with the joint's positions shifted."""
        by = self.by_rad * np.eye(stretch.q.shape[1])[self.joint]
        return replace(stretch, q=stretch.q + by, q_raw=stretch.q_raw + by)


def best_offset(rows: FitRows, tree: _core.Tree) -> Offset | None:
    """Find the shift of one joint with the best fit of gravity, with one factor a joint on torque.

    Gravity is evaluated at the rows' own positions; inertia is unchanged, since a shift changes it little compared with
    friction. None if no shift of LEAST_RAD or more is better.
    """
    others = [_rest(rows, j) for j in range(rows.joints)]
    zero = _log_errors(rows.gravity, others)
    found: Offset | None = None
    for j in range(rows.joints):

        def total(by: float, j: int = j) -> float:
            q = rows.q.copy()
            q[:, j] += by
            return float((_log_errors(tree.momentum(q, np.zeros_like(q))[1], others)).sum())

        by, size = best_zero(total)
        gain = float(zero.sum() - size)
        if abs(by) > LEAST_RAD and gain > (found.gain if found else 0.0):
            found = Offset(j, by, gain)
    return found


def _rest(rows: FitRows, j: int) -> tuple[np.ndarray, np.ndarray, float]:
    """A basis of a joint's columns but gravity, the torque orthogonal to it, and the torque's sign, 0: unknown.

    Friction determines the sign where it is a tenth of the torque's spread; gravity must then agree.
    """
    resists = slice(CONSTANT, CONSTANT + FRICTION - 1)  # after the constant; gravity left out
    columns, y = columns_of(rows, j), rows.tau[:, j]
    own = columns[:, 1:] / np.maximum(np.sqrt((columns[:, 1:] ** 2).mean(axis=0)), 1e-9)
    u, size, v = np.linalg.svd(own, full_matrices=False)
    kept = size > 1e-3 * size[0]
    basis = u[:, kept]
    weights = v[kept].T @ ((basis.T @ y) / size[kept])
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


def exchanged_efforts(rows: FitRows, joints: Sequence[str]) -> tuple[list[Finding], list[int]]:
    """Find torques that fit another joint's motion; also returns for each joint the column of its torque."""
    n = rows.joints
    rows = rows.taken(slice(None, None, max(1, len(rows.time_s) // 5000)))
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
    if max(1 - np.exp(2 * errors[j, column[j]]) for j in wrong) < 0.5:  # some effort must explain another's motion
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
    """Return findings, and the stretches in the robot file's order and signs.

    A shift of a zero must lead an arrangement, a load and a tilted base by 0.15 nats a joint.
    """
    found, few, n = [], search_stretches(stretches), len(joints)
    stretches, rows = list(stretches), rows_of(few, tree)
    changes = [*(negated([j], n) for j in range(n)), *exchanged(n)]
    now, lead = _errors(rows), 0.15 * n
    for _ in range(3):
        chosen = best((change.tried(rows, few, tree, _errors) for change in changes), now)
        shift = best_offset(rows, tree)
        shifted = None if shift is None else best([_shifted(shift, rows, few, tree)], now)
        if shift is not None and shifted is not None:
            gain = shifted.gain(now) - lead
            if (chosen is None or gain > chosen.gain(now)) and gain > _gain_otherwise(few, tree, rows, now):
                found.append(_offset_finding(shift, joints, shifted, now))
                stretches, few, now = [shift.of(s) for s in stretches], [shift.of(s) for s in few], shifted.errors_nm
                rows = rows_of(few, tree)
                continue
        if chosen is None or chosen.change is None:
            break
        found += _order_findings(chosen, joints, now)
        stretches, few = [chosen.change.of(s) for s in stretches], [chosen.change.of(s) for s in few]
        rows = rows_of(few, tree)
        now = _errors(rows)
    return found, stretches


def _shifted(shift: Offset, rows: FitRows, stretches: Sequence[Stretch], tree: _core.Tree) -> Correction:
    moved = with_model(rows, [shift.of(s) for s in stretches], tree)
    return Correction("", shift.joint, _errors(moved), moves=True, shifts=True)


def _offset_finding(shift: Offset, joints: Sequence[str], shifted: Correction, before_nm: np.ndarray) -> Finding:
    evidence = (
        f"with {shift.by_rad:+.2f} rad ({math.degrees(shift.by_rad):+.0f} degrees) added to its positions the model's "
        f"error falls to {(shifted.errors_nm / before_nm).min():.0%} at one joint and rises at none "
        f"({shifted.gain(before_nm):.1f} nats)"
    )
    advice = "its zero differs from the robot file's: add that offset at import, or correct the file's joint origin"
    return Finding("position-offset", "fault", joints[shift.joint], evidence, advice)


def _order_findings(chosen: Correction, joints: Sequence[str], before_nm: np.ndarray) -> list[Finding]:
    assert chosen.change is not None
    names = [joints[j] for j in chosen.change.joints]
    if len(names) == 1:
        code, what, advice = "joint-axis", "its axis reversed", "negate q, dq and tau of it at import"
    else:
        code, what, advice = "joint-order", f"'{names[0]}' and '{names[1]}' exchanged", "map joints by name at import"
    evidence = (
        f"with {what} the model's error falls to {(chosen.errors_nm / before_nm).min():.0%} at one joint and rises at "
        f"none ({chosen.gain(before_nm):.1f} nats)"
    )
    return [Finding(code, "fault", name, evidence, advice) for name in names]


def _gain_otherwise(stretches: Sequence[Stretch], tree: _core.Tree, rows: FitRows, now: np.ndarray) -> float:
    """Gain of a missing load or another direction of gravity."""
    trees = (loaded(tree, fit_load(stretches, tree, rows)), gravity_finding(stretches, tree, rows)[1])
    return max(-float(np.log(_errors(with_model(rows, stretches, other)) / now).sum()) for other in trees)


def _errors(rows: FitRows) -> np.ndarray:
    """Robust error of each joint [N m], with one factor for the whole model: an arrangement must fit as a whole."""
    errors = np.empty(rows.joints)
    for j in range(rows.joints):
        columns = np.column_stack([rows.model[:, j], 0 * rows.time_s, columns_of(rows, j)[:, 2:]])
        errors[j] = robust_spread(rows.tau[:, j] - columns @ robust_solve(columns, rows.tau[:, j])[0])
    return np.maximum(errors, 1e-9)
