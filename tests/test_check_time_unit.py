"""Stamps of another unit are told by the motion, with a recorded velocity and with a derived one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_arms import planar_arm
from made_recordings import made_motion

from tauext.check.clock import time_findings, time_unit
from tauext.check.examination import Examination
from tauext.check.examine import quick_checks
from tauext.data.assemble import derived_velocity
from tauext.data.recording import Recording

DEGREES = 180 / np.pi


@pytest.fixture(scope="module")
def good() -> list[Recording]:
    return made_motion(planar_arm(), 1.2, 100.0, pieces=2).recordings


def stamped(r: Recording, factor: float, derived: bool = False) -> Recording:
    t_ns = np.round(r.t_ns * factor).astype(np.int64)
    dq = derived_velocity(t_ns, r.q, 0.0) if derived else r.dq
    return replace(r, t_ns=t_ns, dq=dq, rate_hz=r.rate_hz / factor)


@pytest.mark.parametrize("factor", [1e3, 1e-3, 1e6, 60.0, 1 / 60, 3600.0])
def test_recorded_velocity_tells_the_unit(good, factor):
    found = time_unit(stamped(good[0], factor))
    assert found is not None and found.factor == pytest.approx(factor) and not found.velocity_derived
    codes = [f.code for f in quick_checks(stamped(good[0], factor), None) if f.severity == "fault"]
    assert codes == ["time-unit"]


@pytest.mark.parametrize("factor", [1e3, 1e-3, 1e6])
def test_derived_velocity_leaves_speeds_and_rates(good, factor):
    found = time_unit(stamped(good[0], factor, derived=True))
    assert found is not None and found.factor == pytest.approx(factor) and found.velocity_derived


def test_all_recordings_are_one_finding_and_some_one_each(good):
    x = Examination([stamped(r, 1e3) for r in good])
    found = list(time_findings(x))
    assert [(f.recording, f.severity) for f in found] == [(None, "fault")]
    for r, back in zip(good, x.recordings, strict=True):
        assert np.array_equal(back.t_ns, r.t_ns) and back.rate_hz == pytest.approx(r.rate_hz)
    found = list(time_findings(Examination([good[0], stamped(good[1], 1e3)])))
    assert [f.recording for f in found] == [good[1].name]


@pytest.mark.parametrize("factor", [1.0, DEGREES, 1 / DEGREES, 9.549, -1.0])
def test_another_unit_of_the_velocity_is_none_of_time(good, factor):
    assert time_unit(replace(good[0], dq=good[0].dq * factor)) is None


@pytest.mark.parametrize("rate_hz", [30.0, 100.0, 1000.0])
def test_good_motion_is_on_its_clock(rate_hz):
    for r in made_motion(planar_arm(), 1.0, rate_hz, pieces=2).recordings:
        assert time_unit(r) is None
        assert time_unit(stamped(r, 1.0, derived=True)) is None


def test_a_slow_arm_and_one_that_stands_are_on_their_clock(good):
    r = good[0]
    slow = replace(r, q=r.q * 0.02, dq=r.dq * 0.02)
    assert time_unit(slow) is None
    still = replace(r, q=np.zeros_like(r.q), dq=np.zeros_like(r.dq))
    assert time_unit(still) is None
