"""What was measured of every joint, findings or none."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tauext.check.coarse import steps_of
from tauext.check.fit import JointFit
from tauext.check.regressors import Rows
from tauext.check.sensors import noise_nm, torque_step_nm
from tauext.check.servo import Effort, is_drive
from tauext.check.velocity import VelocityFit
from tauext.data.backlash import Play
from tauext.data.recording import Recording

Facts = dict[str, float | str]
"""Of one joint, by names that bear their units."""


def facts_of(
    recordings: Sequence[Recording],
    efforts: Sequence[Effort],
    plays: Sequence[Play],
    velocities: Sequence[VelocityFit | None],
    rows: Rows | None,
    fits: Sequence[JointFit],
    lags: Sequence[tuple[float, float, float]],
) -> list[Facts]:
    """One a joint: what could be measured.

    Args:
        recordings: as recorded.
        efforts: what each joint's tau is.
        rows: that the fits were made of; None: there are none.
    """
    facts: list[Facts] = []
    noise = noise_nm(recordings)
    for j, effort in enumerate(efforts):
        fact: Facts = {
            "range_rad": max(float(np.ptp(r.q[:, j])) for r in recordings),
            "speed_rad_s": max(float(np.abs(r.dq[:, j]).max()) for r in recordings),
            "torque_nm": max(float(np.abs(r.tau[:, j]).max()) for r in recordings),
            "torque_noise_nm": float(noise[j]),
            "torque_is": effort.kind,
        }
        fact |= _servo_facts(effort) | _play_facts(plays[j])
        position_rad, velocity_rad_s = steps_of(recordings, j)
        steps = {"torque_step_nm": torque_step_nm(recordings, j)}
        steps |= {"position_step_rad": position_rad, "velocity_step_rad_s": velocity_rad_s}
        fact |= {name: step for name, step in steps.items() if step is not None}
        velocity = velocities[j]
        if velocity is not None:
            fact |= {"velocity_factor": velocity.factor, "velocity_delay_ms": velocity.lag_s * 1e3}
        if fits and rows is not None:
            fit = fits[j]
            fact |= {"torque_spread_nm": fit.torque_nm, "error_nm": fit.error_nm}
            if not any(map(is_drive, efforts)):
                fact["torque_delay_ms"] = lags[j][0] * 1e3
            if fit.gravity_factor[0]:
                fact |= {"gravity_factor": fit.gravity_factor[0], "gravity_factor_error": fit.gravity_factor[1]}
        facts.append(fact)
    return facts


def _servo_facts(effort: Effort) -> Facts:
    fact: Facts = {}
    if effort.made_from is not None:
        fact["torque_made_from"] = effort.made_from
    if effort.law is not None and effort.kind != "torque":
        square = effort.kind == "supply current"
        fact["effort_per_rad2" if square else "effort_per_rad"] = effort.law.gain
        fact["effort_exponent"] = effort.law.exponent
    if effort.full:
        fact["effort_full"] = effort.full
    return fact


def _play_facts(play: Play) -> Facts:
    fact: Facts = {"turns": play.turns}
    if play.width_rad > 0:
        fact |= {"backlash_rad": play.width_rad, "backlash_error_rad": play.error_rad}
    if play.lost_rad > 0:
        fact["lost_motion_rad"] = play.lost_rad
    return fact
