"""Servos of the Dynamixel X series (Koch, ViperX), by dynamixel-sdk. Never run on hardware: tested on a mocked bus."""

from __future__ import annotations

import importlib
import math
import struct
from collections.abc import Sequence
from types import ModuleType

import numpy as np

from tauext.data.servo_types import COUNTS_A_TURN
from tauext.errors import ConfigError
from tauext.sources.reader import Unreachable
from tauext.sources.servo import Identity, Registers, ServoSource
from tauext.sources.servo_bus_file import ServoJoint
from tauext.sources.servo_port import ServoPort

MODELS = {
    1190: ("xl330-m077", 0.001),
    1200: ("xl330-m288", 0.001),
    1060: ("xl430-w250", None),
    1030: ("xm430-w210", 0.00269),
    1020: ("xm430-w350", 0.00269),
    1130: ("xm540-w150", 0.00269),
    1120: ("xm540-w270", 0.00269),
}
"""Model number: name and Present Current [A a count]; None: it has Present Load there, an estimate of its own."""
DUTY_A_COUNT = 1 / 885
"""Present PWM: 0.113 %, of which 885 are all."""
TURNS_A_SECOND_A_COUNT = 0.229 / 60
"""Present Velocity: 0.229 rpm."""
POSITION_MODES = (3, 4, 5)
"""Position, extended position, current-based position."""
ALERT = 0x80


class DynamixelPackets:
    """Protocol 2.0 of dynamixel_sdk: ids, lengths, stuffed bytes and a CRC."""

    overhead, asked, success, silence = 11, 14, 0, -3001

    def __init__(self) -> None:
        self._handler = dynamixel_sdk().PacketHandler(2.0)

    def ask(self, port: ServoPort, address: int, length: int, ids: Sequence[int]) -> int:
        return self._handler.syncReadTx(port, address, length, list(ids), len(ids), False)

    def answer(self, port: ServoPort) -> tuple[int, int, int, bytes]:
        packet, result = self._handler.rxPacket(port, False)
        if result != self.success:
            return result, -1, 0, b""
        return result, packet[4], packet[8], bytes(packet[9 : 5 + packet[5] + 256 * packet[6]])

    def write(self, port: ServoPort, address: int, length: int, data: Sequence[int]) -> int:
        return self._handler.syncWriteTxOnly(port, address, length, list(data), len(data))


class DynamixelSource(ServoSource):
    """X series: position, speed, winding current, duty (Present PWM), voltage, temperature and goal, as the servo has
    them in its registers 116 to 146: one sync read of 31 bytes a servo, so that no indirect addresses need be written.

    An XL430 has no current: NaN. q_des is NaN in operating modes without a goal position.
    """

    kind = "dynamixel"
    packets = DynamixelPackets
    identity = (0, 24)
    block = (116, 31)
    goal = (116, 4)
    position = (132, 4)
    torque_enable = (64, 1)
    current_turns = True

    def identified(self, servo: ServoJoint, data: bytes) -> Identity:
        number, mode, offset = struct.unpack_from("<H", data)[0], data[11], struct.unpack_from("<i", data, 20)[0]
        if number not in MODELS:
            known = ", ".join(f"{name} ({k})" for k, (name, _) in MODELS.items())
            raise Unreachable(f"{servo} says model {number}; known are {known}")
        name, ampere = MODELS[number]
        reports = ("duty",) if ampere is None else ("phase-current", "duty")
        return Identity(name, reports, offset, mode in POSITION_MODES)

    def registers(self, identity: Identity, data: bytes) -> Registers:
        (goal,) = struct.unpack_from("<i", data)
        duty, current, speed, position = struct.unpack_from("<hhii", data, 8)
        volts, celsius = struct.unpack_from("<HB", data, 28)
        ampere = next(ampere for name, ampere in MODELS.values() if name == identity.model)
        return Registers(
            count=position,
            goal=goal if identity.holds else math.nan,
            counts_a_s=speed * TURNS_A_SECOND_A_COUNT * COUNTS_A_TURN,
            current=np.nan if ampere is None else current * ampere,
            duty=duty * DUTY_A_COUNT,
            volts=volts * 0.1,
            celsius=celsius,
        )

    def complaint(self, error: int) -> str:
        return "a hardware alert; its register 70 says which" if error & ALERT else ""


def dynamixel_sdk() -> ModuleType:
    """The optional library.

    Raises:
        ConfigError: it is not installed.
    """
    try:
        return importlib.import_module("dynamixel_sdk")
    except ImportError as error:
        raise ConfigError("source dynamixel needs dynamixel-sdk: pip install 'tauext[dynamixel]'") from error
