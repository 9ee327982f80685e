"""The estimated model: the robot file as it is, wrong on purpose as in the paper, or none at all."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tauext.config import ModelCase
from tauext.errors import ConfigError

if TYPE_CHECKING:
    from tauext._core import Tree
    from tauext.data import Recording

CaseName = Literal["exact", "mass", "com", "mass+com", "none"]


def chosen_case(name: CaseName | None, robot: Path) -> CaseName:
    """The case asked for; left out: exact, or, where the robot file is a placeholder, none, and stderr says so.

    Raises:
        ConfigError: another case than none, and the robot file is a placeholder.
    """
    from tauext.robot import is_placeholder

    if not is_placeholder(robot):
        return name or "exact"
    if name in (None, "none"):
        if name is None:
            print(f"{robot}: the dataset has no model, so the case is 'none'", file=sys.stderr)
        return "none"
    raise ConfigError(
        f"case = {name} needs a model, and {robot} is a placeholder for none: leave --case out, give the arm's URDF or "
        "MJCF with --robot, or name it in arm.toml ([robot] model) and import again"
    )


def estimated_model(robot: Path, recording: Recording, case: ModelCase) -> Tree:
    """The robot file's joints that the recording has, as the case's wrong or missing model."""
    from tauext.robot import empty, load, perturbed

    tree = load(robot, joints=recording.joints)
    return empty(tree) if case.no_model else perturbed(tree, case.mass_factor, case.com_factor)


def why_impossible(recipe: str, case: ModelCase) -> str | None:
    """Why there is no such bundle; None: there is."""
    if recipe == "velocity" and case.no_model:
        return f"recipe = velocity needs a model, which the case '{case.name}' has not: it divides by the inertia"
    return None


def model_digest(tree: Tree) -> str:
    """A checkpoint of another estimated model must not be resumed: SHA-256 of the model's numbers."""
    import hashlib
    import json

    fields = ("joint_name", "parent", "rotation", "translation", "mass", "com", "inertia", "rotor_inertia")
    numbers = [[getattr(link, field) for field in fields] for link in tree.links]
    return hashlib.sha256(json.dumps([numbers, tree.gravity]).encode()).hexdigest()
