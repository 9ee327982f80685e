"""X series servos on a mocked bus: bytes out and in, by ROBOTIS' e-Manual, through the vendor's own packet handler."""

from __future__ import annotations

import math
import struct

import numpy as np
import pytest
from made_servos import NAMES, Dynamixel, MadeServoBus, bus_file, crc16, first_sample, patient, servo_settings, taken

from tauext.errors import ConfigError
from tauext.sources.servo_bus_file import ServoJoint

pytest.importorskip("dynamixel_sdk")
from tauext.sources.dynamixel import DynamixelSource

RAD = 2 * math.pi / 4096
XL330, XL430, XM430 = 1200, 1060, 1020


def x_series(bus: MadeServoBus, id_: int, model: int = XL330, position: int = 2048) -> None:
    """Registers after power-on, in position mode, torque on, goal at the position: 5 V, 30 degC."""
    bus.put(id_, "H", 0, model)
    bus.put(id_, "BB", 10, 0, 3)
    bus.put(id_, "B", 64, 1)
    bus.put(id_, "i", 116, position)
    bus.put(id_, "hhii", 124, 0, 0, 0, position)
    bus.put(id_, "HB", 144, 50, 30)


@pytest.fixture
def two():
    with MadeServoBus(Dynamixel(), [1, 2]) as bus:
        x_series(bus, 1)
        x_series(bus, 2)
        yield bus


def opened(bus: MadeServoBus, *joints: ServoJoint, **settings) -> DynamixelSource:
    joints = joints or tuple(ServoJoint(NAMES[id_ - 1], id_) for id_ in bus.registers)
    source = patient(DynamixelSource(bus.port, bus_file(*joints)))
    source.open(servo_settings(len(joints), **settings))
    return source


def test_the_mocked_bus_has_the_check_of_the_manual():
    assert (
        crc16(bytes.fromhex("ff ff fd 00 01 03 00 01")) == 0x4E19
    )  # e-Manual, Protocol 2.0, example of a ping of id 1


def test_a_reading_is_one_sync_read_of_registers_116_to_146_and_writes_nothing(two):
    source = opened(two)
    try:
        taken(source, 3)
    finally:
        source.close()
    # Header, reserved, to all, length 9, sync read, first register, how many, ids, CRC.
    asked = bytes.fromhex("ff ff fd 00 fe 09 00 82 74 00 1f 00 01 02")
    assert set(two.requests[1:]) == {asked + struct.pack("<H", crc16(asked))}
    assert two.requests[0][7:14] == bytes.fromhex("82 00 00 18 00 01 02")
    assert two.writes == []


def test_an_answer_of_the_servo_is_taken_byte_by_byte(two):
    registers = bytes.fromhex(
        "34 08 00 00 00 00 00 00"  # 116: goal 2100, tick, moving, status
        "8b fc d4 fe 9c ff ff ff 00 08 00 00"  # 124: PWM -885, current -300, velocity -100, position 2048
        "00 00 00 00 00 00 00 00 7b 00 2a"  # 136: trajectories, 12.3 V, 42 degC
    )
    packet = b"\xff\xff\xfd\x00\x01\x23\x00\x55\x00" + registers
    packet += struct.pack("<H", crc16(packet))
    two.sent = lambda id_, made: packet if id_ == 1 and two.readings > 1 else made
    one = first_sample(opened(two))
    assert one.q[0] == 0.0 and one.q_des[0] == pytest.approx(52 * RAD)
    assert one.dq[0] == pytest.approx(-100 * 0.229 * 2 * math.pi / 60)
    assert one.duty[0] == pytest.approx(-1.0) and one.current[0] == pytest.approx(-0.3)
    assert one.voltage[0] == pytest.approx(12.3) and one.temperature[0] == 42.0
    assert np.isnan(one.tau).all()


@pytest.mark.parametrize("model, ampere", [(XL330, 0.001), (1190, 0.001), (XM430, 0.00269), (1120, 0.00269)])
@pytest.mark.parametrize("counts", [1, -1, 1193, -32768])
def test_currents_are_signed_and_in_the_step_of_the_model(two, model, ampere, counts):
    x_series(two, 1, model)
    two.put(1, "h", 126, counts)
    one = first_sample(opened(two))
    assert one.current[0] == pytest.approx(counts * ampere)


def test_an_xl430_has_no_current(two):
    x_series(two, 1, XL430)
    two.put(1, "h", 126, 500)  # its load, an estimate
    one = first_sample(opened(two))
    assert np.isnan(one.current[0]) and one.current[1] == 0.0
    with pytest.raises(
        ConfigError, match=r"a xl430-w250, reports duty, goal, the bundle takes its torque from phase-cu"
    ):
        opened(two, torque_from="phase_current")


def test_bytes_like_a_header_are_stuffed_and_come_back(two):
    """FF FF FD in the registers: a position of -131073 is FF FF FD FF, after which the packet is a byte longer."""
    two.put(1, "i", 132, -131073)
    one = first_sample(opened(two, ServoJoint("pan", 1, 0.0, multi_turn=True), ServoJoint("lift", 2)))
    assert one.q[0] == pytest.approx(-131073 * RAD)


def test_turns_are_counted_in_32_bits_and_directions_turn_currents_too(two):
    two.put(1, "hhii", 124, 100, 7, -5, 3 * 4096 + 10)
    two.put(1, "B", 11, 4)  # extended position
    one = first_sample(opened(two, ServoJoint("pan", 1, 10.0, -1, multi_turn=True), ServoJoint("lift", 2)))
    assert one.q[0] == pytest.approx(-6 * math.pi)
    assert one.current[0] == pytest.approx(-0.007) and one.duty[0] == pytest.approx(-100 / 885) and one.dq[0] > 0


def test_a_mode_without_goal_has_none(two):
    two.put(1, "B", 11, 0)  # current
    one = first_sample(opened(two))
    assert np.isnan(one.q_des[0]) and one.q_des[1] == 0.0


def test_stop_writes_the_present_position_as_goal_to_servos_whose_torque_is_on(two):
    two.put(1, "i", 132, -77)
    two.put(2, "B", 64, 0)
    source = opened(two)
    try:
        taken(source, 2)
        assert two.writes == []
        source.stop()
    finally:
        source.close()
    assert two.writes == [(116, 1, struct.pack("<i", -77))]
    sent = bytes.fromhex("ff ff fd 00 fe 0c 00 83 74 00 04 00 01 b3 ff ff ff")
    assert sent + struct.pack("<H", crc16(sent)) in b"".join(two.requests)


def test_a_hardware_alert_is_told_once(two):
    two.errors[1] = 0x80
    source = opened(two)
    try:
        taken(source, 3)
    finally:
        source.close()
    assert source.notes() == ["servo 1 (pan) says: a hardware alert; its register 70 says which"]
