"""Servos by their names: constants of motor, position controller and registers, with where they come from."""

from __future__ import annotations

import math
from dataclasses import dataclass

COUNTS_A_TURN = 4096


@dataclass(frozen=True)
class ServoType:
    """Constants of a servo, seen at its output shaft: with gear ratio N, back-EMF and torque constants are N times the
    motor's. None: nobody has published it; arm.toml may say it, or training finds it."""

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
"""Servo types that arm.toml knows by name."""
