"""The estimated model: the robot file as it is, wrong on purpose as in the paper, or none at all."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from tauext._core import Tree
from tauext.config import CaseName, ModelCase
from tauext.errors import ConfigError
from tauext.robot.load import load_tree
from tauext.robot.perturb import empty, perturbed
from tauext.robot.write import is_placeholder


def chosen_case(name: CaseName | None, robot: Path) -> tuple[CaseName, str]:
    """The case asked for; left out: exact, or, where the robot file is a placeholder, none. Beside it what is to be
    said of such a choice, in a sentence; empty: nothing.

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
    """These joints of the robot file, as the case's wrong or missing model."""
    tree = load_tree(robot, joints=joints)
    return empty(tree) if case.no_model else perturbed(tree, case.mass_factor, case.com_factor)
