"""Joints on a bus of serial servos: ids, zeros and directions, from a bus file or a LeRobot calibration file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tauext.data.servo_types import MotorCalibration, load_lerobot_calibration
from tauext.errors import ConfigError
from tauext.files.toml_file import flag, number, one_of, read_table, read_toml, tables, text

MOST_ID = 252
BAUD = 1_000_000

BUS_KEYS = {
    "baud": number(9600, 4_500_000, BAUD, whole=True),
    "calibration": text("the path of a LeRobot calibration file", ""),
    "joints": tables("[joints.NAME]", {}),
}
JOINT_KEYS = {
    "id": number(0, MOST_ID, whole=True),
    "zero": number(-(1 << 31), 1 << 31, 2048.0),
    "sign": one_of((1, -1), 1, "1 or -1"),
    "multi_turn": flag(False),
    "type": text('a servo\'s name: "sts3215"', "", empty=True),
}


@dataclass(frozen=True)
class ServoJoint:
    """A joint and its servo."""

    name: str
    id: int
    zero: float = 2048.0
    """Count where the angle is 0."""
    sign: int = 1
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
class ServoBusFile:
    """A bus and its servos."""

    path: Path
    joints: dict[str, ServoJoint]
    baud: int = BAUD


def load_servo_bus(path: Path) -> ServoBusFile:
    """Load a bus file (docs/servo-arms.md) or a LeRobot calibration file (*.json).

    Raises:
        ConfigError: the file breaks a rule; the message names file, joint and rule.
    """
    if path.name.endswith(".json"):
        return ServoBusFile(path, {name: _calibrated(one) for name, one in load_lerobot_calibration(path).items()})
    bus = read_table(path, "", read_toml(path, "docs/servo-arms.md has an example"), BUS_KEYS)
    joints: dict[str, ServoJoint] = {}
    if beside := bus["calibration"]:
        place = Path(beside).expanduser() if beside.startswith(("/", "~")) else path.parent / beside
        joints = {name: _calibrated(one) for name, one in load_lerobot_calibration(place).items()}
    for name, table in bus["joints"].items():
        known = joints.get(name)
        keys = JOINT_KEYS
        if known is not None:
            keys = {key: rule._replace(default=getattr(known, key)) for key, rule in keys.items()}
        homing = None if known is None else known.homing_offset
        joints[name] = ServoJoint(name, **read_table(path, f"[joints.{name}]", table, keys), homing_offset=homing)
    if not joints:
        raise ConfigError(f"{path}: no joints: add [joints.NAME] or calibration = FILE")
    by_id: dict[int, str] = {}
    for name, joint in joints.items():
        if by_id.setdefault(joint.id, name) != name:
            raise ConfigError(f"{path}: joints '{by_id[joint.id]}' and '{name}' have the same id, {joint.id}")
    return ServoBusFile(path, joints, bus["baud"])


def _calibrated(motor: MotorCalibration) -> ServoJoint:
    return ServoJoint(motor.name, motor.id, motor.middle, homing_offset=motor.homing_offset)
