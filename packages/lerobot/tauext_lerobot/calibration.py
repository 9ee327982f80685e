"""Angles of servos by a LeRobot calibration file, from counts, -100 to 100, 0 to 100 or degrees."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated

import numpy as np

from tauext.config import require, within
from tauext.data.description import Arm
from tauext.data.servo_types import COUNTS_A_TURN
from tauext.errors import ConfigError
from tauext.files.plain_file import read_json
from tauext.files.typed_table import TableName, read_table

LARGEST_COUNT = 1 << 20
"""Largest count: 256 turns, more than any joint's."""
Count = Annotated[int, within(-LARGEST_COUNT, LARGEST_COUNT)]
ROUNDING = 1e-3
"""Tolerance of normalised values, stored as float32."""


@dataclass(frozen=True)
class MotorCalibration:
    """One motor of a LeRobot calibration file, with the fields of LeRobot's MotorCalibration.

    An angle is 0 at the middle of the range and rises with the servo's raw counts: q = (count - (min + max) / 2) 2 pi /
    4096. The servo has already subtracted homing_offset.
    """

    name: TableName
    id: Annotated[int, within(0, 252)]
    """Id on the bus."""
    drive_mode: Annotated[int, within(0, 255)]
    """Not 0: LeRobot reverses normalised values (Feetech only; never degrees)."""
    homing_offset: Count
    """[counts]."""
    range_min: Count
    """[counts]."""
    range_max: Count
    """[counts]."""

    def __post_init__(self) -> None:
        require(self.range_min < self.range_max, "range_min", self.range_min, f"below range_max = {self.range_max}")

    @property
    def middle(self) -> float:
        """Counts at angle 0."""
        return (self.range_min + self.range_max) / 2

    def radians_of_counts(self, counts: np.ndarray) -> np.ndarray:
        """Convert positions or goals after homing [counts] to angles [rad]; any shape."""
        return (np.asarray(counts, dtype=np.float64) - self.middle) * (2 * math.pi / COUNTS_A_TURN)

    def counts_of_normalised(self, values: np.ndarray, lowest: float = -100.0, turned: bool = True) -> np.ndarray:
        """Convert LeRobot's normalised values to counts: lowest (-100, or 0 of a gripper) is range_min, 100 range_max.

        LeRobot clips positions to the range. NaN stays NaN.

        Args:
            turned: whether drive_mode reverses the values, as in LeRobot's Feetech bus but not its Dynamixel bus.

        Raises:
            ConfigError: a value is outside, so the unit is wrong.
        """
        values = np.asarray(values, dtype=np.float64)
        if np.any((values < lowest - ROUNDING) | (values > 100 + ROUNDING)):
            worst = values[np.nanargmax(np.abs(values))]
            raise ConfigError(
                f"motor {self.name!r}: {worst:g} is no value from {lowest:g} to 100; is it in degrees, or in counts?"
            )
        if turned and self.drive_mode:
            values = 100 + lowest - values
        return (values - lowest) / (100 - lowest) * (self.range_max - self.range_min) + self.range_min

    def radians_of_normalised(
        self, values: np.ndarray, lowest: float = -100.0, turned: bool = True, sent: bool = False
    ) -> np.ndarray:
        """Convert stored float32 normalised values to angles [rad]. A measured one is rounded to the nearest count; a
        sent goal is truncated, as in LeRobot."""
        counts = self.counts_of_normalised(values, lowest, turned)
        return self.radians_of_counts(np.trunc(counts) if sent else np.rint(counts))


def load_lerobot_calibration(path: Path) -> dict[str, MotorCalibration]:
    """Read the motors of a LeRobot calibration file (~/.cache/huggingface/lerobot/calibration), by name.

    Raises:
        ConfigError: names the file, the motor and the rule that is broken.
    """
    content = read_json(path, "there is no such LeRobot calibration file", "no LeRobot calibration file: ")
    if not isinstance(content, dict) or not content:
        raise ConfigError(f"{path}: no LeRobot calibration file: must be motors by name, is {content!r:.60}")
    motors = {name: _motor(path, name, table) for name, table in content.items()}
    by_id: dict[int, str] = {}
    for name, motor in motors.items():
        if by_id.setdefault(motor.id, name) != name:
            raise ConfigError(f"{path}: motors {by_id[motor.id]!r} and {name!r} have one id, {motor.id}")
    return motors


def _motor(path: Path, name: str, table: object) -> MotorCalibration:
    kept = [one.name for one in fields(MotorCalibration)]
    known = {key: value for key, value in table.items() if key in kept} if isinstance(table, dict) else table
    return read_table(MotorCalibration, known, f"{path}: motor {name!r}:", name=name)


def motors_of(arm: Arm) -> tuple[MotorCalibration, ...]:
    """Calibrations of the joints' motors; the recording's names may end in `.pos`.

    Raises:
        ConfigError: no such file, no LeRobot calibration file, or a joint is missing in it.
    """
    path = arm.path.parent / arm.robot.calibration
    listed = load_lerobot_calibration(path)
    for name in arm.names:
        if name.removesuffix(".pos") not in listed:
            raise ConfigError(
                f"{path}: it has no motor '{name.removesuffix('.pos')}', which {arm.path} names; "
                f"it has {', '.join(listed)}"
            )
    return tuple(listed[name.removesuffix(".pos")] for name in arm.names)


def radians_by(arm: Arm) -> Callable[[np.ndarray, bool], np.ndarray]:
    """The function that converts normalised positions or, if sent, goals (samples, joints) to angles [rad].

    Dynamixel's bus does not reverse them by drive_mode.

    Raises:
        ConfigError: see motors_of().
    """
    motors = motors_of(arm)
    turned = not any(name.startswith("x") for name in (arm.servo.type if arm.servo is not None else ()))

    def radians(values: np.ndarray, sent: bool) -> np.ndarray:
        columns = [
            motor.radians_of_normalised(
                values[:, j], 0.0 if motor.name.endswith("gripper") else -100.0, turned, sent=sent
            )
            for j, motor in enumerate(motors)
        ]
        return np.stack(columns, axis=1)

    return radians
