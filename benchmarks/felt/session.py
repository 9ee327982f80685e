"""Fifty ticks a second: leader, delay, follower before a wall, its tau_ext, delay, torque of the leader."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from felt.arm import Wall
from felt.follower import TICK_S, Follower, Report
from felt.leader import Gears, Hand, Leader
from felt.servo import Servo
from tauext.monitor.leader_feedback import LeaderFeedback

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
        rows.append(
            (
                tick * TICK_S,
                leader.arm.tip,
                follower.arm.tip,
                q,
                torque,
                tau_ext,
                sigma,
                report.outside_nm,
                tank.given_j if tank else 0.0,
                tank.energy_j if tank else 0.0,
            )
        )
        leader.tick(begin + wish((tick + 1) * TICK_S), torque)
    return Course(*(np.array(column) for column in zip(*rows, strict=True)))
