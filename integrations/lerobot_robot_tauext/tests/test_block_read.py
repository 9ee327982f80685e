# ruff: noqa: E402
"""Position, load, current and voltage of LeRobot's own Feetech bus in one request, byte for byte."""

from __future__ import annotations

import struct

import pytest

pytest.importorskip("lerobot.motors.feetech", exc_type=ImportError)
mock_serial = pytest.importorskip("mock_serial")
pytest.importorskip("scservo_sdk")

from lerobot.motors import Motor, MotorCalibration, MotorNormMode
from lerobot.motors.feetech import FeetechMotorsBus
from lerobot_robot_tauext.block_read import BlockRead


def packet(*content: int) -> bytes:
    body = bytes(content)
    return b"\xff\xff" + body + bytes([~sum(body) & 0xFF])


def status(id_: int, data: bytes) -> bytes:
    return packet(id_, len(data) + 2, 0, *data)


def registers(position: int, load: int, volts: int, current: int) -> bytes:
    """56 to 70: position, speed, load, voltage, temperature, sync, status, moving, two bytes, current."""
    return struct.pack("<HHHBB", position, 0, load, volts, 30) + bytes(5) + struct.pack("<H", current)


@pytest.fixture
def serial():
    port = mock_serial.MockSerial()
    port.open()
    yield port
    port.close()


@pytest.fixture
def bus(serial):
    motors = {name: Motor(k + 1, "sts3215", MotorNormMode.DEGREES) for k, name in enumerate(("pan", "lift"))}
    calibration = {name: MotorCalibration(k + 1, 0, 0, 0, 4095) for k, name in enumerate(motors)}
    bus = FeetechMotorsBus(serial.port, motors, calibration)
    bus.connect(handshake=False)
    yield bus
    bus.disconnect(disable_torque=False)


def test_one_request_reads_all(serial, bus):
    asked = packet(0xFE, 6, 0x82, 56, 15, 1, 2)
    answers = status(1, registers(2048, 300, 74, 100)) + status(2, registers(1024, 300 | 1 << 10, 73, 7))
    stub = serial.stub(receive_bytes=asked, send_bytes=answers)
    plain = packet(0xFE, 6, 0x82, 56, 2, 1, 2)
    serial.stub(receive_bytes=plain, send_bytes=status(1, b"\x00\x08") + status(2, b"\x00\x04"))
    block = BlockRead(bus, ("duty", "current", "voltage"))
    assert block.in_one_transaction
    with block.reading():
        position = bus.sync_read("Present_Position")
    assert stub.calls == 1
    assert position == bus.sync_read("Present_Position") and position["pan"] == pytest.approx(0.5 * 360 / 4095)
    assert block.values["duty"] == pytest.approx({"pan": 0.3, "lift": -0.3})  # sign in bit 10
    assert block.values["current"] == pytest.approx({"pan": 0.65, "lift": 0.0455})
    assert block.values["voltage"] == pytest.approx({"pan": 7.4, "lift": 7.3})


def test_a_lost_answer_is_an_error_as_lerobot_has_it(serial, bus):
    asked = packet(0xFE, 6, 0x82, 56, 6, 1, 2)
    serial.stub(receive_bytes=asked, send_bytes=status(1, registers(2048, 300, 74, 100)[:6]))
    block = BlockRead(bus, ("duty",))
    with block.reading(), pytest.raises(ConnectionError, match=r"Failed to sync read 6 bytes from 56 on \[1, 2\]"):
        bus.sync_read("Present_Position")
    assert not block.values and "sync_read" not in vars(bus)


def test_a_servo_without_the_register_is_refused(bus):
    bus.motors["lift"] = Motor(2, "scs0009", MotorNormMode.DEGREES)
    with pytest.raises(ValueError, match="motor 'lift' is a scs0009: it has no current that tauext knows how to read"):
        BlockRead(bus, ("current",))
