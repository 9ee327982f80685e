"""Hobby servos as they were identified: motor, position controller, friction that depends on the load, backlash.

Numbers of a Feetech STS3215 at 7.4 V: Rhoban's BAM, model m6 (Duclusaud, Passault, Padois, Daney: Extended Friction
Models for the Physics Simulation of Servo Actuators, 2024; github.com/Rhoban/bam, feetech_sts3215_7_4V/m6), all at the
output shaft. Backlash is what reversals of a real SO-101 show.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

COUNT_RAD = 2 * np.pi / 4096
GAIN = 16
"""The P gain that LeRobot sets; its I gain is 0."""

OUTPUT_SHARE = 0.4
"""Of the dry friction without load, that of the output shaft's bearing: behind the backlash, where it stops a link that
would bounce in its play for ever. The identification knows the sum alone."""


@dataclass(frozen=True)
class Servos:
    """The servos of one arm; each an array over the joints. The order of the fields is that of servo_steps.cpp."""

    nm_per_ampere: np.ndarray
    """k_t, which is k_e, too."""
    ohm: np.ndarray
    duty_per_rad: np.ndarray
    most_duty: np.ndarray
    goal_rad_s: np.ndarray
    """The goal that the controller follows moves no faster."""
    coulomb_nm: np.ndarray
    stribeck_nm: np.ndarray
    motor_share: np.ndarray
    """Of the motor's torque, that becomes friction."""
    external_share: np.ndarray
    """Of what the arm asks of the gear."""
    motor_stribeck: np.ndarray
    external_stribeck: np.ndarray
    motor_square: np.ndarray
    """[1/Nm], where motor and load oppose each other and the load is the larger."""
    external_square: np.ndarray
    stribeck_rad_s: np.ndarray
    stribeck_power: np.ndarray
    viscous_nm_s_rad: np.ndarray
    rotor_kg_m2: np.ndarray
    backlash_rad: np.ndarray
    """Between the gear train and the output shaft, where the encoder is; from stop to stop."""

    def table(self) -> np.ndarray:
        """(fields, joints), row by row as declared."""
        return np.ascontiguousarray([getattr(self, field.name) for field in fields(self)])


def identified(joints: int) -> Servos:
    """As many servos as the published one, with a degree of backlash."""
    row = (
        1.2753, 2.7534, GAIN * 0.166 * 1.1617, 0.97, 5.0958,
        0.05331, 4.26e-5, 0.04491, 0.24355, 1.245e-4, 0.14229, 0.007595, 0.003404, 0.37114, 9.931, 0.02816,
        0.021564, np.deg2rad(1.0),
    )  # fmt: skip
    return Servos(*(np.full(joints, value) for value in row))


SPREAD = {
    "nm_per_ampere": 0.1,
    "ohm": 0.1,
    "duty_per_rad": 0.05,
    "goal_rad_s": 0.05,
    "coulomb_nm": 0.2,
    "motor_share": 0.2,
    "external_share": 0.2,
    "external_stribeck": 0.2,
    "stribeck_rad_s": 0.2,
    "viscous_nm_s_rad": 0.2,
    "rotor_kg_m2": 0.1,
}
"""By how much a servo differs from the published one, either way."""
BACKLASH_RAD = (np.deg2rad(0.5), np.deg2rad(1.3))


def drawn(joints: int, rng: np.random.Generator) -> Servos:
    """Servos as they come out of one box: every one differs."""
    one = identified(joints)
    values = {field.name: getattr(one, field.name) for field in fields(Servos)}
    for name, share in SPREAD.items():
        values[name] = values[name] * rng.uniform(1 - share, 1 + share, joints)
    values["backlash_rad"] = rng.uniform(*BACKLASH_RAD, joints)
    return Servos(**values)
