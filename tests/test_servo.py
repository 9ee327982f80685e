"""Servo arms: what a recording's velocity and torque are made of, and that a live loop makes the same."""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tauext import _core
from tauext.bundle.match import expect_fit
from tauext.check.finding import Finding
from tauext.check.odd_torque import of_servos
from tauext.check.spikes import normal_ranges, spikes_of
from tauext.data.assemble import assemble
from tauext.data.description import parse_arm
from tauext.data.importers.open_raw import open_raw
from tauext.data.servo import servo_of, servo_of_recordings, velocity_and_torque
from tauext.data.servo_types import SERVO_TYPES
from tauext.errors import BundleError, ConfigError
from tauext.monitor.source import Block, ServoStage, SourceSettings
from tauext.sources.replay import ReplaySource

HEAD = """
[robot]
joints = ["a", "b"]
[time]
column = "t"
[signals]
q.columns = "q_{joint}"
q_des.columns = "goal_{joint}"
current = {columns = "mA_{joint}", unit = "mA"}
duty = {columns = "load_{joint}", unit = "permille"}
[servo]
type = "sts3215-7.4v"
"""
COUNT = 2 * np.pi / 4096


@pytest.fixture
def raw(tmp_path):
    """A minute of two servos at 50 Hz, counted as they count, and what their motors really draw."""
    rng = np.random.default_rng(5)
    t = np.arange(0, 60, 0.02)
    motor = SERVO_TYPES["sts3215-7.4v"]
    phase = rng.uniform(0, 6, 2)
    q = 0.8 * np.sin(0.9 * t[:, None] + phase)
    dq = 0.72 * np.cos(0.9 * t[:, None] + phase)
    tau = 0.5 * np.sin(q) + 0.12 * np.sign(dq)
    ampere = tau / motor.nm_per_ampere
    duty = (motor.ohm * ampere + motor.back_emf_v_s * dq) / motor.volts
    q_seen = COUNT * np.round(q / COUNT)
    columns = {"t": t}
    for j, joint in enumerate("ab"):
        columns[f"q_{joint}"] = q_seen[:, j]
        columns[f"goal_{joint}"] = q[:, j] + duty[:, j] / (16 * motor.duty_per_rad)
        columns[f"load_{joint}"] = np.round(1000 * duty[:, j])
        columns[f"mA_{joint}"] = 6.5 * np.round(np.abs(1000 * duty[:, j] * ampere[:, j]) / 6.5)
    path = tmp_path / "motion.parquet"
    pq.write_table(pa.table(columns), path)
    return path, tau, dq


def imported(path, text):
    return one_of(path, parse_arm(HEAD + text))


def one_of(path, arm):
    (raw,) = open_raw(path, arm.topics)
    (recording,) = assemble(raw, arm)
    return recording


@pytest.mark.parametrize("source, rms", [("duty", 0.02), ("goal", 0.02), ("supply-current", 0.1)])
def test_the_torque_of_a_motor_comes_back_from_what_its_servo_reports(raw, source, rms):
    """But for what counting leaves: of the position, of the speed by back-EMF, and near 0 the root of a current."""
    path, tau, dq = raw
    recording = imported(path, f'torque_from = "{source}"\ngoal_delay_s = 0\n')
    under_way = np.arange(len(dq)) > 20
    # a T^2/8 is at most a count, so the speed is late by a T/2 = sqrt(2 a count), and a is at most 0.65 rad/s^2 here.
    assert np.sqrt(np.mean((recording.dq - dq)[under_way] ** 2)) < np.sqrt(2 * 0.65 * COUNT)
    driven = under_way[:, None] & (tau * dq > 0.02) & (np.abs(tau) > 0.1)  # it does not brake
    assert np.sqrt(np.mean((recording.tau - tau)[driven] ** 2)) < rms


def test_a_recording_keeps_what_was_reported_in_si(raw):
    recording = imported(raw[0], 'torque_from = "duty"\n')
    table = pq.read_table(raw[0])
    assert np.allclose(recording.duty[:, 0], table["load_a"].to_numpy() / 1000, atol=1e-12)
    assert np.allclose(recording.current[:, 1], table["mA_b"].to_numpy() / 1000, atol=1e-12)
    assert recording.voltage is None and recording.torque_timing == "held"
    facts = recording.provenance["servo"]
    assert facts["torque_from"] == "duty" and facts["joints"][0]["ohm"] == SERVO_TYPES["sts3215-7.4v"].ohm
    assert "torque made of the duty" in recording.provenance["done"]


def test_a_live_loop_makes_the_same_to_the_last_bit(raw):
    recording = imported(raw[0], 'torque_from = "supply-current"\n')
    blank = replace(recording, dq=np.zeros_like(recording.dq), tau=np.zeros_like(recording.tau))
    source, stage = ReplaySource(blank, None), ServoStage(servo_of(recording.provenance["servo"]))
    source.open(SourceSettings(recording.joints, 20_000_000))
    for k in range(recording.samples):
        made = stage.made(Block.of([source.next_sample(1.0)]))
        assert (made.dq[0] == recording.dq[k]).all() and (made.tau[0] == recording.tau[k]).all(), k


def test_a_goal_acts_one_period_after_its_stamp_unless_the_table_says_otherwise(raw):
    late, at_once = (imported(raw[0], f'torque_from = "goal"\n{text}') for text in ("", "goal_delay_s = 0\n"))
    assert late.provenance["servo"]["goal_delay_ns"] == 20_000_000
    assert at_once.provenance["servo"]["goal_delay_ns"] == 0
    before = replace(late, q_des=np.vstack([late.q_des[:1], late.q_des[:-1]]))
    settings = servo_of(at_once.provenance["servo"])
    _, tau = velocity_and_torque(settings, before.t_ns, before.q, {"q_des": before.q_des})
    np.testing.assert_allclose(late.tau, tau, rtol=0, atol=1e-9)


def test_a_servo_whose_registers_limit_its_duty_pushes_no_harder(raw):
    """As LeRobot does to the gripper of an SO-101: half the duty, whatever the goal asks for."""
    motor, path = SERVO_TYPES["sts3215-7.4v"], raw[0]
    table = pq.read_table(path)
    far = pa.table({name: table[name] if not name.startswith("goal") else pa.array(table[name].to_numpy() + 1.0)
                    for name in table.column_names})  # fmt: skip
    pq.write_table(far, path)
    recording = imported(path, 'torque_from = "goal"\nmost_duty = [0.97, 0.5]\n')
    ampere = (motor.volts * np.array([0.97, 0.5]) - motor.back_emf_v_s * recording.dq) / motor.ohm
    np.testing.assert_allclose(recording.tau, motor.nm_per_ampere * ampere, rtol=1e-12)


def test_unknown_servos_leave_their_constant_to_training(raw):
    text = HEAD.replace('type = "sts3215-7.4v"', "")
    arm = parse_arm(text + 'torque_from = "duty"\n')
    assert arm.signals["tau"].torque_constant == "unknown"
    recording = one_of(raw[0], arm)
    assert (recording.tau == recording.duty).all() and "amperes" in recording.provenance["torque"]
    assert recording.provenance["servo"]["joints"][0]["count_rad"] == pytest.approx(COUNT, rel=1e-6)


@pytest.mark.parametrize(
    "text, message",
    [
        ('torque_from = "load"\n', "one of torque, phase-current, supply-current, duty, goal"),
        ("", r"\[servo\] torque_from is missing"),
        ('torque_from = "goal"\nohm = 0\n', r"\[servo\] ohm = 0 must be a number > 0"),
        (
            'torque_from = "goal"\nmost_duty = [1, 50]\n',
            r"\[servo\] most_duty = \[1, 50\] must be a number > 0, at most 1",
        ),
        ('torque_from = "goal"\nmost_duty = 0\n', r"\[servo\] most_duty = .* must be a number > 0"),
        ('torque_from = "goal"\ngain = [1, 2, 3]\n', r"\[servo\] gain = .*, one for all joints or a list of 2"),
        ('torque_from = "goal"\nvelocity_window_s = 9\n', "velocity_window_s = 9 must be a number from 0 to 2"),
        ('torque_from = "goal"\ngian = 16\n', ".servo. unknown key 'gian'; the nearest known is 'gain'"),
        ('torque_from = "duty"\n[signals.tau]\ncolumns = "mA_{joint}"\n', "must be left out"),
    ],
)
def test_a_wrong_table_is_refused_with_the_rule(text, message):
    with pytest.raises(ConfigError, match=message):
        parse_arm(HEAD + text)


def test_what_is_missing_is_named():
    without = HEAD.replace("current =", "voltage =").replace('unit = "mA"', 'unit = "V"')
    with pytest.raises(ConfigError, match=r"needs \[signals.current\], which is missing"):
        parse_arm(without + 'torque_from = "supply-current"\n')
    with pytest.raises(ConfigError, match="type = 'sts9000' must be one of sts3215-7.4v"):
        parse_arm(HEAD.replace("sts3215-7.4v", "sts9000") + 'torque_from = "duty"\n')


def test_a_gain_that_nobody_knows_is_asked_for(raw):
    text = HEAD.replace("sts3215-7.4v", "xl430-w250") + 'torque_from = "goal"\n'
    with pytest.raises(ConfigError, match="needs the gain of the position controller of joint 'a': duty_per_rad"):
        one_of(raw[0], parse_arm(text))


def test_a_bundle_of_servos_takes_no_recording_that_was_made_otherwise(raw):
    recording = imported(raw[0], 'torque_from = "duty"\n')
    bundle = _core.Bundle()
    bundle.links = [link("a"), link("b")]
    bundle.observer = _core.ObserverSettings(
        gain_per_s=20.0, timing=_core.TorqueTiming.held, sample_period_ns=20_000_000, network_stride=1
    )
    bundle.servo = servo_of_recordings([recording])
    expect_fit(bundle, recording)
    other = recording.provenance | {"servo": recording.provenance["servo"] | {"velocity_steps": 3}}
    with pytest.raises(BundleError, match="are with other settings"):
        expect_fit(bundle, replace(recording, provenance=other))
    with pytest.raises(BundleError, match="not made by"):
        expect_fit(bundle, replace(recording, provenance={}))
    with pytest.raises(ConfigError, match="import both with one arm.toml"):
        servo_of_recordings([recording, replace(recording, provenance=other)])


def link(name):
    one = _core.Link()
    one.joint_name = name
    return one


def test_a_leap_of_a_velocity_that_comes_from_the_position_is_no_spike(raw):
    recording = imported(raw[0], 'torque_from = "goal"\n')
    dq = recording.dq.copy()
    dq[2000, 0] = 5.0
    leaps = replace(recording, dq=dq)
    normal = normal_ranges([leaps])
    assert not [s for s in spikes_of(leaps, normal) if s.signal == "dq"]
    assert [s for s in spikes_of(replace(leaps, provenance={}), normal) if s.signal == "dq"]


def test_an_odd_recording_of_servos_is_a_warning(raw):
    """Its joints rest within their friction, at whatever torque."""
    recording = imported(raw[0], 'torque_from = "goal"\n')
    odd = [Finding("odd-recording", "fault", "a", "turned", "negate it", recording.name)]
    assert [f.severity for f in of_servos(odd, [recording])] == ["warning"]
    assert of_servos(odd, [replace(recording, provenance={})]) == odd
