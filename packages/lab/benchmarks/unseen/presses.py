"""Arms that press their tool on a surface, at rest and sliding, and are hit meanwhile."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from tauext_lab.sim.arms import rig_arm
from tauext_lab.sim.config import RigConfig
from tauext_lab.sim.contacts import log_uniform
from tauext_lab.sim.rig import arm_xml, low_pass

from tauext import _core
from tauext.data.recording import Recording
from tauext.monitor.source import SourceFacts, SourceSettings
from tauext.robot.read import load_tree
from unseen.arms import Maker, TrueArm, arm_of, direction
from unseen.recordings import logged, told_constants
from unseen.simulation import (
    LINK_RADIUS_M,
    PRESLIDING,
    RATE_HZ,
    Contact,
    Kinematics,
    Pressing,
    Setpoints,
    Way,
    reach_of,
    simulate,
)  # fmt: skip
from unseen.working import recording_of

# --- The arms, each with a tool at the end of its last link.


TOOL_M = 0.15
"""From the last joint's origin along its axis to the tool's tip."""
CONE_DEG = 30.0
WARM_S = 7200.0


@dataclass(frozen=True)
class Signals:
    """Measured signals and the truth at the controller's rate."""

    t_ns: np.ndarray
    measured: dict[str, np.ndarray]
    """By their names in a Recording, (samples, joints)."""
    tau_ext: np.ndarray
    """(samples, joints), [N m]."""
    tool_n: np.ndarray
    """Force of the surface on the arm, base axes, (samples, 3), [N]."""


@dataclass(frozen=True)
class Presser:
    """An arm that presses its tool on surfaces, and what its integrator declares of it."""

    maker: Maker
    tree: _core.Tree
    """Of the true arm."""
    coulomb_nm: np.ndarray
    facts: SourceFacts
    record: Callable[[Session, Pressing | None, np.random.Generator], Signals]
    axis: tuple[float, float, float]
    """Direction of the force on the arm, in the last link's axes."""
    tip_m: tuple[float, float, float]
    points: Callable[[int, float], np.ndarray]
    """On a link, by the share of its length, in its axes, [m]."""
    half_angle_deg: float = CONE_DEG
    friction: tuple[float, float] = (0.1, 0.35)
    """Of the surface against the tool that slides."""
    forces_n: tuple[float, ...] = (5.0, 20.0, 40.0)
    hits_n: tuple[float, float] = (5.0, 250.0)
    hit_factor: float = 1.0
    """On the strengths of hits, where limits are high beside the friction."""
    plane: tuple[float, float, float] | None = None
    """Normal of the plane in which alone the arm moves; None: it moves in space."""


def recorder(
    maker: Maker, arm: TrueArm, known: _core.Tree, constants: np.ndarray | float
) -> Callable[[Session, Pressing | None, np.random.Generator], Signals]:
    """Simulates sessions of an arm of unseen.arms.

    Args:
        known: the maker's model as the drive uses it, without rotors.
        constants: by which measured currents are multiplied.
    """

    def record(session: Session, surface: Pressing | None, rng: np.random.Generator) -> Signals:
        run = simulate(arm, known, session.setpoints, maker.torque_nm, session.hits, WARM_S, surface)
        measured, keep = logged(maker, arm, run, constants, rng), slice(0, None, RATE_HZ // maker.rate_hz)
        return Signals(measured.pop("t_ns"), measured, run.tau_ext[keep], run.tool_n[keep])

    return record


def torque_facts(maker: Maker, known: bool = True) -> SourceFacts:
    """Of a controller that reports torques in N m, or in amperes where the constants are unknown."""
    unit, kind = ("N m", "torque") if known else ("A", "current")
    period_ns = round(1e9 / maker.rate_hz)
    return SourceFacts(SourceSettings(maker.joints, period_ns, (unit,) * len(maker.joints), "held"), kind, False)


def current_presser(maker: Maker, presliding: str = PRESLIDING[0]) -> Presser:
    """An arm of unseen.arms: a wrong URDF, motor currents, and a model of the friction at rest."""
    arm, constants = replace(arm_of(maker, 0), presliding=presliding), told_constants(maker, 0, True)

    def point(link: int, share: float) -> np.ndarray:
        return reach_of(arm.tree, link, share) + [LINK_RADIUS_M, 0, 0]

    given = constants != "unknown"
    record = recorder(
        maker, arm, load_tree(maker.model, maker.joints), np.array(constants, dtype=float) if given else 1.0
    )
    return Presser(
        maker, arm.tree, arm.coulomb_nm, torque_facts(maker, given), record, (0.0, 0.0, -1.0), (0.0, 0.0, TOOL_M), point
    )


def rig_presser(folder: Path) -> Presser:
    """The paper's rig with its friction and noise, and a model that is nearly right.

    Its drives are those of unseen.arms without their integral part.

    Its tool rolls on the surface: two joints cannot separate the friction of a surface from a hit.
    """
    config, maker = RigConfig(), rig_maker(folder)
    folder.mkdir(parents=True, exist_ok=True)
    maker.model.write_text(arm_xml(config))
    true = folder / "true.xml"
    true.write_text(arm_xml(config, true_com=True))
    known, friction = load_tree(maker.model, maker.joints), config.friction
    links = known.links
    for link in links:
        link.rotor_inertia = 0.0
    none, length_m = np.zeros(len(friction)), config.links[-1].length_m

    def of(value: Callable[[Any], float]) -> np.ndarray:
        return np.array([value(one) for one in friction])

    arm = TrueArm(
        load_tree(true, maker.joints),
        of(lambda one: one.coulomb_nm),
        of(lambda one: one.viscous_nm_s_rad),
        none,
        of(lambda one: one.static_nm / one.coulomb_nm),
        of(lambda one: one.stribeck_rad_s),
        of(lambda one: one.static_nm / one.bristle_nm_rad),
        of(lambda one: one.load_share),
        none,
        1.0,
        of(lambda one: one.ripple_nm),
        of(lambda one: one.ripple_cycles),
        none,
        none + 1.0,
        current_filter_s=1e-4,
        current_step_a=1e-3,
        current_noise_a=np.array(config.sensors.torque_noise_nm),  # type: ignore[arg-type]
        integral_per_s=0.0,
    )
    along = np.array([0.0, -1.0, 0.0])

    def point(link: int, share: float) -> np.ndarray:
        return share * config.links[link].length_m * along

    record = recorder(maker, arm, _core.Tree(links, known.gravity), 1.0)
    return Presser(
        maker, arm.tree, arm.coulomb_nm, torque_facts(maker), record, (1.0, 0.0, 0.0), tuple(length_m * along), point,
        0.0, (0.0, 0.0), hit_factor=3.0, plane=(0.0, 1.0, 0.0),
    )  # fmt: skip


def rig_maker(folder: Path) -> Maker:
    """The rig as a `Maker`."""
    two, joints = (0.0,) * 2, rig_arm().joints
    return Maker(
        "rig", folder / "in.xml", joints, 1000, (-np.pi,) * 2, (np.pi,) * 2, (1.6, 1.6), (200.0, 100.0),
        two, two, two, (1.0, 1.0), 17, True, True,
    )  # fmt: skip


# --- What an arm does: it goes somewhere, presses at rest or sliding, and goes on.


PRESS_RISES_S, HOLDS_S, STANDS_S = (0.2, 1.0), (24.0, 34.0), (0.6, 1.2)
STATES = ("still", "sliding", "still, uneven force")
MARGIN_S = 0.3
"""By which a declared contact begins before the force and ends after it."""
SLIDES_RAD, SLIDE_SPEEDS = 0.25, (0.02, 0.25)
"""Way of a joint in a stroke, at most, and share of its most speed."""
AT_M = 0.005
"""By so much the tool touches aside from the declared point, along each axis."""
UNEVEN, UNEVEN_HZ = 0.04, 3.0
"""Standard deviation of the force as a share of it, and how fast it varies."""
CHATTER, CHATTER_HZ = 0.03, (12.0, 40.0)
"""Of a tool that slides: amplitude as a share of the force."""
AFTER_HIT_S = 3.0
SLOT_S = 6.5
KINDS = {"impact": (0.03, 0.1), "slow push": (1.0, 2.0)}
"""Duration of hits, [s]."""
SHAPES = {"impact": "impact", "slow push": "hold"}
"""Their shape by `Contact`: a half sine; ramps of 0.3 s."""


@dataclass(frozen=True)
class Press:
    """The tool presses on a surface once."""

    from_s: float
    to_s: float
    rise_s: float
    force_n: float
    friction: float
    at_m: tuple[float, float, float]
    state: str
    """Of STATES."""
    chatter_hz: float

    @property
    def declared_s(self) -> tuple[float, float]:
        return self.from_s - MARGIN_S, self.to_s + MARGIN_S


@dataclass(frozen=True)
class Session:
    """Some minutes of an arm's work."""

    setpoints: Setpoints
    presses: list[Press]
    hits: list[Contact] = field(default_factory=list)

    @property
    def samples(self) -> int:
        return len(self.setpoints[0])


def draw_session(presser: Presser, minutes: float, rng: np.random.Generator) -> Session:
    """Presses in each state in turn, each with the next force."""
    maker, way, presses = presser.maker, Way(presser.maker, rng), []
    way.stand(1.0)
    while way.now_s < 60 * minutes:
        way.go(rng.uniform(way.low, way.high))
        way.stand(rng.uniform(*STANDS_S))
        state = STATES[len(presses) % len(STATES)]
        rise_s, start, centre = rng.uniform(*PRESS_RISES_S), way.now_s, way.here
        end = start + 2 * rise_s + rng.uniform(*HOLDS_S)
        while state == "sliding" and way.now_s < end - 1.5:
            there = np.clip(centre + rng.uniform(-SLIDES_RAD, SLIDES_RAD, len(centre)), way.low, way.high)
            speed = np.array(maker.speed_rad_s) * rng.uniform(*SLIDE_SPEEDS)
            way.go(there, max(0.4, 15 / 8 * float((np.abs(there - way.here) / speed).max())))
            if rng.uniform() < 0.3:
                way.stand(rng.uniform(0.1, 0.6))
        end = max(end, way.now_s)
        way.stand(end - way.now_s + rng.uniform(*STANDS_S))
        force_n = presser.forces_n[len(presses) // len(STATES) % len(presser.forces_n)]
        at_m = tuple((np.array(presser.tip_m) + rng.uniform(-AT_M, AT_M, 3)).tolist())
        grip = rng.uniform(*presser.friction)
        presses.append(Press(start, end, rise_s, force_n, grip, at_m, state, rng.uniform(*CHATTER_HZ)))
    return Session(way.setpoints(), presses)


def pressing(presser: Presser, session: Session, rng: np.random.Generator) -> Pressing:
    """The forces of a session: a ramp up, a force that is uneven but on an arm that stands, a ramp down."""
    rows = np.zeros((session.samples, 5))
    rows[:, 2:] = presser.tip_m
    for press in session.presses:
        part = slice(round(press.from_s * RATE_HZ), round(press.to_s * RATE_HZ))
        t = np.arange(part.stop - part.start) / RATE_HZ
        ramp = np.minimum(1.0, np.minimum(t, t[-1] - t) / press.rise_s)
        uneven = low_pass(rng.standard_normal((len(t), 1)), 2 * np.pi * UNEVEN_HZ, 1 / RATE_HZ)[:, 0]
        share = np.ones(len(t))
        if press.state != "still":
            share += UNEVEN * uneven / max(float(uneven.std()), 1e-9)
        if press.state == "sliding":
            share += CHATTER * np.sin(2 * np.pi * press.chatter_hz * t + rng.uniform(0, 2 * np.pi))
        rows[part, 0] = press.force_n * ramp * np.maximum(share, 0.0)
        rows[part, 1], rows[part, 2:] = press.friction, press.at_m
    return Pressing(np.array(presser.axis), rows)


def draw_hits(
    presser: Presser, session: Session, strengths: dict[str, tuple[float, float]], rng: np.random.Generator
) -> list[Contact]:
    """Hits on each link in turn while the tool presses, anywhere on its length, in any direction.

    Args:
        strengths: range of the peak by kind, in torque at the joint that feels it most, over its Coulomb friction.
    """
    arm, hits = Kinematics(presser.tree), []
    for press in session.presses:
        start = press.from_s + press.rise_s + 2.0
        while start + SLOT_S < press.to_s - press.rise_s:
            link, kind = len(hits) % len(presser.maker.joints), str(rng.choice(list(KINDS)))
            seconds = rng.uniform(*KINDS[kind])
            begin, share = rng.uniform(start, start + SLOT_S - AFTER_HIT_S - seconds), rng.uniform(0.2, 1.0)
            at_m, along = presser.points(link, share), direction(rng)
            if presser.plane is not None:
                along -= (along @ presser.plane) * np.array(presser.plane)
                along /= np.linalg.norm(along)
            jacobian = arm.jacobian(link, at_m, session.setpoints[0][round(begin * RATE_HZ)])
            felt = float((np.abs(along @ jacobian) / presser.coulomb_nm).max())
            strength = presser.hit_factor * log_uniform(rng, strengths[kind])
            peak, when = float(np.clip(strength / max(felt, 1e-6), *presser.hits_n)), (begin, begin + seconds)
            way = tuple(along.tolist())
            hits.append(Contact(SHAPES[kind], *when, link, share, way, peak, when, tuple(at_m.tolist())))
            start += SLOT_S
    return hits


# --- What is recorded of it.


def signals_of(presser: Presser, session: Session, presses: bool, seed: Sequence[int]) -> Signals:
    """Simulate a session; without `presses` the same motion and the same hits in the air."""
    rng = np.random.default_rng(seed)
    return presser.record(session, pressing(presser, session, rng) if presses else None, rng)


def free_recording(presser: Presser, session: Session, name: str, seed: Sequence[int]) -> Recording:
    """The motion of a session in the air, as a source records it."""
    made = signals_of(presser, replace(session, hits=[]), False, seed)
    return recording_of(presser.facts, name, made.measured, np.zeros(len(made.t_ns)))
