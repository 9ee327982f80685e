"""A low-cost servo arm as its user meets it: a URDF that is roughly right, and servos of which each differs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tauext import _core
from tauext.robot.load import load_tree
from unseen.arms import Maker, true_arm
from unseen.servos import Servos, drawn

SUPPLY_V = (7.2, 7.6)
SUPPLY_OHM = (0.1, 0.25)
"""Of the supply and its thin cables: the voltage sags by what all servos draw."""


def so101(own_seed: int = 101) -> Maker:
    """The arm as a `Maker`. What the others have of friction, currents and constants is the servos' business here."""
    none, two_three = (0.0,) * 5, (2.3,) * 5
    return Maker(
        "so101", Path(__file__).parent / "so101.urdf",
        ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll"),
        50, (-1.5, -1.0, 0.1, -1.3, -2.2), (1.5, 1.2, 2.1, 1.3, 2.2), two_three, (3.4,) * 5,
        none, none, (0.0216,) * 5, (1.275,) * 5, 12, True, True, stop_share=0.15, own_seed=own_seed,
    )  # fmt: skip


@dataclass(frozen=True)
class ServoArm:
    """What nobody knows of it."""

    tree: _core.Tree
    servos: Servos
    volts: float
    supply_ohm: float


def servo_arm(maker: Maker, seed: int) -> ServoArm:
    """An arm that could have come out of the box: links off by up to 20 % and 1 cm, servos by 10 to 20 %."""
    rng = maker.random(seed, 0)
    tree = true_arm(maker, rng, tool=False).tree
    servos = drawn(len(maker.joints), rng)
    links = tree.links
    for link, rotor, known in zip(links, servos.rotor_kg_m2, _known_places(maker), strict=True):
        link.rotor_inertia = rotor
        link.com = [0.5 * (a + b) for a, b in zip(link.com, known, strict=True)]
    return ServoArm(_core.Tree(links, tree.gravity), servos, rng.uniform(*SUPPLY_V), rng.uniform(*SUPPLY_OHM))


def _known_places(maker: Maker) -> list[list[float]]:
    return [list(link.com) for link in load_tree(maker.model, maker.joints).links]
