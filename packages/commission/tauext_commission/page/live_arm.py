"""The arm that a live page draws: links and shapes of a robot file as plain JSON. The browser computes its poses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from tauext import _core
from tauext.errors import TauextError

THIN = 0.12
"""Radius of a link without a shape, by its length."""


def arm_facts(robot: Path | None, joints: tuple[str, ...]) -> dict[str, Any]:
    """Links and shapes by the number of their joint; no links where there is no model, which the page draws as bars.

    Args:
        robot: URDF or MJCF; None: there is none.
    """
    from tauext.robot.capsules import link_capsules
    from tauext.robot.read import load_tree
    from tauext.robot.write import is_placeholder

    nothing: dict[str, Any] = {"joints": list(joints), "links": [], "shapes": [], "notes": []}
    if robot is None or is_placeholder(robot):
        return nothing
    try:
        tree = load_tree(robot, joints)
        capsules, notes = link_capsules(robot, tree)
    except TauextError as error:
        return nothing | {"notes": [str(error)]}
    links = [
        {
            "parent": link.parent,
            "slides": link.type == _core.JointType.prismatic,
            "rotation": list(link.rotation),
            "translation": list(link.translation),
        }
        for link in tree.links
    ]
    shapes = [
        {"link": one.link, "start": list(one.start), "end": list(one.end), "radius": one.radius_m} for one in capsules
    ]
    bare = set(range(len(links))) - {one.link for one in capsules}
    return nothing | {"links": links, "shapes": shapes + sticks(tree.links, bare), "notes": notes}


def sticks(links: list[_core.Link], bare: set[int]) -> list[dict[str, Any]]:
    """A capsule from the joint of each of these links to every joint that it carries, else to its centre of mass."""
    found = []
    for number in sorted(bare):
        ends = [list(link.translation) for link in links if link.parent == number] or [list(links[number].com)]
        for end in ends:
            length = float(np.linalg.norm(end))
            if length > 0:
                found.append({"link": number, "start": [0.0, 0.0, 0.0], "end": end, "radius": THIN * length})
    return found
