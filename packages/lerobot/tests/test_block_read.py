# ruff: noqa: E402
"""Position, load, current and voltage of LeRobot's own Feetech bus in one request, byte for byte."""

from __future__ import annotations

import struct
from contextlib import contextmanager

import pytest

pytest.importorskip("lerobot.motors.feetech", exc_type=ImportError)
mock_serial = pytest.importorskip("mock_serial")
pytest.importorskip("scservo_sdk")

from lerobot.motors import Motor, MotorCalibration, MotorNormMode
from lerobot.motors.feetech import FeetechMotorsBus
from lerobot_robot_tauext.block_read import BlockRead
from made_servo_bus import crc16


def packet(*content: int) -> bytes:
    body = bytes(content)
    return b"\xff\xff" + body + bytes([~sum(body) & 0xFF])


def status(id_: int, data: bytes) -> bytes:
    return packet(id_, len(data) + 2, 0, *data)


def registers(position: int, load: int, volts: int, current: int) -> bytes:
    """56 to 70: position, speed, load, voltage, temperature, sync, status, moving, two bytes, current."""
    return struct.pack("<HHHBB", position, 0, load, volts, 30) + bytes(5) + struct.pack("<H", current)


def read_at_once(bus, stub, values: dict[str, tuple[float, float]]) -> dict[str, float]:
    """The position, read in one request with these values of pan and lift."""
    block = BlockRead(bus, tuple(values))
    assert block.in_one_transaction
    with block.reading():
        position = bus.sync_read("Present_Position")
    assert stub.calls == 1
    for signal, (pan, lift) in values.items():
        assert block.values[signal] == pytest.approx({"pan": pan, "lift": lift})
    return position


@pytest.fixture
def serial():
    port = mock_serial.MockSerial()
    port.open()
    yield port
    port.close()


@contextmanager
def connected(serial, kind, model: str):
    """LeRobot's bus of this kind with two motors."""
    motors = {name: Motor(k + 1, model, MotorNormMode.DEGREES) for k, name in enumerate(("pan", "lift"))}
    calibration = {name: MotorCalibration(k + 1, 0, 0, 0, 4095) for k, name in enumerate(motors)}
    bus = kind(serial.port, motors, calibration)
    bus.connect(handshake=False)
    yield bus
    bus.disconnect(disable_torque=False)


@pytest.fixture
def bus(serial):
    with connected(serial, FeetechMotorsBus, "sts3215") as bus:
        yield bus


def test_one_request_reads_all(serial, bus):
    asked = packet(0xFE, 6, 0x82, 56, 15, 1, 2)
    answers = status(1, registers(2048, 300, 74, 100)) + status(2, registers(1024, 300 | 1 << 10, 73, 7))
    stub = serial.stub(receive_bytes=asked, send_bytes=answers)
    plain = packet(0xFE, 6, 0x82, 56, 2, 1, 2)
    serial.stub(receive_bytes=plain, send_bytes=status(1, b"\x00\x08") + status(2, b"\x00\x04"))
    values = {"duty": (0.3, -0.3), "current": (0.65, 0.0455), "voltage": (7.4, 7.3)}  # sign in bit 10
    position = read_at_once(bus, stub, values)
    assert position == bus.sync_read("Present_Position") and position["pan"] == pytest.approx(0.5 * 360 / 4095)


def test_a_lost_answer_is_an_error_as_lerobot_has_it(serial, bus):
    asked = packet(0xFE, 6, 0x82, 56, 6, 1, 2)
    serial.stub(receive_bytes=asked, send_bytes=status(1, registers(2048, 300, 74, 100)[:6]))
    block = BlockRead(bus, ("duty",))
    with block.reading(), pytest.raises(ConnectionError, match=r"Failed to sync read 6 bytes from 56 on \[1, 2\]"):
        bus.sync_read("Present_Position")
    assert not block.values and "sync_read" not in vars(bus)


def test_a_servo_without_the_register_is_refused(bus):
    bus.motors["lift"] = Motor(2, "scs0009", MotorNormMode.DEGREES)
    with pytest.raises(ValueError, match="motor 'lift' is a scs0009: tauext cannot read its current"):
        BlockRead(bus, ("current",))


def packet2(id_: int, *content: int) -> bytes:
    body = b"\xff\xff\xfd\x00" + struct.pack("<BH", id_, len(content) + 2) + bytes(content)
    return body + struct.pack("<H", crc16(body))


def test_one_request_reads_all_of_dynamixels(serial):
    pytest.importorskip("dynamixel_sdk")
    from lerobot.motors.dynamixel import DynamixelMotorsBus

    asked = packet2(0xFE, 0x82, 124, 0, 22, 0, 1, 2)  # 124 to 145: PWM, current, velocity, position, ..., voltage
    held = [struct.pack("<hhiiiiH", 443, -120, 0, 2048, 0, 0, 50), struct.pack("<hhiiiiH", -885, 7, 0, 1024, 0, 0, 49)]
    answers = b"".join(packet2(k + 1, 0x55, 0, *data) for k, data in enumerate(held))
    values = {"duty": (443 / 885, -1.0), "current": (-0.12, 0.007), "voltage": (5.0, 4.9)}
    with connected(serial, DynamixelMotorsBus, "xl330-m288") as bus:
        position = read_at_once(bus, serial.stub(receive_bytes=asked, send_bytes=answers), values)
    assert position == pytest.approx({"pan": 0.5 * 360 / 4095, "lift": -1023.5 * 360 / 4095})


def test_servos_of_different_tables_get_a_request_a_register():
    """And so does a bus that is none of LeRobot's serial ones: the position first, as it would be asked for alone."""

    class Bus:
        motors = {"pan": Motor(1, "sts3215", MotorNormMode.DEGREES), "lift": Motor(2, "sts3250", MotorNormMode.DEGREES)}
        model_ctrl_table = {
            "sts3215": {"Present_Position": (56, 2), "Present_Load": (60, 2)},
            "sts3250": {"Present_Position": (56, 2), "Present_Load": (80, 2)},
        }
        asked: list[tuple[str, bool]] = []

        def sync_read(self, data_name, motors=None, *, normalize=True, num_retry=0):
            self.asked.append((data_name, normalize))
            return {"pan": 300, "lift": 1 << 10 | 20} if data_name == "Present_Load" else {"pan": 1.0, "lift": 2.0}

    bus = Bus()
    block = BlockRead(bus, ("duty",))
    assert not block.in_one_transaction
    with block.reading():
        assert bus.sync_read("Present_Position") == {"pan": 1.0, "lift": 2.0}
        bus.sync_read("Present_Position")  # a second one in the same tick reads nothing else again
    assert bus.asked == [("Present_Position", True), ("Present_Load", False), ("Present_Position", True)]
    assert block.values == {"duty": pytest.approx({"pan": 0.3, "lift": -0.02})}
