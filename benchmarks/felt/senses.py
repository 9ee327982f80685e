"""What the follower's servos feel, estimated by tauext from positions and goals: training and the monitor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from felt.arm import JOINTS, xml
from felt.follower import TICK_S, Report
from felt.leader import GEARS, HANDS
from felt.servo import Servo
from felt.session import run
from felt.wishes import moves
from tauext import TrainConfig, estimate_recording, load_dataset, train_bundle
from tauext._core import Bundle, Health, Monitor, ServoConstants, ServoInput, ServoSettings, TorqueFrom
from tauext.data.dataset import Split, save_split
from tauext.data.description import ServoTable
from tauext.data.recording import Recording
from tauext.data.recording_file import save_recording
from tauext.data.servo import servo_facts, velocity_and_torque
from tauext.data.servo_types import SERVO_TYPES
from tauext.progress import Reporter

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
