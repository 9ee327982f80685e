"""A rigid load at the last link that the model does not have, or has and the arm has not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tauext import _core
from tauext.check.finding import Finding
from tauext.check.fit import BLOCKS, columns_of, robust_spread, spread_of
from tauext.check.regressors import Rows, rows_of
from tauext.robot.inertial import inertial_parameters, with_inertial_parameters

LEAST_KG = 0.3
"""Less is a cable, or an error of the links."""
SURE = 5.0
"""Standard errors that the mass must exceed."""
GAIN = 0.5
"""Sum over the joints that gravity acts on of the logarithm of how much the error falls."""
FURTHEST_M = 0.6
"""Of the load's centre of mass from the last joint: further out is no tool."""


@dataclass(frozen=True)
class Load:
    """What must be added to the last link."""

    mass_kg: float
    mass_error_kg: float
    com_m: np.ndarray  # (3,), in the tree's frame of the last joint: z is its axis, x and y are any
    error_nm: np.ndarray  # (joints,), robust: with it
    error_without_nm: np.ndarray

    def gain(self, joints: Sequence[int]) -> float:
        return float(np.log(self.error_without_nm[joints] / self.error_nm[joints]).sum())


def with_load(tree: _core.Tree, by: np.ndarray) -> _core.Tree:
    """The tree with m and m com (4,) added to the last link."""
    links = list(tree.links)
    parameters = inertial_parameters(links[-1])
    parameters[:4] += by
    com = by[1:] / by[0] if by[0] else np.zeros(3)
    about = by[0] * (com @ com * np.eye(3) - np.outer(com, com))
    parameters[4:10] += about[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    links[-1] = with_inertial_parameters(links[-1], parameters)
    return _core.Tree(links, tree.gravity)


def fit_load(stretches: Sequence, tree: _core.Tree, rows: Rows) -> Load:
    r"""Least squares of the joints together.

    .. math:: \tau_i - \hat\tau_i = Z_i(m, m c) + J_i \ddot q_i + friction_i

    with m and m c common to all joints, and J_i and friction their own. The load's own inertia about its centre of
    mass is left out: of a hand's size it is a hundredth of m c^2 + rotor inertia.
    """
    columns = []
    for k in range(4):
        unit = np.zeros(4)
        unit[k] = 1.0
        links = list(tree.links)
        parameters = inertial_parameters(links[-1])
        parameters[:4] += unit
        links[-1] = with_inertial_parameters(links[-1], parameters)
        columns.append(rows_of(stretches, _core.Tree(links, tree.gravity)).model - rows.model)
    shared = np.stack(columns, axis=2)  # (rows, joints, 4)
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


def _solve(left: list[np.ndarray], rest: list[np.ndarray], weights: list[float]) -> np.ndarray:
    gram = sum(w**2 * x.T @ x for x, w in zip(left, weights, strict=True))
    moment = sum(w**2 * x.T @ r for x, r, w in zip(left, rest, weights, strict=True))
    return np.linalg.lstsq(gram, moment, rcond=1e-9)[0]


def payload_findings(load: Load, joints: Sequence[str], strong: Sequence[int]) -> list[Finding]:
    """A load of this mass, where it explains the torques of the joints that gravity acts on."""
    gain = load.gain(list(strong))
    sure = abs(load.mass_kg) > max(LEAST_KG, SURE * load.mass_error_kg)
    if not strong or not sure or gain < GAIN or np.linalg.norm(load.com_m) > FURTHEST_M:
        return []
    told = ", ".join(f"'{joints[j]}' {load.error_without_nm[j]:.3g} to {load.error_nm[j]:.3g}" for j in strong)
    com = ", ".join(f"{x:.2f}" for x in load.com_m)
    evidence = (
        f"{abs(load.mass_kg):.2f} ± {load.mass_error_kg:.1g} kg at ({com}) m from '{joints[-1]}', z along its axis, "
        f"bring the error in Nm from {told}"
    )
    if load.mass_kg > 0:
        advice = "add the tool or payload to the model, as a link fixed to the last one"
        return [Finding("payload-missing", "warning", joints[-1], "a load that the model lacks: " + evidence, advice)]
    advice = "take the tool or hand that is not mounted out of the model"
    return [Finding("payload-absent", "warning", joints[-1], "less load than the model has: " + evidence, advice)]


def loaded(tree: _core.Tree, load: Load) -> _core.Tree:
    """The tree with the load found, where that leaves the last link a mass."""
    mass = max(load.mass_kg, 0.1 * tree.links[-1].mass - tree.links[-1].mass)
    return with_load(tree, np.r_[mass, mass * load.com_m])
