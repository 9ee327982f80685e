r"""What two states of an arm weigh differently: a tool at the flange, or the scale of a joint's torque.

.. math:: y_j(q) = X_j(q) (m, m c) - \kappa_j g_j(q) + error

y: by how much the gravity torques of two bundles differ at the same poses. A tool shows at all joints at once, as its
weight says; a constant that is off by kappa shows at its own joint, in proportion to what weighs there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tauext import _core
from tauext.robot.inertial import inertial_parameters, with_inertial_parameters

POSES = 200
INDEPENDENT = 10.0
"""Of all poses: gravity of an arm is told by about so many numbers."""
MASS_KG, MOMENT_KG_M = 1.0, 0.15
"""Standard deviations of a tool's mass, and of its first moment, before anything is seen: grippers and their parts."""
ROUNDS = 3
LEAST_SHARE, LEAST_NM = 0.5, 0.02
"""Of what training leaves of a joint's torque: no bundle knows gravity better, whatever all arms agree in."""


@dataclass(frozen=True)
class Weighed:
    """One arm beside another state of it, or beside the fleet."""

    kg: float
    kg_error: float
    share: np.ndarray  # (n,) kappa
    share_error: np.ndarray  # (n,); as large as believed before where nothing weighs on the joint


def poses_seen(bundles: Sequence[_core.Bundle], seed: int = 0) -> np.ndarray:
    """Poses of the cells that half of these bundles' training saw, (POSES, n); each joint by itself."""
    rng = np.random.default_rng(seed)
    n = bundles[0].joints
    q = np.empty((POSES, n))
    for j in range(n):
        ranges = [seen_range(bundle, j) for bundle in bundles]
        low, high = (float(np.median([one[k] for one in ranges])) for k in (0, 1))
        q[:, j] = rng.uniform(low, high, POSES)
    return q


def seen_range(bundle: _core.Bundle, joint: int) -> tuple[float, float]:
    """First and last position of the joint in training; a turn about 0 where nobody knows."""
    coverage = bundle.coverage
    if not len(coverage.fastest_rad_s):
        return -np.pi, np.pi
    cells = [c for c in range(64) if int(coverage.seen[joint]) >> c & 1]
    if not cells:
        return -np.pi, np.pi
    if coverage.turns[joint]:
        cells = longest_run(cells)
    first = coverage.centre_rad[joint] - coverage.span_rad[joint] / 2
    cell = coverage.span_rad[joint] / 64
    return first + cells[0] * cell, first + (cells[-1] + 1) * cell


def longest_run(cells: Sequence[int]) -> list[int]:
    """Cells of a circle from behind its widest gap on, counted upwards."""
    gaps = [(cells[(k + 1) % len(cells)] - cell) % 64 or 64 for k, cell in enumerate(cells)]
    start = (int(np.argmax(gaps)) + 1) % len(cells)
    turned = [*cells[start:], *(c + 64 for c in cells[:start])]
    return [c - 64 for c in turned] if turned[0] >= 32 else turned


def arm_tree(bundle: _core.Bundle) -> _core.Tree:
    """The arm as training found it."""
    return _core.Tree(bundle.prior.corrected_links or bundle.links, bundle.gravity)


def gravity_nm(tree: _core.Tree, q: np.ndarray) -> np.ndarray:
    """Torques that hold the arm, (poses, n)."""
    return tree.momentum(q, np.zeros_like(q))[1]


def tool_columns(tree: _core.Tree, q: np.ndarray) -> np.ndarray:
    """What a kilogram, and a first moment of 1 kg m along each axis, adds on the last link, (poses, n, 4)."""
    usual = gravity_nm(tree, q)
    columns = []
    for k in range(4):
        links = tree.links
        parameters = inertial_parameters(links[-1])
        parameters[k] += 1.0
        links[-1] = with_inertial_parameters(links[-1], parameters)
        columns.append(gravity_nm(_core.Tree(links, tree.gravity), q) - usual)
    return np.stack(columns, axis=-1)


def weigh_all(
    y: Sequence[np.ndarray], gravity: np.ndarray, columns: np.ndarray, share_spread: float, left_nm: np.ndarray
) -> list[Weighed]:
    """Tool and shares of each arm; how well gravity is known is found in what all of them leave.

    Args:
        y: of each arm, (poses, n) [N m].
        gravity: (poses, n) that shares are of.
        share_spread: standard deviation of kappa before anything is seen.
        left_nm: (n,) what training leaves of a joint's torque; NaN: nobody knows.
    """
    n = gravity.shape[1]
    least_nm = np.maximum(LEAST_SHARE * np.nan_to_num(left_nm), LEAST_NM)
    noise_nm = np.full(n, 0.1 * float(np.sqrt(np.mean(gravity**2)))) + least_nm
    found: list[Weighed] = []
    for _ in range(ROUNDS):
        found, left = [], []
        for one in y:
            weighed, rest = weigh(one, gravity, columns, share_spread, noise_nm)
            found.append(weighed)
            left.append(np.mean(rest**2, axis=0))
        noise_nm = np.maximum(np.sqrt(np.median(left, axis=0)), least_nm)
    return found


def weigh(
    y: np.ndarray, gravity: np.ndarray, columns: np.ndarray, share_spread: float, noise_nm: np.ndarray
) -> tuple[Weighed, np.ndarray]:
    """Least squares on all joints; and what it leaves, (poses, n)."""
    poses, n = y.shape
    design = np.zeros((poses, n, 4 + n))
    design[:, :, :4] = columns
    design[:, range(n), range(4, 4 + n)] = -gravity
    worth = INDEPENDENT / poses / noise_nm**2
    information = np.diag(1 / np.r_[MASS_KG, [MOMENT_KG_M] * 3, [share_spread] * n] ** 2)
    information += np.einsum("pji,j,pjk->ik", design, worth, design)
    covariance = np.linalg.inv(information)
    theta = covariance @ np.einsum("pji,j,pj->i", design, worth, y)
    error = np.sqrt(np.diag(covariance))
    return Weighed(float(theta[0]), float(error[0]), theta[4:], error[4:]), y - design @ theta
