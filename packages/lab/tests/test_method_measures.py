"""What methods are compared by: against slow twins, closed forms and counts by hand."""

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose
from sliding_mass import estimates_of, noisy, observer_bundle, pushed, recording
from tauext_lab.evaluate.collisions import LatchVerdict, by_strength, find_collisions
from tauext_lab.evaluate.comparison import evaluate
from tauext_lab.evaluate.errors import low_pass
from tauext_lab.evaluate.free_motion import AfterContact, FreeMotionErrors, count_episodes
from tauext_lab.evaluate.missed_curve import MissedCurve, held_ratio
from tauext_lab.evaluate.results import to_json

from tauext.bundle.estimates import COLLISION
from tauext.errors import ConfigError
from tauext.fit.tail import at_most_per_hour, promised_per_hour
from tauext.monitor.estimate import estimate_recording


@pytest.mark.parametrize("hold_s", [0.0, 0.02])
def test_the_missed_curve_equals_alarms_with_scaled_limits_run_anew(hold_s):
    bundle = observer_bundle(1.5)
    bundle.hold_s = hold_s
    free, hit = noisy("free", 1), noisy("hit", 2, force=2.0)
    touches = find_collisions(hit)
    curve = MissedCurve(hold_s)
    curve.add_free(free, estimate_recording(bundle, free, 1))
    curve.add_collisions(touches, hit, estimate_recording(bundle, hit, 1))
    points = curve.summary()
    assert any(p.scale == 1 for p in points) and len({p.missed for p in points}) > 2
    assert len({p.false_per_hour for p in points}) > 5
    for point in points[::6]:
        bundle.sliding_limit_nm = bundle.near_stiction_limit_nm = [1.5 * point.scale]
        said = estimate_recording(bundle, free, 1)
        false = count_episodes(said.held_alarm == COLLISION, 500)
        assert point.false_per_hour == pytest.approx(false / (said.healthy.sum() / 3.6e6))
        alarm = estimate_recording(bundle, hit, 1).held_alarm == COLLISION
        assert point.missed == sum(not alarm[t.begin : t.end + 200].any() for t in touches)


def test_the_held_ratio_is_over_a_factor_only_where_one_joint_was_all_the_time():
    rng = np.random.default_rng(3)
    size = rng.uniform(0, 2, (400, 2)).astype(np.float32)
    t_ns = np.arange(400, dtype=np.int64) * 1_000_000
    made = estimates_of(size[:, 0], 1.0, warm_from=50)
    made = replace(made, tau_ext=size, limit_nm=np.full_like(size, 0.5))
    for stamps in (t_ns, t_ns + rng.integers(0, 300_000, 400)):  # even and uneven ones
        ratio = held_ratio(replace(made, t_ns=stamps), 0.003)
        slow = np.zeros(400)
        for k in range(400):
            first = np.searchsorted(stamps, stamps[k] - 3_000_000, side="right") - 1
            if first >= 50:
                slow[k] = (size[first : k + 1] / 0.5).min(axis=0).max()
        assert_allclose(ratio, slow, rtol=1e-6)


def test_the_reference_is_the_step_response_at_any_gain_and_for_uneven_stamps():
    rng = np.random.default_rng(4)
    t_ns = np.cumsum(rng.integers(200_000, 3_000_000, 5000))
    for gain in (20.0, 100.0):
        y = low_pass(t_ns, np.full((5000, 1), 3.0), gain)
        assert_allclose(y[:, 0], 3 * (1 - np.exp(-gain * 1e-9 * (t_ns - t_ns[0]))), rtol=1e-12, atol=1e-14)
        torque, slow = rng.normal(size=(5000, 2)), np.zeros((5000, 2))
        for k in range(1, 5000):
            a = np.exp(-gain * 1e-9 * (t_ns[k] - t_ns[k - 1]))
            slow[k] = a * slow[k - 1] + (1 - a) * torque[k - 1]
        assert_allclose(low_pass(t_ns, torque, gain), slow, atol=1e-13)


def test_an_observer_of_another_gain_is_held_against_the_true_torque_at_its_own_gain(tmp_path):
    hit = pushed("hit", 10.0)
    fast = observer_bundle(2.0, gain_per_s=100.0)
    (bundle,) = evaluate({"fast": fast}, [recording], [lambda: hit], tmp_path, seed=0, threads=1).bundles
    # At K0 = 20 the sensor would be 8.9 ms behind.
    assert abs(bundle.latched.delay_against_sensor_median_s) <= 0.001
    assert bundle.rmse_during_contact_nm[0] < 1e-6 * 10  # single precision
    plain = replace(hit, tau_ext=None)
    (bundle,) = evaluate({"fast": fast}, [recording], [lambda: plain], tmp_path, seed=0, threads=1).bundles
    assert bundle.latched.delay_against_sensor_median_s == pytest.approx(-0.0089, abs=0.001)


def test_what_was_promised_is_compared_with_what_was_counted():
    asked, less = {"rate_per_hour": 0.125}, {"rate_per_hour": 6.0}
    promise = {"asked": asked, "supported": True, "supported_budget": less}
    assert promised_per_hour({"promise": promise}) == 0.125
    assert promised_per_hour({"promise": promise | {"supported": False}}) == 6.0
    assert promised_per_hour({}) is at_most_per_hour({}) is None
    extrapolated = {"promise": promise, "extrapolated": {"per_hour": 0.125, "between_per_hour": [0.02, 1.2]}}
    assert promised_per_hour(extrapolated) == 0.125 and at_most_per_hour({"promise": promise}) == 0.125
    assert at_most_per_hour(extrapolated) == 1.2
    # Garwood: three events in 10 h, 95 %: 0.062 to 0.877 an hour.
    counted = partial(FreeMotionErrors, 1, seconds=36000.0)
    found = counted(false_collisions=3).summary(0.125)
    assert_allclose(found.false_collisions_interval_per_hour, [0.0619, 0.8767], atol=1e-4)
    assert found.promise_consistent and found.promise_kept
    assert not counted(false_collisions=6).summary(0.125).promise_kept
    few = counted(false_collisions=6).summary(0.125, 1.2)  # within the interval that the limits state
    assert few.promise_kept and not few.promise_consistent and few.at_most_per_hour == 1.2
    assert not counted(false_collisions=20).summary(0.125, 1.2).promise_kept
    one = counted(false_collisions=1).summary(1.0)
    assert not one.promise_consistent and one.promise_kept
    none = FreeMotionErrors(1).summary(0.125)
    assert none.promise_kept is none.false_collisions_interval_per_hour is None
    assert counted(false_collisions=3).summary(None).promise_kept is None


def test_strength_bins_hold_every_collision_once():
    touches = [find_collisions(pushed(f"p{k}", force))[0] for k, force in enumerate((0.5, 1.5, 1.6, 9.0, 100.0))]
    verdicts = [LatchVerdict(k > 1, False, False, 0.01 * k if k > 1 else None, None) for k in range(5)]
    bins = by_strength(touches, verdicts)
    assert [b.collisions for b in bins] == [1, 2, 0, 0, 1, 0, 1] and bins[-1].peak_nm_to is None
    assert [b.latched for b in bins] == [0, 1, 0, 0, 1, 0, 1]
    assert bins[1].delay_median_s == pytest.approx(0.02) and bins[0].delay_median_s is None


def test_alarms_and_errors_are_distinguished_by_the_time_since_the_touch():
    contact = np.zeros(6000, dtype=np.int8)
    contact[1000:1200] = contact[5000:5100] = 1
    contact[5500:] = -1
    made = recording("touched", 6000, contact=contact)
    tau = np.full(6000, 1.0)
    tau[1100:1350] = 10.0  # over from the touch on: begins nothing
    tau[1800:1900] = tau[1950:1960] = 4.0  # 0.6 s after the touch, a contact and again, within 0.1 s
    tau[3000:3001] = 10.0  # 1.8 s after
    tau[4900:4950] = 10.0  # 3.7 s after: in no bin
    said = estimates_of(tau, 5.0)
    level = np.where(np.abs(tau) > 5, 2, np.where(np.abs(tau) > 3, 1, 0)).astype(np.int8)
    after = AfterContact(1)
    after.add_touched(made, replace(said, held_alarm=level))
    free = recording("free", 6000)
    after.add_free(free, replace(said, held_alarm=level))
    found = after.summary()
    # Sample 1199 is the last in touch; 5099 the last of the second, and from 5500 on nothing is known.
    assert_allclose([b.hours * 3.6e6 for b in found.bins], [300 + 201, 500, 500, 1000], atol=1.001)
    assert [b.contacts for b in found.bins] == [0, 1, 0, 1]
    assert [b.collisions for b in found.bins] == [0, 0, 0, 1]
    assert found.bins[2].rmse_nm == (1.0,)
    assert found.bins[1].rmse_nm[0] == pytest.approx(np.sqrt((390 + 110 * 16) / 500), rel=0.01)
    assert found.free_motion.contacts == 4 and found.free_motion.collisions == 3
    assert found.free_motion.contacts_per_hour == pytest.approx(4 / (6 / 3600))


def test_only_the_first_estimates_of_free_motion_are_kept_and_all_of_collisions(tmp_path):
    frees = [partial(recording, f"free-{k}") for k in range(3)]
    hits = [lambda: pushed("hit", 10.0)]
    kept = {}
    for keep in (0, 2, 20):
        out = tmp_path / str(keep)
        evaluate({"o": observer_bundle()}, frees, hits, out, 0, 1, keep_free_estimates=keep)
        kept[keep] = sorted(p.stem for p in (out / "o").iterdir())
    assert kept == {
        0: ["hit"],
        2: ["free-0", "free-1", "hit"],
        20: ["free-0", "free-1", "free-2", "hit"],
    }
    with pytest.raises(ConfigError, match="keep_free_estimates = -1 must be >= 0"):
        evaluate({"o": observer_bundle()}, frees, hits, tmp_path, 0, 1, keep_free_estimates=-1)


def test_detectors_that_know_nothing_show_what_a_number_is_worth(tmp_path):
    frees = [partial(recording, f"free-{k}", 600_000) for k in range(3)]
    results = evaluate(
        {"o": observer_bundle()},
        frees,
        [lambda: pushed("hit", 10.0)],
        tmp_path,
        0,
        1,
        keep_free_estimates=0,
        sanity=True,
    )
    json.dumps(to_json(results), allow_nan=False)
    always, never, random = results.sanity
    assert (always.found, always.latched, always.time_in_alarm_share) == (1, 0, 1.0)
    assert always.false_per_hour == pytest.approx(2)  # one that never ends, in half an hour
    assert (never.found, never.latched, never.false_per_hour) == (0, 0, 0)
    # 30 alarms are expected in half an hour, 5.5 the standard deviation; each 0.1 s.
    assert 30 - 17 < random.false_per_hour / 2 < 30 + 17
    assert "60 an hour in the long run" in random.worth  # the measured rate stands beside it, and differs
    assert random.time_in_alarm_share == pytest.approx(0.1 * random.false_per_hour / 3600, rel=0.1)


def test_free_motion_that_was_not_there_is_not_measured(tmp_path):
    """Not an error of 0 and no false alarm: with collisions alone, and with motion in which nothing was healthy."""
    too_short = recording("short", 20)
    for frees in ([], [lambda: too_short]):
        results = evaluate({"o": observer_bundle()}, frees, [lambda: pushed("hit", 10.0)], tmp_path, 0, 1)
        free = to_json(results)["bundles"][0]["free_motion"]
        assert (free["hours"], free["samples"]) == (0.0, 0)
        for name in ("l1_nm", "l2_nm", "near_stiction_share", "observer_peak_nm", "rmse_sliding_nm"):
            assert free[name] == [None], name
        for name in ("false_alarms", "false_alarms_per_hour", "false_collisions", "promise_kept"):
            assert free[name] is None, name


def test_results_are_plain_json_and_copy_what_the_bundle_was_trained_on(tmp_path):
    bundle = observer_bundle()
    promise = {"asked": {"rate_per_hour": 0.125}, "supported": True}
    facts = {"recipe": "prior", "case": "none", "training_minutes": 5.0, "limits": {"promise": promise}}
    bundle.provenance = json.dumps(facts)
    results = evaluate({"o": bundle}, [recording], [lambda: pushed("hit", 10.0)], tmp_path, seed=0, threads=1)
    (bundle,) = results.bundles
    json.dumps(to_json(results), allow_nan=False)
    assert (bundle.recipe, bundle.case, bundle.training_minutes) == ("prior", "none", 5.0)
    assert bundle.free_motion.promised_per_hour == 0.125 and bundle.free_motion.promise_kept is True
    assert results.sanity == ()


def test_one_method_with_hopeless_limits_does_not_leave_the_others_without_collisions_to_show(tmp_path):
    hits = [partial(pushed, f"hit-{k:02d}", 10.0 + k) for k in range(12)]
    good = {name: observer_bundle(2.0) for name in "abc"}
    alone = evaluate(good, [recording], hits, tmp_path, seed=5, threads=1).ten_collisions
    beside = evaluate(good | {"d": observer_bundle(1e3)}, [recording], hits, tmp_path, seed=5, threads=1)
    assert beside.ten_collisions == alone and len(alone) == 10
