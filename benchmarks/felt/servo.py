"""The STS3215 at 7.4 V as it was identified: position control by duty, motor, friction of its gear."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Servo:
    """Motor and gear at the output shaft; parameters of model m6 that Rhoban's BAM identified for the STS3215 at 7.4 V
    (https://github.com/Rhoban/bam, params/feetech_sts3215_7_4V)."""

    volts: float = 7.4
    ohm: float = 2.753
    nm_per_ampere: float = 1.275
    """Also the back-EMF, [V s/rad]."""
    armature_kg_m2: float = 0.02156
    duty_per_rad: float = 16 * 0.166 * 1.16
    """Of the position error, at the gain P = 16 that LeRobot sets for these arms."""
    most_duty: float = 0.97
    coulomb_nm: float = 0.053
    motor_share: float = 0.045
    """Coulomb friction a motor torque."""
    load_share: float = 0.244
    """Coulomb friction a torque from outside: weight, touch."""
    viscous_nm_s_rad: float = 0.028

    def duty(self, error_rad: np.ndarray) -> np.ndarray:
        """What the controller gives the motor for goal - position."""
        return np.clip(self.duty_per_rad * error_rad, -self.most_duty, self.most_duty)

    def torque(self, duty: np.ndarray, dq: np.ndarray) -> np.ndarray:
        """k_t (V D - k_e dq) / R, [N m]."""
        return self.nm_per_ampere * (self.volts * duty - self.nm_per_ampere * dq) / self.ohm


COUNT_RAD = 2 * np.pi / 4096


def counted(q: np.ndarray) -> np.ndarray:
    """What the 12-bit encoder says."""
    return np.round(q / COUNT_RAD) * COUNT_RAD
