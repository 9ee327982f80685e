"""A link's eleven inertial parameters, in which momentum and gravity are linear."""

from __future__ import annotations

import numpy as np

from tauext._core import Link

PARAMETERS = ("m", "hx", "hy", "hz", "Ixx", "Iyy", "Izz", "Ixy", "Ixz", "Iyz", "rotor")
"""Mass [kg], first moment m com [kg m], inertia about the joint's origin, in the link frame, rotor inertia [kg m^2]."""


def inertial_parameters(link: Link) -> np.ndarray:
    """(11,) in the order of PARAMETERS: I_origin = I_com + m (|c|^2 1 - c c^T)."""
    com = np.array(link.com)
    xx, yy, zz, xy, xz, yz = link.inertia
    about_origin = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    about_origin = about_origin + link.mass * (com @ com * np.eye(3) - np.outer(com, com))
    return np.r_[
        link.mass, link.mass * com, np.diag(about_origin), about_origin[[0, 0, 1], [1, 2, 2]], link.rotor_inertia
    ]


def with_inertial_parameters(link: Link, parameters: np.ndarray) -> Link:
    """The link with these parameters; a mass must be > 0, or every parameter 0."""
    mass = float(parameters[0])
    com = parameters[1:4] / mass if mass else np.zeros(3)
    xx, yy, zz, xy, xz, yz = parameters[4:10]
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    inertia = inertia - mass * (com @ com * np.eye(3) - np.outer(com, com))
    changed = Link()
    for name in ("joint_name", "parent", "type", "rotation", "translation"):
        setattr(changed, name, getattr(link, name))
    changed.mass, changed.com, changed.rotor_inertia = mass, com.tolist(), float(parameters[10])
    changed.inertia = [float(inertia[k]) for k in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
    return changed
