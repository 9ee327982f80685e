"""Damiao motors (OpenArm) over CAN, by python-can. Tested on its virtual bus, never on hardware."""

from __future__ import annotations

import struct
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from tauext.config import Rule, within
from tauext.errors import ConfigError
from tauext.files.typed_table import TableName, Text, read_table
from tauext.monitor.cell_file import Cell
from tauext.monitor.source import Sample, SourceFacts, SourceSettings
from tauext.plugins import optional_library
from tauext.sources.describing import chosen_joints, learnt_period_ns
from tauext.sources.reader import ReaderSource, Unreachable
from tauext_lerobot.bus_source import TRIES, WAIT_S, BusSource, shortest_period_ns

# --- The bus file: ids, zeros and directions of the motors by joint.


MOST_ID = 0x7FE
"""0x7FF addresses commands to all motors."""
BitRate = Annotated[int, within(1e4, 1e7)]
Range = Annotated[float, within(1e-3, 1e4)]


@dataclass(frozen=True)
class CanMotor:
    """A joint and its motor: a table [bus.joints.NAME]."""

    name: TableName
    id: Annotated[int, within(1, MOST_ID)]
    """ESC_ID: id of requests to it."""
    answer_id: Annotated[int, within(0, MOST_ID)] = -1
    """MST_ID: id of its answers; -1: id + 0x10."""
    zero_rad: Annotated[float, within(-100, 100)] = 0.0
    """Its position where the joint's angle is 0, [rad]."""
    sign: Literal[1, -1] = 1
    """-1: the joint's angle falls as the motor's position rises."""
    ranges: Annotated[tuple[Range, Range, Range], Rule(", [PMAX, VMAX, TMAX]", bool)] | None = None
    """PMAX [rad], VMAX [rad/s], TMAX [N m]: ranges of the numbers in its answers; None: read from the motor."""

    def __post_init__(self) -> None:
        if self.answer_id < 0:
            object.__setattr__(self, "answer_id", self.id + 0x10)

    def __str__(self) -> str:
        return f"motor {self.id:#04x} ({self.name})"


@dataclass(frozen=True)
class CanBus:
    """A bus and its motors: the table [bus].

    [bus]
    interface = "socketcan"    # of python-can; the bit rate of a socketcan interface is set by `ip link`
    baud = 1000000             # fd_baud = 5000000: CAN FD
    ask = true                 # false: send nothing, listen to the answers to another program's commands

    [bus.joints.joint_1]       # joint name of the bundle
    id = 0x01                  # answer_id = 0x11: id + 0x10 if left out
    # zero_rad = 0.0           # the motor's position where the joint's angle is 0
    # sign = -1
    # ranges = [12.5, 30, 10]  # PMAX, VMAX, TMAX; read from the motor if left out, which needs ask = true
    """

    joints: Annotated[dict[str, CanMotor], Rule(" [bus.joints.NAME] with id = 0x01, one or more", bool)]
    interface: Text = "socketcan"
    """Interface of python-can."""
    baud: BitRate = 1_000_000
    fd_baud: BitRate | None = None
    """Bit rate of the data of CAN FD frames, [bit/s]; None: classic CAN."""
    ask: bool = True
    """Poll the state of each motor. False: another program commands the motors, the source listens to their answers and
    sends nothing, since that program could mistake an answer to a request for ranges for a state."""


def can_bus(cell: Cell) -> CanBus:
    """The bus of a cell's file.

    Raises:
        ConfigError: the file breaks a rule; the message names file, joint and rule.
    """
    path = cell.path
    bus = read_table(CanBus, cell.bus, f"{path}: [bus]")
    by_id: dict[tuple[int, int], str] = {}
    for name, motor in bus.joints.items():
        if (other := by_id.setdefault((motor.answer_id, motor.id & 0xF), name)) != name:
            raise ConfigError(
                f"{path}: answers of joints '{other}' and '{name}' cannot be distinguished: same answer_id, and ids "
                "with the same last digit"
            )
    for motor in bus.joints.values():
        if not bus.ask and motor.ranges is None:
            raise ConfigError(
                f"{path}: [bus.joints.{motor.name}] ranges = [PMAX, VMAX, TMAX] is missing: with ask = false the motor "
                "cannot be polled for them"
            )
    return bus


# --- The source.


TO_ALL = 0x7FF
STATE, REGISTER = 0xCC, 0x33
"""Third byte of a command to TO_ALL: request the state or a register. Commands that set a register are never sent."""
FAULTS = {
    0x8: "too high a voltage", 0x9: "too low a voltage", 0xA: "overcurrent", 0xB: "hot bridge", 0xC: "hot windings",
    0xD: "communication lost", 0xE: "overload",
}  # fmt: skip
"""Upper half of a state's first byte; 0 and 1: disabled, enabled."""


class DamiaoSource(BusSource):
    """Reads position, speed, torque [N m] and winding temperature: one state of each motor per period, with 16, 12 and
    12 bits over the motor's ranges.

    A polled motor sends its state whether it is enabled or not. The source sends requests only, and with ask = false
    nothing: no enable, no MIT frame, and it sets no register. There is no stop(): the program that drives the motors
    would continue.
    """

    def __init__(self, channel: str, bus: CanBus, path: Path = Path("cell.toml")):
        super().__init__(f"damiao {channel}")
        self._channel, self._of_bus, self._path = channel, bus, path
        self._bus: Any = None
        self._motors: list[CanMotor] = []
        self.answer_s = 0.02
        """Longest delay of an answer."""

    def find_out(self, wait_s: float, robot: Path | None) -> SourceFacts:
        """Time some readings; the period is the shortest usual one of at least twice a reading. With ask = false: learn
        the other program's."""
        joints, notes = chosen_joints(list(self._of_bus.joints), robot, self.name)
        settings = SourceSettings(joints, 20_000_000 if self._of_bus.ask else 1, ("N m",) * len(joints), "instant")
        self._prepare(settings)
        self.settings = settings
        self.connect()
        samples = self.several(wait_s)
        if self._of_bus.ask:
            period_ns = shortest_period_ns(samples, (1, 2, 5, 10, 20), self.name)
        else:
            period_ns = learnt_period_ns([one.t_ns for one in samples], self.name)
        return SourceFacts(replace(settings, period_ns=period_ns), "torque", temperature=True, notes=notes)

    def open(self, settings: SourceSettings) -> None:
        self._prepare(settings)
        super().open(settings)

    def _prepare(self, settings: SourceSettings) -> None:
        self._motors = self.motors_of(settings.joints, self._path, self._of_bus.joints)
        if any(unit not in ("N m", "N") for unit in settings.torque_units):
            raise ConfigError(f"{self.name} reports torque in N m, the bundle takes {', '.join(settings.torque_units)}")
        if settings.servo is not None and settings.servo.on and settings.servo.torque_from.name != "torque":
            wanted = settings.servo.torque_from.name.replace("_", "-")
            raise ConfigError(f"{self.name} reports torque, the bundle takes its torque from {wanted}")
        self._which = {(one.answer_id, one.id & 0xF): k for k, one in enumerate(self._motors)}

    def connect(self) -> None:
        library = self._library = optional_library("can", "source damiao", "python-can")
        rates: dict[str, Any] = {"bitrate": self._of_bus.baud}
        if self._of_bus.fd_baud is not None:
            rates |= {"fd": True, "data_bitrate": self._of_bus.fd_baud}
        try:
            self._bus = library.Bus(interface=self._of_bus.interface, channel=self._channel, **rates)
        except (library.CanError, OSError, ValueError) as error:
            raise Unreachable(
                f"{error}; is the interface up? `ip link set {self._channel} up type can bitrate 1000000`"
            ) from error
        try:
            self._ranges = np.array([self._ranges_of(motor) for motor in self._motors])
        except Unreachable:
            self.disconnect()
            raise
        self._states: dict[int, bytes] = {}
        self._due_s = None

    def read(self) -> Sample | None:
        return super().read() if self._of_bus.ask else self._overheard()

    def ask(self) -> Sample | None:
        if not self._of_bus.ask:
            return self._overheard()
        while self._receive(0.0) is not None:  # late answers to an earlier request
            pass
        t_ns = time.monotonic_ns()
        for motor in self._motors:
            self._send(motor, STATE)
        states: dict[int, bytes] = {}
        until = time.monotonic() + self.answer_s
        while len(states) < len(self._motors) and (left_s := until - time.monotonic()) > 0:
            if (came := self._state(left_s)) is not None:
                states[came[0]] = came[1]
        return self._whole(t_ns, states)

    def disconnect(self) -> None:
        if self._bus is not None:
            self._bus.shutdown()
            self._bus = None

    # Inside.

    def _count_lost(self, t_ns: int) -> None:
        if not self._of_bus.ask:
            ReaderSource._count_lost(self, t_ns)

    def _overheard(self) -> Sample | None:
        """A sample once every motor has answered another program; a motor that answers twice before starts over."""
        if (came := self._state(WAIT_S)) is None:
            return None
        index, state = came
        states, again = self._states, index in self._states
        if not states or again:
            self._begun_ns = time.monotonic_ns()
        if again:
            self._states = {index: state}
            return self._whole(self._begun_ns, states)
        states[index] = state
        if len(states) < len(self._motors):
            return None
        self._states = {}
        return self._whole(self._begun_ns, states)

    def _whole(self, t_ns: int, states: dict[int, bytes]) -> Sample | None:
        if not self.whole([self._motors[k].id for k in states]):
            self._last_ns = t_ns  # refused, but not lost
            return None
        data = np.array([list(states[k]) for k in range(len(self._motors))])
        for motor, fault in zip(self._motors, data[:, 0] >> 4, strict=True):
            self.reports(motor.id, FAULTS.get(int(fault), ""))
        counts = np.stack(
            [
                data[:, 1] << 8 | data[:, 2],
                data[:, 3] << 4 | data[:, 4] >> 4,
                (data[:, 4] & 0xF) << 8 | data[:, 5],
            ],
            axis=1,
        )
        ends = np.array([0xFFFF, 0xFFF, 0xFFF])
        position, speed, torque = ((counts / ends * 2 - 1) * self._ranges).T
        sign = np.array([float(motor.sign) for motor in self._motors])
        zero = np.array([motor.zero_rad for motor in self._motors])
        return Sample(
            t_ns=t_ns,
            q=sign * (position - zero),
            dq=sign * speed,
            tau=sign * torque,
            received_ns=time.monotonic_ns(),
            temperature=data[:, 7].astype(float),
        )

    def _state(self, wait_s: float) -> tuple[int, bytes] | None:
        """Receive a state: index of the motor, and the state; None: none arrived."""
        message = self._receive(wait_s)
        if message is None or len(message.data) != 8:
            return None
        data = bytes(message.data)
        if data[1] == 0 and data[2] in (REGISTER, 0x55, 0xAA) and data[3] <= 81:
            return None  # a register that another program has requested, written or stored, not a state
        k = self._which.get((message.arbitration_id, data[0] & 0xF))
        return None if k is None else (k, data)

    def _ranges_of(self, motor: CanMotor) -> list[float]:
        """PMAX, VMAX and TMAX of a motor. Raises Unreachable: it does not answer."""
        if motor.ranges is not None:
            return list(motor.ranges)
        found = []
        for register in (21, 22, 23):  # PMAX [rad], VMAX [rad/s], TMAX [N m]: ranges of the numbers in a state
            for _ in range(TRIES):
                self._send(motor, REGISTER, register)
                if (value := self._register(motor, register)) is not None:
                    break
            else:
                raise Unreachable(
                    f"{motor} does not answer: check its power, its id and its answer id {motor.answer_id:#04x}"
                )
            if not 0 < value < 1e4:
                raise Unreachable(f"{motor} reports an invalid range: register {register} is {value:g}")
            found.append(value)
        return found

    def _register(self, motor: CanMotor, register: int) -> float | None:
        until = time.monotonic() + WAIT_S
        head = bytes([motor.id & 0xFF, motor.id >> 8, REGISTER, register])
        while (left_s := until - time.monotonic()) > 0:
            message = self._receive(left_s)
            if message is not None and message.arbitration_id == motor.answer_id and message.data[:4] == head:
                return struct.unpack_from("<f", message.data, 4)[0]
        return None

    def _send(self, motor: CanMotor, command: int, register: int = 0) -> None:
        library = self._library
        data = [motor.id & 0xFF, motor.id >> 8, command, register, 0, 0, 0, 0]
        fd = self._of_bus.fd_baud is not None
        message = library.Message(arbitration_id=TO_ALL, data=data, is_extended_id=False, is_fd=fd, bitrate_switch=fd)
        try:
            self._bus.send(message, timeout=WAIT_S)
        except (library.CanError, OSError) as error:
            raise Unreachable(f"sending failed: {error}") from error

    def _receive(self, wait_s: float) -> Any:
        """The next data frame with a standard id; None: none arrived."""
        library = self._library
        try:
            message = self._bus.recv(wait_s)
        except (library.CanError, OSError) as error:
            raise Unreachable(f"the bus is lost: {error}") from error
        usable = message is not None and not (message.is_error_frame or message.is_remote_frame)
        return message if usable and not message.is_extended_id else None
