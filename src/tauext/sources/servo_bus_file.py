"""What a bus of serial servos carries: ids, zeros and directions of the joints, from a file, ours or LeRobot's."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tauext.data.description_file import refuse_unknown
from tauext.data.servo_types import MotorCalibration, load_lerobot_calibration
from tauext.errors import ConfigError
from tauext.files.places import Place
from tauext.files.toml_file import number, read_toml

MOST_ID = 252
BAUD = 1_000_000
TEMPLATE = """\
# A bus of serial servos, for `tauext monitor --source feetech:PORT --bus THIS` or dynamixel:PORT.
# LeRobot's calibration file alone can stand in the place of this file: --bus my_follower.json.

baud = 1000000
# calibration = "my_follower.json"    # LeRobot's: ids, and zeros at the middle of the ranges; tables below go first

# A table a joint, by the name that it has in the bundle.
[joints.shoulder_pan]
id = 1
zero = 2048              # count of the encoder where the angle is 0
# sign = -1              # where the angle falls as the counts rise; 1 if left out
# multi_turn = true      # counts go on beyond a turn; if left out, angles are within half a turn of the zero
# type = "sts3215"       # refuse another servo; if left out, what the servo says that it is
"""


@dataclass(frozen=True)
class ServoJoint:
    """A joint and its servo."""

    name: str
    id: int
    zero: float = 2048.0
    """Where the angle is 0, [counts]."""
    sign: int = 1
    """-1: the angle falls as the counts rise."""
    multi_turn: bool = False
    """Counts go on beyond a turn. Otherwise angles are within half a turn of the zero."""
    type: str = ""
    """That it must be, say xl330-m288, or the beginning of it; empty: any that is known."""
    homing_offset: int | None = None
    """That it must hold, [counts]; None: any."""

    def __str__(self) -> str:
        return f"servo {self.id} ({self.name})"


@dataclass(frozen=True)
class ServoBusFile:
    """A bus and its servos."""

    path: Place
    joints: dict[str, ServoJoint]
    baud: int = BAUD

    def of(self, names: tuple[str, ...]) -> list[ServoJoint]:
        """The servos of these joints.

        Raises:
            ConfigError: one is not in the file.
        """
        for name in names:
            if name not in self.joints:
                raise ConfigError(f"{self.path}: joint '{name}' of the bundle is missing; there are {self._names()}")
        return [self.joints[name] for name in names]

    def _names(self) -> str:
        return ", ".join(self.joints)


def load_servo_bus(path: Place) -> ServoBusFile:
    """A bus file (TEMPLATE says what it may hold), or a LeRobot calibration file (*.json).

    Raises:
        ConfigError: names the file, the joint and the rule that is broken.
    """
    if path.name.endswith(".json"):
        return ServoBusFile(path, {name: _calibrated(one) for name, one in load_lerobot_calibration(path).items()})
    content = read_toml(path, "--new-bus")
    refuse_unknown(path, "", content, ("baud", "calibration", "joints"))
    joints: dict[str, ServoJoint] = {}
    if "calibration" in content:
        beside = content["calibration"]
        if not isinstance(beside, str) or not beside:
            raise ConfigError(f"{path}: calibration = {beside!r} must be the path of a LeRobot calibration file")
        place = Path(beside).expanduser() if beside.startswith(("/", "~")) else path.parent / beside
        joints = {name: _calibrated(one) for name, one in load_lerobot_calibration(place).items()}
    tables = content.get("joints", {})
    if not isinstance(tables, dict):
        raise ConfigError(f"{path}: [joints] is {tables!r}, must be a table a joint: [joints.elbow_flex]")
    for name, table in tables.items():
        joints[name] = _joint(path, name, table, joints.get(name))
    if not joints:
        raise ConfigError(f"{path}: no joints: neither [joints.NAME] nor calibration = FILE")
    by_id: dict[int, str] = {}
    for name, joint in joints.items():
        if by_id.setdefault(joint.id, name) != name:
            raise ConfigError(f"{path}: joints '{by_id[joint.id]}' and '{name}' have one id, {joint.id}")
    baud = number(f"{path}: baud", content.get("baud", BAUD), 9600, 4_500_000)
    return ServoBusFile(path, joints, round(baud))


def _calibrated(motor: MotorCalibration) -> ServoJoint:
    return ServoJoint(motor.name, motor.id, motor.middle, homing_offset=motor.homing_offset)


def _joint(path: Place, name: str, table: Any, known: ServoJoint | None) -> ServoJoint:
    """The joint of a table; what it does not say is as known, if it is."""
    where = f"{path}: [joints.{name}]"
    refuse_unknown(path, f"joints.{name}", table, ("id", "zero", "sign", "multi_turn", "type"))
    if "id" not in table and known is None:
        raise ConfigError(f"{where} id is missing")
    known = known or ServoJoint(name, -1)
    sign, turns, kind = (table.get(key, getattr(known, key)) for key in ("sign", "multi_turn", "type"))
    id_ = number(f"{where} id", table.get("id", known.id), 0, MOST_ID)
    zero = number(f"{where} zero", table.get("zero", known.zero), -(1 << 31), 1 << 31)
    if id_ != round(id_):
        raise ConfigError(f"{where} id = {id_:g} must be a whole number")
    if sign not in (1, -1) or isinstance(sign, bool):
        raise ConfigError(f"{where} sign = {sign!r} must be 1 or -1")
    if not isinstance(turns, bool):
        raise ConfigError(f"{where} multi_turn = {turns!r} must be true or false")
    if not isinstance(kind, str):
        raise ConfigError(f'{where} type = {kind!r} must be a servo\'s name: "sts3215"')
    return ServoJoint(name, round(id_), zero, sign, turns, kind, known.homing_offset)
