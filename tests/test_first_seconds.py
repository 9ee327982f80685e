"""The beginning of a set of recordings."""

from dataclasses import replace

import numpy as np
import pytest

from tauext.data.free_motion import first_seconds, total_s
from tauext.data.recording import Recording


def made(name: str, seconds: float, rate_hz: float = 100.0, **changes) -> Recording:
    samples = round(seconds * rate_hz)
    signal = np.arange(2.0 * samples).reshape(samples, 2)
    return Recording(
        name=name,
        joints=("a", "b"),
        t_ns=5_000_000_000 + np.arange(samples) * round(1e9 / rate_hz),
        q=signal,
        dq=signal,
        tau=signal,
        contact=np.zeros(samples, dtype=np.int8),
        rate_hz=rate_hz,
        torque_timing="held",
        source="test",
        robot_sha256="",
        **changes,
    )


THREE = [made("one", 9.0), made("two", 9.0), made("three", 9.0)]


@pytest.mark.parametrize(
    "seconds, samples", [(4.0, [400]), (9.0, [900]), (18.0, [900, 900]), (20.5, [900, 900, 250]), (99.0, [900] * 3)]
)
def test_whole_recordings_come_first_and_the_last_one_is_cut(seconds, samples):
    taken = first_seconds(THREE, seconds)
    assert [recording.samples for recording in taken] == samples
    assert total_s(taken) == pytest.approx(min(seconds, 27.0), abs=1e-9)
    for whole, part in zip(THREE, taken, strict=False):
        for signal in ("t_ns", "q", "dq", "tau", "contact"):
            np.testing.assert_array_equal(getattr(part, signal), getattr(whole, signal)[: part.samples])
        assert part.name == whole.name and part.temperature is None


def test_a_gap_counts_as_time():
    with_gap = replace(THREE[0], t_ns=THREE[0].t_ns + np.where(np.arange(900) >= 300, 2_000_000_000, 0))
    (part,) = first_seconds([with_gap], 4.0)
    assert part.samples == 300  # 3 s of samples, then nothing until 5 s
