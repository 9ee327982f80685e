"""Inertial parameters of links in joint torques, and corrections that stay physical."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tauext import _core
from tauext.data.recording import Recording
from tauext.fit.regression import NormalEquations, Regression
from tauext.robot.inertial import PARAMETERS, inertial_parameters

# --- r of the model alone.


def observed(
    links: Sequence[_core.Link],
    gravity: Sequence[float],
    observer: _core.ObserverSettings,
    recording: Recording,
    rows: np.ndarray,
) -> np.ndarray:
    """r of these links with zero motor torque, i.e. of the model alone, (rows, n), [N m]."""
    still = np.zeros_like(recording.tau)
    tree = _core.Tree(list(links), gravity)
    return _core.observe(tree, observer, recording.t_ns, recording.q, recording.dq, still).residual[rows]


# --- Corrections of inertial parameters that make links which the core accepts, as bounds of the fit.


MASS, ROTOR = PARAMETERS.index("m"), PARAMETERS.index("rotor")
FIRST_MOMENT = slice(1, 4)
LEAST_MASS_KG = 1e-6
"""The centre of mass of a lighter link exceeds the range of numbers."""
LARGEST = 1e8
"""Of a mass, a first moment or an inertia, [kg], [kg m], [kg m2]: the core takes 1e9 (kLargestOfAnArm), and a link's
own numbers are sums of a few of them."""
LARGEST_SPREAD = 1e8
"""Of |first moment|^2 / mass, [kg m2]: what turns an inertia about the origin into one about the centre of mass."""


def solve_possible(
    regression: Regression, equations: NormalEquations, ridge: float, corrected: _core.Tree | None
) -> np.ndarray:
    """Coefficients that make links which the core accepts; masses that would not are fixed in the regression.

    Args:
        corrected: whose parameters the last columns correct; None: there are none.
    """
    while True:
        solution = regression.solve(equations, ridge)
        if not fix_impossible(regression, corrected, solution):
            return solution


def bound_links(regression: Regression, tree: _core.Tree) -> None:
    """Bound the last columns, corrections of this tree's inertial parameters: no rotor inertia is below 0, and nothing
    is larger than an arm."""
    before = np.array([inertial_parameters(link) for link in tree.links]).ravel()
    columns = correction_columns(tree, len(regression.used))
    low, high = np.minimum(-LARGEST - before, 0.0), np.maximum(LARGEST - before, 0.0)
    low[ROTOR :: len(PARAMETERS)] = -before[ROTOR :: len(PARAMETERS)]
    regression.bound(columns, low, high)


def correction_columns(tree: _core.Tree, width: int) -> np.ndarray:
    """The last of so many columns, (11 n,)."""
    return np.arange(width - len(PARAMETERS) * tree.size, width)


def fix_impossible(regression: Regression, corrected: _core.Tree | None, solution: np.ndarray) -> bool:
    """Fix corrections at a bound and impossible masses; returns whether there were any.

    What is fixed counts as not determined by the motion. A mass that falls to zero or below keeps the file's value,
    or is 1 kg where the file has none: what it adds shows in other parameters too, and they make up for it. One
    that is too small for its link's first moment grows to 1 kg, or as many kg as the moment has kg m.
    """
    if corrected is None:
        return False
    columns = correction_columns(corrected, len(solution))
    values = solution[columns]
    at_bound = (values <= regression.low[columns]) | (values >= regression.high[columns])
    at_bound &= regression.used[columns]
    fixed = dict(zip(columns[at_bound], values[at_bound], strict=True))
    for k, link in enumerate(corrected.links):
        own = slice(len(PARAMETERS) * k, len(PARAMETERS) * (k + 1))
        p, mass = inertial_parameters(link) + values[own], columns[own][MASS]
        if is_possible(p):
            continue
        kept = link.mass
        if not regression.used[mass] or not is_possible(np.r_[kept, p[1:]]):
            kept = max(1.0, float(np.linalg.norm(p[FIRST_MOMENT])))
        fixed[mass] = kept - link.mass
    for column, value in fixed.items():
        regression.fix(column, value)
    return bool(fixed)


def is_possible(p: np.ndarray) -> bool:
    """Whether a link of these parameters, (11,), within the bounds of bound_links, has a mass that goes with them."""
    if not p[1:ROTOR].any():
        return bool(p[MASS] >= 0)
    return bool(p[MASS] >= LEAST_MASS_KG and p[FIRST_MOMENT] @ p[FIRST_MOMENT] <= LARGEST_SPREAD * p[MASS])
