"""The held minimum and its peaks: against slow loops, the core's own alarm, and hand-made series."""

from dataclasses import replace

import numpy as np
import pytest
from made_bundles import LIMIT_NM, pushed, watching_bundle

from tauext import _core
from tauext.bundle.estimates import FAULT
from tauext.config import FreeMotionConfig
from tauext.errors import TrainingError
from tauext.train.error_scale import judge
from tauext.train.held_peaks import (
    PeakConfig,
    Peaks,
    collect_peaks,
    count_episodes,
    held_minimum,
    hold_lengths,
    peak_indices,
)
from tauext.train.paper_limits import paper_limits


def slow_held_minimum(values, healthy, hold):
    out = np.full(len(values), np.nan)
    for k in range(len(values)):
        first = k - hold[k]
        if first >= 0 and healthy[first : k + 1].all() and not np.isnan(values[first : k + 1]).any():
            out[k] = values[first : k + 1].min()
    return out


def noise(rng, samples, smooth=20):
    """Rough series of half a second's memory at 40 Hz, >= 0, with ties: rounded to a tenth."""
    return np.round(np.abs(np.convolve(rng.normal(size=samples + smooth), np.ones(smooth) / 4, "valid")[:samples]), 1)


@pytest.mark.parametrize("hold", [0, 1, 2, 3, 7, 8, 10, 63, 64, 200, 1000])
def test_held_minimum_equals_a_slow_loop(hold):
    rng = np.random.default_rng(hold)
    values, healthy = rng.exponential(size=700), rng.random(700) > 0.005
    values[rng.integers(700, size=3)] = np.nan
    joints = np.column_stack([values, values[::-1]])
    for holds in (np.full(700, hold), rng.integers(0, hold + 1, 700)):  # regular stamps, and others
        slow = [slow_held_minimum(of_joint, healthy, holds) for of_joint in joints.T]
        np.testing.assert_array_equal(held_minimum(joints, healthy, holds), np.transpose(slow))


def test_hold_lengths_follow_stamps_that_jitter_and_miss_samples():
    rng = np.random.default_rng(1)
    t_ns = np.cumsum(rng.integers(700_000, 1_300_000, 400))
    t_ns[200:] += 6_000_000
    for hold_s in (0.0, 0.001, 0.01, 0.5):
        lengths = hold_lengths(t_ns, hold_s)
        for k, length in enumerate(lengths):
            old = np.flatnonzero(t_ns <= t_ns[k] - hold_s * 1e9)
            assert k - length == (old[-1] if len(old) else -1)
    regular = np.arange(50) * 1_000_000
    assert (hold_lengths(regular, 0.01)[10:] == 10).all()


@pytest.mark.parametrize("hold_s", [0.0, 0.005, 0.02])
def test_the_held_minimum_is_over_a_limit_exactly_while_the_cores_alarm_stands(hold_s):
    """With one limit and no release time, a contact stands at samples that are over it long enough, and no other."""
    rng = np.random.default_rng(4)
    tau = np.zeros((6000, 2))
    tau[:, 0] = 12 * np.repeat(rng.normal(size=240), 25)
    made = pushed(tau=tau)
    keep = np.ones(made.samples, dtype=bool)
    for start in rng.integers(1000, 5900, 60):
        keep[start : start + rng.integers(1, 6)] = False  # bridged: the monitor's network period is ten samples
    samples = [np.ascontiguousarray(signal[keep]) for signal in made.signals]
    bundle = watching_bundle(network=False)
    bundle.sliding_limit_nm = bundle.near_stiction_limit_nm = [1e6] * 2
    bundle.contact_sliding_limit_nm = bundle.contact_near_stiction_limit_nm = [LIMIT_NM] * 2
    bundle.contact_hold_s, bundle.contact_release_s = hold_s, 0.0
    said = _core.Monitor(bundle).run(*samples)
    healthy = np.isfinite(said["tau_ext"]).all(axis=1)
    assert healthy.sum() > 5000
    held = held_minimum(np.abs(said["tau_ext"]), healthy, hold_lengths(samples[0], hold_s))[:, 0]
    stands = said["alarm"] == 1
    assert (np.diff(stands.astype(int)) == 1).sum() > 20
    np.testing.assert_array_equal(held[healthy] > LIMIT_NM, stands[healthy])


def test_an_alarm_with_two_limits_rises_only_where_the_minimum_of_a_touched_region_is_over_its_limit():
    rng = np.random.default_rng(8)
    hold, limits = 6, (3.0, 2.0)
    for _ in range(20):
        tau = noise(rng, 3000)
        near = np.repeat(rng.random(300) < 0.5, 10)
        run, alarms = 0, []
        for k in range(3000):
            run = run + 1 if tau[k] > limits[int(near[k])] else 0
            if run > hold:
                alarms.append(k)
        held = held_minimum(tau[:, None], np.ones(3000, dtype=bool), np.full(3000, hold))[:, 0]
        touched = [np.array([flags[max(0, k - hold) : k + 1].any() for k in range(3000)]) for flags in (~near, near)]
        counted = [touched[region] & (held > limits[region]) for region in range(2)]
        assert (counted[0] | counted[1])[alarms].all()


def test_episodes_on_a_hand_made_series():
    t_ns = np.array([0, 100, 200, 700, 1300, 1800, 5000]) * 1_000_000
    values = np.array([1.0, 3.0, 0.5, 2.0, 4.0, 1.5, np.nan])
    # Over 0.9: 0.0, 0.1 | 0.7 (0.6 later) | 1.3 (0.6 later) | 1.8 (0.5 later, so not less than the gap apart).
    assert count_episodes(values, t_ns, 0.9) == 4
    # Over 0.4 also 0.2, which links 0.1 to 0.7; and 0.5 s are less than 0.55.
    assert count_episodes(values, t_ns, 0.4, gap_s=0.55) == 2
    assert count_episodes(values, t_ns, 9.0) == 0


def test_over_every_level_there_are_at_least_as_many_separate_peaks_as_episodes():
    t_ns = np.arange(20_000) * 25_000_000
    values = noise(np.random.default_rng(3), 20_000)
    peaks = values[peak_indices(values, t_ns)]
    for level in np.linspace(0, values.max(), 60)[:-1]:
        assert (peaks > level).sum() >= count_episodes(values, t_ns, level)


def parts(seed, count=6, samples=4000):
    """Made estimates of two joints: (t_ns, tau_ext, near_stiction, healthy) a recording at 100 Hz."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        tau = np.stack([noise(rng, samples), noise(rng, samples)], axis=1) * rng.choice([-1, 1], (samples, 2))
        healthy = np.arange(samples) >= 100
        healthy[2000:2050] = False
        near = np.repeat(rng.random((samples // 50, 2)) < 0.3, 50, axis=0)
        yield np.arange(samples) * 10_000_000, tau, near, healthy


def test_the_largest_peaks_are_kept_in_whatever_order_recordings_come():
    every, some, again = (Peaks(["a", "b"], 0.02, PeakConfig(keep=keep)) for keep in (10**6, 25, 25))
    recordings = list(parts(5))
    for recording, backwards in zip(recordings, reversed(recordings), strict=True):
        every.add("", *recording)
        some.add("", *recording)
        again.add("", *backwards)
    for joint in range(2):
        for region in range(2):
            assert len(every.nm[joint][region]) > 100
            np.testing.assert_array_equal(some.nm[joint][region], every.nm[joint][region][:25])
            np.testing.assert_array_equal(again.nm[joint][region], every.nm[joint][region][:25])


def slow_peaks(parts, hold_s, gap_ns=500_000_000):
    """Sample by sample, as the held minimum, its regions and separate peaks are defined: [joint][region], falling."""
    found = [[[], []], [[], []]]
    for t_ns, tau, near, healthy in parts:
        hold = hold_lengths(t_ns, hold_s)
        for joint in range(2):
            held = slow_held_minimum(np.abs(tau[:, joint]), healthy, hold)
            for region, inside in enumerate((~near[:, joint], near[:, joint])):
                touched = [inside[max(0, k - hold[k]) : k + 1].any() for k in range(len(t_ns))]
                value = np.where(np.array(touched) & (held > 0), held, np.nan)
                for k in np.flatnonzero(value > 0):
                    first, last = np.searchsorted(t_ns, (t_ns[k] - gap_ns + 1, t_ns[k] + gap_ns))
                    if not (value[first:k] >= value[k]).any() and not (value[k + 1 : last] > value[k]).any():
                        found[joint][region].append(value[k])
    return [[np.sort(nm)[::-1] for nm in of_joint] for of_joint in found]


@pytest.mark.parametrize("hold_s", [0.0, 0.01, 0.05])
@pytest.mark.parametrize("regular", [True, False])
def test_the_peaks_equal_a_slow_loop_with_and_without_a_floor(hold_s, regular):
    rng = np.random.default_rng(7)
    recordings = list(parts(7, count=4, samples=2500))
    if not regular:  # jitter and missing samples
        keep = rng.random(2500) < 0.97
        recordings = [
            ((t + rng.integers(-2_000_000, 2_000_000, 2500))[keep], *(a[keep] for a in rest)) for t, *rest in recordings
        ]
    slow = slow_peaks(recordings, hold_s)
    for keep_peaks in (10**6, 15):
        peaks = Peaks(["a", "b"], hold_s, PeakConfig(keep=keep_peaks))
        for recording in recordings:
            peaks.add("", *recording)
        for joint in range(2):
            for region in range(2):
                np.testing.assert_array_equal(peaks.nm[joint][region], slow[joint][region][:keep_peaks], strict=True)
        assert min(len(nm) for of_joint in slow for nm in of_joint) > 30


def test_the_number_of_threads_changes_no_peak():
    bundle = watching_bundle()
    recordings = [pushed(f"swing-{k}", seconds=3.0, pushes=((1.0 + 0.1 * k, 0, 3.0 + k),)) for k in range(7)]
    one, many = (collect_peaks(bundle, iter(recordings), (0.0, 0.01), threads) for threads in (1, 9))
    for a, b in zip(one, many, strict=True):
        assert a.hours == b.hours and a.region_hours.tobytes() == b.region_hours.tobytes()
        assert all((a.nm[j][r] == b.nm[j][r]).all() for j in range(2) for r in range(2))


def test_hours_are_those_of_healthy_steps_and_regions_share_them():
    peaks = Peaks(["a", "b"], 0.0)
    for part in parts(6, count=2):
        peaks.add("", *part)
    # Of 4000 samples the first 100 are not healthy and 50 others: two runs of 1900 and 1950 samples.
    assert peaks.hours == pytest.approx(2 * (1899 + 1949) * 0.01 / 3600, rel=1e-12)
    np.testing.assert_allclose(peaks.region_hours.sum(axis=1), peaks.hours, rtol=1e-12)


def test_without_hold_the_largest_peaks_are_the_papers_limits():
    bundle = watching_bundle()
    recordings = [pushed(f"swing-{k}", pushes=((2.0 + k, 0, 3.0 + k), (3.5, 1, 2.0))) for k in range(3)]
    held, peaks = collect_peaks(bundle, iter(recordings), holds_s=(0.01, 0.0), threads=1)
    sliding, both = paper_limits(bundle, recordings, threads=1)
    np.testing.assert_array_equal(peaks.largest_nm[:, 0], sliding)
    np.testing.assert_array_equal(peaks.largest_nm.max(axis=1), both)
    found = [judge(bundle, one, 1, FreeMotionConfig()) for one in recordings]
    every = [(error[counted], estimates["near_stiction"][counted] == 1) for _, estimates, error, counted in found]
    slid = [np.where(near, 0, error).max(axis=0) for error, near in every]
    np.testing.assert_array_equal(sliding, np.max(slid, axis=0))
    np.testing.assert_array_equal(both, np.max([error.max(axis=0) for error, _ in every], axis=0))
    assert (held.joints, held.hold_s, peaks.hold_s) == (("shoulder", "elbow"), 0.01, 0.0)
    assert all((held.nm[j][0][:1] < peaks.nm[j][0][:1]).all() for j in range(2))


def test_contacts_are_left_out_and_recordings_without_a_healthy_sample_refused():
    bundle = watching_bundle()
    margins = FreeMotionConfig(before_s=0.5, after_s=0.25)
    touched = pushed("touched", contact=(np.arange(6000) // 1000 == 3).astype(np.int8))
    (whole,), (rest,) = (
        collect_peaks(bundle, [one], (0.0,), threads=1, margins=margins) for one in (pushed("touched"), touched)
    )
    # A second of contact, half a second before it and a quarter after: of 6 s at 1 kHz.
    assert (whole.hours - rest.hours) * 3600 == pytest.approx(1.75, abs=0.003)
    with pytest.raises(TrainingError, match="no recording has any beyond the warm-up"):
        collect_peaks(bundle, [pushed("short", seconds=0.3, pushes=())], (0.0,), threads=1)


def test_samples_of_a_saturated_drive_count_since_an_alarm_may_rise_there_and_a_still_encoders_do_not():
    made, bundle = pushed(pushes=()), watching_bundle()
    tau, dq, still = made.tau.copy(), made.dq.copy(), made.q.copy()
    tau[2000:2050] += 30.0
    saturated = replace(made, tau=tau)
    whole = judge(bundle, saturated, 1, FreeMotionConfig())[3]
    bundle.torque_limit_nm = [20.0, 20.0]
    said = _core.estimate(bundle, made.t_ns, made.q, made.dq, tau, 1)
    assert (said["health"] == FAULT).sum() == 50 and whole[2000:2050].all()
    np.testing.assert_array_equal(judge(bundle, saturated, 1, FreeMotionConfig())[3], whole)
    still[3000:3500], dq[3000:3500] = still[3000], 1.0
    frozen = judge(watching_bundle(), replace(made, q=still, dq=dq), 1, FreeMotionConfig())[3]
    assert whole[3400] and not frozen[3400]
