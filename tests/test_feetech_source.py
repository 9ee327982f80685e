"""STS3215 servos on a mocked bus: bytes out and in, by Feetech's memory table, through the vendor's packet handler."""

from __future__ import annotations

import math

import numpy as np
import pytest
from made_servos import NAMES, Feetech, MadeServoBus, bus_file, first_sample, patient, servo_settings, taken

from tauext.sources.servo_bus_file import ServoJoint

pytest.importorskip("scservo_sdk")
from tauext.sources.feetech import FeetechSource

RAD = 2 * math.pi / 4096


def sts3215(bus: MadeServoBus, id_: int, position: int = 2048) -> None:
    """Registers after power-on, torque on, goal at the position: 7.4 V, 31 degC."""
    bus.put(id_, "H", 3, 777)
    bus.put(id_, "B", 40, 1)
    bus.put(id_, "H", 42, position)
    bus.put(id_, "HHHBB", 56, position, 0, 0, 74, 31)


@pytest.fixture
def two():
    with MadeServoBus(Feetech(), [1, 2]) as bus:
        sts3215(bus, 1)
        sts3215(bus, 2)
        yield bus


def opened(bus: MadeServoBus, *joints: ServoJoint, **settings) -> FeetechSource:
    joints = joints or tuple(ServoJoint(NAMES[id_ - 1], id_) for id_ in bus.registers)
    source = patient(FeetechSource(bus.port, bus_file(*joints)))
    source.open(servo_settings(len(joints), **settings))
    return source


def test_a_reading_is_one_sync_read_of_registers_40_to_70_and_writes_nothing(two):
    source = opened(two)
    try:
        taken(source, 3)
    finally:
        source.close()
    # Header, to all, length 6, sync read, first register, how many, ids, ~sum: by the manual, written out by hand.
    assert two.requests[0] == bytes.fromhex("ff ff fe 06 82 03 1f 01 02 54")
    assert set(two.requests[1:]) == {bytes.fromhex("ff ff fe 06 82 28 1f 01 02 2f")}
    assert two.writes == []


def test_an_answer_of_the_servo_is_taken_byte_by_byte(two):
    """An answer as it stands on the wire: FF FF, id, length 33, no error, 31 registers, ~sum."""
    registers = bytes.fromhex(
        "01 00 34 08 00 00 00 00 e8 03 00 00 00 00 00 00"  # 40: on, acceleration, goal 2100, time, speed, limit 1000
        "00 08 2c 81 64 04 7b 2a 00 00 01 00 00 c8 00"  # 56: 2048, -300, -100, 12.3 V, 42 degC, ..., current 200
    )
    body = bytes([1, 33, 0]) + registers
    packet = b"\xff\xff" + body + bytes([~sum(body) & 0xFF])
    two.sent = lambda id_, made: packet if id_ == 1 and two.readings > 1 else made
    one = first_sample(opened(two))
    assert one.q[0] == 0.0 and one.q_des[0] == pytest.approx(52 * RAD)
    assert one.dq[0] == pytest.approx(-300 * RAD)
    assert one.duty[0] == pytest.approx(-0.100) and one.current[0] == pytest.approx(1.3)
    assert one.voltage[0] == pytest.approx(12.3) and one.temperature[0] == 42.0
    assert np.isnan(one.tau).all()


@pytest.mark.parametrize(
    "register, word, signal, value",
    [
        (56, 0x8005, "q", (-5 - 2048 + 4096) * RAD),  # sign in bit 15; within half a turn of the zero
        (58, 0x012C, "dq", 300 * RAD),
        (58, 0x812C, "dq", -300 * RAD),
        (58, 0x8000, "dq", 0.0),
        (60, 0x03E8, "duty", 1.0),
        (60, 0x07E8, "duty", -1.0),  # sign in bit 10
        (60, 0x0400, "duty", 0.0),
        (69, 0x0064, "current", 0.65),
        (69, 0x8064, "current", -0.65),
        (42, 0x0834, "q_des", 52 * RAD),
        (42, 0x8034, "q_des", (-52 - 2048) * RAD),
    ],
)
def test_signs_are_in_the_bits_that_the_manual_says(two, register, word, signal, value):
    two.put(1, "H", register, word)
    one = first_sample(opened(two))
    assert getattr(one, signal)[0] == pytest.approx(value, abs=1e-12)


def test_zeros_directions_and_turns_are_those_of_the_file(two):
    two.put(1, "HHH", 56, 3048, 100, 50)
    two.put(1, "H", 42, 3148)
    two.put(1, "H", 69, 10)
    two.put(2, "H", 56, 0x8000 | 5000)
    joints = ServoJoint("lift", 1, 1048.0, -1), ServoJoint("pan", 2, 0.0, 1, multi_turn=True)
    one = first_sample(opened(two, *joints))
    assert one.q == pytest.approx([-5000 * RAD, -2000 * RAD])  # in the order of the bundle: pan, lift
    assert one.q_des[1] - one.q[1] == pytest.approx(-100 * RAD)
    assert one.dq[1] == pytest.approx(-100 * RAD) and one.duty[1] == pytest.approx(-0.05)
    assert one.current[1] == pytest.approx(0.065)  # what the supply gives has no direction


def test_an_angle_goes_on_where_the_counts_wrap(two):
    def moves(reading: int) -> None:
        two.put(1, "H", 56, (4090 + 2 * reading) % 4096)

    two.moves = moves
    source = opened(two, ServoJoint("pan", 1, 4000.0), ServoJoint("lift", 2))
    try:
        q = np.array([one.q[0] for one in taken(source, 12)])
    finally:
        source.close()
    np.testing.assert_allclose(np.diff(q), 2 * RAD, atol=1e-12)
    assert q[0] > 0


def test_a_servo_without_torque_or_in_another_mode_has_no_goal(two):
    two.put(1, "B", 40, 0)
    two.put(2, "B", 33, 1)  # speed
    one = first_sample(opened(two))
    assert np.isnan(one.q_des).all() and np.isfinite(one.q).all() and np.isfinite(one.duty).all()


def test_stop_writes_the_present_position_as_goal_to_servos_whose_torque_is_on(two):
    two.put(1, "H", 56, 0x8123)
    two.put(2, "B", 40, 0)
    source = opened(two)
    try:
        taken(source, 2)
        assert two.writes == []
        source.stop()
    finally:
        source.close()
    assert two.writes == [(42, 1, b"\x23\x81")]
    # Header, to all, length 7, sync write, register 42, two bytes, id 1 and its position, ~sum.
    assert bytes.fromhex("ff ff fe 07 83 2a 02 01 23 81 a6") in b"".join(two.requests)


def test_stop_says_what_does_not_hold(two):
    two.put(2, "B", 33, 1)
    source = opened(two)
    with pytest.raises(RuntimeError, match=r"does not hold: servo 2 \(lift\) is in an operating mode without goal"):
        source.stop()
    assert two.writes == [(42, 1, b"\x00\x08")]
    patient(source, 0.05)
    two.sent = lambda id_, packet: b"" if id_ == 1 else packet
    with pytest.raises(RuntimeError, match=r"servo 1 \(pan\) does not answer"):
        source.stop()
    source.close()


def test_a_servo_that_does_not_take_its_goal_is_named(two, monkeypatch):
    source = opened(two)
    source.bus.write = lambda *_: None  # on its way it is lost
    two.put(1, "H", 42, 99)
    with pytest.raises(RuntimeError, match=r"servo 1 \(pan\) does not take the goal"):
        source.stop()
    source.close()


def test_what_a_servo_complains_of_is_told_once(two):
    source = opened(two)
    try:
        taken(source, 2)
        two.errors[2] = 32 | 4
        taken(source, 10)
        assert source.notes() == ["servo 2 (lift) says: overheated, overload"]
        two.errors[2] = 0
        taken(source, 10)
        assert source.notes() == ["servo 2 (lift) has no more to say"]
    finally:
        source.close()


@pytest.mark.slow
def test_six_servos_are_read_six_thousand_times_and_each_time_whole():
    """A minute at 100 Hz. How late they are depends on the machine: benchmarks/servo_buses.py."""
    with MadeServoBus(Feetech(), [1, 2, 3, 4, 5, 6]) as bus:
        for id_ in bus.registers:
            sts3215(bus, id_)
        bus.moves = lambda reading: [bus.put(id_, "H", 56, (reading + 100 * id_) % 4096) for id_ in bus.registers]
        source = opened(bus, period_ns=10_000_000)
        try:
            q = np.array([one.q for one in taken(source, 6000, 300.0)])
        finally:
            source.close()
        assert source.counts.refused == source.counts.overrun == 0 and source.notes() == []
    steps = np.diff(q, axis=0) / RAD
    assert np.isin(np.rint(steps), (1, -4095)).all()  # no reading twice, none mixed from two
