"""Servos of Feetech's STS series (SO-101), by feetech-servo-sdk. Never run on hardware: tested on a mocked bus."""

from __future__ import annotations

import importlib
import struct
from collections.abc import Sequence
from types import ModuleType

import numpy as np

from tauext.errors import ConfigError
from tauext.sources.reader import Unreachable
from tauext.sources.servo import Identity, Registers, ServoSource, sign_magnitude
from tauext.sources.servo_bus_file import ServoJoint
from tauext.sources.servo_port import ServoPort

MODELS = {777: "sts3215", 2825: "sts3250"}
AMPERE_A_COUNT = 0.0065
"""Present_Current: 6.5 mA."""
LOAD_BIT, SIGN_BIT, HOMING_BIT = 10, 15, 11
"""Of what direction and amount of their words are; of the word's own sign, none."""
ERRORS = {1: "voltage", 2: "angle sensor", 4: "overheated", 8: "overcurrent", 32: "overload"}
POSITION_MODE = 0


class FeetechPackets:
    """Protocol 0 of scservo_sdk: ids, lengths and a sum as a check."""

    overhead, asked, success, silence = 6, 8, 0, -6

    def __init__(self) -> None:
        self._library = scservo_sdk()
        self._handler = self._library.PacketHandler(0)

    def ask(self, port: ServoPort, address: int, length: int, ids: Sequence[int]) -> int:
        return self._handler.syncReadTx(port, address, length, list(ids), len(ids))

    def answer(self, port: ServoPort) -> tuple[int, int, int, bytes]:
        packet, result = self._handler.rxPacket(port)
        if result != self.success:
            return result, -1, 0, b""
        return result, packet[2], packet[4], bytes(packet[5 : 3 + packet[3]])

    def write(self, port: ServoPort, address: int, length: int, data: Sequence[int]) -> int:
        return self._handler.syncWriteTxOnly(port, address, length, list(data), len(data))


class FeetechSource(ServoSource):
    """STS3215 and its like: position, speed, duty (Present_Load), supply current, voltage, temperature and goal, as the
    servo has them in its registers 40 to 70: one sync read of 31 bytes a servo.

    The current has no direction. q_des is NaN while the torque of a servo is off: it follows no goal then.
    """

    kind = "feetech"
    packets = FeetechPackets
    identity = (3, 31)
    block = (40, 31)
    goal = (42, 2)
    position = (56, 2)
    torque_enable = (40, 1)
    current_turns = False

    def identified(self, servo: ServoJoint, data: bytes) -> Identity:
        number, offset, mode = struct.unpack_from("<H", data, 0)[0], struct.unpack_from("<H", data, 28)[0], data[30]
        if number not in MODELS:
            known = ", ".join(f"{name} ({k})" for k, name in MODELS.items())
            raise Unreachable(f"{servo} says model {number}; known are {known}")
        homing = sign_magnitude(offset, HOMING_BIT)
        return Identity(MODELS[number], ("duty", "supply-current"), homing, mode == POSITION_MODE)

    def registers(self, identity: Identity, data: bytes) -> Registers:
        on, goal = data[0], struct.unpack_from("<H", data, 2)[0]
        position, speed, load, volts, celsius = struct.unpack_from("<HHHBB", data, 16)
        current = struct.unpack_from("<H", data, 29)[0]
        follows = identity.holds and on == 1
        return Registers(
            count=sign_magnitude(position, SIGN_BIT),
            goal=sign_magnitude(goal, SIGN_BIT) if follows else np.nan,
            counts_a_s=sign_magnitude(speed, SIGN_BIT),
            current=sign_magnitude(current, SIGN_BIT) * AMPERE_A_COUNT,
            duty=sign_magnitude(load, LOAD_BIT) * 1e-3,
            volts=volts * 0.1,
            celsius=celsius,
        )

    def complaint(self, error: int) -> str:
        return ", ".join(text for bit, text in ERRORS.items() if error & bit) or (f"error {error}" if error else "")


def scservo_sdk() -> ModuleType:
    """The optional library.

    Raises:
        ConfigError: it is not installed.
    """
    try:
        return importlib.import_module("scservo_sdk")
    except ImportError as error:
        raise ConfigError("source feetech needs feetech-servo-sdk: pip install 'tauext[feetech]'") from error
