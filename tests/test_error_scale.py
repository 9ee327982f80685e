"""The error scale: weights from errors, limits and standard error that follow the motion."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_arms import planar_arm
from sliding_mass import prismatic_mass
from test_check_data import Heard
from test_few_data import EXACT, motion, trained

from tauext import _core
from tauext.config import AlarmConfig, DriftConfig, FreeMotionConfig, ObserverConfig, PriorConfig, TrainConfig
from tauext.data.dataset import Dataset, Split
from tauext.data.recording import Recording
from tauext.errors import ConfigError
from tauext.fit.bundle_writing import build_setup, make_bundle
from tauext.train import asked_limits, other_programs
from tauext.train.calibrate import recalibrate
from tauext.train.error_scale import (
    FEATURES,
    ErrorRows,
    ErrorScaleConfig,
    HeldOut,
    add_friction,
    add_unseen,
    collect_rows,
    fit_weights,
    freeze_floor_nm,
    judge,
    put_constant_error,
    rest_sigma_nm,
    sigma_weights,
)
from tauext.train.fitting import GainConfig, mean_delay_s
from tauext.train.preparation import TrainingInput
from tauext.train.stage import train_on_recordings

ROWS = 20_000


def made_rows(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Features (1, a speed, an acceleration that is rare) and the true standard error that they announce."""
    rng = np.random.default_rng(seed)
    features = np.stack([np.ones(ROWS), rng.uniform(0, 2, ROWS), rng.exponential(size=ROWS) ** 2], axis=1)
    return features, features @ [0.2, 0.5, 0.1]


def test_the_weights_of_a_normal_error_are_found():
    """p = 2 is its likelihood: with 20,000 rows the standard error of each share of sigma is some 2 %."""
    features, sigma = made_rows()
    error = np.abs(sigma * np.random.default_rng(1).standard_normal(ROWS))
    found = features @ sigma_weights(features, error)
    assert np.abs(found / sigma - 1).max() < 0.1
    assert (error < found).mean() == pytest.approx(0.6827, abs=0.01)
    assert (error < 2 * found).mean() == pytest.approx(0.9545, abs=0.01)


def test_errors_that_are_mostly_0_have_the_root_of_their_mean_square_for_a_standard_error():
    """A servo that stands at its goal to the count: two thirds of its errors and more are exactly 0."""
    features, _ = made_rows()
    error = np.where(np.arange(ROWS) % 10 == 0, 0.5, 0.0)
    assert features @ sigma_weights(features, error) == pytest.approx(np.full(ROWS, np.sqrt(0.025)))


def test_a_feature_that_announces_nothing_weighs_nothing():
    features, sigma = made_rows()
    idle = np.random.default_rng(2).exponential(size=(ROWS, 1))
    error = np.abs(sigma * np.random.default_rng(1).standard_normal(ROWS))
    weights = fit_weights(np.hstack([features, idle]), error, 2.0)
    assert weights[-1] * idle.mean() < 0.03 * np.median(features @ weights[:-1])


def test_no_weight_is_negative_and_scaling_the_error_changes_nothing():
    features, sigma = made_rows()
    error = np.abs(sigma * np.random.default_rng(3).standard_normal(ROWS))
    falling = np.hstack([features, 1 / features[:, 1:2].clip(0.1)])
    for power in (2.0, ErrorScaleConfig.blunt, ErrorScaleConfig.sharp):
        one, other = (fit_weights(falling, by * error, power) for by in (1.0, 1e3))
        assert (one >= 0).all() and one[0] > 0
        np.testing.assert_allclose(one / one[0], other / other[0], rtol=1e-3, atol=1e-6)


def test_a_sharp_scale_lowers_the_limit_that_rare_large_errors_set():
    """Rare moments have mostly small errors, and now and then the largest of all: p = 2 sees the former."""
    rng = np.random.default_rng(4)
    rare = (rng.uniform(size=ROWS) < 0.05).astype(float)
    features = np.stack([np.ones(ROWS), rare], axis=1)
    uniform = rng.uniform(size=ROWS)
    error = np.where(rare > 0, 5.0 * uniform**16, uniform**2)
    usual = {}
    for power in (2.0, ErrorScaleConfig.sharp):
        scale = features @ fit_weights(features, error, power)
        usual[power] = (error / scale).max() * np.median(scale)
    assert usual[ErrorScaleConfig.sharp] < 0.8 * usual[2.0] and usual[ErrorScaleConfig.sharp] < 2


def test_the_drift_tracker_stands_still_in_as_much_of_the_motion_as_stated():
    rng = np.random.default_rng(5)
    error = np.abs(rng.standard_normal((30_000, 3))) * [0.1, 0.5, 2.0]
    error[rng.integers(0, 30_000, 10)] *= 8
    config, period_s = DriftConfig(), 0.01
    floor = freeze_floor_nm(error, config, period_s)
    np.testing.assert_allclose(floor / floor[0], [1, 5, 20], rtol=0.15)
    left, frozen = 0.0, 0
    for touched in (error > floor).any(axis=1):  # the tracker's own rule
        left = config.freeze_s if touched else max(left - period_s, 0)
        frozen += touched or left > 1e-9
    assert 0.5 * config.most_frozen < frozen / 30_000 <= config.most_frozen + 1e-3


def test_limits_follow_the_motion_and_sigma_covers_left_out_errors(tmp_path, monkeypatch):
    """Errors grow with the speed: so do limit and sigma, and sigma covers what it should on new motion."""
    rng = np.random.default_rng(6)

    def noisy(seed: int):
        r = motion(seconds=75.0, seed=seed, name=f"made{seed}")
        noise = rng.standard_normal(r.q.shape) * (0.05 + 0.4 * np.abs(r.dq))
        return motion(seconds=75.0, seed=seed, name=f"made{seed}", tau=r.tau + noise)

    settings = {"recipe": "prior", "observer": ObserverConfig(gain_per_s=50.0)}
    bundle, facts = trained(tmp_path, monkeypatch, [noisy(1), noisy(2), noisy(3)], **settings)
    bundle.drift.friction_share = 0.0  # what is unknown of the friction comes on top
    new = noisy(4)
    said = _core.estimate(bundle, *new.signals, 1)
    healthy = said["health"] == 1
    assert facts["error_scale"]["power"] == ErrorScaleConfig.blunt
    for j in range(2):
        ratio = np.abs(said["tau_ext"][healthy, j]) / said["sigma_nm"][healthy, j]
        assert 0.6 < (ratio < 1).mean() < 0.76 and 0.9 < (ratio < 2).mean() < 0.98
        fast, slow = (np.abs(new.dq[healthy, j]) > 1.0), (np.abs(new.dq[healthy, j]) < 0.2)
        slow &= said["near_stiction"][healthy, j] == 0  # where a share of the friction is open: this arm never rested
        for column in ("sigma_nm", "limit_nm"):
            assert said[column][healthy, j][fast].mean() > 1.5 * said[column][healthy, j][slow].mean()


@pytest.mark.parametrize(
    ("settings", "follows"),
    [
        ({"recipe": "prior", "error_scale": "off"}, False),
        ({"recipe": "friction"}, False),
        ({"recipe": "friction", "error_scale": "on"}, True),
    ],
)
def test_constants_are_there_for_the_asking_and_for_other_recipes(tmp_path, monkeypatch, settings, follows):
    bundle, facts = trained(tmp_path, monkeypatch, [motion()], **settings)
    assert bundle.error_scale.on and bundle.error_scale.follows == follows
    if follows:
        return
    assert "friction_reserve_nm" in facts["limits"]
    said = _core.estimate(bundle, *motion().signals, 1)
    for j in range(2):
        certain = (said["doubt"][:, j] == 0) & np.isfinite(said["sigma_nm"][:, j])
        assert len(np.unique(said["sigma_nm"][certain, j])) <= 2  # sliding and near stiction
        limits = {bundle.sliding_limit_nm[j], bundle.near_stiction_limit_nm[j]}
        certain = (said["doubt"][:, j] == 0) & np.isfinite(said["limit_nm"][:, j])
        assert set(np.unique(said["limit_nm"][certain, j])) <= limits


def test_a_reserve_of_friction_is_added_at_every_speed(tmp_path, monkeypatch):
    bundle, _ = trained(tmp_path, monkeypatch, [motion(seconds=60.0)], recipe="prior", observer=ObserverConfig(20.0))
    bundle.drift.friction_share = 0.0
    more = _core.Bundle.from_bytes(bundle.to_bytes())
    at_rest, per_speed = np.array([2.0, 1.0]), np.array([0.5, 3.0])
    add_friction(more, 0.1, at_rest, per_speed)
    r = motion(seconds=20.0, seed=9)
    before, after = (_core.estimate(b, *r.signals, 1) for b in (bundle, more))
    scale = _core.Bundle.from_bytes(bundle.to_bytes()).error_scale
    motion_of_r = (r.t_ns, r.dq, *(before[name] for name in ("near_stiction", "entered", "restarted")))
    said = _core.motion_errors(bundle, *motion_of_r, np.arange(r.samples))
    speed = said["features"][:, :, scale.features.index(_core.MotionFeature.speed)]
    # The chain itself multiplies by the same, and adds what doubt and unfamiliar motion do.
    certain = (before["doubt"] < 1e-20) & np.isfinite(before["sigma_nm"])
    assert certain.sum() > 1000
    widens = 1 + 0.5 * before["unfamiliar"][:, None]
    np.testing.assert_allclose((widens * said["sigma_nm"])[certain], before["sigma_nm"][certain], rtol=1e-15)
    widened = widens * said["scale"]
    np.testing.assert_allclose(widened[certain], before["limit_scale"][certain], rtol=1e-15)
    sliding = (before["near_stiction"] == 0) & (before["doubt"] < 1e-15) & np.isfinite(before["limit_nm"])
    sliding &= (said["scale"] < np.array(scale.largest)) & (before["unfamiliar"] == 0)[:, None]
    assert sliding.sum() > 300
    added = after["limit_nm"] - before["limit_nm"]
    np.testing.assert_allclose(added[sliding], (0.1 * (at_rest + per_speed * speed))[sliding], rtol=1e-9)


def test_a_hit_is_found_as_the_observer_s_own_response_says():
    """Against the core's observer on a mass that rests while the hit is all that acts."""
    period_ns = 100_000
    t_ns = np.arange(1500, dtype=np.int64) * period_ns
    t = 1e-9 * t_ns
    hit = np.where(t < GainConfig.hit_s, np.sin(np.pi * t / GainConfig.hit_s), 0.0)
    for gain in (20.0, 100.0):
        settings = _core.ObserverSettings(
            gain_per_s=gain, timing=_core.TorqueTiming.instant, sample_period_ns=period_ns, network_stride=1
        )
        still = np.zeros((len(t), 1))
        r = _core.observe(prismatic_mass(1.0), settings, t_ns, still, still, -hit[:, None]).residual[:, 0]
        for limit in (0.05, 0.2, 0.35):
            found = t[np.argmax(r > limit)]
            assert mean_delay_s(gain, np.array([[limit]]), np.array([1.0])) == pytest.approx(found, abs=2.5e-4)
    assert mean_delay_s(20.0, np.array([[4.0, 4.0]]), np.array([1.0, 2.0])) == GainConfig.latest_s


def test_the_gain_follows_from_the_errors(tmp_path, monkeypatch):
    """Noise of the torque speaks for a slow observer; errors that last, and no noise, for a fast one."""
    worth = {}
    for name, noise in (("noise", 2.0), ("none", 0.0)):
        rng, r = np.random.default_rng(7), motion(seconds=90.0, seed=5)
        ripple = 0.3 * np.sin(7 * r.q) * np.cos(1.3 * np.arange(r.samples) / 125.0)[:, None]
        tau = r.tau + noise * rng.standard_normal(r.tau.shape) + ripple
        folder = tmp_path / name
        folder.mkdir()
        bundle, facts = trained(folder, monkeypatch, [motion(seconds=90.0, seed=5, tau=tau)], recipe="prior")
        delay_s = {float(gain): delay for gain, delay in facts["gain"]["mean_delay_s"].items()}
        worth[name] = delay_s[20.0] / delay_s[50.0]
        chosen = 50.0 if worth[name] > 1 + GainConfig.worth else 20.0  # 100 1/s follows samples of 8 ms
        assert bundle.observer.gain_per_s == facts["gain"]["chosen_per_s"] == chosen
        assert "is found after" in facts["gain"]["reason"]
        assert json.dumps(facts["settings"]).count('"gain_per_s": "auto"') == 1
    assert worth["none"] > 1.15 * worth["noise"]


def test_every_feature_has_a_place_in_the_fit():
    assert [feature.name for feature in FEATURES][0] == "constant" and len(set(FEATURES)) == 8


@pytest.mark.slow
def test_calibrate_keeps_the_scale_or_fits_it_to_recordings_apart_from_those_of_the_limits(tmp_path, monkeypatch):
    bundle, _ = trained(tmp_path, monkeypatch, [motion(seconds=60.0)], recipe="prior")
    recordings = [motion(seconds=60.0, seed=seed, name=f"day{seed}") for seed in range(10)]
    monkeypatch.setattr(Dataset, "stretches", lambda self, part: [lambda r=r: r for r in recordings])
    dataset, made = Dataset(tmp_path, Split((), (), ())), {}
    for refit in (False, True):
        out = tmp_path / f"{refit}.tauext"
        recalibrate(tmp_path / "made.tauext", dataset, out, AlarmConfig(), refit_error_scale=refit)
        made[refit] = _core.Bundle.load(str(out))
    kept, fitted = made[False], made[True]
    of_limits = json.loads(bundle.provenance)["error_scale"]["of_limits"]["limit_weights"]
    before, same, changed = (
        np.array(weights).reshape(bundle.joints, -1)
        for weights in (of_limits, kept.error_scale.limit_weights, fitted.error_scale.limit_weights)
    )
    standstill = FEATURES.index(_core.MotionFeature.standstill)  # limits at rest are no lower than the friction's share
    np.testing.assert_array_equal(np.delete(same, standstill, 1), np.delete(before, standstill, 1))
    assert (same[:, standstill] >= before[:, standstill]).all()
    assert not np.array_equal(np.delete(changed, standstill, 1), np.delete(before, standstill, 1))
    facts = json.loads(fitted.provenance)
    assert facts["error_scale"]["recordings"] == ["day0", "day1"]
    assert facts["limits"]["recordings"] == [f"day{k}" for k in range(2, 10)]
    assert fitted.drift.freeze_share == kept.drift.freeze_share > 0
    recordings[1:] = []
    with pytest.raises(ConfigError, match="2 calibration recordings or more"):
        recalibrate(tmp_path / "made.tauext", dataset, tmp_path / "x.tauext", AlarmConfig(), refit_error_scale=True)


def with_unknown(recording: Recording) -> Recording:
    contact = np.zeros(recording.samples, dtype=np.int8)
    contact[100:600] = -1
    return replace(recording, contact=contact)


def twice_as_large_at_rest(bundle: _core.Bundle, *_) -> None:
    """What other programs add to sigma."""
    scale = bundle.error_scale
    near = np.array(scale.sigma_near_weights).reshape(bundle.joints, -1)
    near[:, FEATURES.index(_core.MotionFeature.standstill)] += rest_sigma_nm(bundle)
    scale.sigma_near_weights = near.ravel().tolist()
    bundle.error_scale = scale


@pytest.mark.parametrize("in_hours", [0.02, 8.0], ids=["proved", "extrapolated"])
def test_calibrate_gives_the_limits_of_a_training_with_the_same_calibration_recordings(tmp_path, monkeypatch, in_hours):
    """Nothing is left of what minutes need: floors, the share of friction, and limits at rest that outlast a rest."""
    day = [with_unknown(motion(seconds=60.0, seed=1)), *(motion(seconds=60.0, seed=k) for k in range(2, 6))]
    day = [replace(one, name=f"day{k}") for k, one in enumerate(day)]
    loaders = [lambda one=one: one for one in day]
    training, alarm = [motion(seconds=60.0)], AlarmConfig(in_hours=in_hours)
    rest_nm, put_floors = [], asked_limits.put_floors
    monkeypatch.setattr(asked_limits, "put_floors", lambda *given: rest_nm.append(given[-1]) or put_floors(*given))
    monkeypatch.setattr(other_programs, "add_at_rest", twice_as_large_at_rest)
    short, _ = trained(tmp_path, monkeypatch, training, recipe="prior", alarm=alarm)
    monkeypatch.setattr(Dataset, "stretches", lambda self, part: loaders)
    heard, names = Heard(), ("once", "twice")
    for old, new in zip(("made", "once"), names, strict=True):
        paths = (tmp_path / f"{name}.tauext" for name in (old, new))
        recalibrate(next(paths), Dataset(tmp_path, Split((), (), ())), next(paths), alarm, report=heard)
    assert sum("calibration: 4." in words and "of 4.0 s the contact is unknown" in words for words in heard.said) == 2
    given = TrainingInput(Path(), EXACT, training, [], calibration=loaders, model=planar_arm())
    config = TrainConfig(recipe="prior", prior=PriorConfig(most_ripples=0), alarm=alarm)
    train_on_recordings(given, config, tmp_path / "whole.tauext", heard)
    if in_hours == 8.0:  # sigma at rest contains other programs; floors do not
        assert len(rest_nm) == 4 and rest_sigma_nm(short) == pytest.approx(2 * rest_nm[0])
        np.testing.assert_allclose(rest_nm, [rest_nm[0]] * 4, rtol=0.05)
    assert any("made" not in words and "of 4.0 s the contact is unknown" in words for words in heard.said)
    whole, *made = (_core.Bundle.load(str(tmp_path / f"{name}.tauext")) for name in ("whole", *names))
    assert not np.allclose(short.error_scale.limit_weights, whole.error_scale.limit_weights, rtol=0.01)
    for one in made:
        # the rows of the scale are judged with and without the time for which limits at rest outlast a rest
        scales = one.error_scale, whole.error_scale
        np.testing.assert_allclose(*(scale.limit_weights for scale in scales), rtol=0.05, atol=0.01)
        np.testing.assert_allclose(*(scale.largest for scale in scales), rtol=0.05)
        for limit in ("sliding_limit_nm", "near_stiction_limit_nm", "contact_sliding_limit_nm"):
            np.testing.assert_allclose(getattr(one, limit), getattr(whole, limit), rtol=0.05)


def test_the_error_in_a_span_does_not_depend_on_what_follows(tmp_path, monkeypatch):
    bundle, _ = trained(tmp_path, monkeypatch, [motion()], recipe="prior")
    one, part = motion(seed=1), slice(2_000, 3_000)
    whole, until = (judge(bundle, judged, 1, FreeMotionConfig()) for judged in (one, HeldOut(one, part)))
    counted = until[3]
    assert until[0].samples == part.stop and counted[part].all() and not counted[: part.start].any()
    np.testing.assert_array_equal(whole[2][: part.stop], until[2])
    for column, values in until[1].items():
        np.testing.assert_array_equal(whole[1][column][: part.stop], values)


def test_rows_that_were_thinned_out_tell_the_same_hours(tmp_path, monkeypatch):
    bundle, _ = trained(tmp_path, monkeypatch, [motion()], recipe="prior")
    recordings = [motion(seed=seed) for seed in range(4)]
    whole = collect_rows(bundle, recordings, 1, FreeMotionConfig())
    thin = collect_rows(bundle, recordings, 1, FreeMotionConfig(), ErrorScaleConfig(most_rows=6000))
    assert len(thin.error_nm) <= 6000 < 2 * len(thin.error_nm) + 4 and thin.period_s == 4 * whole.period_s
    assert thin.hours == pytest.approx(whole.hours, rel=1e-3)


def rows_of(error_nm: np.ndarray, near: np.ndarray) -> ErrorRows:
    count, joints = error_nm.shape
    features = np.ones((count, joints, 1))
    t_ns = np.arange(count, dtype=np.int64) * 10_000_000
    return ErrorRows(error_nm, near, features, 0.01, t_ns, np.zeros(count, dtype=int), ("made",))


def bundle_of(recipe: str = "observer") -> _core.Bundle:
    recording = motion(seconds=20.0, seed=3)
    tree = _core.Tree(planar_arm().links, planar_arm().gravity)
    return make_bundle("made", build_setup(tree, recording, ObserverConfig(), recipe), 0.02, recording)


def test_the_standard_error_is_that_of_each_region_and_limits_stay():
    bundle, rng = bundle_of(), np.random.default_rng(1)
    near = rng.random((20_000, 2)) < 0.3
    size = np.where(near, [0.8, 0.3], [0.5, 0.2])
    put_constant_error(bundle, rows_of(np.abs(rng.normal(0, size)), near))
    scale = bundle.error_scale
    assert scale.on and not scale.follows
    # 68 % of 6,000 normal errors: known to about a hundredth.
    np.testing.assert_allclose(scale.sigma_weights, [0.5, 0.2], rtol=0.04)
    np.testing.assert_allclose(scale.sigma_near_weights, [0.8, 0.3], rtol=0.04)
    made = motion(seconds=5.0, seed=4)
    said = _core.estimate(bundle, *made.signals, 1)
    healthy = said["health"] == 1
    assert (said["limit_scale"][healthy] == 1).all()
    expected = np.where(said["near_stiction"][healthy], scale.sigma_near_weights, scale.sigma_weights)
    np.testing.assert_array_equal(said["sigma_nm"][healthy], expected)
    assert not _core.WrenchModel(bundle).refused and not _core.PlaceModel(bundle).refused


def test_a_region_without_rows_has_the_error_of_both():
    bundle = bundle_of()
    put_constant_error(bundle, rows_of(np.full((1000, 2), 0.4), np.zeros((1000, 2), dtype=bool)))
    assert bundle.error_scale.sigma_near_weights == pytest.approx([0.4, 0.4])


@pytest.mark.parametrize("rests", [0, 3, 1000])
def test_few_rests_leave_a_share_of_the_friction_open_and_many_show_the_error(tmp_path, monkeypatch, rests):
    """The equation of add_unseen by hand: a prior of ten rests with 0.3 times the friction, and rests of three rows."""
    bundle, _ = trained(tmp_path, monkeypatch, [motion()], recipe="prior")
    slept = np.tile([True, True, True, False], max(rests, 1)) & (rests > 0)
    rows = rows_of(np.where(slept, 0.1, 0.02)[:, None] * np.ones(2), slept[:, None] & np.ones(2, dtype=bool))
    features = np.zeros((len(slept), 2, len(FEATURES)))
    constant, speed, standstill = (
        FEATURES.index(getattr(_core.MotionFeature, name)) for name in ("constant", "speed", "standstill")
    )
    features[:, :, constant], features[~slept, :, speed], features[slept, :, standstill] = 1, 1, 1
    scale = bundle.error_scale
    scale.sigma_weights = scale.sigma_near_weights = [0.0] * (2 * len(FEATURES))
    bundle.error_scale = scale
    rows = replace(rows, features=features)
    add_unseen(bundle, rows)
    near = np.array(bundle.error_scale.sigma_near_weights).reshape(2, -1)
    for j in range(2):
        friction = bundle.prior.friction_at_rest_nm(j)
        assert friction > 0.5
        expected = np.sqrt((10 * (0.3 * friction) ** 2 + rests * 0.1**2) / (10 + rests))
        assert near[j, constant] + near[j, standstill] == pytest.approx(expected)
        rms = np.sqrt(np.mean(rows.error_nm[:, j] ** 2))
        assert near[j, constant] == bundle.error_scale.sigma_weights[j * len(FEATURES)] == pytest.approx(0.2 * rms)
    assert (np.array(bundle.error_scale.largest_sigma) >= near[:, constant] + near[:, standstill]).all()


@pytest.mark.parametrize("recipe", ["bandpass", "highpass"])
def test_a_filtered_residual_is_refused_for_forces_and_places(recipe):
    bundle = bundle_of(recipe)
    put_constant_error(bundle, rows_of(np.full((1000, 2), 0.4), np.zeros((1000, 2), dtype=bool)))
    for model in (_core.WrenchModel(bundle), _core.PlaceModel(bundle)):
        assert "its residual is filtered" in model.refused and "recipe observer" in model.refused
