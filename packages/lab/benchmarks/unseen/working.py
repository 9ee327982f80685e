"""Arms that work for days: their motion in stretches of ten minutes, each with touches that nobody reports."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from tauext_lab.sim.arms import rig_arm
from tauext_lab.sim.collect import SETTLE_S, measure, simulate_motion
from tauext_lab.sim.collect import draw_motion as rig_motion
from tauext_lab.sim.config import LinkConfig, RigConfig, changed_friction
from tauext_lab.sim.rig import encoder
from tauext_lab.sim.servo_arm import COUNTS, ServoArm
from tauext_lab.sim.source import servo_facts_of_so101

from tauext import _core
from tauext.data.recording import Recording
from tauext.monitor.source import Block, ServoStage, SourceFacts, SourceSettings
from tauext.robot.read import load_tree
from unseen.arms import Maker, TrueArm, add_ball, arm_of, fresh_makers, with_ball
from unseen.recordings import Take, logged
from unseen.servos import (
    DUTY_STEP,
    SUPPLY_NOISE_A,
    SUPPLY_STEP_A,
    TOUCHED_NM,
    VOLTAGE_STEP_V,
    ServoRun,
    draw_touches,
    servo_arm,
    simulate_servos,
    so101,
)
from unseen.simulation import RATE_HZ, draw_contacts, draw_motion, simulate

STRETCH_S = 600.0
PROGRAMS, REPEATED = 4, 0.5
"""Half of the stretches repeat one of four programs; the others move as never before."""
BALL_M = 0.05
WARM_S = 400.0
"""Time constant of an arm's gears that has none of its own."""


@dataclass(frozen=True)
class Part:
    """Some hours of work from a cold start."""

    name: str
    hours: float
    load: int = 0
    """0: none, 1 and 2: the arm's two loads."""
    tool: bool = False
    """Whether the tool is another one."""


@dataclass(frozen=True)
class Working:
    """An arm at its work."""

    facts: SourceFacts
    robot: Path | None
    """Robot file that its integrator has."""
    robot_text: str
    """Its content where it is made here; empty: the file exists."""
    loads_kg: tuple[float, float]
    stretch: Callable[[int, int, Part, float, int], Recording]
    """Makes STRETCH_S of motion from stamp 0 with true torque and true contacts, from seed, number, part, time since
    the cold start [s] and number of touches."""


def program(seed: int, number: int) -> np.random.Generator:
    """Draws of a stretch's motion: one of the programs, or motion of its own."""
    rng = np.random.default_rng([seed, 1, number])
    if rng.uniform() < REPEATED:
        return np.random.default_rng([seed, 2, int(rng.integers(PROGRAMS))])
    return rng


def recording_of(facts: SourceFacts, name: str, signals: dict[str, np.ndarray], touched: np.ndarray) -> Recording:
    """Signals by the names of a recording, one row a sample."""
    settings = facts.settings
    return Recording(
        name=name,
        joints=settings.joints,
        t_ns=np.arange(len(touched), dtype=np.int64) * settings.period_ns,
        rate_hz=1e9 / settings.period_ns,
        torque_timing="held",
        source="simulated",
        robot_sha256="",
        provenance={},
        contact=touched.astype(np.int8),
        **signals,
    )


# --- Arms with motor currents and a URDF that is not quite right.


TOUCHED_NM_ARM = 0.5
"""A force that no joint feels with so much touches nothing."""


def current_arm(maker: Maker, seed: int, loads_kg: tuple[float, float], model: bool) -> Working:
    """An arm of unseen.arms; without `model` its integrator has no robot file."""
    units = ("A",) * len(maker.joints)
    facts = SourceFacts(SourceSettings(maker.joints, round(1e9 / maker.rate_hz), units, "held"), "current", False)
    known, bare = load_tree(maker.model, maker.joints), arm_of(maker, seed)

    def arm_in(part: Part) -> TrueArm:
        links = bare.tree.links
        if part.tool:
            add_ball(links[-1], loads_kg[0], np.array([0.03, 0.05, 0.09]), BALL_M)
        if part.load:
            add_ball(links[-1], loads_kg[part.load - 1], np.array([0.0, 0.0, 0.12]), BALL_M)
        return replace(bare, tree=_core.Tree(links, bare.tree.gravity))

    def make(seed: int, number: int, part: Part, warm_s: float, touches: int) -> Recording:
        arm, moving, rng = arm_in(part), program(seed, number), np.random.default_rng([seed, 3, number])
        setpoints = draw_motion(maker, round(STRETCH_S * RATE_HZ), RATE_HZ, moving)
        contacts = draw_contacts(touches, STRETCH_S, len(maker.joints), rng)
        run = simulate(arm, known, setpoints, maker.torque_nm, contacts, warm_s)
        kept = logged(maker, arm, run, 1.0, rng)
        kept["tau_ext"] = np.ascontiguousarray(run.tau_ext[:: RATE_HZ // maker.rate_hz])
        del kept["t_ns"]
        touched = (np.abs(kept["tau_ext"]) > TOUCHED_NM_ARM).any(axis=1)
        return recording_of(facts, f"stretch-{number:04d}", kept, touched)

    return Working(facts, maker.model if model else None, "", loads_kg, make)


# --- The paper's rig: torques in N m, and a right model.


RIG_LOADS_KG = (0.5, 1.0)
RIG_COLD = 1.15
"""Friction of the cold rig, times that of the warm one."""


def rig() -> Working:
    arm = rig_arm()
    settings = SourceSettings(arm.joints, 1_000_000, ("N m",) * len(arm.joints), "held")
    facts = SourceFacts(settings, "torque", False)

    def make(seed: int, number: int, part: Part, warm_s: float, touches: int) -> Recording:
        config = RigConfig()
        factor = 1 + (RIG_COLD - 1) * np.exp(-(warm_s + STRETCH_S / 2) / WARM_S)
        held = (RIG_LOADS_KG[0] if part.tool else 0.0) + (RIG_LOADS_KG[part.load - 1] if part.load else 0.0)
        config = replace(
            config,
            links=(*config.links[:-1], with_weight(config.links[-1], held)),
            friction=changed_friction(config.friction, float(factor)),
            collisions_per_recording=touches,
        )
        settle, rng = round(SETTLE_S * RATE_HZ), np.random.default_rng([seed, 3, number])
        samples = round(STRETCH_S * RATE_HZ)
        setpoints = rig_motion(config.motion, len(config.links), samples + settle, RATE_HZ, program(seed, number))
        truth, tau_ext, force = simulate_motion(config, "pulses" if touches else "free", *setpoints, settle, rng)
        measured = measure(config, truth, tau_ext, rng)
        signals = {name: measured[name] for name in ("q", "dq", "tau")} | {"tau_ext": tau_ext}
        return recording_of(facts, f"stretch-{number:04d}", signals, (force > 0).any(axis=1))

    return Working(facts, Path("robot.xml"), arm.xml, RIG_LOADS_KG, make)


def with_weight(link: LinkConfig, kg: float) -> LinkConfig:
    """A link of the rig with a weight at its end."""
    along = np.array([1.0, 0, 0])
    own = link.mass_kg, link.com_m * along, np.eye(3) * link.inertia_kg_m2
    mass, com, inertia = with_ball(*own, kg, link.length_m * along, BALL_M)
    return replace(link, mass_kg=mass, com_m=float(com[0]), inertia_kg_m2=float(inertia[2, 2]))


# --- An arm of hobby servos: registers of duty at 50 Hz.


SO101_LOADS_KG = (0.06, 0.12)
COLD_GREASE = 1.3


def servo_signals(settings: SourceSettings, run: ServoRun, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Registers of a run, and the velocity and torque that a source computes from them, (samples, joints)."""
    true = run.signals
    ampere = np.abs(true["supply_a"]) + SUPPLY_NOISE_A * rng.standard_normal(true["q"].shape)
    volts = np.round(run.volts / VOLTAGE_STEP_V)[:, None] * VOLTAGE_STEP_V
    registers = {
        "q": encoder(true["q"], COUNTS),
        "q_des": true["goal"],
        "current": np.round(np.maximum(ampere, 0) / SUPPLY_STEP_A) * SUPPLY_STEP_A,
        "duty": np.round(true["duty"] / DUTY_STEP) * DUTY_STEP,
        "voltage": np.repeat(volts, true["q"].shape[1], axis=1),
    }
    assert settings.servo is not None
    t_ns = np.arange(len(run.ticks)) * settings.period_ns
    unknown = np.full_like(true["q"], np.nan)
    block = Block(t_ns, dq=true["speed"], tau=unknown, received_ns=t_ns, **registers)
    made = ServoStage(settings.servo).made(block)
    signals = registers | {"dq": made.dq, "tau": made.tau}
    signals["dq"][0], signals["tau"][0] = 0.0, signals["tau"][1]  # a derived velocity begins with the second sample
    return signals


def servos() -> Working:
    facts, maker = servo_facts_of_so101(), so101()
    settings = facts.settings
    bare = servo_arm(maker, 0)

    def arm_in(part: Part, warm_s: float) -> ServoArm:
        links = bare.tree.links
        held = (SO101_LOADS_KG[0] if part.tool else 0.0) + (SO101_LOADS_KG[part.load - 1] if part.load else 0.0)
        if held:
            add_ball(links[-1], held, np.array([0.0, 0.0, 0.08]), 0.02)
        factor = 1 + (COLD_GREASE - 1) * np.exp(-(warm_s + STRETCH_S / 2) / WARM_S)
        greased = replace(
            bare.servos,
            coulomb_nm=factor * bare.servos.coulomb_nm,
            viscous_nm_s_rad=factor * bare.servos.viscous_nm_s_rad,
        )
        return replace(bare, tree=_core.Tree(links, bare.tree.gravity), servos=greased)

    def make(seed: int, number: int, part: Part, warm_s: float, touches: int) -> Recording:
        arm, rng, rate_hz = arm_in(part, warm_s), np.random.default_rng([seed, 3, number]), maker.rate_hz
        take = Take("stretch", "", STRETCH_S / 60, touches)
        goals = draw_motion(maker, round(STRETCH_S * RATE_HZ), RATE_HZ, program(seed, number))[0]
        at = np.arange(round(STRETCH_S * rate_hz)) * (RATE_HZ // rate_hz)
        run = simulate_servos(arm, goals[at], rate_hz, draw_touches(maker, arm, take, rng))
        signals = servo_signals(settings, run, rng) | {"tau_ext": run.signals["tau_ext"]}
        touched = (np.abs(signals["tau_ext"]) > TOUCHED_NM).any(axis=1)
        return recording_of(facts, f"stretch-{number:04d}", signals, touched)

    return Working(facts, maker.model, "", SO101_LOADS_KG, make)


# --- By name.


LOADS_KG = {"palletizer": (4.0, 8.0), "offset_wrist": (3.0, 6.0), "light_arm": (0.7, 1.4)}
NAMES = ("rig", *LOADS_KG, "so101")


def working(name: str, seed: int, model: bool = True) -> Working:
    """The arm of this name at its work; without `model` no robot file is given."""
    if name == "rig":
        made = rig()
    elif name == "so101":
        made = servos()
    else:
        return current_arm(fresh_makers()[name], seed, LOADS_KG[name], model)
    return made if model else replace(made, robot=None, robot_text="")
