"""A link's eleven inertial parameters, in which momentum and gravity are linear."""

from __future__ import annotations

import numpy as np

from tauext._core import Link, Tree

PARAMETERS = ("m", "hx", "hy", "hz", "Ixx", "Iyy", "Izz", "Ixy", "Ixz", "Iyz", "rotor")
"""Mass [kg], first moment m com [kg m], inertia about the joint's origin in the link frame, rotor inertia [kg m^2]."""


def inertial_parameters(link: Link) -> np.ndarray:
    """Return a link's parameters (11,), in the order of PARAMETERS: I_origin = I_com + m (|c|^2 1 - c c^T)."""
    com = np.array(link.com)
    xx, yy, zz, xy, xz, yz = link.inertia
    about_origin = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) + point_inertia(link.mass, com)
    return np.r_[link.mass, link.mass * com, six_of(about_origin), link.rotor_inertia]


def with_inertial_parameters(link: Link, parameters: np.ndarray) -> Link:
    """The link with these parameters; a mass must be > 0, or every parameter 0."""
    mass = float(parameters[0])
    com = parameters[1:4] / mass if mass else np.zeros(3)
    xx, yy, zz, xy, xz, yz = parameters[4:10]
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) - point_inertia(mass, com)
    changed = Link()
    for name in ("joint_name", "parent", "type", "rotation", "translation"):
        setattr(changed, name, getattr(link, name))
    changed.mass, changed.com, changed.rotor_inertia = mass, com.tolist(), float(parameters[10])
    changed.inertia = six_of(inertia).tolist()
    return changed


def point_inertia(mass: float, arm: np.ndarray) -> np.ndarray:
    """m (|c|^2 1 - c c^T): inertia (3, 3) of a mass at the end of the arm (3,)."""
    return mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))


def six_of(inertia: np.ndarray) -> np.ndarray:
    """Return xx, yy, zz, xy, xz, yz of a symmetric (3, 3)."""
    return inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]


def with_more_at_end(tree: Tree, more: np.ndarray) -> Tree:
    """Return the tree with `more` (up to 11,) added to the first parameters of its last link."""
    links = tree.links
    parameters = inertial_parameters(links[-1])
    parameters[: len(more)] += more
    links[-1] = with_inertial_parameters(links[-1], parameters)
    return Tree(links, tree.gravity)
