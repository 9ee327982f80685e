"""A low-cost servo arm in MuJoCo, sample by sample, and its hobby servos as they were identified.

These have a motor, a position controller, friction that depends on the load, and backlash.

Numbers of a Feetech STS3215 at 7.4 V: Rhoban's BAM, model m6 (Duclusaud, Passault, Padois, Daney: Extended Friction
Models for the Physics Simulation of Servo Actuators, 2024; github.com/Rhoban/bam, feetech_sts3215_7_4V/m6), all at the
output shaft. Backlash is what reversals of a real SO-101 show.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path

import mujoco
import numpy as np

from tauext import _core
from tauext.robot.read import load_tree
from tauext_lab.sim.rig import encoder, quintic

# --- Hobby servos.


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
    """Share of the motor's torque that becomes friction."""
    external_share: np.ndarray
    """Share of the torque that the arm puts on the gear."""
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
    """Servos with the published parameters, one a joint, with a degree of backlash."""
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


# --- The arm and its supply.


SUPPLY_V = (7.2, 7.6)
SUPPLY_OHM = (0.1, 0.25)
"""Resistance of the supply and its thin cables: the voltage sags with the current of all servos."""


@dataclass(frozen=True)
class ServoArm:
    """The true arm, its servos and its supply, which no estimator knows."""

    tree: _core.Tree
    servos: Servos
    volts: float
    supply_ohm: float


# --- The arm in MuJoCo: gear and link of each joint joined through a gap.


PHYSICS_HZ = 2000
TICKS_HZ = 1000
"""Rate of the servos' own loop."""
COMMAND_TICKS = 5
"""From the writing of a goal until a servo follows it (BAM: 5.0 ms)."""
DRY_SOLVER = ((0.002, 1.0), (0.9999, 0.9999, 0.001, 0.5, 2.0))
"""How hard MuJoCo holds dry friction: what stands creeps by less than 1e-4 rad/s."""
STOP_SOLVER = ((0.002, 1.0), (0.95, 0.99, 0.001, 0.5, 2.0))
"""How hard the ends of the backlash are."""


def specification(
    tree: _core.Tree, rate_hz: float, join: Callable[[mujoco.MjsBody, _core.Link], None]
) -> mujoco.MjSpec:
    """The tree's links as bodies, each moved by what `join` gives it."""
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.gravity = 1 / rate_hz, list(tree.gravity)
    spec.compiler.balanceinertia = True  # masses off by 20 % may leave an inertia that no body has
    bodies: list = []
    for link in tree.links:
        parent = spec.worldbody if link.parent < 0 else bodies[link.parent]
        turn = np.zeros(4)
        mujoco.mju_mat2Quat(turn, np.array(link.rotation))
        body = parent.add_body(pos=link.translation, quat=turn, mass=link.mass, ipos=link.com)
        body.fullinertia, body.explicitinertial = link.inertia, True
        join(body, link)
        bodies.append(body)
    return spec


def backlash_model(arm: ServoArm, held: _core.Load | None = None) -> mujoco.MjModel:
    """Two joints about one axis a link: the gear, with the rotor's inertia and friction, and the gap beside it.

    The bearing of the output shaft rubs on the sum of the two, which is the link's angle: a tendon.
    """
    number = itertools.count()

    def join(body: mujoco.MjsBody, link: _core.Link) -> None:
        turn, j = {"type": mujoco.mjtJoint.mjJNT_HINGE, "axis": [0, 0, 1]}, next(number)
        body.add_joint(name=f"gear{j}", **turn, armature=link.rotor_inertia)
        body.add_joint(name=f"gap{j}", **turn, range=[-1, 1], limited=mujoco.mjtLimited.mjLIMITED_TRUE)

    spec = specification(arm.tree, PHYSICS_HZ, join)
    if held is not None:
        spec.bodies[-1].add_body(
            name="held", mass=held.mass, ipos=held.com, fullinertia=held.inertia, explicitinertial=True
        )
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


# --- The arm stepped tick by tick of its servos' own loop: servo_steps.cpp of benchmarks/unseen in NumPy.


STEPS_A_TICK = PHYSICS_HZ // TICKS_HZ
LOAD_FILTER = 0.9
"""Factor a physics step of the low-pass of the load that friction sees: 5 ms."""
SUPPLY_FILTER = 0.8187
"""Factor a tick of the low-pass of the supply current: 5 ms."""
SPEED_TICKS = 20
"""Ticks over which a servo takes its difference of positions."""
SPEED_COUNTS = 50.0
"""Step of the register of speed, [counts/s]."""


@dataclass(frozen=True)
class Registers:
    """What the servos report at a tick, and beside it the truth; (joints,) each."""

    q: np.ndarray
    """True position of the links, [rad]."""
    speed: np.ndarray
    goal: np.ndarray
    duty: np.ndarray
    supply_a: np.ndarray
    volts: float
    tau_ext: np.ndarray


class ServoPlant:
    """The arm and its servos; push() and goals may change between ticks."""

    def __init__(self, arm: ServoArm, q: np.ndarray, held: _core.Load | None = None):
        """q: position at the start, and the first goal, [rad]."""
        n = len(q)
        self._arm, self._volts, self._friction = arm, arm.volts, 1.0
        self._model = backlash_model(arm, held)
        self._data = mujoco.MjData(self._model)
        self._data.qpos[::2] = encoder(q, COUNTS)
        self.goal = encoder(q, COUNTS)
        """Goal that the servos follow, [rad]."""
        self._follows, self._supply, self._load = self.goal.copy(), np.zeros(n), np.zeros(n)
        self._past = deque([np.round(self._data.qpos[::2] / COUNT_RAD)] * SPEED_TICKS, maxlen=SPEED_TICKS)
        self._push: tuple[int, np.ndarray, np.ndarray] | None = None
        self._tau_ext = np.zeros(n)

    @property
    def q(self) -> np.ndarray:
        """True position of the links, (joints,), [rad]."""
        return self._data.qpos[::2] + self._data.qpos[1::2]

    def push(self, joint: int, force_n: np.ndarray | None, point_m: np.ndarray | None = None) -> None:
        """Push the link of a joint with this force at a point (None: its centre of mass), in the base frame.

        Args:
            force_n: (3,), [N]; None: nothing pushes.
        """
        if force_n is None:
            self._push = None
            return
        body = joint + 1
        at = self._data.xipos[body] if point_m is None else point_m
        self._push = joint, force_n, self._data.xmat[body].reshape(3, 3).T @ (at - self._data.xpos[body])

    def hold(self, held: _core.Load | None) -> None:
        """Go on with this in the hand."""
        before, state = self._data, mujoco.mjtState.mjSTATE_FULLPHYSICS
        values = np.empty(mujoco.mj_stateSize(self._model, state))
        mujoco.mj_getState(self._model, before, values, state)
        self._model = backlash_model(self._arm, held)
        self._data = mujoco.MjData(self._model)
        mujoco.mj_setState(self._model, self._data, values, state)
        mujoco.mj_forward(self._model, self._data)
        self.set_friction(self._friction)

    def set_friction(self, factor: float) -> None:
        """Go on with so many times the gears' own friction."""
        self._friction = factor
        self._model.dof_damping[::2] = factor * self._arm.servos.viscous_nm_s_rad

    def tick(self) -> Registers:
        """The registers as a tick begins; then this tick passes."""
        servos, data = self._arm.servos, self._data
        counts = np.round(self.q / COUNT_RAD)
        most = servos.goal_rad_s / TICKS_HZ
        self._follows += np.clip(self.goal - self._follows, -most, most)
        duty = servos.duty_per_rad * (self._follows - COUNT_RAD * counts)
        duty = np.clip(duty, -servos.most_duty, servos.most_duty)
        ampere = (self._volts * duty - servos.nm_per_ampere * data.qvel[::2]) / servos.ohm
        self._supply = SUPPLY_FILTER * self._supply + (1 - SUPPLY_FILTER) * duty * ampere
        moved = (counts - self._past[0]) / (SPEED_TICKS / TICKS_HZ)
        speed = np.round(moved / SPEED_COUNTS) * SPEED_COUNTS * COUNT_RAD
        found = Registers(self.q, speed, self.goal, duty, self._supply, self._volts, self._tau_ext)
        self._past.append(counts)
        self._volts = self._arm.volts - self._arm.supply_ohm * float(np.abs(self._supply).sum())
        for _ in range(STEPS_A_TICK):
            self._step(duty)
        return found

    def _step(self, duty: np.ndarray) -> None:
        """One step of the physics."""
        servos, model, data = self._arm.servos, self._model, self._data
        speed = data.qvel[::2]
        motor = servos.nm_per_ampere * (self._volts * duty - servos.nm_per_ampere * speed) / servos.ohm
        model.dof_frictionloss[::2] = self._friction * self._resisting(motor, speed)
        mujoco.mj_step1(model, data)
        self._tau_ext = self._pushed()
        data.qfrc_applied[::2], data.qfrc_applied[1::2] = motor + self._tau_ext, self._tau_ext
        mujoco.mj_step2(model, data)
        pressed = -data.qfrc_constraint[1::2]  # the stop's force on the gear
        shafts = data.efc_type == mujoco.mjtConstraint.mjCNSTR_FRICTION_TENDON  # of which the gear feels nothing
        pressed[data.efc_id[shafts]] += data.efc_force[shafts]
        self._load = LOAD_FILTER * self._load + (1 - LOAD_FILTER) * pressed

    def _resisting(self, motor: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """Dry friction of the gears by Rhoban's m6, [N m]: a load against the motor adds to what the gear carries."""
        servos, load = self._arm.servos, self._load
        still = np.exp(-((np.abs(speed) / servos.stribeck_rad_s) ** servos.stribeck_power))
        dry = (1 - OUTPUT_SHARE) * servos.coulomb_nm + np.abs(load * servos.external_share - motor * servos.motor_share)
        more = servos.stribeck_nm + np.abs(load * servos.external_stribeck - motor * servos.motor_stribeck)
        smaller = np.abs(load) < np.abs(motor)
        square = np.where(smaller, servos.external_square * load**2, servos.motor_square * motor**2)
        return dry + still * (more + np.where(np.sign(load) != np.sign(motor), square, 0.0))

    def _pushed(self) -> np.ndarray:
        """Torque of the push on the joints, [N m]."""
        if self._push is None:
            return np.zeros(len(self.goal))
        joint, force, local = self._push
        body, jacobian = joint + 1, np.zeros((3, self._model.nv))
        point = self._data.xpos[body] + self._data.xmat[body].reshape(3, 3) @ local
        mujoco.mj_jac(self._model, self._data, jacobian, None, point, body)
        return force @ jacobian[:, ::2]


# --- An SO-101 as its user meets it: a URDF that is roughly right, servos of which each differs, moves between poses.


SO101_FILE = Path(__file__).with_name("so101.urdf")
SO101_JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
SO101_TYPE = "sts3215-7.4v"
LOW_RAD, HIGH_RAD = (-1.5, -1.0, 0.1, -1.3, -2.2), (1.5, 1.2, 2.1, 1.3, 2.2)
FASTEST_RAD_S = 2.3
OWN_SEED = 101
"""Draws the one arm that sim:so101 is."""
HAND_M = 0.1


def so101_arm() -> ServoArm:
    """An arm that could have come out of the box: masses off by up to 20 %, centres by 1 cm, servos by 10 to 20 %."""
    rng = np.random.default_rng(OWN_SEED)
    servos, links = drawn(len(SO101_JOINTS), rng), load_tree(SO101_FILE, SO101_JOINTS).links
    for link, rotor in zip(links, servos.rotor_kg_m2, strict=True):
        share = rng.uniform(0.8, 1.2)
        link.mass, link.inertia = share * link.mass, [share * x for x in link.inertia]
        link.com = [x + rng.uniform(-0.006, 0.006) for x in link.com]
        link.rotor_inertia = rotor
    return ServoArm(_core.Tree(links, [0, 0, -9.81]), servos, rng.uniform(*SUPPLY_V), rng.uniform(*SUPPLY_OHM))


class Poses:
    """Goals of moves from pose to pose with pauses, a fifth of them slow and short."""

    def __init__(self, rate_hz: float, rng: np.random.Generator):
        self._rate_hz, self._rng = rate_hz, rng
        self.goal = (np.array(LOW_RAD) + HIGH_RAD) / 2
        self.stopped = False
        self._left: deque[np.ndarray] = deque()

    def next(self) -> np.ndarray:
        """Goal of the next sample, (joints,), [rad]."""
        if self.stopped:
            self._left.clear()
            return self.goal
        if not self._left:
            self._plan()
        self.goal = self._left.popleft()
        return self.goal

    def _plan(self) -> None:
        rng, slow = self._rng, self._rng.uniform() < 0.2
        there = rng.uniform(LOW_RAD, HIGH_RAD)
        if slow:
            there = np.clip(self.goal + rng.uniform(-0.25, 0.25, len(there)), LOW_RAD, HIGH_RAD)
        speed = FASTEST_RAD_S * rng.uniform(*((0.02, 0.08) if slow else (0.15, 0.85)))
        seconds = max(0.3, 15 / 8 * float(np.abs(there - self.goal).max()) / speed)
        count = round(seconds * self._rate_hz)
        done, _ = quintic(np.arange(1, count + 1) / count)
        pause = round(rng.uniform(0.2, 3.0) * self._rate_hz) if rng.uniform() < 0.7 else 0
        self._left.extend(self.goal + done[:, None] * (there - self.goal))
        self._left.extend([there] * pause)
