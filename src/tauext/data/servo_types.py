"""Servos by name, and their angles by a LeRobot calibration file."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from tauext.errors import ConfigError
from tauext.files.places import Place
from tauext.files.plain_file import read_json
from tauext.files.toml_file import number, read_table

# --- Servos by their names: constants of motor, position controller and registers, with where they come from.


COUNTS_A_TURN = 4096


@dataclass(frozen=True)
class ServoType:
    """Constants of a servo, at its output shaft: with gear ratio N, back-EMF and torque constants are N times the
    motor's. None: not published; arm.toml may set it, or training finds it."""

    volts: float
    """Nominal supply, [V]."""
    ohm: float | None
    """Of the windings, [ohm]."""
    back_emf_v_s: float | None
    """k_e, [V s/rad]."""
    nm_per_ampere: float | None
    """k_t, [N m/A of winding current]."""
    duty_per_rad: float | None = None
    """Duty a rad of position error and unit of the P gain."""
    gain: float | None = None
    """P gain that LeRobot sets, or the maker does."""
    most_duty: float = 1.0
    """Limit of the duty."""
    count_rad: float = 2 * math.pi / COUNTS_A_TURN
    """Step of the encoder, [rad]."""
    reports: tuple[str, ...] = ()
    """What it reports in place of its torque, of torque, phase-current, supply-current, duty; best first."""
    source: str = ""
    """Where the constants come from."""


def _by_stall(volts: float, stall_nm: float, stall_a: float, free_rpm: float) -> tuple[float, float, float, float]:
    """V, R, k_e and k_t of a data sheet's stall torque and current, and its speed without load."""
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


# --- Angles of servos by a LeRobot calibration file: of counts, of values from -100 to 100 or 0 to 100, of degrees.


LARGEST_COUNT = 1 << 20
"""256 turns: no joint's."""
COUNT = number(-LARGEST_COUNT, LARGEST_COUNT, whole=True)
KEYS = {
    "id": number(0, 252, whole=True), "drive_mode": number(0, 255, whole=True),
    "homing_offset": COUNT, "range_min": COUNT, "range_max": COUNT,
}  # fmt: skip
ROUNDING = 1e-3
"""Values are stored as float32; [their unit]."""


@dataclass(frozen=True)
class MotorCalibration:
    """One motor of a LeRobot calibration file, as LeRobot's own MotorCalibration.

    An angle is 0 at the middle of the range and rises with the servo's counts, whatever LeRobot made of them:
    q = (count - (min + max) / 2) 2 pi / 4096. The servo has taken homing_offset off its counts already.
    """

    name: str
    id: int
    """On the bus."""
    drive_mode: int
    """Not 0: LeRobot turns normalised values round (Feetech's; degrees it never turns)."""
    homing_offset: int
    """[counts]."""
    range_min: int
    """[counts]."""
    range_max: int
    """[counts]."""

    @property
    def middle(self) -> float:
        """Where the angle is 0, [counts]."""
        return (self.range_min + self.range_max) / 2

    def radians_of_counts(self, counts: np.ndarray) -> np.ndarray:
        """Angles [rad] of positions or goals [counts] as the servo has them after its homing; any shape."""
        return (np.asarray(counts, dtype=np.float64) - self.middle) * (2 * math.pi / COUNTS_A_TURN)

    def counts_of_normalised(self, values: np.ndarray, lowest: float = -100.0, turned: bool = True) -> np.ndarray:
        """Counts of LeRobot's normalised values: lowest (-100, or 0 of a gripper) at range_min, 100 at range_max.

        A position beyond the range stands at its end: LeRobot cuts it off. NaN stays.

        Args:
            turned: whether drive_mode turns the values round, as LeRobot's Feetech bus does and its Dynamixel bus not.

        Raises:
            ConfigError: a value that is outside, so that these are other units.
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
        """Angles [rad] of normalised values as they are stored, in float32: of the nearest count, which the servo had
        measured, or, sent, of the one that LeRobot made of a goal: it leaves the fraction off."""
        counts = self.counts_of_normalised(values, lowest, turned)
        return self.radians_of_counts(np.trunc(counts) if sent else np.rint(counts))


def load_lerobot_calibration(path: Place) -> dict[str, MotorCalibration]:
    """The motors of a file as LeRobot writes it below ~/.cache/huggingface/lerobot/calibration, by their names.

    Raises:
        ConfigError: names the file, the motor and the rule that is broken.
    """
    content = read_json(path, "there is no such LeRobot calibration file", "no LeRobot calibration file: ")
    if not isinstance(content, dict) or not content:
        raise ConfigError(f"{path}: no LeRobot calibration file: must be motors by their names, is {content!r:.60}")
    motors = {name: _motor(path, name, table) for name, table in content.items()}
    by_id: dict[int, str] = {}
    for name, motor in motors.items():
        if by_id.setdefault(motor.id, name) != name:
            raise ConfigError(f"{path}: motors {by_id[motor.id]!r} and {name!r} have one id, {motor.id}")
    return motors


def _motor(path: Place, name: str, table: object) -> MotorCalibration:
    keys = {key: table[key] for key in KEYS if key in table} if isinstance(table, dict) else table
    motor = MotorCalibration(name, **read_table(path, f"motor {name!r}:", keys, KEYS))
    if motor.range_min >= motor.range_max:
        raise ConfigError(
            f"{path}: motor {name!r}: range_min = {motor.range_min} must be below range_max = {motor.range_max}"
        )
    return motor
