"""Steps of registers and encoders: found through rounding, not invented, and too coarse for a velocity."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tauext.check.examination import Examination
from tauext.check.sensors import coarse_velocities, position_step, step_of
from tauext.data.recording import Recording

COUNT_RAD = 2 * np.pi / 4096


def test_steps_are_found_through_single_precision_and_not_invented():
    rng = np.random.default_rng(0)
    places = rng.integers(0, 900, 20000)
    assert position_step((places * COUNT_RAD - 0.7).astype(np.float32).astype(float)) == COUNT_RAD
    assert step_of((places * 0.02).astype(np.float32).astype(float)) == pytest.approx(0.02, rel=1e-6)
    assert step_of(np.repeat(rng.uniform(0, 1, 2000), 10) + 1e-9 * rng.integers(0, 2, 20000)) is None
    assert step_of(rng.standard_normal(20000)) is None and position_step(rng.standard_normal(20000)) is None
    assert position_step(np.round(1e-3 * rng.standard_normal(20000), 6)) is None  # decimals of a text file


def test_a_velocity_of_few_steps_is_coarse_where_positions_give_a_finer_one():
    t = np.arange(3000) / 50.0
    q = np.column_stack([0.5 * np.sin(t), 0.7 * np.cos(1.3 * t)])
    dq = np.column_stack([0.5 * np.cos(t), -0.91 * np.sin(1.3 * t)])
    q = np.round(q / COUNT_RAD) * COUNT_RAD
    arm = Recording("run", ("pan", "lift"), np.arange(3000) * 20_000_000, q, dq, dq, 50.0, "instant", "made", "")

    def with_step(step: float, **changes) -> Recording:
        return replace(arm, dq=np.round(dq / step) * step, **changes)

    found = list(coarse_velocities(Examination([with_step(50 * COUNT_RAD)])))  # the speed register of a Feetech servo
    assert [f.joint for f in found] == ["pan", "lift"] and "0.0767 rad/s" in found[0].evidence
    assert not list(coarse_velocities(Examination([with_step(0.229 * np.pi / 30)])))  # that of a Dynamixel
    derived = {"servo": {"torque_from": "torque", "velocity_steps": 10}}
    assert not list(coarse_velocities(Examination([with_step(50 * COUNT_RAD, provenance=derived)])))
