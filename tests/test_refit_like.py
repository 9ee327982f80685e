"""A joint that stood through the minute teaches a refit nothing; with a fleet it follows the joints that moved."""

import json
from dataclasses import replace

import numpy as np
import pytest
from arms import planar_arm
from made_fleet import CONFIG, FRICTION, dataset, moving
from test_prior import motion, record
from test_refit import COULOMB_NM, NOISE_NM, RATE_HZ, fitted, friction, refitted  # noqa: F401

from tauext import _core
from tauext.bundle.bundle_file import load_bundle
from tauext.cli import main
from tauext.data.dataset import load_dataset
from tauext.data.recording import Recording
from tauext.errors import ConfigError, TrainingError
from tauext.fit.fleet_prior import load_fleet_prior
from tauext.fleet.prior import make_fleet_prior
from tauext.fleet.prior_arms import fleet_arms
from tauext.fleet.prior_evidence import FRICTION as FRICTION_KINDS
from tauext.fleet.prior_evidence import fleet_days
from tauext.train.refit import agreeing, expectations, predicted, refit_recordings, settings_with
from tauext.train.stage import train_bundle

ALIKE = 0.05**2 * (0.7 + 0.3 * np.eye(4))
"""Four joints whose friction goes up and down by 5 %, much of it together."""


def stands(seed: int = 50, seconds: float = 60.0, moves_s: float = 0.0, coulomb: float = 1.3) -> Recording:
    """The elbow stands but for the first seconds: its encoder trembles, and its gear holds most of what it can."""
    q, dq = motion(seed, seconds, RATE_HZ)
    first = round(moves_s * RATE_HZ)
    rng = np.random.default_rng(seed)
    q[first:, 1] = (q[first - 1, 1] if first else 0.4) + rng.normal(0, 1e-4, len(q) - first)
    dq[first:, 1] = rng.normal(0, 5e-3, len(q) - first)
    made = record(planar_arm(), (q, dq), friction(coulomb=coulomb), NOISE_NM, seed, RATE_HZ)
    tau = made.tau.copy()
    held = np.linspace(0.9, -0.2, len(q) - first) * COULOMB_NM[1]
    tau[first:, 1] += held - coulomb * COULOMB_NM[1] * np.tanh(dq[first:, 1] / 0.03)
    return replace(made, tau=tau)


def own_weights(bundle: _core.Bundle, joint: int) -> np.ndarray:
    own = [m for m, term in enumerate(bundle.prior.terms) if term.a == joint]
    return np.array(bundle.prior.weights).reshape(2, -1)[joint, own]


def test_what_a_standing_joints_gear_holds_is_not_learned_as_friction(fitted):  # noqa: F811
    found = refitted(fitted[0], stands())
    assert np.array_equal(own_weights(found.bundle, 1), own_weights(fitted[0], 1))
    assert found.joints[1].coulomb == (1.0, pytest.approx(np.hypot(0.3, 0.15), rel=0.02))
    assert abs(found.joints[0].coulomb[0] - 1.3) < 0.02
    assert found.joints[1].viscous == (1.0, pytest.approx(np.hypot(0.3, 0.15), rel=0.02))
    assert found.joints[1].limit_factor >= 1.3  # nobody knows how much it is today


def test_seconds_of_motion_before_it_stood_are_learned(fitted):  # noqa: F811
    found = refitted(fitted[0], stands(moves_s=15.0))
    assert abs(found.joints[1].coulomb[0] - 1.3) < 0.06 < 0.3


def test_a_joint_is_refitted_about_what_is_expected_of_it(fitted):  # noqa: F811
    bundle = fitted[0]
    settings = settings_with([1.0, 1.2], [0.1, 0.04], [False, True])
    assert settings.expected == [1.0, 1.2] and settings.expected_error == [0.3, 0.04]
    made = stands()
    found = _core.refit(bundle, [(made.t_ns, made.q, made.dq, made.tau, None)], settings)
    plain = _core.refit(bundle, [(made.t_ns, made.q, made.dq, made.tau, None)])
    kinds = [term.kind for term in bundle.prior.terms if term.a == 1]
    ratio = own_weights(found.bundle, 1) / own_weights(bundle, 1)
    moves = np.array([kind in FRICTION_KINDS for kind in kinds])
    assert ratio[moves] == pytest.approx(1.2) and ratio[~moves] == pytest.approx(1.0) and moves.sum() == 7
    assert found.joints[1].coulomb == (pytest.approx(1.2), pytest.approx(np.hypot(0.04, 0.02), rel=0.02))
    assert found.joints[0].coulomb == plain.joints[0].coulomb


@pytest.mark.parametrize(
    "wrong", [([1.0], [0.1]), ([1.0, 1.0], [0.1]), ([1.0, 9.0], [0.1, 0.1]), ([1.0, 1.0], [0.1, 0])]
)
def test_expectations_that_are_none_are_refused(fitted, wrong):  # noqa: F811
    settings, made = _core.RefitSettings(), stands()
    settings.expected, settings.expected_error = wrong
    with pytest.raises(_core.CoreError, match="a refit's expect"):
        _core.refit(fitted[0], [(made.t_ns, made.q, made.dq, made.tau, None)], settings)


def test_a_still_joint_is_expected_at_the_conditional_mean():
    factor, error = np.array([1.10, 1.10, 1.10, 0.3]), np.array([0.01, 0.01, 0.01, 0.5])
    told = expectations(factor, error, np.array([40.0, 40.0, 40.0, 0.0]), ALIKE)
    assert told is not None and told[2].tolist() == [False, False, False, True]
    # A draw of all joints beside what three of them show, by chance alone: where they show 10 %, the fourth is ...
    rng = np.random.default_rng(0)
    draws = rng.multivariate_normal(np.zeros(4), ALIKE, 200_000)
    shown = draws[:, :3] + 0.01 / 1.1 * rng.normal(size=(200_000, 3))
    fit = np.linalg.lstsq(shown, draws[:, 3], rcond=None)[0]
    assert np.log(told[0][3]) == pytest.approx(fit.sum() * np.log(1.1), rel=0.02)
    assert told[1][3] / told[0][3] == pytest.approx(np.std(draws[:, 3] - shown @ fit), rel=0.02)


def test_a_worn_joint_tells_the_others_nothing():
    log_factor = np.log([1.05, 1.06, 1.40, 1.05])
    assert agreeing(np.arange(4), log_factor, np.full(4, 0.01), ALIKE).tolist() == [0, 1, 3]
    told = expectations(np.exp(log_factor), np.full(4, 0.01), np.array([40.0, 40.0, 40.0, 2.0]), ALIKE)
    assert told is None  # what its own two seconds say is more than the others know
    told = expectations(np.exp(log_factor), np.array([0.01, 0.01, 0.01, 0.3]), np.array([40.0, 40, 40, 2]), ALIKE)
    assert told is not None and 1.02 < told[0][3] < 1.06


def test_one_joint_or_two_that_disagree_tell_nothing():
    error = np.array([0.01, 0.01, 0.3, 0.3])
    assert expectations(np.array([1.1, 1.0, 1.0, 1.0]), error, np.array([40.0, 0, 0, 0]), ALIKE) is None
    assert expectations(np.array([1.3, 0.9, 1.0, 1.0]), error, np.array([40.0, 40, 0, 0]), ALIKE) is None
    assert expectations(np.array([1.1, 1.1, 1.0, 1.0]), error, np.array([40.0, 40, 0, 0]), ALIKE) is not None
    assert predicted(0, np.array([], dtype=int), np.zeros(4), error, ALIKE) == (0.0, pytest.approx(0.05))


def test_days_are_pooled_within_arms_and_drawn_to_their_diagonal():
    rng = np.random.default_rng(1)
    truth = np.array([[0.04, 0.03], [0.03, 0.09]]) ** 1 * 0.01
    arms = [np.exp(rng.normal(0, 0.3, 2) + rng.multivariate_normal([0, 0], truth, 3)) for _ in range(400)]
    days = fleet_days(arms)
    assert days is not None and (days.arms, days.recordings) == (400, 1200)
    assert days.covariance == pytest.approx(truth, rel=0.15)
    few = fleet_days(arms[:4])
    assert few is not None
    alone = fleet_days([arms[0], *(one[:1] for one in arms)])
    assert alone is None
    of_four = [np.log(one) - np.log(one).mean(axis=0) for one in arms[:4]]
    plain = sum(one.T @ one for one in of_four) / 8
    assert np.diag(few.covariance) == pytest.approx(np.diag(plain)) and few.covariance[0, 1] == pytest.approx(
        plain[0, 1] / 2
    )


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A fleet whose arms were recorded on a cold and a warm day, and a bundle of one more arm."""
    folder = tmp_path_factory.mktemp("days")
    arms = []
    for k, (a, b) in enumerate(FRICTION[:4]):
        warm = [moving(10 * k + d, 45.0, (a * f, b * f), f"day-{d}") for d, f in enumerate((1.08, 0.95))]
        arms.append(dataset(folder / f"arm-{k}" / "data", *warm))
    prior = folder / "planar.prior.json"
    with pytest.MonkeyPatch.context() as patch:  # the doctor would take half of the time, and is tested by itself
        patch.setattr("tauext.fleet.prior_arms.look_first", lambda *told: {})
        make_fleet_prior(fleet_arms([str(one) for one in arms]), prior, CONFIG)
    new = load_dataset(dataset(folder / "new", moving(90, 120.0, (1.0, 1.0))))
    bundle = folder / "new.tauext"
    train_bundle(new, bundle, config=CONFIG, look=False)
    return prior, bundle


def test_a_fleets_file_knows_how_days_differ(made):
    days = load_fleet_prior(made[0]).days
    assert days is not None and (days.arms, days.recordings) == (4, 8)
    spread = np.log(1.08 / 0.95) / np.sqrt(2)
    assert np.sqrt(np.diag(days.covariance)) == pytest.approx([spread, spread], rel=0.15)
    assert days.covariance[0, 1] == pytest.approx(spread**2 / 2, rel=0.3)  # half: as many more arms that vary apart


def test_show_says_how_days_differ(made, capsys):
    assert main(["show", str(made[0]), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    days = load_fleet_prior(made[0]).days
    assert told["friction_change_share"]["elbow"] == pytest.approx(np.sqrt(days.covariance[1, 1]))
    assert told["friction_change_from"] == {"recordings": 8, "arms": 4}


def test_a_prior_that_knows_no_days_is_refused(made):
    prior = replace(load_fleet_prior(made[0]), days=None)
    with pytest.raises(ConfigError, match="knows how arms differ and not how days do"):
        refit_recordings(load_bundle(made[1]), [moving(91, 30.0, (1.0, 1.0))], like=prior)
    other = replace(prior, type=replace(prior.type, joints=("a", "b")))
    with pytest.raises(ConfigError, match="joints = .a, b. of the fleet prior must be .shoulder, elbow."):
        refit_recordings(load_bundle(made[1]), [moving(91, 30.0, (1.0, 1.0))], like=other)


def test_refit_with_a_fleet_names_it(made, tmp_path, capsys):
    data = dataset(tmp_path / "today", moving(92, 30.0, (1.1, 1.1)))
    out = tmp_path / "today.tauext"
    words = ["refit", str(made[1]), "--data", str(data), "--out", str(out), "--like", str(made[0]), "--json"]
    assert main(words) == 0
    said = json.loads(capsys.readouterr().out)
    assert [joint["follows"] for joint in said["joints"]] == [False, False]  # both moved
    facts = json.loads(load_bundle(out).provenance)["refitted"]
    assert facts["like"]["sha256"] == load_fleet_prior(made[0]).sha256
    assert main([*words[:-2], str(data / "robot.xml")]) == 2
    assert "not a readable fleet prior" in capsys.readouterr().err


def test_the_core_refuses_too_little_motion_with_a_fleet_too(made):
    with pytest.raises(TrainingError, match="10 s of motion"):
        refit_recordings(load_bundle(made[1]), [moving(91, 5.0, (1.0, 1.0))], like=load_fleet_prior(made[0]))
