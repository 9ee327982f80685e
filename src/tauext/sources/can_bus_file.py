"""What a CAN bus of Damiao motors carries: their ids, zeros and directions by joint, from a file."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from tauext.data.description_file import refuse_unknown
from tauext.errors import ConfigError
from tauext.files.place import Place
from tauext.files.toml_file import number, read_toml

MOST_ID = 0x7FE
"""0x7FF is the address of commands to all."""
BAUD = 1_000_000


@dataclass(frozen=True)
class CanMotor:
    """A joint and its motor."""

    name: str
    id: int
    """ESC_ID: that it is asked by."""
    answer_id: int
    """MST_ID: that it answers with."""
    zero_rad: float = 0.0
    """Its position where the joint's angle is 0, [rad]."""
    sign: int = 1
    """-1: the joint's angle falls as the motor's rises."""
    ranges: tuple[float, float, float] | None = None
    """PMAX [rad], VMAX [rad/s], TMAX [N m]: ends of the numbers in its answers; None: the motor is asked for them."""

    def __str__(self) -> str:
        return f"motor {self.id:#04x} ({self.name})"


@dataclass(frozen=True)
class CanBusFile:
    """A bus and its motors."""

    path: Place
    motors: dict[str, CanMotor]
    interface: str = "socketcan"
    """Of python-can."""
    baud: int = BAUD
    fd_baud: int | None = None
    """Of the data of CAN FD frames; None: classic CAN."""
    ask: bool = True
    """Ask each motor for its state; False: another program commands them, their answers are overheard, and nothing is
    sent: a question for ranges, too, would be answered where that program expects a state."""

    def of(self, names: tuple[str, ...]) -> list[CanMotor]:
        """The motors of these joints.

        Raises:
            ConfigError: one is not in the file.
        """
        for name in names:
            if name not in self.motors:
                there = ", ".join(self.motors)
                raise ConfigError(f"{self.path}: joint '{name}' of the bundle is missing; there are {there}")
        return [self.motors[name] for name in names]


def load_can_bus(path: Place) -> CanBusFile:
    """A file like

        interface = "socketcan"    # of python-can; the bit rate of a socketcan interface is set by `ip link`
        baud = 1000000             # fd_baud = 5000000: CAN FD
        ask = true                 # false: send nothing, overhear the answers to another program's commands

        [joints.joint_1]           # by the name that the bundle has
        id = 0x01                  # answer_id = 0x11: id + 0x10 if left out
        # zero_rad = 0.0           # the motor's position where the joint's angle is 0
        # sign = -1
        # ranges = [12.5, 30, 10]  # PMAX, VMAX, TMAX; the motor is asked if left out, which needs ask = true

    Raises:
        ConfigError: names the file, the joint and the rule that is broken.
    """
    content = read_toml(path)
    refuse_unknown(path, "", content, ("interface", "baud", "fd_baud", "ask", "joints"))
    tables = content.get("joints")
    if not isinstance(tables, dict) or not tables:
        raise ConfigError(f"{path}: no joints: [joints.NAME] with id = 0x01 is missing")
    motors = {name: _motor(path, name, table) for name, table in tables.items()}
    by_id: dict[tuple[int, int], str] = {}
    for name, motor in motors.items():
        if (other := by_id.setdefault((motor.answer_id, motor.id & 0xF), name)) != name:
            raise ConfigError(
                f"{path}: answers of joints '{other}' and '{name}' cannot be told apart: one answer_id, and ids "
                "with the same last digit"
            )
    interface, ask, fd_baud = content.get("interface", "socketcan"), content.get("ask", True), content.get("fd_baud")
    if not isinstance(interface, str) or not interface:
        raise ConfigError(f'{path}: interface = {interface!r} must be one of python-can: "socketcan"')
    if not isinstance(ask, bool):
        raise ConfigError(f"{path}: ask = {ask!r} must be true or false")
    for motor in motors.values():
        if not ask and motor.ranges is None:
            raise ConfigError(
                f"{path}: [joints.{motor.name}] ranges = [PMAX, VMAX, TMAX] is missing: with ask = false the motor "
                "is not asked for them"
            )
    baud = round(number(f"{path}: baud", content.get("baud", BAUD), 1e4, 1e7))
    fd = None if fd_baud is None else round(number(f"{path}: fd_baud", fd_baud, 1e4, 1e7))
    return CanBusFile(path, motors, interface, baud, fd, ask)


def _motor(path: Place, name: str, table: Any) -> CanMotor:
    where = f"{path}: [joints.{name}]"
    refuse_unknown(path, f"joints.{name}", table, ("id", "answer_id", "zero_rad", "sign", "ranges"))
    if "id" not in table:
        raise ConfigError(f"{where} id is missing")
    id_ = number(f"{where} id", table["id"], 1, MOST_ID)
    answer = number(f"{where} answer_id", table.get("answer_id", id_ + 0x10), 0, MOST_ID)
    zero = number(f"{where} zero_rad", table.get("zero_rad", 0.0), -100, 100)
    sign, ranges = table.get("sign", 1), table.get("ranges")
    if ranges is not None:
        if not isinstance(ranges, list) or len(ranges) != 3:
            raise ConfigError(f"{where} ranges = {ranges!r} must be [PMAX, VMAX, TMAX]: [12.5, 30, 10]")
        ranges = tuple(number(f"{where} ranges", one, 1e-3, 1e4) for one in ranges)
    if id_ != round(id_) or answer != round(answer):
        raise ConfigError(f"{where} id and answer_id must be whole numbers")
    if sign not in (1, -1) or isinstance(sign, bool):
        raise ConfigError(f"{where} sign = {sign!r} must be 1 or -1")
    return CanMotor(name, round(id_), round(answer), zero, sign, ranges)
