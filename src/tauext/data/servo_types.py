"""Servos by name, and their angles by a LeRobot calibration file."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tauext.errors import ConfigError
from tauext.files.plain_file import read_json
from tauext.files.toml_file import number, read_table

# --- Servos by name: constants of motor, position controller and registers, with their sources.


COUNTS_A_TURN = 4096


@dataclass(frozen=True)
class ServoType:
    """Constants of a servo at its output shaft: with gear ratio N, back-EMF and torque constants are N times the
    motor's. None: not published; arm.toml sets it or training finds it."""

    volts: float
    """Nominal supply, [V]."""
    ohm: float | None
    """Resistance of the windings, [ohm]."""
    back_emf_v_s: float | None
    """Back-EMF constant k_e, [V s/rad]."""
    nm_per_ampere: float | None
    """Torque constant k_t, [N m/A of winding current]."""
    duty_per_rad: float | None = None
    """Duty a rad of position error for a P gain of 1."""
    gain: float | None = None
    """P gain set by LeRobot or the maker."""
    most_duty: float = 1.0
    """Limit of the duty."""
    count_rad: float = 2 * math.pi / COUNTS_A_TURN
    """Step of the encoder, [rad]."""
    reports: tuple[str, ...] = ()
    """Signals that it reports, of torque, phase-current, supply-current, duty; best first."""
    source: str = ""
    """Source of the constants."""


def _by_stall(volts: float, stall_nm: float, stall_a: float, free_rpm: float) -> tuple[float, float, float, float]:
    """Compute V, R, k_e and k_t from a data sheet's stall torque, stall current and no-load speed."""
    return volts, volts / stall_a, volts / (free_rpm * math.pi / 30), stall_nm / stall_a


SERVO_TYPES = {
    "sts3215-7.4v": ServoType(
        7.4, 2.753, 1.275, 1.275, 0.166, 16, 0.97,
        reports=("duty", "supply-current"),
        source="Rhoban BAM, params/feetech_sts3215_7_4V/m6; gain and limit of the duty by oscilloscope, there",
    ),
    "sts3215-12v": ServoType(
        12.0, 8.789, 3.644, 3.644, 0.165, 16, 0.97,
        reports=("duty", "supply-current"),
        source="K-Scale Labs sysid, STS_3215_12V_20250317 m4; gain of the duty by oscilloscope, there",
    ),
    "xl330-m288": ServoType(
        *_by_stall(5.0, 0.52, 1.47, 103), reports=("phase-current", "duty"), source="ROBOTIS e-Manual, at 5 V"
    ),
    "xl430-w250": ServoType(*_by_stall(12.0, 1.5, 1.4, 61), reports=("duty",), source="ROBOTIS e-Manual, at 12 V"),
    "xm430-w350": ServoType(
        *_by_stall(12.0, 4.1, 2.3, 46), reports=("phase-current", "duty"), source="ROBOTIS e-Manual, at 12 V"
    ),
    "dm4310": ServoType(
        24.0, None, None, None, count_rad=25.0 / 65535, reports=("torque",),
        source="Damiao DM-J4310-2EC manual: torque comes in N m; position in 16 bit over ±12.5 rad",
    ),
}  # fmt: skip
"""Servo types that arm.toml accepts by name."""


# --- Angles of servos by a LeRobot calibration file, from counts, -100 to 100, 0 to 100 or degrees.


LARGEST_COUNT = 1 << 20
"""Largest count: 256 turns, more than any joint's."""
COUNT = number(-LARGEST_COUNT, LARGEST_COUNT, whole=True)
KEYS = {
    "id": number(0, 252, whole=True), "drive_mode": number(0, 255, whole=True),
    "homing_offset": COUNT, "range_min": COUNT, "range_max": COUNT,
}  # fmt: skip
ROUNDING = 1e-3
"""Tolerance of normalised values, stored as float32."""


@dataclass(frozen=True)
class MotorCalibration:
    """One motor of a LeRobot calibration file, with the fields of LeRobot's MotorCalibration.

    An angle is 0 at the middle of the range and rises with the servo's raw counts: q = (count - (min + max) / 2) 2 pi /
    4096. The servo has already subtracted homing_offset.
    """

    name: str
    id: int
    """Id on the bus."""
    drive_mode: int
    """Not 0: LeRobot reverses normalised values (Feetech only; never degrees)."""
    homing_offset: int
    """[counts]."""
    range_min: int
    """[counts]."""
    range_max: int
    """[counts]."""

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
    keys = {key: table[key] for key in KEYS if key in table} if isinstance(table, dict) else table
    motor = MotorCalibration(name, **read_table(path, f"motor {name!r}:", keys, KEYS))
    if motor.range_min >= motor.range_max:
        raise ConfigError(
            f"{path}: motor {name!r}: range_min = {motor.range_min} must be below range_max = {motor.range_max}"
        )
    return motor
