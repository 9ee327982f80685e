"""Metrics, collisions and delays against values worked out by hand."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from made_bundles import SIGMA_NEAR_NM, with_error_scale
from numpy.testing import assert_allclose
from sliding_mass import estimates_of, observer_bundle, pushed, recording
from tauext_lab.evaluate.collisions import choose_ten, find_collisions, found_curve, held, judge
from tauext_lab.evaluate.comparison import evaluate
from tauext_lab.evaluate.errors import ErrorAgainstSigma
from tauext_lab.evaluate.free_motion import FreeMotionErrors, count_episodes
from tauext_lab.evaluate.results import SigmaRegion, to_json

from tauext.bundle.estimates import Estimates, load_estimates, save_estimates
from tauext.bundle.loss_history import read_loss_history, thin
from tauext.errors import BundleError, ConfigError, RecordingError


def test_a_push_is_found_after_the_time_that_the_observer_needs_to_reach_the_limit(tmp_path):
    # r(t) = F (1 - exp(-K0 t)) passes the limit at t = -ln(1 - limit/F)/K0; the sensor has the same low-pass.
    force, limit = 10.0, 2.0
    hit = pushed("hit", force)
    results = evaluate({"observer": observer_bundle(limit)}, [recording], [lambda: hit], tmp_path, seed=0, threads=1)
    (verdict,) = results.bundles[0].collisions
    expected = -np.log(1 - limit / force) / 20.0
    assert verdict.found and verdict.joint == "slide"
    assert expected <= verdict.delay_s <= expected + 1.001e-3  # the first sample after it
    assert verdict.delay_against_sensor_s == pytest.approx(0.0, abs=1.001e-3)
    (collision,) = results.collisions
    assert (collision.start_s, collision.end_s) == (1.0, 1.399)
    assert collision.true_peak_nm == (force,)
    assert collision.sensor_peak_nm[0] == pytest.approx(force * (1 - np.exp(-20 * 0.4)), rel=1e-3)
    assert results.ten_collisions == (collision.id,) and results.bundles[0].ten_found == 1


def test_a_push_below_the_limit_is_missed_and_counts_as_missed_in_the_curve(tmp_path):
    weak = pushed("weak", 1.5)
    results = evaluate({"observer": observer_bundle(2.0)}, [recording], [lambda: weak], tmp_path, seed=0, threads=1)
    (verdict,) = results.bundles[0].collisions
    assert not verdict.found and verdict.delay_s is None and verdict.delay_against_sensor_s is None
    entry = next(e for e in results.bundles[0].found_curve if e.collisions)
    assert (entry.peak_over_limit_from, entry.collisions, entry.found) == (0.5, 1, 0)


def test_a_push_is_latched_after_limit_and_hold_time_and_strong_where_it_must_be(tmp_path):
    bundle = observer_bundle(2.0)
    bundle.hold_s = 0.02
    results = evaluate({"observer": bundle}, [recording], [lambda: pushed("pushed", 5.0)], tmp_path, seed=0, threads=1)
    latched = results.bundles[0].latched
    # 5 (1 - exp(-20 t)) > 2 from 25.5 ms on, and from 46 ms, 20 held ms later, a collision; over 3 Nm from 46 ms on.
    assert latched.collisions == latched.latched == latched.strong == latched.strong_latched == 1
    assert abs(latched.delay_against_sensor_median_s) <= 0.001  # the sensor filters alike
    weak = evaluate({"observer": bundle}, [recording], [lambda: pushed("pushed", 2.5)], tmp_path, seed=0, threads=1)
    assert weak.bundles[0].latched.latched == 1 and weak.bundles[0].latched.strong == 0
    short = evaluate({"o": bundle}, [recording], [lambda: pushed("p", 5.0, 1000, 1030)], tmp_path, seed=0, threads=1)
    assert short.bundles[0].latched.strong == 0


def test_held_flags_equal_a_slow_count():
    over = np.random.default_rng(1).uniform(size=(300, 2)) < 0.8
    for hold in (0, 1, 5):
        slow = [[k >= hold and over[k - hold : k + 1, j].all() for j in range(2)] for k in range(300)]
        np.testing.assert_array_equal(held(over, hold), slow)


def test_free_motion_numbers_equal_those_of_all_samples_in_one_array():
    rng = np.random.default_rng(1)
    parts = [rng.normal(0, 3, 500), rng.normal(0, 1, 700)]
    errors = FreeMotionErrors(1)
    for part in parts:
        # Every other sample is slower than 0.02 rad/s, whatever the region of the limit.
        dq = np.where(np.arange(len(part)) % 2 == 0, 0.01, 0.03)[:, None]
        errors.add(recording(samples=len(part), dq=dq), estimates_of(part, limit=1e9, warm_from=100))
    summary = errors.summary(None)
    kept = np.concatenate([part[100:] for part in parts]).astype(np.float32).astype(float)
    near = np.concatenate([np.arange(100, len(part)) % 2 == 0 for part in parts])
    assert_allclose(summary.l1_nm, [np.abs(kept).mean()], rtol=1e-12)
    assert_allclose(summary.l2_nm, [np.sqrt((kept**2).mean())], rtol=1e-12)
    assert_allclose(summary.mse_nm2, [(kept**2).mean()], rtol=1e-12)
    assert_allclose(summary.rmse_near_stiction_nm, [np.sqrt((kept[near] ** 2).mean())], rtol=1e-12)
    assert_allclose(summary.rmse_sliding_nm, [np.sqrt((kept[~near] ** 2).mean())], rtol=1e-12)
    assert summary.samples == 1000 and summary.hours == pytest.approx(1 / 3600)
    assert summary.false_alarms == 0


def test_what_does_not_exist_is_null_and_not_zero():
    errors = FreeMotionErrors(1)
    errors.add(recording(samples=10), estimates_of(np.full(10, np.nan), 1.0, warm_from=10))
    summary = errors.summary(None)
    assert summary.rmse_sliding_nm == (None,) and summary.false_alarms_per_hour is None
    json.dumps(to_json(summary), allow_nan=False)


@pytest.mark.parametrize(
    "at, episodes", [([], 0), ([5], 1), ([5, 6, 7], 1), ([5, 505], 1), ([5, 506], 2), ([0, 600, 1200, 1201], 3)]
)
def test_detections_less_than_half_a_second_apart_are_one_false_alarm(at, episodes):
    flags = np.zeros(2000, dtype=bool)
    flags[at] = True
    assert count_episodes(flags, quiet_samples=500) == episodes


def test_a_bouncing_touch_is_one_collision_and_one_after_a_pause_another():
    contact = np.zeros(3000, dtype=np.int8)
    contact[100:150] = contact[300:340] = contact[1000:1001] = 1
    found = find_collisions(recording(contact=contact))
    assert [(c.begin, c.end) for c in found] == [(100, 340), (1000, 1001)]
    assert [c.id for c in found] == ["made:0", "made:1"]
    assert find_collisions(recording()) == []


def test_an_alarm_that_was_on_before_the_touch_does_not_find_it():
    contact = np.zeros(3000, dtype=np.int8)
    contact[1000:1200] = 1
    made = recording(contact=contact)
    (collision,) = find_collisions(made)
    stuck = np.zeros(3000)
    stuck[900:1500] = 5.0
    assert not judge(collision, made, estimates_of(stuck, 1.0)).found
    stuck[1050:1060] = 0.0  # released and raised again while in contact
    verdict = judge(collision, made, estimates_of(stuck, 1.0))
    assert verdict.found and verdict.delay_s == pytest.approx(0.060)


def test_the_delay_of_a_joint_compares_its_own_estimate_with_its_own_sensor():
    def rising(*first: int) -> np.ndarray:
        return 5.0 * (np.arange(3000)[:, None] >= np.array(first))

    contact = np.zeros(3000, dtype=np.int8)
    contact[1000:1200] = 1
    sensor, tau_ext = rising(1010, 1020, 1015), rising(1030, 1018, 2500).astype(np.float32)
    still = np.zeros_like(sensor)
    hit = recording(contact=contact, joints=("a", "b", "c"), q=still, dq=still, tau=still, tau_ext_sensor=sensor)
    one = estimates_of(np.zeros(3000), 1.0)
    limit, detection = np.ones_like(tau_ext), (tau_ext > 1).any(axis=1)
    estimates = replace(one, joints=hit.joints, tau_ext=tau_ext, limit_nm=limit, detection=detection)
    verdict = judge(find_collisions(hit)[0], hit, estimates)
    assert verdict.joint == "b" and verdict.delay_against_sensor_s == pytest.approx(0.008)  # b after the sensor of a
    first, second, third = verdict.joint_delays_against_sensor_s
    assert (first, second, third) == (pytest.approx(0.020), pytest.approx(-0.002), None)


def test_the_ten_are_drawn_by_seed_among_those_of_twice_the_limit():
    recordings = [pushed(f"push-{k:02d}", force=k + 1.0) for k in range(30)]
    touches = [find_collisions(r)[0] for r in recordings]
    limit = np.array([5.0])
    ten = choose_ten(touches, limit, seed=3)
    assert len(ten) == 10 and ten == choose_ten(touches, limit, seed=3) and ten != choose_ten(touches, limit, seed=4)
    assert all(c.sensor_peak_nm[0] >= 10.0 for c in touches if c.id in ten)
    assert choose_ten(touches[:12], limit, seed=3) == [c.id for c in touches[:12] if c.sensor_peak_nm[0] >= 10.0]
    assert not {touches[20].id, touches[25].id} & set(
        choose_ten(touches[15:], limit, 3, [touches[20].id, touches[25].id])
    )
    curve = found_curve([SimpleNamespace(found=True, peak_over_limit=c.sensor_peak_nm[0] / 5) for c in touches])
    assert sum(entry.collisions for entry in curve) == 30 == sum(entry.found for entry in curve)
    assert sum(entry.collisions for entry in found_curve([SimpleNamespace(found=False, peak_over_limit=None)])) == 0


def test_a_push_is_held_against_the_limit_that_holds_at_its_samples(tmp_path):
    # 5 Nm on 2 kg: after 0.4 s it slides at 1 m/s, and its limit of 2 Nm has doubled.
    hit = pushed("hit", 5.0)
    constant, moving = observer_bundle(2.0), with_error_scale(observer_bundle(2.0))
    bundles = {"constant": constant, "moving": moving}
    results = evaluate(bundles, [recording], [lambda: hit], tmp_path, seed=0, threads=1)
    still, entry = results.bundles
    assert (still.limits.moving, entry.limits.moving) == (False, True)
    said = load_estimates(tmp_path / "moving" / "hit.parquet")
    ratio = np.abs(hit.tau_ext_sensor / said.limit_nm)[1000:1600].max()
    assert entry.collisions[0].peak_over_limit == pytest.approx(ratio)
    assert 1.2 < ratio < 2.0 < still.collisions[0].peak_over_limit
    assert results.ten_collisions == ()  # at the limits that move it is not strong
    (found,) = [one for one in entry.found_curve if one.collisions]
    assert found.peak_over_limit_from <= ratio < found.peak_over_limit_to
    assert still.error_against_sigma is None and load_estimates(tmp_path / "constant/hit.parquet").sigma_nm is None
    (sliding,), (near,) = (entry.error_against_sigma[region] for region in ("sliding", "near_stiction"))
    assert sliding == SigmaRegion(samples=0, within_one_sigma=None, within_two_sigma=None, bins=())
    assert near.samples == entry.free_motion.samples and near.within_one_sigma == 1.0
    (only,) = near.bins
    assert only.sigma_nm_from <= SIGMA_NEAR_NM < only.sigma_nm_to
    assert only.sigma_rms_nm == pytest.approx(SIGMA_NEAR_NM) and only.error_rms_nm == pytest.approx(0, abs=1e-9)


def test_errors_against_sigma_are_counted_by_joint_region_and_bin():
    rng = np.random.default_rng(0)
    error, sigma = rng.normal(0, 1, 4000), np.where(np.arange(4000) < 2000, 0.5, 2.0)
    counted = ErrorAgainstSigma(1)
    said = replace(estimates_of(error, 1e9, warm_from=100), sigma_nm=sigma[:, None].astype(np.float32))
    counted.add(said)
    counted.add(said)
    summary = counted.summary()
    size = np.abs(error.astype(np.float32))
    for region, odd in (("sliding", 1), ("near_stiction", 0)):
        rows = (np.arange(4000) >= 100) & (np.arange(4000) % 2 == odd)
        (entry,) = summary[region]
        assert entry.samples == 2 * rows.sum() == sum(one.samples for one in entry.bins)
        assert entry.within_one_sigma == pytest.approx((size <= sigma)[rows].mean())
        assert entry.within_two_sigma == pytest.approx((size <= 2 * sigma)[rows].mean())
        for one, told in zip(entry.bins, (0.5, 2.0), strict=True):
            here = rows & (sigma == told)
            assert one.sigma_rms_nm == pytest.approx(told)
            assert one.error_rms_nm == pytest.approx(np.sqrt((size[here] ** 2).mean()))


def test_errors_of_contacts_and_of_the_second_after_them_are_held_against_their_own_sigma():
    """Errors of 1 within the contact and 3 in the second after it, 0.1 beyond; a contact's standard error is 2."""
    rng = np.random.default_rng(1)
    contact = np.zeros(4000, dtype=np.int8)
    contact[1000:1600] = 1
    made = recording(samples=4000, contact=contact)
    (touch,) = find_collisions(made)
    true = rng.normal(0, 5, (4000, 1))
    size = np.full(4000, 0.1)
    size[1000:1600], size[1600:2599] = 1.0, 3.0
    said = estimates_of(true[:, 0] + size, 1e9, warm_from=100)
    sigma = np.full((4000, 1), 2.0, dtype=np.float32)
    counted = ErrorAgainstSigma(1)
    counted.add_touched([touch], made, replace(said, sigma_nm=sigma), true)
    assert counted.summary() is None  # a bundle without an error scale has neither
    counted.add(replace(said, sigma_nm=sigma, contact_sigma_nm=sigma))
    assert set(counted.summary()) == {"sliding", "near_stiction"}
    counted.add_touched([touch], made, replace(said, sigma_nm=sigma, contact_sigma_nm=sigma), None)
    assert "contact" not in counted.summary()
    counted.add_touched([touch], made, replace(said, sigma_nm=sigma, contact_sigma_nm=sigma), true)
    (during,), (after,) = (counted.summary()[part] for part in ("contact", "second_after"))
    assert (during.samples, during.within_one_sigma, during.within_two_sigma) == (600, 1.0, 1.0)
    assert (after.samples, after.within_one_sigma, after.within_two_sigma) == (999, 0.0, 1.0)
    assert after.bins[0].error_rms_nm == pytest.approx(3.0, rel=1e-6)


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"joints": ("other",)}, "is for joints slide; recording made has other"),
        ({"t_ns": np.arange(3000, dtype=np.int64) * 2_000_000, "rate_hz": 500.0}, "runs at 1000 Hz"),
        ({"torque_timing": "instant"}, "torques that are held"),
    ],
)
def test_a_recording_that_does_not_fit_is_refused_by_name(tmp_path, changes, message):
    made = recording(**changes)
    with pytest.raises(BundleError, match=message):
        evaluate({"observer": observer_bundle()}, [lambda: made], [], tmp_path, seed=0, threads=1)


def test_an_empty_test_set_and_no_bundle_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="no test recording"):
        evaluate({"observer": observer_bundle()}, [], [], tmp_path, seed=0, threads=1)
    with pytest.raises(ConfigError, match="no bundle"):
        evaluate({}, [recording], [], tmp_path, seed=0, threads=1)


def test_estimates_come_back_from_their_file_as_they_were(tmp_path):
    made = estimates_of(np.r_[np.full(5, np.nan), np.arange(10.0)], 3.0, warm_from=5)
    made = replace(made, sigma_nm=np.abs(made.tau_ext) / 10)
    save_estimates(made, tmp_path / "e.parquet")
    loaded = load_estimates(tmp_path / "e.parquet")
    for field in Estimates.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(loaded, field), getattr(made, field))
    (tmp_path / "e.parquet").write_bytes(b"PAR1 not really")
    with pytest.raises(RecordingError, match="not a readable estimates file"):
        load_estimates(tmp_path / "e.parquet")
    with pytest.raises(RecordingError, match="no such estimates"):
        load_estimates(tmp_path / "missing.parquet")


# Loss history of training, from the run file beside a bundle


def test_a_loss_history_stands_in_the_results_of_its_case(tmp_path):
    history = [[200, 0.1, 0.05], [400, 0.02, 0.03]]
    (tmp_path / "observer.run.json").write_text(json.dumps({"recipe": "observer", "loss_history": history}))
    bundle = observer_bundle()
    histories = {"observer": read_loss_history(bundle, tmp_path / "observer.tauext")}
    bundles = {"observer": bundle, "copied": bundle}
    results = evaluate(bundles, [recording], [], tmp_path, seed=0, threads=1, loss_histories=histories)
    assert [to_json(bundle.loss_history) for bundle in results.bundles] == [history, None]


def test_a_bundle_without_a_run_file_or_without_training_has_no_loss_history(tmp_path):
    assert read_loss_history(observer_bundle(), tmp_path / "copied.tauext") is None
    for content in ({}, {"loss_history": []}, {"loss_history": None}):
        (tmp_path / "observer.run.json").write_text(json.dumps(content))
        assert read_loss_history(observer_bundle(), tmp_path / "observer.tauext") is None


@pytest.mark.parametrize(
    "text, message",
    [
        ("{", "not a readable run file"),
        ("[1]", "it is no JSON object"),
        ('{"loss_history": 3}', "'loss_history' is no list"),
        (
            '{"loss_history": [[1, 0.1]]}',
            r"loss_history\[0\] is \[1, 0.1\], must be \[step, training, validation loss\]",
        ),
        ('{"loss_history": [[1, 0.1, true]]}', r"loss_history\[0\] is"),
        ('{"loss_history": [[2, 0.1, 0.1], [2, 0.1, 0.1]]}', r"loss_history\[1\] is .*steps must grow"),
        ('{"loss_history": [[1, NaN, 0.1]]}', "losses be finite"),
        ('{"recipe": "paper", "steps": 0}', "it is of another training than observer.tauext \\('recipe' differs\\)"),
    ],
)
def test_a_run_file_that_is_damaged_or_of_another_bundle_is_refused_with_the_way_out(tmp_path, text, message):
    (tmp_path / "observer.run.json").write_text(text)
    with pytest.raises(ConfigError, match=message) as caught:
        read_loss_history(observer_bundle(), tmp_path / "observer.tauext")
    assert "remove it to do without its loss history" in str(caught.value)


@pytest.mark.parametrize("entries", [1, 199, 200, 201, 945, 5000])
def test_a_thinned_history_keeps_both_ends_and_the_lowest_validation_loss(entries):
    rng = np.random.default_rng(entries)
    history = [[200 * (k + 1), *rng.random(2)] for k in range(entries)]
    kept = thin(history)
    assert len(kept) <= 200
    assert kept[0] == history[0] and kept[-1] == history[-1] and min(history, key=lambda e: e[2]) in kept
    assert kept == sorted(kept) and kept == thin(history)
    assert entries > 200 or kept == history
    assert entries <= 200 or len(kept) >= 150
