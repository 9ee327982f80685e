"""Spikes are named with joint, time and size; stops, impacts, noise, steps, repeats and gaps are none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_arms import planar_arm
from made_recordings import Drive, made_motion

from tauext.check.examine import quick_checks
from tauext.check.finding import Finding
from tauext.check.spikes import normal_ranges, spikes_of, without_spikes
from tauext.data.recording import Recording

RATES_HZ = (100.0, 1000.0)
AS_IT_IS = Drive()


def made(rate_hz: float = 100.0, drive: Drive = AS_IT_IS) -> list[Recording]:
    return made_motion(planar_arm(), 1.2, rate_hz, pieces=3, drive=drive).recordings


@pytest.fixture(scope="module", params=RATES_HZ, ids=lambda hz: f"{hz:g} Hz")
def good(request) -> list[Recording]:
    return made(request.param)


def changed(r: Recording, signal: str, rows: slice, by: float | np.ndarray) -> Recording:
    x = getattr(r, signal).copy()
    x[rows, 1] += by
    return replace(r, **{signal: x})


def spikes(recordings: list[Recording], limits: np.ndarray | None = None) -> list[Finding]:
    found = []
    for r in recordings:
        found += [f for f in quick_checks(r, limits) if f.code == "spike"]
    return found


@pytest.mark.parametrize("size", [1e300, 1e6, 1000.0, "3 ranges", "2 ranges"])
@pytest.mark.parametrize("signal", ["tau", "dq", "q"])
@pytest.mark.parametrize("where", [0.0, 0.37, 1.0], ids=["first", "middle", "last"])
def test_one_sample_is_found(good, signal, size, where):
    if where != 0.37 and isinstance(size, str):
        pytest.skip("at an end a motion may begin or stop")
    if size == 1e300 and signal != "tau":
        pytest.skip("no square of it is finite")
    r = good[1]
    by = float(size[0]) * float(np.ptp(getattr(r, signal)[:, 1])) if isinstance(size, str) else size
    row = int(where * (r.samples - 1))
    (found,) = spikes([changed(r, signal, slice(row, row + 1), by)])
    severity = "warning" if size == "2 ranges" and signal != "q" else "fault"  # a hard stop reaches as far
    assert (found.joint, found.severity, found.recording) == (r.joints[1], severity, r.name)
    assert f"at {r.time_s[row]:.3f} s" in found.evidence


def test_few_samples_of_a_fast_recording_are_one_spike():
    r = made(1000.0)[0]
    for signal, by in (("tau", 500.0), ("dq", 10.0), ("q", 0.05)):
        (found,) = spikes([changed(r, signal, slice(5000, 5010), by)])
        assert found.severity == "fault" and found.evidence.count(" s beside") == 3 and "and 7 more" in found.evidence


def test_small_spike_is_a_warning(good):
    r = good[0]
    low, high = np.percentile(r.tau[:, 1], [0.5, 99.5])
    row = int(np.argmin(np.abs(r.tau[100:-100, 1] - (low + high) / 2))) + 100
    (found,) = spikes([changed(r, "tau", slice(row, row + 1), 0.88 * (high - low))])  # 1.76 times half the range
    assert found.severity == "warning"


def test_beyond_the_drives_limit_is_a_fault(good):
    r = good[0]
    limits = np.array([np.inf, 1.2 * np.abs(r.tau[:, 1]).max()])
    assert not spikes([r], limits)
    (found,) = spikes([changed(r, "tau", slice(500, 501), 3 * limits[1])], limits)
    assert found.severity == "fault"


def test_spikes_are_bridged():
    recordings = made()
    broken = changed(recordings[0], "tau", slice(700, 701), 1e6)
    found = spikes_of(broken, normal_ranges(recordings))
    assert [s.rows.tolist() for s in found] == [[700]]
    whole = without_spikes(broken, found)
    assert whole.tau[700, 1] == pytest.approx(recordings[0].tau[[699, 701], 1].mean())
    assert np.array_equal(np.delete(whole.tau, 700, axis=0), np.delete(recordings[0].tau, 700, axis=0))


@pytest.mark.parametrize(
    "drive",
    [Drive(), Drive(noise=0.2), Drive(step=2.0), Drive(profile="trapezoid"), Drive(presliding_rad=0.01, pause_s=2.0)],
    ids=["as it is", "noisy", "in steps", "trapezoids", "pauses"],
)
@pytest.mark.parametrize("rate_hz", [30.0, *RATES_HZ])
def test_good_motion_has_no_spikes(drive, rate_hz):
    assert not spikes(made(rate_hz, drive))


def test_a_stop_and_an_impact_are_no_spikes(good):
    """40 ms of many times the usual torque that begins within a sample, as a hard stop's; an impact of 50 ms."""
    r = good[0]
    rows, most = slice(1000, 1000 + round(0.04 * r.rate_hz)), float(np.abs(r.tau[:, 1]).max())
    assert not spikes([changed(r, "tau", rows, 3 * most)])
    shape = np.sin(np.pi * np.arange(round(0.05 * r.rate_hz)) / (0.05 * r.rate_hz))
    assert not spikes([changed(r, "tau", slice(1000, 1000 + len(shape)), 5 * most * shape)])


def test_a_jump_over_a_gap_and_repeated_rows_are_no_spikes(good):
    r = good[0]
    keep = np.ones(r.samples, dtype=bool)
    keep[1000:1500] = False
    keep[1501:2000] = False  # one row between two gaps
    held = {name: getattr(r, name)[keep] for name in ("t_ns", "q", "dq", "tau", "contact")}
    assert not spikes([replace(r, **held)])
    rows = np.arange(r.samples) // 2 * 2
    assert not spikes([replace(r, **{name: getattr(r, name)[rows] for name in ("q", "dq", "tau")})])


def test_noise_of_a_standing_joint_is_no_spike():
    rng = np.random.default_rng(0)
    r = made()[0]
    tau = r.tau.copy()
    tau[:, 1] = np.where(rng.random(r.samples) < 0.001, 0.02, 0.0)  # one step of a current, now and then
    assert not spikes([replace(r, tau=tau)])
