"""Corrections of inertial parameters that no link can have, and what stands in their place."""

from __future__ import annotations

import numpy as np

from tauext import _core
from tauext.learn.regression import NormalEquations, Regression
from tauext.robot.inertial import PARAMETERS

ROTOR = PARAMETERS.index("rotor")


def solve_possible(
    regression: Regression, equations: NormalEquations, ridge: float, corrected: _core.Tree | None
) -> np.ndarray:
    """Coefficients that make no impossible link; columns that would are fixed in the regression.

    Args:
        corrected: whose parameters the last columns correct; None: there are none.
    """
    while True:
        solution = regression.solve(equations, ridge)
        if not fix_impossible(regression, corrected, solution):
            return solution


def fix_impossible(regression: Regression, corrected: _core.Tree | None, solution: np.ndarray) -> bool:
    """Fix the columns of corrections that would make a link that no link can be; whether there were any."""
    if corrected is None:
        return False
    impossible = impossible_columns(corrected, solution, regression.used)
    for column in impossible:
        regression.fix(column, nearest_possible(corrected, column, len(solution)))
    return bool(impossible)


def impossible_columns(tree: _core.Tree, solution: np.ndarray, used: np.ndarray) -> list[int]:
    """They have to go, and the rest to be solved anew.

    A mass that falls to zero or below keeps what the file says, or is 1 kg where the file says nothing: what it adds
    shows in other parameters too, and they make up for it. A rotor inertia below zero is none.
    """
    first, columns = len(solution) - len(PARAMETERS) * tree.size, []
    for k, link in enumerate(tree.links):
        at = first + len(PARAMETERS) * k
        by = solution[at : at + len(PARAMETERS)]
        if link.mass + by[0] <= 0 and used[at]:  # one that shows nowhere may be any
            columns.append(at)
        if link.rotor_inertia + by[ROTOR] < 0 and used[at + ROTOR]:
            columns.append(at + ROTOR)
    return columns


def nearest_possible(tree: _core.Tree, column: int, columns: int) -> float:
    """The correction that an impossible one is replaced by."""
    link, parameter = divmod(column - (columns - len(PARAMETERS) * tree.size), len(PARAMETERS))
    if parameter == ROTOR:
        return -tree.links[link].rotor_inertia
    return 0.0 if tree.links[link].mass > 0 else 1.0
