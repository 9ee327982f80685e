"""Wrong models on purpose: the cases of the paper, and tests of how little the model matters."""

import math

from tauext._core import Link, Tree
from tauext.errors import RobotError


def perturbed(tree: Tree, mass_factor: float = 1.0, com_factor: float = 1.0) -> Tree:
    """The tree with every mass times `mass_factor` and every centre of mass times `com_factor`.

    A centre of mass moves on the line to its joint's origin: 1 leaves it, 0 puts it there. Inertia about the centre of
    mass and rotor inertia do not change, so neither p nor beta scales as a whole.

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
    """No model: the same joints with neither mass, inertia nor rotor inertia, so that p = beta = 0 in every state."""
    links: list[Link] = []
    for link in tree.links:
        link.mass = link.rotor_inertia = 0.0
        link.com = [0.0] * 3
        link.inertia = [0.0] * 6
        links.append(link)
    return Tree(links, tree.gravity)
