"""The drift tracker's settings and what people and files are told of it; cpp/tests/drift_test.cpp tests its law."""

import json
from dataclasses import replace

import numpy as np
import pytest
from made_arms import planar_arm
from made_bundles import cut_flight
from test_train import recording

from tauext import _core
from tauext.bundle.estimates import load_estimates, save_estimates
from tauext.cli.show import describe_bundle
from tauext.config import PAPER_CASES, DriftConfig, ObserverConfig, PriorConfig, TrainConfig
from tauext.data.recording import Recording
from tauext.data.recording_file import save_recording
from tauext.fit.bundle_writing import build_setup, freeze_drift, make_bundle, set_drift
from tauext.fit.prior import fit_prior
from tauext.fit.prior_facts import friction_nm
from tauext.fit.training_set import with_presliding
from tauext.monitor.changes import ChangeFinder, DriftChange
from tauext.monitor.estimate import estimate_recording
from tauext.monitor.flight_content import as_estimates, rows_kept
from tauext.monitor.flight_files import FlightSource
from tauext.train.error_scale import unit_scale
from tauext.train.preparation import training_settings

CONFIG = DriftConfig(time_constant_s=5.0, rate_share_per_s=0.2)


@pytest.fixture(scope="module")
def fitted():
    """An arm with a friction of 5 tanh(dq / 0.05) + 2 dq, nothing else unknown; see test_train.recording."""
    made = [with_dynamics(recording(k, seconds=10.0)) for k in range(4)]
    setup = build_setup(planar_arm(), made[0], ObserverConfig())
    settings = PriorConfig((), coulomb_speeds_rad_s=(0.05,), most_ripples=0, correct_model=False)
    fit = fit_prior(with_presliding(setup, ()), made, settings)
    bundle = make_bundle("drifting", replace(setup, prior=fit.settings), 0.02, made[0])
    return bundle, fit


def with_dynamics(made: Recording, friction: float = 1.0) -> Recording:
    """Its friction times this, and what moves the arm beside it: the true model's residual is minus the friction."""
    tree = planar_arm()
    p, beta = tree.momentum(made.q, made.dq)
    held = np.vstack([np.diff(p, axis=0) / 1e-3 + 0.5 * (beta[1:] + beta[:-1]), beta[-1:]])
    return replace(made, tau=held + friction * made.tau)


def tracking(bundle: _core.Bundle, fit, config: DriftConfig = CONFIG) -> _core.Bundle:
    copy = _core.Bundle.from_bytes(bundle.to_bytes())
    set_drift(copy, fit, config)
    return copy


def test_the_bounds_are_a_share_of_the_friction_that_the_prior_found(fitted):
    bundle, fit = fitted
    # Held torques act half a sample late on friction that the prior takes as the trapezoid: below 1 % here.
    np.testing.assert_allclose(friction_nm(fit, 0.5), 5.0 + 2.0 * 0.5, rtol=0.02)
    drifting = tracking(bundle, fit)
    np.testing.assert_allclose(drifting.drift.size_nm, 0.3 * friction_nm(fit, 0.5))
    assert drifting.drift.freeze_share == 0
    freeze_drift(drifting, CONFIG)
    assert _core.Bundle.from_bytes(drifting.to_bytes()).drift.freeze_share == 0.5
    assert tracking(bundle, fit, replace(CONFIG, size_share=0.0)).drift.size_nm == [0.1, 0.1]


def test_lower_friction_is_followed(fitted):
    bundle, fit = fitted
    made = with_dynamics(recording(9, seconds=60.0), friction=0.9)
    signals = made.signals
    last = slice(-20_000, None)
    drifting = tracking(bundle, fit)
    before = _core.estimate(bundle, *signals, 1)["tau_ext"][last]
    said = _core.estimate(drifting, *signals, 1)
    after = said["tau_ext"][last]
    assert (np.sqrt((after**2).mean(axis=0)) < 0.5 * np.sqrt((before**2).mean(axis=0))).all()
    of_monitor = _core.Monitor(drifting).run(*signals)["uncertainty"]
    np.testing.assert_array_equal(of_monitor[600:], (said["prior"] + said["network"] + said["drift"])[600:])


def with_sigma(bundle: _core.Bundle, sigma_nm: float) -> _core.Bundle:
    """A bundle whose standard error is a constant."""
    copy = _core.Bundle.from_bytes(bundle.to_bytes())
    scale = unit_scale(copy.joints)
    scale.sigma_weights = scale.sigma_near_weights = (sigma_nm * np.array(scale.sigma_weights)).tolist()
    scale.largest_sigma = [sigma_nm] * copy.joints
    copy.error_scale = scale
    return copy


@pytest.fixture
def alarming(fitted):
    """A bundle with a tracker, a standard error and limits."""
    bundle, fit = fitted
    drifting = with_sigma(tracking(bundle, fit), 0.1)
    freeze_drift(drifting, CONFIG)
    drifting.contact_sliding_limit_nm = drifting.contact_near_stiction_limit_nm = [0.5, 0.5]
    drifting.sliding_limit_nm = drifting.near_stiction_limit_nm = [1.0, 1.0]
    return drifting


def test_friction_that_is_off_at_once_is_followed_although_it_looks_like_a_touch(alarming):
    assert alarming.drift.friction_share == 1.5
    slow = _core.Bundle.from_bytes(alarming.to_bytes())
    slow.drift.friction_share = 0.0
    for friction in (0.55, 0.75, 1.9):
        signals = with_dynamics(recording(9, seconds=60.0), friction).signals
        said = _core.estimate(alarming, *signals, 1)
        last = slice(-20_000, None)
        rmse = [np.sqrt((one["tau_ext"][last] ** 2).mean(axis=0)) for one in (said, _core.estimate(slow, *signals, 1))]
        assert (rmse[0] < 0.15).all() and (rmse[1] > 1.0).all()


def test_a_push_held_for_a_minute_is_not_absorbed(alarming):
    made = with_dynamics(recording(9, seconds=90.0))
    push = np.where(made.time_s[:, None] >= 30.0, [3.0, 0.0], 0.0)
    free = _core.estimate(alarming, *made.signals, 1)
    pushed = _core.estimate(alarming, *replace(made, tau=made.tau - push).signals, 1)
    last = slice(-10_000, None)
    assert np.abs(pushed["drift"] - free["drift"])[last].max() < 0.02 * 3.0
    assert np.abs(pushed["tau_ext"][last, 0]).min() > 2.5


def test_limits_contain_a_share_of_friction_until_the_joint_has_shown_it(alarming):
    said = _core.estimate(alarming, *with_dynamics(recording(9, seconds=30.0)).signals, 1)
    sliding = (said["near_stiction"] == 0) & (said["health"] == 1)[:, None]
    limits = np.where(sliding, said["limit_nm"], np.nan)
    assert (np.nanmax(limits[:3000], axis=0) > 2.0).all()  # by a quarter of the friction, 5 to 8 N m
    assert (np.nanmax(limits[-10_000:], axis=0) < 1.05).all()


def test_the_standard_error_contains_what_is_unknown_of_the_friction(alarming):
    """15 % of the friction before the first stroke has ended; then the joint has shown its trained friction."""
    made = with_dynamics(recording(9, seconds=30.0))
    known = _core.Bundle.from_bytes(alarming.to_bytes())
    known.drift.friction_share = 0.0
    unknown, alone = (_core.estimate(bundle, *made.signals, 1) for bundle in (alarming, known))
    sliding = (unknown["near_stiction"] == 0) & (unknown["health"] == 1)[:, None]
    np.testing.assert_array_equal(alone["sigma_nm"][sliding], 0.1)
    added = np.sqrt(np.where(sliding, unknown["sigma_nm"] ** 2 - 0.1**2, np.nan))
    friction = np.array([alarming.prior.friction_at_rest_nm(j) for j in range(2)])
    # The viscous part is as large as Coulomb's at the fastest.
    assert (np.nanmax(added[:1000], axis=0) > 0.15 * friction).all()
    assert (np.nanmax(added, axis=0) < 0.15 * 2.5 * friction).all()
    assert (np.nanmedian(added[-10_000:], axis=0) < 0.05 * friction).all()


def test_estimates_hold_drift_where_there_is_a_tracker(fitted, tmp_path):
    bundle, fit = fitted
    made = with_dynamics(recording(9), friction=0.8)
    for one, has in ((bundle, False), (tracking(bundle, fit), True)):
        save_estimates(estimate_recording(one, made, 1), tmp_path / "made.estimates.parquet")
        loaded = load_estimates(tmp_path / "made.estimates.parquet")
        assert (loaded.drift is not None) == has
    left = loaded.residual - loaded.prior - loaded.network - loaded.drift
    np.testing.assert_allclose(loaded.tau_ext[600:], left[600:], atol=1e-5)  # float32


def test_a_flight_tells_drift_from_the_network(fitted):
    bundle, fit = fitted
    drifting = tracking(bundle, fit)
    made = with_dynamics(recording(9, seconds=20.0), friction=0.8)
    flight = cut_flight(drifting, made, 15_000)
    source = FlightSource.of(drifting, made)
    estimates = as_estimates(flight, rows_kept(flight), source)
    assert np.abs(estimates.drift).max() > 0.1
    np.testing.assert_allclose(estimates.network, 0, atol=1e-9)  # the bundle has none


def test_a_drift_at_its_bound_is_reported_once(fitted, tmp_path, capsys):
    from tauext.cli import main

    bundle, fit = fitted
    drifting = tracking(bundle, fit, replace(CONFIG, size_share=0.01, time_constant_s=1.0))
    drifting.sliding_limit_nm = drifting.near_stiction_limit_nm = [50.0, 50.0]
    drifting.contact_sliding_limit_nm = drifting.contact_near_stiction_limit_nm = [50.0, 50.0]
    drifting.save(str(tmp_path / "drifting.tauext"))
    made = with_dynamics(recording(9, seconds=20.0), friction=0.5)
    save_recording(made, tmp_path / "made.parquet")
    main(["run", str(tmp_path / "drifting.tauext"), str(tmp_path / "made.parquet")])
    told = capsys.readouterr().out
    assert told.count("recalibrate: joint shoulder's adaptive bias is at its bound") == 1 == told.count("joint elbow's")
    main(["run", str(tmp_path / "drifting.tauext"), str(tmp_path / "made.parquet"), "--json"])
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    drifts = [event for event in events if event["event"] == "drift"]
    said = _core.Monitor(drifting).run(*made.signals)["drift_saturated"]
    first = {joint: int(np.argmax(said[:, j])) for j, joint in enumerate(made.joints)}
    assert {event["joint"]: event["row"] for event in drifts} == first
    content = describe_bundle(tmp_path / "drifting.tauext")
    assert content["drift_at_most_nm"]["shoulder"] == drifting.drift.size_nm[0]


def test_drift_is_found_at_the_same_row_whatever_the_chunks():
    saturated = np.zeros((10, 2), dtype=np.uint8)
    saturated[4:6, 1] = saturated[8:, :] = 1
    quiet = {key: np.zeros(10, dtype=np.uint8) for key in ("health", "causes", "alarm")}
    for size in (1, 3, 10):
        finder, found = ChangeFinder(), []
        for k in range(0, 10, size):
            rows = slice(k, k + size)
            said = {key: values[rows] for key, values in quiet.items()} | {"drift_saturated": saturated[rows]}
            found += finder.find(k, np.arange(10)[rows], said)
        assert found == [DriftChange(4, 4, 1), DriftChange(8, 8, 0)]


def test_only_recipes_with_a_prior_depend_on_drift():
    for recipe in ("tauext", "prior", "paper", "dense", "observer"):
        settings = training_settings(PAPER_CASES["exact"], TrainConfig(recipe=recipe))
        assert ("drift" in settings["config"]) == (recipe in ("tauext", "prior"))
