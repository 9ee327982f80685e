"""A low-cost servo arm in MuJoCo, and its hobby servos as they were identified.

These have a motor, a position controller, friction that depends on the load, and backlash.

Numbers of a Feetech STS3215 at 7.4 V: Rhoban's BAM, model m6 (Duclusaud, Passault, Padois, Daney: Extended Friction
Models for the Physics Simulation of Servo Actuators, 2024; github.com/Rhoban/bam, feetech_sts3215_7_4V/m6), all at the
output shaft. Backlash is what reversals of a real SO-101 show.
"""

from __future__ import annotations

import ctypes
import itertools
import os
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import mujoco
import numpy as np

from tauext import _core
from tauext.robot.load import load_tree
from tauext.sim.rig import encoder
from unseen.arms import Maker, true_arm
from unseen.simulation import specification

COUNTS = 4096
COUNT_RAD = 2 * np.pi / COUNTS
GAIN = 16
"""The P gain that LeRobot sets; its I gain is 0."""

OUTPUT_SHARE = 0.4
"""Of the dry friction without load, that of the output shaft's bearing: behind the backlash, where it stops a link that
would bounce in its play for ever. The identification knows the sum alone."""


@dataclass(frozen=True)
class Servos:
    """The servos of one arm; each an array over the joints. The order of the fields is that of servo_steps.cpp."""

    nm_per_ampere: np.ndarray
    """k_t, which is k_e, too."""
    ohm: np.ndarray
    duty_per_rad: np.ndarray
    most_duty: np.ndarray
    goal_rad_s: np.ndarray
    """The goal that the controller follows moves no faster."""
    coulomb_nm: np.ndarray
    stribeck_nm: np.ndarray
    motor_share: np.ndarray
    """Of the motor's torque, that becomes friction."""
    external_share: np.ndarray
    """Of what the arm asks of the gear."""
    motor_stribeck: np.ndarray
    external_stribeck: np.ndarray
    motor_square: np.ndarray
    """[1/Nm], where motor and load oppose each other and the load is the larger."""
    external_square: np.ndarray
    stribeck_rad_s: np.ndarray
    stribeck_power: np.ndarray
    viscous_nm_s_rad: np.ndarray
    rotor_kg_m2: np.ndarray
    backlash_rad: np.ndarray
    """Between the gear train and the output shaft, where the encoder is; from stop to stop."""

    def table(self) -> np.ndarray:
        """(fields, joints), row by row as declared."""
        return np.ascontiguousarray([getattr(self, field.name) for field in fields(self)])


def identified(joints: int) -> Servos:
    """As many servos as the published one, with a degree of backlash."""
    row = (
        1.2753, 2.7534, GAIN * 0.166 * 1.1617, 0.97, 5.0958,
        0.05331, 4.26e-5, 0.04491, 0.24355, 1.245e-4, 0.14229, 0.007595, 0.003404, 0.37114, 9.931, 0.02816,
        0.021564, np.deg2rad(1.0),
    )  # fmt: skip
    return Servos(*(np.full(joints, value) for value in row))


SPREAD = {
    "nm_per_ampere": 0.1,
    "ohm": 0.1,
    "duty_per_rad": 0.05,
    "goal_rad_s": 0.05,
    "coulomb_nm": 0.2,
    "motor_share": 0.2,
    "external_share": 0.2,
    "external_stribeck": 0.2,
    "stribeck_rad_s": 0.2,
    "viscous_nm_s_rad": 0.2,
    "rotor_kg_m2": 0.1,
}
"""By how much a servo differs from the published one, either way."""
BACKLASH_RAD = (np.deg2rad(0.5), np.deg2rad(1.3))


def drawn(joints: int, rng: np.random.Generator) -> Servos:
    """Servos as they come out of one box: every one differs."""
    one = identified(joints)
    values = {field.name: getattr(one, field.name) for field in fields(Servos)}
    for name, share in SPREAD.items():
        values[name] = values[name] * rng.uniform(1 - share, 1 + share, joints)
    values["backlash_rad"] = rng.uniform(*BACKLASH_RAD, joints)
    return Servos(**values)


# --- A low-cost servo arm as its user meets it: a URDF that is roughly right, and servos of which each differs.


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
    believed = load_tree(maker.model, maker.joints).links
    for link, rotor, known in zip(links, servos.rotor_kg_m2, believed, strict=True):
        link.rotor_inertia = rotor
        link.com = [0.5 * (a + b) for a, b in zip(link.com, known.com, strict=True)]
    return ServoArm(_core.Tree(links, tree.gravity), servos, rng.uniform(*SUPPLY_V), rng.uniform(*SUPPLY_OHM))


# --- The arm in MuJoCo: gear and link of each joint joined through a gap, stepped by servo_steps.cpp.


PHYSICS_HZ = 2000
TICKS_HZ = 1000
"""Of the servos' own loop."""
COMMAND_TICKS = 5
"""From the writing of a goal until a servo follows it (BAM: 5.0 ms)."""
DRY_SOLVER = ((0.002, 1.0), (0.9999, 0.9999, 0.001, 0.5, 2.0))
"""How hard MuJoCo holds dry friction: what stands creeps by less than 1e-4 rad/s."""
STOP_SOLVER = ((0.002, 1.0), (0.95, 0.99, 0.001, 0.5, 2.0))
"""How hard the ends of the backlash are."""
SAMPLE = ("q", "dq", "goal", "duty", "supply_a", "speed", "motor_nm", "load_nm", "tau_ext")
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


def backlash_model(arm: ServoArm) -> mujoco.MjModel:
    """Two joints about one axis a link: the gear, with the rotor's inertia and friction, and the gap beside it.

    The bearing of the output shaft rubs on the sum of the two, which is the link's angle: a tendon.
    """
    number = itertools.count()

    def join(body: mujoco.MjsBody, link: _core.Link) -> None:
        turn, j = {"type": mujoco.mjtJoint.mjJNT_HINGE, "axis": [0, 0, 1]}, next(number)
        body.add_joint(name=f"gear{j}", **turn, armature=link.rotor_inertia)
        body.add_joint(name=f"gap{j}", **turn, range=[-1, 1], limited=mujoco.mjtLimited.mjLIMITED_TRUE)

    spec = specification(arm.tree, PHYSICS_HZ, join)
    for j, coulomb in enumerate(arm.servos.coulomb_nm):
        shaft = spec.add_tendon(frictionloss=OUTPUT_SHARE * coulomb)
        shaft.wrap_joint(f"gear{j}", 1.0)
        shaft.wrap_joint(f"gap{j}", 1.0)
    model = spec.compile()
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    gear, gap = np.arange(0, model.nv, 2), np.arange(1, model.nv, 2)
    model.jnt_range[gap] = np.outer(arm.servos.backlash_rad / 2, [-1, 1])  # a specification counts in degrees
    model.dof_damping[gear], model.dof_damping[gap] = arm.servos.viscous_nm_s_rad, 1e-4
    model.dof_frictionloss[gear] = arm.servos.coulomb_nm  # > 0 from the start, or the solver makes no room for it
    model.dof_solref[gear], model.dof_solimp[gear] = DRY_SOLVER
    model.tendon_solref_fri[:], model.tendon_solimp_fri[:] = DRY_SOLVER
    model.jnt_solref[gap], model.jnt_solimp[gap] = STOP_SOLVER
    return model


def simulate_servos(
    arm: ServoArm, goals: np.ndarray, rate_hz: float, touches: Sequence[Touch], build_in: Path
) -> ServoRun:
    """The arm follows goals, (samples, joints), [rad], each written as the servos are read, at `rate_hz`.

    A goal is that of the register: whole counts. Samples are taken at the servos' ticks of 1 ms.

    Args:
        build_in: folder where the compiled steps are kept.
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
    taken = _steps(build_in)(
        model._address, data._address, _address(table), n, arm.volts, arm.supply_ohm, COUNT_RAD,
        _address(goals), _address(acts), samples, _address(rows), len(touches),
        _address(ticks), samples, _address(out), _address(volts),
    )  # fmt: skip
    if taken != samples or not np.isfinite(out).all() or data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number:
        raise RuntimeError("the simulation diverged")
    return ServoRun(ticks, {name: out[:, :, k].copy() for k, name in enumerate(SAMPLE)}, volts)


def _address(values: np.ndarray) -> ctypes.c_void_p:
    return ctypes.c_void_p(values.ctypes.data)


def _steps(folder: Path) -> ctypes._CFuncPtr:  # type: ignore[name-defined]
    """servo_steps(), compiled where it is not there or older than its source."""
    source, compiled = Path(__file__).with_name("servo_steps.cpp"), folder / "servo_steps.so"
    if not compiled.exists() or compiled.stat().st_mtime < source.stat().st_mtime:
        folder.mkdir(parents=True, exist_ok=True)
        library = Path(mujoco.__file__).parent
        engine = next(library.glob("libmujoco.so*"))
        made = compiled.with_suffix(f".{os.getpid()}")
        command = [os.environ.get("CXX", "g++"), *"-std=c++20 -O2 -shared -fPIC -Wall".split(), f"-I{library}/include"]
        subprocess.run([*command, str(source), str(engine), f"-Wl,-rpath,{library}", "-o", str(made)], check=True)
        made.replace(compiled)
    pointer, whole, number = ctypes.c_void_p, ctypes.c_int, ctypes.c_double
    steps = ctypes.CDLL(str(compiled)).servo_steps
    steps.restype = whole
    steps.argtypes = [
        pointer, pointer, pointer, whole, number, number, number, pointer, pointer, whole, pointer, whole,
        pointer, whole, pointer, pointer,
    ]  # fmt: skip
    return steps
