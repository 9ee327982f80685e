"""Supported serial servos: packets, registers and models of Feetech's STS and of the Dynamixel X series."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any, NamedTuple

from tauext.data.servo_types import COUNTS_A_TURN


class Register(NamedTuple):
    """A number in a servo's memory or in a packet, little-endian."""

    address: int
    layout: str
    """Format character of the module struct."""
    unit: float = 1
    """Value of one count."""
    sign_bit: int | None = None
    """Index of the sign bit; the bits below it are the amount. None: the sign follows from the layout."""

    @property
    def block(self) -> tuple[int, int]:
        """Address and length in bytes."""
        return self.address, struct.calcsize(self.layout)

    def of(self, data: bytes, first: int = 0) -> float:
        """Decode the value from bytes that begin at address `first`."""
        (word,) = struct.unpack_from(f"<{self.layout}", data, self.address - first)
        if self.sign_bit is not None:
            amount = word & ((1 << self.sign_bit) - 1)
            word = -amount if word >> self.sign_bit & 1 else amount
        return word * self.unit


@dataclass(frozen=True)
class Series:
    """A series of servos of one manufacturer."""

    kind: str
    """Name on the command line."""
    package: str
    library: str
    """Module of the package."""
    protocol: float
    flags: tuple[Any, ...]
    """Further arguments of the library's functions that send and receive."""
    silence: int
    """Return value of these functions if no packet arrived."""
    request_bytes: int
    """Bytes of a request for a block, without the ids."""
    overhead: int
    """Bytes of an answer, without its data."""
    packet: dict[str, Register]
    """id, length and error of an answer. The data follow the error."""
    identity: tuple[int, int]
    """First register and length of the block that identifies the servo: model, mode, homing."""
    state: tuple[int, int]
    """First register and length of the block that is read every period."""
    registers: dict[str, Register]
    """Registers in use of `identity` and `state`, in counts, counts/s, shares of the supply voltage, V and degC.
    `torque` is 1 if the servo's torque is on."""
    models: dict[int, tuple[str, float | None]]
    """By model number: name, and current [A per count]; None: the servo measures no current."""
    holds: tuple[int, ...]
    """Operating modes in which a servo follows a goal position."""
    current: str
    """supply-current has no direction; phase-current has the joint's."""
    complaints: dict[int, str]
    """Error bits of an answer."""


FEETECH = Series(
    kind="feetech", package="feetech-servo-sdk", library="scservo_sdk", protocol=0, flags=(), silence=-6,
    request_bytes=8, overhead=6, packet={"id": Register(2, "B"), "length": Register(3, "B"), "error": Register(4, "B")},
    identity=(3, 31), state=(40, 31),
    registers={
        "model": Register(3, "H"), "homing": Register(31, "H", sign_bit=11), "mode": Register(33, "B"),
        "torque": Register(40, "B"), "goal": Register(42, "H", sign_bit=15), "position": Register(56, "H", sign_bit=15),
        "speed": Register(58, "H", sign_bit=15), "duty": Register(60, "H", 1e-3, 10), "voltage": Register(62, "B", 0.1),
        "celsius": Register(63, "B"), "current": Register(69, "H", sign_bit=15),
    },
    models={777: ("sts3215", 0.0065), 2825: ("sts3250", 0.0065)}, holds=(0,), current="supply-current",
    complaints={1: "voltage", 2: "angle sensor", 4: "overheated", 8: "overcurrent", 32: "overload"},
)  # fmt: skip
"""STS3215 and similar (SO-101), protocol 0: ids, lengths and a checksum. Never run on hardware: tested on a
mocked bus. The duty is the register Present_Load."""
DYNAMIXEL = Series(
    kind="dynamixel", package="dynamixel-sdk", library="dynamixel_sdk", protocol=2.0, flags=(False,), silence=-3001,
    request_bytes=14, overhead=11,
    packet={"id": Register(4, "B"), "length": Register(5, "H"), "error": Register(8, "B")},
    identity=(0, 24), state=(116, 31),
    registers={
        "model": Register(0, "H"), "mode": Register(11, "B"), "homing": Register(20, "i"), "torque": Register(64, "B"),
        "goal": Register(116, "i"), "duty": Register(124, "h", 1 / 885), "current": Register(126, "h"),
        "speed": Register(128, "i", 0.229 / 60 * COUNTS_A_TURN), "position": Register(132, "i"),
        "voltage": Register(144, "H", 0.1), "celsius": Register(146, "B"),
    },
    models={
        1190: ("xl330-m077", 0.001), 1200: ("xl330-m288", 0.001), 1060: ("xl430-w250", None),
        1030: ("xm430-w210", 0.00269), 1020: ("xm430-w350", 0.00269), 1130: ("xm540-w150", 0.00269),
        1120: ("xm540-w270", 0.00269), 1110: ("xh540-w150", 0.00269), 1210: ("xc330-t181", 0.001),
        1220: ("xc330-t288", 0.001), 1070: ("xc430-w150", None),
    },
    holds=(3, 4, 5), current="phase-current", complaints={0x80: "a hardware alert; its register 70 holds the cause"},
)  # fmt: skip
"""The X series (Koch, ViperX), protocol 2.0: ids, lengths, stuffed bytes and a CRC. Never run on hardware: tested on a
mocked bus. One block of 31 bytes needs no indirect addresses. The duty is Present PWM, at most 885 counts. An XL430
reports an estimated load in place of a current."""
SERIES = {series.kind: series for series in (FEETECH, DYNAMIXEL)}
