"""A refit with a fleet prior: how friction differs from day to day, and what it is called."""

import json
from dataclasses import replace

import numpy as np
import pytest
from made_fleets import FRICTION
from made_planar import CONFIG, dataset, moving
from tauext_fleet.fleet_prior import load_fleet_prior
from tauext_fleet.like import Like, load_like
from tauext_fleet.prior import make_fleet_prior
from tauext_fleet.prior_arms import fleet_arms
from tauext_fleet.prior_evidence import fleet_days

from tauext.bundle.bundle_file import load_bundle
from tauext.cli import main
from tauext.data.dataset import load_dataset
from tauext.errors import ConfigError, TrainingError
from tauext.train.refit import refit_recordings
from tauext.train.stage import train_bundle


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
        patch.setattr("tauext_fleet.prior_arms.check_data", lambda *told: {})
        make_fleet_prior(fleet_arms([str(one) for one in arms]), prior, CONFIG)
    new = load_dataset(dataset(folder / "new", moving(90, 120.0, (1.0, 1.0))))
    bundle = folder / "new.tauext"
    train_bundle(new, bundle, config=CONFIG, check=False)
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
    with pytest.raises(ConfigError, match="has differences between arms, not between days"):
        refit_recordings(load_bundle(made[1]), [moving(91, 30.0, (1.0, 1.0))], like=Like(prior))
    other = replace(prior, type=replace(prior.type, joints=("a", "b")))
    with pytest.raises(ConfigError, match="joints = .a, b. of the fleet prior must be .shoulder, elbow."):
        refit_recordings(load_bundle(made[1]), [moving(91, 30.0, (1.0, 1.0))], like=Like(other))


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
        refit_recordings(load_bundle(made[1]), [moving(91, 5.0, (1.0, 1.0))], like=load_like(made[0]))
