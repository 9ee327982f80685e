"""Simulated arms as sources: their samples, commands and scripts, in real time and as fast as the loop takes them."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from tauext_commission.connect import judge, recording_of
from tauext_lab.sim.arms import ARMS
from tauext_lab.sim.plant import Mover, Plant
from tauext_lab.sim.servo_arm import SO101_JOINTS
from tauext_lab.sim.source import KINDS, Clock, DrivenArm, SimSource, Stamps, command_of, write_robot_file

from tauext.errors import ConfigError
from tauext.monitor.source import Block, Commanded, Describes, ServoStage, Stoppable

JOINTS = ("joint1", "joint2")


def taken(source: SimSource, count: int) -> list:
    """The next samples, each with the true external torque."""
    found, until = [], time.monotonic() + 20
    while len(found) < count:
        assert time.monotonic() < until and not source.ended
        if (sample := source.next_sample(0.1)) is not None:
            found.append((sample, source.tau_ext))
    return found


def run(script=(), seconds: float = 0.5, arm: str = "rig", seed: int = 0, **options) -> list:
    source = SimSource(arm, seed, None, script, **options)
    source.open(source.describe(1.0).settings)
    try:
        first = source.next_sample(0.0)  # which waits: a sample that is not paced must not count as missing
        assert first is not None
        return [(first, source.tau_ext), *taken(source, round(seconds * 1000) - 1)]
    finally:
        source.close()
        source.close()


def test_a_simulated_arm_describes_itself_and_is_what_the_loop_expects():
    source = SimSource("seven")
    facts = source.describe(0.0)
    assert facts.settings.joints == tuple(f"joint{k}" for k in range(1, 8))
    assert facts.settings.period_ns == 1_000_000 and facts.settings.torque_timing == "held"
    assert facts.settings.torque_units == ("N m",) * 7 and facts.signal == "torque" and not facts.temperature
    assert isinstance(source, Describes) and isinstance(source, Commanded) and isinstance(source, Stoppable)
    source.close()


def test_samples_are_those_of_the_plant_and_the_same_seed_gives_the_same():
    arm = ARMS["rig"]()
    plant, mover = Plant(arm, 3), Mover(arm, 3)
    expected = []
    for _ in range(1500):
        expected.append(plant.step(*mover.step()))
    came = run(seed=3)
    assert [sample.t_ns for sample, _ in came] == list(range(0, 500_000_000, 1_000_000))
    for name in ("q", "dq", "tau"):
        np.testing.assert_array_equal(
            [getattr(sample, name) for sample, _ in came], [getattr(one, name) for one in expected[1000:]]
        )
    assert not np.array([truth for _, truth in came]).any()


def test_scripts_push_at_their_time_in_the_base_frame():
    came = run([(0.1, "push joint=joint2 force=0,0,-20 point=0.1,0.12,0.3 seconds=0.2")])
    truth = np.array([torque for _, torque in came])
    pushed = truth.any(axis=1)
    assert pushed[100:300].all() and not pushed[:100].any() and not pushed[300:].any()
    np.testing.assert_allclose(truth[100, 0], 0.1 * 20, atol=1e-3)  # about +y: z f_x - x f_z, at the first joint


def test_friction_load_silence_and_clock_follow_their_commands():
    free = run(seconds=1.0)
    stiff = run([(0.0, "friction factor=2")], seconds=1.0)
    heavy = run([(0.5, "load mass=2")], seconds=1.0, arm="seven")
    for one in (stiff, heavy):
        assert np.isfinite([sample.tau for sample, _ in one]).all()
    power = [np.mean([abs(s.tau) @ abs(s.dq) for s, _ in one]) for one in (free, stiff)]
    assert power[1] > 1.2 * power[0]
    held = np.array([torque for _, torque in heavy])
    assert not held[:500].any() and np.abs(held[500:]).max() > 5
    off = run([(0.1, "off seconds=3600"), (0.2 + 3600, "clock seconds=-1800")])
    stamps = np.diff([sample.t_ns for sample, _ in off])
    np.testing.assert_allclose(stamps[stamps != 1_000_000] / 1e9, [3600.001, 0.001 - 1800], atol=2e-3)


def test_friction_that_warms_falls_with_its_time_constant():
    arm = DrivenArm(ARMS["rig"](), 0)
    arm.obey(command_of("friction factor=1 start=1.5 minutes=0.05", JOINTS))
    model, own = arm._plant.model, arm._plant.arm.model

    def factor() -> float:
        return float(model.actuator_damping[-1] / own.actuator_damping[-1])

    assert factor() == pytest.approx(1.5)
    for _ in range(3001):
        arm.step()
    assert factor() == pytest.approx(1 + 0.5 / np.e, rel=1e-3)
    arm.obey(command_of("friction factor=0.9", JOINTS))
    assert factor() == pytest.approx(0.9)


def test_stop_brings_the_arm_to_rest_and_move_lets_it_go_on():
    came = run([(0.1, "stop"), (0.8, "move")], seconds=2.0)
    speed = np.array([np.abs(sample.dq).max() for sample, _ in came])
    assert speed[500:800].max() < 0.02 < 0.1 < max(speed[:100].max(), speed[900:].max())


def test_in_real_time_a_second_takes_a_second_and_a_push_comes_at_once():
    source = SimSource("rig", 0)
    source.open(source.facts.settings)
    try:
        taken(source, 1)
        began, first = time.monotonic(), source.next_sample(1.0).t_ns
        samples = taken(source, 500)
        assert (samples[-1][0].t_ns - first) * 1e-9 < time.monotonic() - began + 0.1
        assert time.monotonic() - began > 0.4
        source.command("push joint=joint1 force=10,0,0")
        assert any(torque.any() for _, torque in taken(source, 300))
        source.command("stop")
    finally:
        source.close()
    with pytest.raises(ConfigError, match="is not running"):
        source.command("move")


def test_an_so101_reports_registers_of_which_the_loop_makes_torque(tmp_path):
    source = SimSource("so101", 0, None, [(4.0, "push joint=elbow_flex force=0,0,-5 seconds=1"), (5.0, "stop")])
    facts = source.describe(0.0)
    assert facts.settings.period_ns == 20_000_000 and facts.signal == "duty" and facts.settings.servo.on
    stage = ServoStage(facts.settings.servo)
    source.open(facts.settings)
    try:
        came = taken(source, 350)
    finally:
        source.close()
    made = stage.made(Block.of([sample for sample, _ in came]))
    q, dq, tau = made.q[1:], made.dq[1:], made.tau[1:]
    truth = np.array([torque for _, torque in came[1:]])
    assert np.isfinite(tau).all() and np.isnan(came[0][0].tau).all()
    np.testing.assert_allclose(q / (2 * np.pi / 4096), np.round(q / (2 * np.pi / 4096)), atol=1e-9)
    assert np.abs(dq[:200]).max() > 0.3 and np.abs(dq[-40:]).max() < 0.01 and np.abs(tau).max() < 3
    assert np.flatnonzero(truth.any(axis=1)).tolist() == list(range(200, 250))
    recording, lives = recording_of([sample for sample, _ in came], facts)
    assert recording.samples == 350 and not lives and recording.duty is not None
    robot = write_robot_file("so101", tmp_path)
    for lives in (judge([recording], None, facts), judge([recording], robot, facts)):
        assert not any(live.severity in ("fault", "warning") for live in lives), lives


def test_an_so101_carries_warms_and_moves_on():
    arm = KINDS["so101"].make(0)
    free = np.array([arm.step() for _ in range(50)])
    for line in ("load mass=0.1", "friction factor=1 start=2 minutes=1", "stop"):
        arm.obey(command_of(line, SO101_JOINTS))
    held = np.array([arm.step() for _ in range(100)])
    assert np.isfinite(held[:, :2]).all() and np.ptp(held[50:, 3], axis=0).max() == 0
    assert arm._plant._friction == pytest.approx(1 + np.exp(-50 / 3000), abs=0.02)
    arm.obey(command_of("move", SO101_JOINTS))
    assert np.ptp([arm.step()[3] for _ in range(200)], axis=0).max() > 0.05 and len(free) == 50


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("", "must be `push"),
        ("dance", "must be `push"),
        ("push force=1,2,3", "joint is missing"),
        ("push joint=elbow force=1,2,3", "joint = 'elbow' must be one of joint1, joint2"),
        ("push joint=joint1 force=1,2", "force = .* must be a list of 3, each a number"),
        ("push joint=joint1 force=1,2,nan", "force = '1,2,nan' must be"),
        ("push joint=joint1 force=1,2,1e9", "force = .* must be"),
        ("load mass=-1", "mass = -1.0 must be a number from 0 to 10"),
        ("load mass", "must be `push"),
        ("friction factor=0", "factor = 0.0 must be"),
        ("off seconds=1 hours=2", "unknown key 'hours'"),
        ("clock seconds=inf", "seconds = 'inf' must be"),
        ("stop now", "must be `push"),
    ],
)
def test_a_wrong_command_is_refused_with_what_is_allowed(line, words):
    with pytest.raises(ConfigError, match=words):
        command_of(line, JOINTS)
    with pytest.raises(ConfigError, match=words):
        SimSource("rig", script=[(0.0, line)])


def test_an_unknown_arm_and_other_settings_are_refused():
    with pytest.raises(ConfigError, match="must be one of sim:rig, sim:seven, sim:so101"):
        SimSource("elephant")
    with pytest.raises(ConfigError, match="has joints joint1, joint2, not joint1, joint2, joint3"):
        SimSource("rig").open(SimSource("seven").facts.settings)


def test_a_process_that_ends_ends_the_source_with_a_note():
    source = SimSource("rig", 0)
    source.open(source.facts.settings)
    try:
        taken(source, 1)
        os.kill(source._process.pid, 9)
        until = time.monotonic() + 10
        while not source.ended:
            source.next_sample(0.1)
            assert time.monotonic() < until
        assert source.notes() == ["sim rig: the simulation has ended"] and source.next_sample(0.1) is None
    finally:
        source.close()


def test_a_busy_machine_gives_time_up_and_ticks_that_are_off_pass():
    clock = Clock(0.001)
    clock._next_s -= 10
    assert clock.due() <= 102 and clock.due() <= 1
    stamps = Stamps(1_000_000)
    assert stamps.next_ns() == 0
    stamps.off_ns = 2_500_000
    assert [stamps.is_off(skip=False) for _ in range(4)] == [True, True, True, False] and stamps.next_ns() == 4_000_000
    stamps.off_ns = 2_500_000
    assert not stamps.is_off(skip=True) and stamps.next_ns() == 8_000_000


PARENT = """
import sys, time
from tauext_lab.sim.source import SimSource
if __name__ == "__main__":
    source = SimSource("rig", 0, None if sys.argv[1] == "unpaced" else 1.0)
    source.open(source.facts.settings)
    while source.next_sample(1.0) is None: pass
    print(source._process.pid, flush=True)
    time.sleep(60)
"""


@pytest.mark.parametrize("pace", ["paced", "unpaced"])
def test_a_killed_loop_leaves_no_simulation_behind(pace, tmp_path):
    script = tmp_path / "parent.py"
    script.write_text(PARENT)
    with subprocess.Popen([sys.executable, str(script), pace], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        child = int(parent.stdout.readline())
        parent.kill()
    until = time.monotonic() + 10
    while Path(f"/proc/{child}/stat").exists() and Path(f"/proc/{child}/stat").read_text().split()[2] != "Z":
        assert time.monotonic() < until
        time.sleep(0.02)
