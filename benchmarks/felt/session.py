"""Fifty ticks a second: leader, delay, follower before a wall, its tau_ext by tauext, delay, torque of the leader."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from tauext_lerobot.leader_feedback import LeaderFeedback

from felt.arm import GEARS, HANDS, JOINTS, TICK_S, Follower, Gears, Hand, Leader, Report, Servo, Wall, xml
from tauext import TrainConfig, estimate_recording, load_dataset, train_bundle
from tauext._core import Bundle, Health, Monitor, ServoConstants, ServoInput, ServoSettings, TorqueFrom
from tauext.data.dataset import Split, save_split
from tauext.data.description import ServoTable
from tauext.data.recording import Recording
from tauext.data.recording_file import save_recording
from tauext.data.servo import servo_facts, velocity_and_torque
from tauext.data.servo_types import SERVO_TYPES
from tauext.progress import Reporter

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
