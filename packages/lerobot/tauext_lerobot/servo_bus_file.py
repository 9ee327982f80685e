"""Joints on a bus of serial servos: ids, zeros and directions, from the table [bus] of a cell's file."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from tauext.config import within
from tauext.errors import ConfigError
from tauext.files.typed_table import TableName, read_table
from tauext.monitor.cell_file import Cell
from tauext_lerobot.calibration import MotorCalibration, load_lerobot_calibration

BAUD = 1_000_000


@dataclass(frozen=True)
class ServoJoint:
    """A joint and its servo: a table [bus.joints.NAME]."""

    name: TableName
    id: Annotated[int, within(0, 252)]
    zero: Annotated[float, within(-(1 << 31), 1 << 31)] = 2048.0
    """Count where the angle is 0."""
    sign: Literal[1, -1] = 1
    """-1: the angle falls as the counts rise."""
    multi_turn: bool = False
    """Counts continue beyond a turn. Otherwise angles are within half a turn of the zero."""
    type: str = ""
    """Required type, such as xl330-m288, or its beginning; empty: any known type."""
    homing_offset: int | None = None
    """Required homing offset of the servo, [counts]; None: any."""

    def __str__(self) -> str:
        return f"servo {self.id} ({self.name})"


@dataclass(frozen=True)
class BusTable:
    """Keys of [bus]."""

    baud: Annotated[int, within(9600, 4_500_000)] = BAUD
    calibration: str = ""
    """Path of a LeRobot calibration file, which describes joints; keys of [bus.joints.NAME] take precedence."""
    joints: dict[str, dict] = field(default_factory=dict)


@dataclass(frozen=True)
class ServoBusFile:
    """A bus and its servos."""

    path: Path
    joints: dict[str, ServoJoint]
    baud: int = BAUD


def servo_bus(cell: Cell) -> ServoBusFile:
    """The bus of a cell's file (docs/servo-arms.md).

    Raises:
        ConfigError: the file breaks a rule; the message names file, joint and rule.
    """
    bus, where = read_table(BusTable, cell.bus, f"{cell.path}: [bus]"), f"{cell.path}: [bus.joints"
    tables: dict[str, dict[str, Any]] = {}
    if bus.calibration:
        place = cell.path.parent / str(Path(bus.calibration).expanduser())
        tables = {name: calibrated(one) for name, one in load_lerobot_calibration(place).items()}
    for name, table in bus.joints.items():
        tables[name] = tables.get(name, {}) | table
    joints = {name: read_table(ServoJoint, one, f"{where}.{name}]", name=name) for name, one in tables.items()}
    if not joints:
        raise ConfigError(f"{cell.path}: [bus] no joints: add [bus.joints.NAME] or calibration = FILE")
    by_id: dict[int, str] = {}
    for name, joint in joints.items():
        if by_id.setdefault(joint.id, name) != name:
            raise ConfigError(
                f"{cell.path}: [bus] joints '{by_id[joint.id]}' and '{name}' have the same id, {joint.id}"
            )
    return ServoBusFile(cell.path, joints, bus.baud)


def calibrated(motor: MotorCalibration) -> dict[str, Any]:
    """Keys of the joint of a calibrated motor."""
    return {"id": motor.id, "zero": motor.middle, "homing_offset": motor.homing_offset}
