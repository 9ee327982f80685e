"""Leader and follower of feeling.py: two arms of an SO-101's size in MuJoCo, their servos, hands, wire and monitor.

Fifty ticks a second: leader, delay, follower before a wall, its tau_ext by tauext, delay, torque of the leader.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import mujoco
import numpy as np
from tauext_lab.sim.rig import encoder
from tauext_lerobot.leader_feedback import LeaderFeedback

from tauext import TrainConfig, estimate_recording, load_dataset, train_bundle
from tauext._core import Bundle, Health, Monitor, ServoConstants, ServoInput, ServoSettings, TorqueFrom
from tauext.data.dataset import Split, save_split
from tauext.data.description import ServoTable
from tauext.data.recording import Recording
from tauext.data.recording_file import save_recording
from tauext.data.servo import servo_facts, velocity_and_torque
from tauext.data.servo_types import SERVO_TYPES
from tauext.progress import Reporter

# --- The STS3215 at 7.4 V as it was identified: position control by duty, motor, friction of its gear.


@dataclass(frozen=True)
class Servo:
    """Motor and gear at the output shaft; parameters of model m6 that Rhoban's BAM identified for the STS3215 at 7.4 V
    (https://github.com/Rhoban/bam, params/feetech_sts3215_7_4V)."""

    volts: float = 7.4
    ohm: float = 2.753
    nm_per_ampere: float = 1.275
    """Also the back-EMF, [V s/rad]."""
    armature_kg_m2: float = 0.02156
    duty_per_rad: float = 16 * 0.166 * 1.16
    """Of the position error, at the gain P = 16 that LeRobot sets for these arms."""
    most_duty: float = 0.97
    coulomb_nm: float = 0.053
    motor_share: float = 0.045
    """Coulomb friction a motor torque."""
    load_share: float = 0.244
    """Coulomb friction a torque from outside: weight, touch."""
    viscous_nm_s_rad: float = 0.028

    def duty(self, error_rad: np.ndarray) -> np.ndarray:
        """What the controller gives the motor for goal - position."""
        return np.clip(self.duty_per_rad * error_rad, -self.most_duty, self.most_duty)

    def torque(self, duty: np.ndarray, dq: np.ndarray) -> np.ndarray:
        """k_t (V D - k_e dq) / R, [N m]."""
        return self.nm_per_ampere * (self.volts * duty - self.nm_per_ampere * dq) / self.ohm


def counted(q: np.ndarray) -> np.ndarray:
    """The reading of the 12-bit encoder, [rad]."""
    return encoder(q, 4096)


# --- The arm, and a wall.


STEP_S = 0.002
JOINTS = ("pan", "lift", "elbow")
LED_RANGES, FREE_RANGES = ((-1.5, 1.5), (-1.2, 1.2), (-0.8, 1.4)), ((-2, 2), (-2, 2), (-2, 2))
READY = np.array([0.0, -0.2, 0.55])
"""The hand 28 cm before the pan's axis, 10 cm over the ground, [rad]."""
MJCF = """
<mujoco model="small_arm">
  <compiler autolimits="true" angle="radian"/>
  <option timestep="{step_s}" gravity="0 0 {gravity}" integrator="implicitfast"/>
  <worldbody>
    <body name="shoulder" pos="0 0 0.062">
      <joint name="pan" axis="0 0 1" {range_pan}/>
      <inertial pos="0.03 0 0.03" mass="0.1" diaginertia="8e-5 8e-5 3e-5"/>
      <body name="upper_arm" pos="0.03 0 0.054">
        <joint name="lift" axis="0 1 0" {range_lift}/>
        <inertial pos="0.01 0 0.088" mass="0.103" diaginertia="1.5e-4 1.5e-4 4e-5"/>
        <body name="forearm" pos="0.028 0 0.113">
          <joint name="elbow" axis="0 1 0" {range_elbow}/>
          <inertial pos="0.143 0 0" mass="0.282" diaginertia="1e-4 1.3e-3 1.3e-3"/>
          <body name="hand" pos="0.294 0 0">
            <inertial pos="0 0 0" mass="{hand_kg}" diaginertia="1e-5 1e-5 1e-5"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
"""Lengths, masses and places of masses after the SO-101's URDF, rounded; wrist and gripper are one with the forearm."""


@dataclass(frozen=True)
class Wall:
    """A plane that pushes the hand back like a stiff spring with a little damping."""

    normal: tuple[float, float, float]
    """Away from the wall."""
    at_m: float
    """Where it is along the normal."""
    n_per_m: float = 10_000.0
    n_s_per_m: float = 20.0

    def depth(self, tip: np.ndarray) -> float:
        """How deep the point is in it, [m]; negative before it."""
        return self.at_m - float(np.dot(self.normal, tip))

    def force(self, arm: Arm) -> np.ndarray | None:
        """On the arm's hand, (3,), [N], never towards the wall; None before it."""
        depth = self.depth(arm.tip)
        if depth <= 0:
            return None
        velocity = arm.jacobian() @ arm.dq
        push = self.n_per_m * depth - self.n_s_per_m * float(np.dot(self.normal, velocity))
        return max(push, 0.0) * np.array(self.normal)


def xml(gravity: float = -9.81, hand_kg: float = 1e-4, led: bool = False) -> str:
    """The model's text; the follower's is also what training takes for the robot file.

    Args:
        led: a leader, whose stops are nearer: where its hand goes, the follower's can, and neither arm comes near to
            being straight or folded, where a hand that leads its end could turn the elbow over.
    """
    ranges = LED_RANGES if led else FREE_RANGES
    texts = {f"range_{name}": f'range="{low} {high}"' for name, (low, high) in zip(JOINTS, ranges, strict=True)}
    return MJCF.format(step_s=STEP_S, gravity=gravity, hand_kg=hand_kg, **texts)


class Arm:
    """One arm under torques that are given step by step."""

    def __init__(self, servo: Servo, gravity: float = -9.81, hand_kg: float = 1e-4, led: bool = False):
        self.model = mujoco.MjModel.from_xml_string(xml(gravity, hand_kg, led))
        self.model.dof_armature[:] = servo.armature_kg_m2
        self.model.dof_damping[:] = servo.viscous_nm_s_rad
        self.data = mujoco.MjData(self.model)
        self.data.qpos[:] = READY
        self.servo = servo
        self.outside_nm = np.zeros(3)
        """Torque of wall and hand in the last step, (3,), [N m]."""
        self._jacobian = np.zeros((3, 3))
        self._hand = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_BODY, "hand")
        mujoco.mj_forward(self.model, self.data)

    @property
    def q(self) -> np.ndarray:
        """[rad]."""
        return self.data.qpos.copy()

    @property
    def dq(self) -> np.ndarray:
        """[rad/s]."""
        return self.data.qvel.copy()

    @property
    def tip(self) -> np.ndarray:
        """Where the hand is, (3,), [m]."""
        return self.data.xpos[self._hand].copy()

    def jacobian(self) -> np.ndarray:
        """Of the hand's point, (3, joints)."""
        mujoco.mj_jac(self.model, self.data, self._jacobian, None, self.data.xpos[self._hand], self._hand)
        return self._jacobian

    def step(self, motor_nm: np.ndarray, force_n: np.ndarray | None) -> None:
        """STEP_S under the motors' torque and a force on the hand; friction follows what loads the gears."""
        self.outside_nm = np.zeros(3) if force_n is None else self.jacobian().T @ force_n
        load = np.abs(self.outside_nm - self.data.qfrc_bias)
        servo = self.servo
        friction = servo.coulomb_nm + servo.motor_share * np.abs(motor_nm) + servo.load_share * load
        self.model.dof_frictionloss[:] = friction
        self.data.qfrc_applied[:] = motor_nm + self.outside_nm
        mujoco.mj_step(self.model, self.data)


# --- The follower: servos hold the goals they are sent; what it reports 50 times a second.


TICK_S = 0.02
TICK_STEPS = round(TICK_S / STEP_S)


@dataclass(frozen=True)
class Report:
    """What the follower says at a tick: (joints,) each."""

    q: np.ndarray
    """By its encoders, [rad]."""
    goal: np.ndarray
    """That it followed since the last tick, [rad]."""
    outside_nm: np.ndarray
    """The truth, [N m]: torque of the wall."""


class Follower:
    """An SO-101-like arm under position control, perhaps before a wall."""

    def __init__(self, servo: Servo, wall: Wall | None):
        self.arm, self.wall, self._servo = Arm(servo), wall, servo
        self._goal = counted(self.arm.q)

    def tick(self, goal: np.ndarray) -> Report:
        """20 ms under this goal; the answer is of their end."""
        self._goal = counted(goal)
        felt = np.zeros(3)
        for _ in range(TICK_STEPS):
            arm = self.arm
            duty = self._servo.duty(self._goal - counted(arm.q))
            arm.step(self._servo.torque(duty, arm.dq), self.wall.force(arm) if self.wall else None)
            felt += arm.outside_nm
        return Report(counted(self.arm.q), self._goal.copy(), felt / TICK_STEPS)


# --- The leader: motors that give a torque, moved by a hand that is a spring, a damper and a mass.


@dataclass(frozen=True)
class Hand:
    """How a person holds the leader: the hand is drawn to where the person wants it."""

    name: str
    n_per_m: float
    n_s_per_m: float
    kg: float


HANDS = (Hand("two fingers", 50.0, 2.0, 0.1), Hand("loose", 150.0, 6.0, 0.3), Hand("firm", 400.0, 20.0, 0.5))
"""From a light hold to a firm one: a relaxed human arm has some 100 to 400 N/m at the hand."""


@dataclass(frozen=True)
class Gears:
    """What the leader's gears take."""

    name: str
    servo: Servo


GEARS = (
    Gears("STS3215", Servo()),
    Gears("light", replace(Servo(), coulomb_nm=0.01, motor_share=0.0, load_share=0.0, viscous_nm_s_rad=0.004)),
)
"""Those of an SO-101's servo, and some that hardly rub, which are the harder case."""


class Leader:
    """Its weight is carried by the hand: there is no gravity."""

    def __init__(self, gears: Gears, hand: Hand):
        self.arm, self.hand = Arm(gears.servo, gravity=0.0, hand_kg=hand.kg, led=True), hand
        self._wanted = self.arm.tip

    @property
    def q(self) -> np.ndarray:
        """By its encoders, [rad]."""
        return counted(self.arm.q)

    def tick(self, wanted: np.ndarray, torque_nm: np.ndarray) -> None:
        """20 ms in which the person's wish goes on to `wanted`, (3,), [m], and the motors hold the torque."""
        way = (wanted - self._wanted) / TICK_STEPS
        speed = way / STEP_S
        for _ in range(TICK_STEPS):
            self._wanted = self._wanted + way
            arm, hand = self.arm, self.hand
            velocity = arm.jacobian() @ arm.dq
            force = hand.n_per_m * (self._wanted - arm.tip) + hand.n_s_per_m * (speed - velocity)
            arm.step(torque_nm, force)


# --- A session.


Wish = Callable[[float], np.ndarray]
"""Where the person wants the leader's hand at a time, beside where it began, (3,), [m]."""


class Senses(Protocol):
    """What says tau_ext of the follower."""

    def step(self, tick: int, report: Report) -> tuple[np.ndarray, np.ndarray, bool]:
        """tau_ext and its standard error, (joints,), and whether they can be trusted."""
        ...


@dataclass(frozen=True)
class Course:
    """What happened, a row a tick."""

    t_s: np.ndarray
    leader_tip: np.ndarray
    follower_tip: np.ndarray
    q_leader: np.ndarray
    torque_nm: np.ndarray
    tau_ext: np.ndarray
    sigma: np.ndarray
    outside_nm: np.ndarray
    """The truth at the follower."""
    given_j: np.ndarray
    """What the leader's motors have given the hand since the start."""
    tank_j: np.ndarray


def run(
    wish: Wish,
    seconds: float,
    delay_ticks: int,
    hand: Hand,
    gears: Gears,
    wall: Wall | None,
    senses: Senses,
    feedback: LeaderFeedback | None,
) -> Course:
    """A session from rest; None: nothing is fed back.

    Goals reach the follower delay_ticks after the leader was read, what it feels the leader as many ticks later. What
    is read at a tick and needs no wire is there at that tick.
    """
    leader, follower = Leader(gears, hand), Follower(Servo(), wall)
    begin = leader.arm.tip
    goals = [leader.q] * (delay_ticks + 1)
    quiet = (np.zeros(3), np.zeros(3), True)
    answers = [quiet] * (delay_ticks + 1)
    rows: list[tuple] = []
    for tick in range(round(seconds / TICK_S)):
        q = leader.q
        goals = [*goals[1:], q]
        report = follower.tick(goals[0])
        answers = [*answers[1:], senses.step(tick, report)]
        tau_ext, sigma, healthy = answers[0]
        torque = feedback.step(tau_ext, sigma, q, TICK_S, healthy) if feedback else np.zeros(3)
        tank = feedback.tank if feedback else None
        energy = (tank.given_j, tank.energy_j) if tank else (0.0, 0.0)
        tips = leader.arm.tip, follower.arm.tip
        rows.append((tick * TICK_S, *tips, q, torque, tau_ext, sigma, report.outside_nm, *energy))
        leader.tick(begin + wish((tick + 1) * TICK_S), torque)
    return Course(*(np.array(column) for column in zip(*rows, strict=True)))


# --- Where a person wants the hand: free moves, a press on the table, taps.


LOW_M, HIGH_M = np.array([-0.07, -0.15, -0.06]), np.array([0.03, 0.15, 0.09])
"""Free moves stay within, beside where the hand began: far from the arm being straight or folded."""


def moves(seconds: float, rng: np.random.Generator) -> Wish:
    """Minimum-jerk moves between random places, 0.7 to 2.5 s long, some with a rest of up to 1 s after them."""
    ends, places = [0.0], [np.zeros(3)]
    while ends[-1] < seconds:
        ends.append(ends[-1] + rng.uniform(0.7, 2.5))
        places.append(rng.uniform(LOW_M, HIGH_M))
        if rng.random() < 0.3:
            ends.append(ends[-1] + rng.uniform(0.2, 1.0))
            places.append(places[-1])

    def wish(t: float) -> np.ndarray:
        k = min(int(np.searchsorted(ends, t, side="right")), len(ends) - 1)
        s = float(np.clip((t - ends[k - 1]) / (ends[k] - ends[k - 1]), 0, 1))
        return places[k - 1] + (10 * s**3 - 15 * s**4 + 6 * s**5) * (places[k] - places[k - 1])

    return wish


def press(deep_m: float, down_s: float = 1.0, until_s: float = np.inf) -> Wish:
    """Down by deep_m within down_s, there until until_s, and up again."""

    def wish(t: float) -> np.ndarray:
        down = np.clip(min(t - 1.0, until_s + down_s - t) / down_s, 0, 1)
        return np.array([0, 0, -deep_m * down])

    return wish


def taps(deep_m: float, hz: float) -> Wish:
    """Up and down from the second second on, down to deep_m."""

    def wish(t: float) -> np.ndarray:
        return np.array([0, 0, -deep_m * (0.5 - 0.5 * np.cos(2 * np.pi * hz * max(t - 1.0, 0)))])

    return wish


# --- What the servos of the follower feel, from positions and goals: training and the monitor.


PERIOD_NS = round(TICK_S * 1e9)
TRAIN, VALIDATE = 4, 2
"""Recordings of each."""
RECORDING_S = 150.0


def settings() -> ServoSettings:
    """Torque from goal and position, speed from positions: an SO-101 tells no more in one reading of its bus."""
    servo, kind = Servo(), SERVO_TYPES["sts3215-7.4v"]
    constants = ServoConstants(
        volts=servo.volts,
        ohm=servo.ohm,
        back_emf_v_s=servo.nm_per_ampere,
        nm_per_ampere=servo.nm_per_ampere,
        duty_per_rad=servo.duty_per_rad,
        most_duty=servo.most_duty,
        count_rad=kind.count_rad,
    )
    steps = round(ServoTable("goal").velocity_window_s / TICK_S)
    return ServoSettings(TorqueFrom.goal, [constants] * len(JOINTS), steps, PERIOD_NS)


@dataclass
class Kept:
    """A session's reports, for a recording; nothing is felt."""

    reports: list[Report]

    def step(self, tick: int, report: Report) -> tuple[np.ndarray, np.ndarray, bool]:
        """Keep it."""
        self.reports.append(report)
        return np.zeros(3), np.zeros(3), True


class MonitorSenses:
    """tauext's monitor at the follower."""

    def __init__(self, bundle: Bundle):
        self._monitor, self._input = Monitor(bundle), ServoInput(bundle.servo)

    def step(self, tick: int, report: Report) -> tuple[np.ndarray, np.ndarray, bool]:
        """Its answer at this tick."""
        t_ns = (tick + 1) * PERIOD_NS
        dq, tau = self._input.step(t_ns, report.q, q_des=report.goal)
        answer = self._monitor.step(t_ns, report.q, dq, tau)
        return np.array(answer.tau_ext), np.array(answer.sigma_nm), answer.health == Health.ok


def recording(name: str, reports: Sequence[Report]) -> Recording:
    """What a program beside the follower would have kept."""
    t_ns = (1 + np.arange(len(reports))) * PERIOD_NS
    q, goal = np.array([report.q for report in reports]), np.array([report.goal for report in reports])
    dq, tau = velocity_and_torque(settings(), t_ns, q, {"q_des": goal})
    facts = {"servo": servo_facts(settings())}
    maker = "benchmarks/feeling.py"
    return Recording(name, JOINTS, t_ns, q, dq, tau, 1 / TICK_S, "instant", maker, "", q_des=goal, provenance=facts)


def train(folder: Path, seed: int, reporter: Reporter) -> Bundle:
    """A bundle from free motion of the follower, led by a hand; what is in the folder is used again."""
    folder.mkdir(parents=True, exist_ok=True)
    bundle = folder / "arm.tauext"
    names = [f"free-{k}.parquet" for k in range(TRAIN + VALIDATE)]
    for k, name in enumerate(names):
        if not (folder / name).exists():
            kept = Kept([])
            wish = moves(RECORDING_S, np.random.default_rng([seed, k]))
            run(wish, RECORDING_S, 1, HANDS[1], GEARS[1], None, kept, None)
            save_recording(recording(name.removesuffix(".parquet"), kept.reports), folder / name)
    (folder / "robot.xml").write_text(xml())
    save_split(Split(tuple(names[:TRAIN]), tuple(names[TRAIN:]), (), (), ()), folder)
    return train_bundle(load_dataset(folder), bundle, config=TrainConfig(recipe="prior", seed=seed), report=reporter)


def free_motion(folder: Path, bundle: Bundle) -> tuple[np.ndarray, np.ndarray]:
    """tau_ext and its standard error on the validation recordings, (samples, joints) each."""
    estimates = [estimate_recording(bundle, one) for one in load_dataset(folder).recordings("validation")]
    return (
        np.concatenate([one.tau_ext for one in estimates]),
        np.concatenate([one.sigma_nm for one in estimates if one.sigma_nm is not None]),
    )
