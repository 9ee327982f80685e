"""Servos by name: constants of motor, position controller and registers, with their sources."""

from __future__ import annotations

import math
from dataclasses import dataclass

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
