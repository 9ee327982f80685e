"""Deliberately wrong models: the cases of the paper, and no model at all."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from tauext._core import Link, Tree
from tauext.config import CaseName, ModelCase
from tauext.errors import ConfigError, RobotError
from tauext.robot.read import load_tree
from tauext.robot.write import is_placeholder


def perturbed(tree: Tree, mass_factor: float = 1.0, com_factor: float = 1.0) -> Tree:
    """The tree with every mass times `mass_factor` and every centre of mass times `com_factor`.

    com_factor scales a centre of mass towards its joint's origin: 1 keeps it, 0 puts it there. Inertia about the centre
    of mass and rotor inertia do not change, so neither p nor beta scales as a whole.

    Raises:
        RobotError: a factor is negative or not finite.
    """
    for name, factor in (("mass_factor", mass_factor), ("com_factor", com_factor)):
        if not (math.isfinite(factor) and factor >= 0):
            raise RobotError(f"{name} = {factor} must be finite and >= 0; 1 leaves the model as it is")
    links = []
    for link in tree.links:
        link.mass = link.mass * mass_factor
        link.com = [com_factor * x for x in link.com]
        links.append(link)
    return Tree(links, tree.gravity)


def empty(tree: Tree) -> Tree:
    """Return the same joints without mass, inertia and rotor inertia, so that p = beta = 0 in every state."""
    links: list[Link] = []
    for link in tree.links:
        link.mass = link.rotor_inertia = 0.0
        link.com = [0.0] * 3
        link.inertia = [0.0] * 6
        links.append(link)
    return Tree(links, tree.gravity)


def chosen_case(name: CaseName | None, robot: Path) -> tuple[CaseName, str]:
    """Resolve the model case: None means exact, or none where the robot file is a placeholder. Returns the case and a
    sentence about that choice (empty: none).

    Raises:
        ConfigError: another case than none, and the robot file is a placeholder.
    """
    if not is_placeholder(robot):
        return name or "exact", ""
    if name is None:
        return "none", f"{robot}: the dataset has no model, so the case is 'none'"
    if name == "none":
        return "none", ""
    raise ConfigError(
        f"case = {name} needs a model, and {robot} is a placeholder for none: leave --case out, give the arm's URDF or "
        "MJCF with --robot, or name it in arm.toml ([robot] model) and import again"
    )


def estimated_model(robot: Path, joints: Sequence[str], case: ModelCase) -> Tree:
    """Tree of these joints of the robot file, changed as the case states."""
    tree = load_tree(robot, joints=joints)
    return empty(tree) if case.no_model else perturbed(tree, case.mass_factor, case.com_factor)
