"""Which way a joint's torque counts: friction resists, inertia resists, gravity pulls down."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tauext.check.fit import CONSTANT, JointFit, spread_of
from tauext.check.regressors import FRICTION, Rows

MOST = 6.0
"""No witness counts for more than so many standard errors: a wrong model can be very sure."""


@dataclass(frozen=True)
class SignVote:
    """Friction work a unit of speed, inertia and gravity factor, each in standard errors times its share of torque."""

    friction: float
    inertia: float
    gravity: float
    power_w: float  # mean of torque times speed
    friction_nm_s: float  # friction power by squared speed
    inertia_kg_m2: float

    @property
    def motion(self) -> float:
        """Of friction and inertia, which hold whatever the model says."""
        return self.friction + self.inertia

    @property
    def total(self) -> float:
        return self.motion + self.gravity


def sign_vote(rows: Rows, joint: int, fit: JointFit) -> SignVote:
    dq, acceleration = rows.dq[:, joint], rows.acceleration[:, joint]
    columns = np.column_stack([rows.inertial[:, joint], acceleration])
    by_speed = (rows.friction[:, joint] * dq[:, None]).mean(axis=0) / max(float((dq**2).mean()), 1e-12)
    by_speed[0] = 0.0
    by_acceleration = (columns * acceleration[:, None]).mean(axis=0) / max(float((acceleration**2).mean()), 1e-12)
    friction = fit.left_out[:, CONSTANT : CONSTANT + FRICTION] @ by_speed
    inertia = fit.left_out[:, 1:3] @ by_acceleration

    def witness(value: float, spread: float, part_nm: float) -> float:
        if part_nm == 0 or fit.torque_nm == 0:
            return 0.0
        return float(np.clip(value / max(spread, 1e-9 * abs(value) + 1e-12), -MOST, MOST)) * part_nm / fit.torque_nm

    friction_now = float(fit.weights[CONSTANT : CONSTANT + FRICTION] @ by_speed)
    inertia_now = float(fit.weights[1:3] @ by_acceleration)
    return SignVote(
        witness(friction_now, spread_of(friction), fit.friction_nm),
        witness(inertia_now, spread_of(inertia), fit.inertial_nm),
        witness(*fit.gravity_factor, fit.gravity_nm) if rows.has_model else 0.0,
        float((rows.tau[:, joint] * dq).mean()),
        friction_now,
        inertia_now,
    )
