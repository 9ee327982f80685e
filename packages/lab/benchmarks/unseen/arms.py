"""The arms of the trial: what an integrator knows of each, and by how much the true arm differs; arms of one type."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from common import ROOT

from tauext import _core
from tauext.robot.read import load_tree

HERE = Path(__file__).parent
RIPPLES_A_TURN = (100, 200, 202)
"""Of a strain-wave gear of ratio 100 and its motor, in a turn of the joint."""


@dataclass(frozen=True)
class Maker:
    """What a maker's data sheet would say; tuples run over the joints."""

    name: str
    model: Path
    joints: tuple[str, ...]
    rate_hz: int
    low_rad: tuple[float, ...]
    high_rad: tuple[float, ...]
    speed_rad_s: tuple[float, ...]
    torque_nm: tuple[float, ...]
    coulomb_nm: tuple[float, ...]
    viscous_nm_s_rad: tuple[float, ...]
    rotor_kg_m2: tuple[float, ...]
    nm_per_ampere: tuple[float, ...]
    """At the joint: torque constant times gear ratio."""
    encoder_bits: int
    measured_velocity: bool
    constants_known: bool
    """To 10 %; else the description says "unknown"."""
    stop_share: float = 0.0
    """Of the moves that are not slow, those that end in an abrupt stop, as where a program ends or is stopped."""
    stamp_jitter_s: float = 5e-5
    missing_share: float = 0.0
    """Of the samples, those that the log lacks."""
    own_seed: int | None = None
    """Draws another arm, motion and contacts; those without it share theirs."""
    fresh: bool = False
    """Of the arms that no method was fixed on: they are run once, afterwards."""
    type_seed: int | None = None
    """Draws what arms of one type share (arm_of_type); None: every arm is of a type of its own."""

    def random(self, seed: int, stream: int) -> np.random.Generator:
        """One of the arm's streams of draws: 0 the arm, 99 what the integrator believes, 1 + k take k."""
        own = () if self.own_seed is None else (self.own_seed,)
        return np.random.default_rng([seed, stream, *own])


@dataclass(frozen=True)
class TrueArm:
    """The true arm under its drives, which no integrator knows."""

    tree: _core.Tree
    coulomb_nm: np.ndarray
    viscous_nm_s_rad: np.ndarray
    asymmetry: np.ndarray
    """Share by which friction is larger in the positive direction."""
    static_share: np.ndarray
    stribeck_rad_s: np.ndarray
    presliding_rad: np.ndarray
    load_share: np.ndarray
    warm_drop: np.ndarray
    warm_s: float
    ripple_nm: np.ndarray
    """0: none."""
    ripple_cycles: np.ndarray
    ripple_phase_rad: np.ndarray
    nm_per_ampere: np.ndarray
    current_filter_s: float
    current_step_a: float
    current_noise_a: float
    integral_per_s: float = 8.0
    """Of the drives' speed loop."""
    presliding: str = "lugre"
    """How friction builds up at rest, of simulation.PRESLIDING."""


def makers(models: Path) -> dict[str, Maker]:
    """The arms by name.

    Friction of the UR5 scales what a UR3's currents show (Coulomb 1 to 4 Nm, viscous 0.7 to 5.4 Nms/rad) by its size;
    that of the Panda lies above the 0.3 to 1.3 Nm that Gaz et al. 2019 find behind its torque sensors, since a current
    sees the gear too. Rotor inertias are of servo motors of that size times 100 squared.

    Args:
        models: folder of ur5_robot.urdf, panda.urdf and kinova.urdf.
    """
    turn = np.pi
    ur5 = Maker(
        "ur5", models / "ur5_robot.urdf",
        ("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint"),
        125, (-2.6, -2.4, -2.3, -2.6, -2.4, -2.8), (2.6, -0.6, 2.3, 0.6, 2.4, 2.8), (turn,) * 6,
        (150, 150, 150, 28, 28, 28),
        (9.0, 10.0, 8.0, 2.6, 2.4, 2.2), (11.0, 13.0, 9.0, 2.4, 2.2, 2.0), (1.1, 1.1, 1.1, 0.13, 0.13, 0.13),
        (12.9, 12.9, 12.9, 9.2, 9.2, 9.2), 17, True, True,
    )  # fmt: skip
    panda = Maker(
        "panda", models / "panda.urdf", tuple(f"panda_joint{k}" for k in range(1, 8)),
        200, (-2.5, -1.5, -2.5, -2.8, -2.5, 0.2, -2.5), (2.5, 1.5, 2.5, -0.3, 2.5, 3.4, 2.5),
        (2.1, 2.1, 2.1, 2.1, 2.6, 2.6, 2.6), (87, 87, 87, 87, 12, 12, 12),
        (4.5, 5.0, 3.6, 4.0, 1.4, 1.1, 1.0), (5.0, 5.5, 4.0, 4.0, 1.3, 1.0, 0.9), (0.6, 0.6, 0.45, 0.45, 0.2, 0.2, 0.2),
        (10.5, 10.5, 10.5, 10.5, 6.0, 6.0, 6.0), 20, True, False,
    )  # fmt: skip
    kinova = Maker(
        "kinova", models / "kinova.urdf", tuple(f"j2s6s200_joint_{k}" for k in range(1, 7)),
        200, (-2.6, 1.2, 0.9, -2.6, 1.2, -2.6), (2.6, 4.9, 5.2, 2.6, 4.9, 2.6),
        (0.63, 0.63, 0.63, 0.84, 0.84, 0.84), (40, 80, 40, 20, 20, 20),
        (3.4, 4.6, 3.4, 1.3, 1.3, 1.2), (5.0, 7.0, 5.0, 2.0, 2.0, 1.8), (0.35, 0.6, 0.35, 0.1, 0.1, 0.1),
        (14.0, 20.0, 14.0, 8.0, 8.0, 8.0), 16, False, True,
    )  # fmt: skip
    seven = Maker(
        "seven_axis", ROOT / "benchmarks/seven_axis.urdf", tuple(f"joint{k}" for k in range(1, 8)),
        500, (-2.5, -1.7, -2.5, -1.9, -2.5, -1.9, -2.5), (2.5, 1.7, 2.5, 1.9, 2.5, 1.9, 2.5),
        (2.5, 2.5, 2.5, 2.5, 2.8, 2.8, 2.8), (90, 90, 60, 60, 30, 15, 15),
        (7.0, 8.0, 5.0, 5.0, 2.4, 1.8, 1.5), (7.0, 8.0, 5.0, 5.0, 2.2, 1.5, 1.2),
        (0.6, 0.6, 0.45, 0.45, 0.2, 0.12, 0.12),
        (11.0, 11.0, 8.0, 8.0, 6.0, 5.0, 5.0), 19, True, True,
    )  # fmt: skip
    return {maker.name: maker for maker in (ur5, panda, kinova, seven)}


def true_arm(maker: Maker, rng: np.random.Generator, tool: bool = True) -> TrueArm:
    """An arm that could have left the maker's works: every number drawn once, from ranges found in the literature.

    Load and temperature: Bittencourt et al. 2010; warming by 10 to 15 % in minutes: Simoni et al. 2019; Stribeck and
    presliding of strain-wave gears: Wolf and Iskandar 2018.
    """
    n = len(maker.joints)
    links = []
    for link in load_tree(maker.model, maker.joints).links:
        share = rng.uniform(0.8, 1.2)
        link.mass *= share
        link.inertia = [share * x for x in link.inertia]
        link.com = (np.array(link.com) + rng.uniform(0, 0.02) * direction(rng)).tolist()
        links.append(link)
    if tool:
        add_tool(links[-1], rng)
    for link, rotor in zip(links, maker.rotor_kg_m2, strict=True):
        link.rotor_inertia = rotor * rng.uniform(0.8, 1.2)
    coulomb = np.array(maker.coulomb_nm) * rng.uniform(0.7, 1.3, n)
    return TrueArm(
        tree=_core.Tree(links, [0, 0, -9.81]),
        coulomb_nm=coulomb,
        viscous_nm_s_rad=np.array(maker.viscous_nm_s_rad) * rng.uniform(0.7, 1.3, n),
        asymmetry=rng.uniform(-0.05, 0.05, n),
        static_share=rng.uniform(1.05, 1.35, n),
        stribeck_rad_s=rng.uniform(0.01, 0.06, n),
        presliding_rad=rng.uniform(3e-4, 1.5e-3, n),
        load_share=rng.uniform(0.02, 0.06, n),
        warm_drop=rng.uniform(0.10, 0.15, n),
        warm_s=rng.uniform(180, 400),
        ripple_nm=np.where(rng.uniform(size=n) < 0.6, 0.06 * coulomb * rng.uniform(0.5, 1.5, n), 0.0),
        ripple_cycles=rng.choice(RIPPLES_A_TURN, n),
        ripple_phase_rad=np.arange(n) * 1.0,
        nm_per_ampere=np.array(maker.nm_per_ampere) * rng.uniform(0.92, 1.08, n),
        current_filter_s=rng.uniform(0.002, 0.005),
        current_step_a=rng.uniform(0.01, 0.02),
        current_noise_a=rng.uniform(0.01, 0.02),
    )


def with_ball(
    mass_kg: float, com_m: np.ndarray, inertia: np.ndarray, ball_kg: float, at_m: np.ndarray, radius_m: float
) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass, centre of mass (3,) and inertia about it (3, 3) of a body with a ball fixed to it."""
    both = (mass_kg * com_m + ball_kg * at_m) / (mass_kg + ball_kg)
    inertia = inertia + 0.4 * ball_kg * radius_m**2 * np.eye(3)
    for one, place in ((mass_kg, com_m), (ball_kg, at_m)):
        arm = place - both
        inertia += one * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    return mass_kg + ball_kg, both, inertia


def add_ball(link: _core.Link, ball_kg: float, at_m: np.ndarray, radius_m: float) -> None:
    """Fix a ball to a link."""
    xx, yy, zz, xy, xz, yz = link.inertia
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    link.mass, com, inertia = with_ball(link.mass, np.array(link.com), inertia, ball_kg, at_m, radius_m)
    link.com, link.inertia = com.tolist(), [float(inertia[k]) for k in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]


def direction(rng: np.random.Generator) -> np.ndarray:
    """A unit vector, even over the sphere."""
    x = rng.standard_normal(3)
    return x / np.linalg.norm(x)


def add_tool(link: _core.Link, rng: np.random.Generator) -> None:
    """A ball of 6 cm fixed to the last link, of a mass and at a place that are drawn."""
    add_ball(link, rng.uniform(0.5, 1.5), np.append(rng.uniform(-0.03, 0.03, 2), rng.uniform(0.05, 0.14)), 0.06)


# --- Arms that no method was fixed on: other kinematics, rates and stamps, and programs that end in abrupt stops.


STOP_SHARE = 0.25
JITTER_SHARE = 0.1
"""Standard deviation of a stamp, of the sample period."""


def fresh_makers() -> dict[str, Maker]:
    """The arms by name; their friction and rotors have the sizes of the others' beside their torque."""
    palletizer = Maker(
        "palletizer", HERE / "palletizer.urdf", tuple(f"joint{k}" for k in range(1, 6)),
        100, (-2.6, -0.9, -1.0, -1.6, -3.0), (2.6, 1.2, 1.1, 1.6, 3.0), (2.4, 2.0, 2.2, 2.8, 4.0),
        (350, 380, 240, 70, 35),
        (12.0, 14.0, 10.0, 4.0, 2.0), (13.0, 15.0, 10.0, 3.5, 1.5), (1.5, 1.7, 1.1, 0.25, 0.1),
        (18.0, 18.0, 15.0, 9.0, 7.0), 17, False, True,
        stop_share=STOP_SHARE, stamp_jitter_s=JITTER_SHARE / 100, missing_share=0.03, own_seed=5, fresh=True,
    )  # fmt: skip
    offset_wrist = Maker(
        "offset_wrist", HERE / "offset_wrist.urdf", tuple(f"joint{k}" for k in range(1, 7)),
        250, (-2.7, -1.0, -1.1, -2.6, -1.9, -3.0), (2.7, 1.2, 1.0, 2.6, 1.9, 3.0), (2.6, 2.2, 2.6, 3.6, 3.6, 4.5),
        (320, 380, 220, 70, 60, 35),
        (13.0, 16.0, 10.0, 3.5, 3.0, 1.8), (15.0, 17.0, 10.0, 3.2, 2.6, 1.4), (1.6, 1.8, 1.1, 0.25, 0.2, 0.1),
        (16.0, 16.0, 13.0, 8.0, 7.5, 6.0), 19, True, False,
        stop_share=STOP_SHARE, stamp_jitter_s=JITTER_SHARE / 250, own_seed=6, fresh=True,
    )  # fmt: skip
    light_arm = Maker(
        "light_arm", HERE / "light_arm.urdf", tuple(f"joint{k}" for k in range(1, 8)),
        1000, (-2.6, -1.6, -2.6, -2.0, -2.6, -1.8, -2.8), (2.6, 1.6, 2.6, 2.0, 2.6, 1.8, 2.8),
        (2.8, 2.8, 3.1, 3.1, 3.5, 3.5, 4.0), (45, 45, 28, 28, 12, 10, 8),
        (2.2, 2.4, 1.4, 1.5, 0.6, 0.5, 0.4), (2.0, 2.2, 1.3, 1.3, 0.5, 0.4, 0.3),
        (0.16, 0.16, 0.09, 0.09, 0.03, 0.025, 0.02),
        (6.0, 6.0, 5.0, 5.0, 3.0, 2.6, 2.4), 14, False, True,
        stop_share=STOP_SHARE, stamp_jitter_s=JITTER_SHARE / 1000, own_seed=7, fresh=True,
    )  # fmt: skip
    return {maker.name: maker for maker in (palletizer, offset_wrist, light_arm)}


# --- Arms of one type: links, gears and drives they share; friction, tool and constants are each arm's own.


MASSES = (0.99, 1.01)
"""Of links from the same moulds."""
FRICTION = (0.7, 1.3)
"""Of a joint, by that of the type: all of it ..."""
APART = (0.9, 1.1)
"""... and its parts beside that."""
CONSTANTS = (0.92, 1.08)


def arm_of(maker: Maker, seed: int) -> TrueArm:
    """The arm that `seed` drew: of its type, where the maker names one."""
    rng = maker.random(seed, 0)
    return true_arm(maker, rng) if maker.type_seed is None else arm_of_type(maker, rng)


def arm_of_type(maker: Maker, rng: np.random.Generator) -> TrueArm:
    """One arm of the type that maker.type_seed drew.

    Ripple has the type's numbers of cycles; how large it is, and its phase, follow from how a gear was put together.
    """
    assert maker.type_seed is not None
    of_type = true_arm(maker, np.random.default_rng([maker.type_seed, 7]), tool=False)
    n = len(maker.joints)
    links = of_type.tree.links
    for link in links:
        share = rng.uniform(*MASSES)
        link.mass *= share
        link.inertia = [share * x for x in link.inertia]
    add_tool(links[-1], rng)
    friction = rng.uniform(*FRICTION, n)
    return replace(
        of_type,
        tree=_core.Tree(links, of_type.tree.gravity),
        coulomb_nm=of_type.coulomb_nm * friction * rng.uniform(*APART, n),
        viscous_nm_s_rad=of_type.viscous_nm_s_rad * friction * rng.uniform(*APART, n),
        asymmetry=rng.uniform(-0.05, 0.05, n),
        static_share=of_type.static_share * rng.uniform(0.97, 1.03, n),
        stribeck_rad_s=of_type.stribeck_rad_s * rng.uniform(*APART, n),
        presliding_rad=of_type.presliding_rad * rng.uniform(*APART, n),
        load_share=of_type.load_share * rng.uniform(*APART, n),
        warm_drop=rng.uniform(0.10, 0.15, n),
        warm_s=rng.uniform(180, 400),
        ripple_nm=of_type.ripple_nm * rng.uniform(0.5, 1.5, n),
        ripple_phase_rad=rng.uniform(0, 2 * np.pi, n),
        nm_per_ampere=np.array(maker.nm_per_ampere) * rng.uniform(*CONSTANTS, n),
    )
