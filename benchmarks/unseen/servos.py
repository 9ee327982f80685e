"""Recordings of a low-cost servo arm of tauext.sim.servo_arm, stepped by compiled code, with touches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from tauext import _core
from tauext.robot.read import load_tree
from tauext.sim.rig import encoder
from tauext.sim.servo_arm import (
    COMMAND_TICKS,
    COUNT_RAD,
    COUNTS,
    HIGH_RAD,
    LOW_RAD,
    OUTPUT_SHARE,
    SO101_FILE,
    SO101_JOINTS,
    SUPPLY_OHM,
    SUPPLY_V,
    TICKS_HZ,
    ServoArm,
    backlash_model,
    drawn,
)
from unseen.arms import Maker, true_arm
from unseen.compiled import NUMBER, POINTER, WHOLE, address, compiled

# --- A low-cost servo arm as its user meets it: a URDF that is roughly right, and servos of which each differs.


def so101(own_seed: int = 101) -> Maker:
    """The arm as a `Maker`. What the others have of friction, currents and constants is the servos' business here."""
    none, two_three = (0.0,) * 5, (2.3,) * 5
    return Maker(
        "so101", SO101_FILE, SO101_JOINTS, 50, LOW_RAD, HIGH_RAD, two_three, (3.4,) * 5,
        none, none, (0.0216,) * 5, (1.275,) * 5, 12, True, True, stop_share=0.15, own_seed=own_seed,
    )  # fmt: skip


def servo_arm(maker: Maker, seed: int) -> ServoArm:
    """An arm that could have come out of the box: links off by up to 20 % and 1 cm, servos by 10 to 20 %."""
    rng = maker.random(seed, 0)
    tree = true_arm(maker, rng, tool=False).tree
    servos = drawn(len(maker.joints), rng)
    links = tree.links
    believed = load_tree(maker.model, maker.joints).links
    for link, rotor, known in zip(links, servos.rotor_kg_m2, believed, strict=True):
        link.rotor_inertia = rotor
        link.com = [0.5 * (a + b) for a, b in zip(link.com, known.com, strict=True)]
    return ServoArm(_core.Tree(links, tree.gravity), servos, rng.uniform(*SUPPLY_V), rng.uniform(*SUPPLY_OHM))


# --- The arm in MuJoCo: gear and link of each joint joined through a gap, stepped by servo_steps.cpp.


SAMPLE = ("q", "dq", "goal", "duty", "supply_a", "speed", "motor_nm", "load_nm", "tau_ext")
STEPS = (
    POINTER, POINTER, POINTER, WHOLE, NUMBER, NUMBER, NUMBER, POINTER, POINTER, WHOLE, POINTER, WHOLE,
    POINTER, WHOLE, POINTER, POINTER,
)  # fmt: skip
"""Arguments of servo_steps()."""
SHAPES = ("impact", "push", "wall")
"""Half sine; ramps up and down; a spring that stands where the link is as the touch begins."""


@dataclass(frozen=True)
class Touch:
    """What touches the arm once; `Contact` of these arms, whose strength is a torque."""

    shape: str
    from_s: float
    to_s: float
    link: int
    at_m: tuple[float, float, float]
    """In the link's axes."""
    direction: tuple[float, float, float]
    """In the world; impacts and walls act against the motion instead, where there is any."""
    peak: float
    """Most torque that it exerts on a joint as it begins, [N m]; of a wall, its stiffness, [N/m]."""
    rise_s: float = 0.1

    def row(self) -> list[float]:
        shape = float(SHAPES.index(self.shape))
        return [self.from_s, self.to_s, self.link, *self.at_m, *self.direction, self.peak, self.rise_s, shape]


@dataclass(frozen=True)
class ServoRun:
    """True signals at the bus's samples, (samples, joints): see SAMPLE; and the voltage, (samples,)."""

    ticks: np.ndarray
    signals: dict[str, np.ndarray]
    volts: np.ndarray


def simulate_servos(arm: ServoArm, goals: np.ndarray, rate_hz: float, touches: Sequence[Touch]) -> ServoRun:
    """The arm follows goals, (samples, joints), [rad], each written as the servos are read, at `rate_hz`.

    A goal is that of the register: whole counts. Samples are taken at the servos' ticks of 1 ms.
    """
    model = backlash_model(arm)
    data = mujoco.MjData(model)
    gears = replace(arm.servos, coulomb_nm=(1 - OUTPUT_SHARE) * arm.servos.coulomb_nm)
    table, goals = gears.table(), np.ascontiguousarray(encoder(goals, COUNTS))
    data.qpos[::2] = goals[0]
    samples, n = goals.shape
    ticks = np.round(np.arange(samples) * TICKS_HZ / rate_hz).astype(np.int32)
    acts = (ticks + COMMAND_TICKS).astype(np.int32)
    out, volts = np.zeros((samples, n, len(SAMPLE))), np.zeros(samples)
    rows = np.array([touch.row() for touch in touches], dtype=np.float64)
    taken = compiled("servo_steps", STEPS, WHOLE)(
        model._address, data._address, address(table), n, arm.volts, arm.supply_ohm, COUNT_RAD,
        address(goals), address(acts), samples, address(rows), len(touches),
        address(ticks), samples, address(out), address(volts),
    )  # fmt: skip
    if taken != samples or not np.isfinite(out).all() or data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number:
        raise RuntimeError("the simulation diverged")
    return ServoRun(ticks, {name: out[:, :, k].copy() for k, name in enumerate(SAMPLE)}, volts)
