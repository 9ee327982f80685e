"""The simulated servo arm: its torques balance, its friction is the published one, its gears have play."""

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pyarrow.parquet as pq
import pytest

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))
sys.path.insert(0, str(Path(__file__).parents[2] / "lerobot/benchmarks"))
sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

from so101_sim import Verdicts
from tauext_lab.sim.rig import encoder
from tauext_lab.sim.servo_arm import (
    COMMAND_TICKS,
    COUNT_RAD,
    COUNTS,
    OUTPUT_SHARE,
    ServoPlant,
    backlash_model,
    identified,
)
from unseen.recordings import Take
from unseen.servos import TOUCHED_NM, Touch, description, servo_arm, simulate_servos, so101, write_take

from tauext import _core
from tauext.data.description import parse_arm
from tauext.data.recording import Recording
from tauext.robot.read import load_tree

pytestmark = pytest.mark.skipif(shutil.which("g++") is None, reason="the steps are compiled by g++")
MAKER = so101()
RATE_HZ = 100
PUBLISHED = identified(5)
POSE = np.array([0.2, 0.7, 0.9, -0.5, 0.3])


def an_arm():
    """The URDF's links, the published servos, a supply that does not sag."""
    links = load_tree(MAKER.model, MAKER.joints).links
    for link, rotor in zip(links, PUBLISHED.rotor_kg_m2, strict=True):
        link.rotor_inertia = rotor
    return replace(
        servo_arm(MAKER, 0), tree=_core.Tree(links, [0, 0, -9.81]), servos=PUBLISHED, volts=7.4, supply_ohm=0.0
    )


def run_of(goals, touches=()):
    return simulate_servos(an_arm(), goals, RATE_HZ, touches).signals


def test_standing_gears_carry_gravity_and_what_pushes():
    """0 = gear on link + bearing's friction + tau_ext - beta by the core's tree, where MuJoCo moved the arm."""
    push = Touch("push", 1.5, 5.0, 4, (0.01, 0.0, 0.08), (0.0, 0.6, 0.8), 0.3)
    run = run_of(np.tile(POSE, (300, 1)), [push])
    for row in (140, 290):
        gravity = an_arm().tree.momentum(run["q"][row : row + 1], np.zeros((1, 5)))[1][0]
        off = np.abs(run["load_nm"][row] - (run["tau_ext"][row] - gravity))
        assert off.max() < OUTPUT_SHARE * 0.05331 + 2e-3
    assert np.abs(run["tau_ext"][290]).max() == pytest.approx(0.3, abs=0.01) and not run["tau_ext"][140].any()


@pytest.mark.parametrize("speed", [0.2, -0.2, 1.0, -1.0])
def test_a_sliding_gear_resists_as_the_published_model_says(speed):
    """Rhoban's m6: coulomb + |share of the load - share of the motor's torque|, more below 0.37 rad/s."""
    goals = np.tile(POSE, (200, 1))
    goals[:, 1] = (0.2 if speed > 0 else 0.9) + speed * (np.arange(200) / RATE_HZ - 1)  # gravity keeps its side
    run = run_of(goals)
    at = slice(150, 195)
    motor, load, dq = (run[name][at, 1] for name in ("motor_nm", "load_nm", "dq"))
    resists = (1 - OUTPUT_SHARE) * 0.05331 + np.abs(0.24355 * load - 0.04491 * motor)
    if abs(speed) < 0.3:
        resists += 4.26e-5 + np.abs(0.14229 * load - 1.245e-4 * motor)
        square = np.where(np.abs(load) < np.abs(motor), 0.003404 * load**2, 0.007595 * motor**2)
        resists += np.where(load * motor < 0, square, 0.0)
    assert dq.mean() == pytest.approx(speed, abs=0.15 * abs(speed))  # its lag changes with the load
    speeds_up = 0.021564 * (dq[-1] - dq[0]) / 0.44
    left = motor + load - np.sign(speed) * resists - 0.02816 * dq
    # Half a count of the encoder is 0.008 N m of the motor.
    assert left.mean() == pytest.approx(speeds_up, abs=0.008)


def test_the_arm_of_sim_so101_steps_as_the_compiled_one():
    arm, rng = servo_arm(MAKER, 3), np.random.default_rng(0)
    goals = POSE + 0.4 * np.sin(np.linspace(0, 6, 150))[:, None] * rng.uniform(-1, 1, 5)
    run = simulate_servos(arm, goals, RATE_HZ, ())
    plant, sent = ServoPlant(arm, goals[0]), encoder(goals, COUNTS)
    for k in range(len(goals)):
        for tick in range(10):
            if tick == COMMAND_TICKS:
                plant.goal = sent[k]
            came = plant.tick()
            if tick == 0:
                for name in ("q", "goal", "duty", "supply_a", "speed"):
                    tolerance = 50 * COUNT_RAD if name == "speed" else 1e-6  # a step of its register
                    assert getattr(came, name) == pytest.approx(run.signals[name][k], abs=tolerance), (k, name)
                assert came.volts == pytest.approx(run.volts[k], abs=1e-6)


def test_a_link_has_a_degree_of_play_that_no_torque_resists():
    model = backlash_model(an_arm())
    data, ends = mujoco.MjData(model), []
    model.dof_frictionloss[::2] = 10.0  # gears that stand
    for push in (0.03, -0.03):  # the bearing resists with 0.021
        data.qfrc_applied[8:] = push  # gear and link of the roll axis, which is upright: no gravity
        for _ in range(1000):
            mujoco.mj_step(model, data)
        ends.append(data.qpos[8] + data.qpos[9])
        assert abs(data.qpos[8]) < 1e-4
    # The stops give way a little: by 0.01/kappa of the acceleration that the push would be, kappa = 1/(2 ms)^2.
    assert ends[0] - ends[1] == pytest.approx(np.deg2rad(1.0), rel=0.03)


def test_the_motor_obeys_its_published_constants():
    goals = np.tile(POSE, (150, 1))
    goals[50:] += 0.4
    run = run_of(goals)
    duty = np.clip(16 * 0.166 * 1.1617 * (run["goal"] - np.round(run["q"] / COUNT_RAD) * COUNT_RAD), -0.97, 0.97)
    still = slice(30, 50)
    assert run["duty"][still] == pytest.approx(duty[still], abs=1e-6)
    assert run["motor_nm"][still] == pytest.approx(1.2753 * 7.4 * duty[still] / 2.7534, abs=2e-3)
    assert run["supply_a"][still] == pytest.approx(7.4 * duty[still] ** 2 / 2.7534, abs=2e-3)
    assert np.abs(run["dq"]).max() < 5.1  # the goal that is followed moves no faster


def test_what_the_bus_says_is_whole_registers_and_can_be_imported(tmp_path):
    folder = tmp_path / "registers"
    folder.mkdir()
    take = Take("touched-1", "collisions", 0.5, 2)
    write_take(MAKER, servo_arm(MAKER, 3), 50, take, 9, 3, folder)
    table, joint = pq.read_table(folder / "touched-1.parquet"), MAKER.joints[1]
    truth = np.load(folder / "touched-1.truth.npz")
    for name, step in (("position", COUNT_RAD), ("load", 0.001), ("current", 0.0065), ("voltage", 0.1)):
        counts = table[f"{name}_{joint}"].to_numpy() / step
        assert np.abs(counts - np.round(counts)).max() < 1e-6
    assert table[f"current_{joint}"].to_numpy().min() >= 0
    assert (np.diff(table["time"].to_numpy()) > 0).all()
    touched = (np.abs(truth["tau_ext"]) > TOUCHED_NM).any(axis=1)
    assert (table["touched"].to_numpy() == touched).all() and touched.any()
    assert len(json.loads((folder / "touched-1.touches.json").read_text())) == 2
    for source in ("duty", "supply-current", "goal"):
        arm = parse_arm(description(MAKER, [take], source, True))
        assert arm.servo is not None and arm.servo.torque_from == source


def test_servos_differ_and_rates_share_the_motion(tmp_path):
    arm = servo_arm(MAKER, 0)
    assert len(set(arm.servos.ohm)) == 5 and not np.allclose(arm.servos.ohm, servo_arm(MAKER, 1).servos.ohm)
    assert np.rad2deg(arm.servos.backlash_rad).min() >= 0.5 and np.rad2deg(arm.servos.backlash_rad).max() <= 1.3
    ends = {}
    for rate in (50, 100):
        folder = tmp_path / str(rate)
        folder.mkdir()
        write_take(MAKER, arm, rate, Take("free-1", "test", 0.1), 4, 0, folder)
        ends[rate] = np.load(folder / "free-1.truth.npz")["goal"][:: rate // 50]
    assert np.abs(ends[50][2:] - ends[100][2:]).max() < 0.05


def test_alarms_count_once_and_beside_contacts_as_false():
    n = 1000
    contact = np.zeros(n, dtype=np.int8)
    contact[300:350] = 1
    tau_ext = np.zeros((n, 1))
    tau_ext[300:350] = 0.4
    zeros = np.zeros((n, 1))
    recording = Recording(
        "r", ("a",), np.arange(n) * 20_000_000, zeros, zeros, zeros, 50.0, "instant", "", "", tau_ext=tau_ext,
        contact=contact,
    )  # fmt: skip
    ratio = np.zeros(n)
    ratio[[310, 311, 400, 900, 901]] = 3, 3, 2, 4, 4

    def judged(factor):
        verdicts = Verdicts()
        verdicts.add(recording, ratio > factor, np.ones(n, dtype=bool))
        return verdicts

    verdicts = judged(1.0)
    assert verdicts.found == [True] and verdicts.delays_s == [pytest.approx(0.2)]
    assert (verdicts.false_free, verdicts.false_after) == (1, 1)
    assert verdicts.free_hours == pytest.approx((n - 60) / 50 / 3600)
