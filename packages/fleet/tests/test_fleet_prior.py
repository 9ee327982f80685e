"""A fleet prior from small arms, and a new arm that is trained with it on less than a minute."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from made_fleets import FRICTION, QUICKER, fleet, run_here, write_fleet
from made_planar import CONFIG, dataset, moving
from tauext_fleet.book import plain, plan_fleet
from tauext_fleet.fleet_file import load_fleet
from tauext_fleet.fleet_prior import load_fleet_prior, write_fleet_prior
from tauext_fleet.like import Like, load_like, scale_settings
from tauext_fleet.prior import make_fleet_prior
from tauext_fleet.prior_arms import distinct, fleet_arms, own_terms_of
from tauext_fleet.prior_content import table
from tauext_fleet.prior_evidence import factor_of
from tauext_fleet.stages import train_arm

from tauext import _core
from tauext.cli import main
from tauext.data.dataset import load_dataset
from tauext.errors import ConfigError
from tauext.progress import SILENT
from tauext.train.preparation import NOTHING
from tauext.train.stage import train_bundle
from tauext.train.supported_limits import SupportedConfig

SECONDS = 20.0


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> tuple[Path, list[Path]]:
    """The file of a fleet prior, and the datasets that it came from."""
    folder = tmp_path_factory.mktemp("fleet")
    data = fleet(folder)
    out = folder / "planar.prior.json"
    with pytest.MonkeyPatch.context() as patch:  # the doctor would take half of the time, and is tested by itself
        patch.setattr("tauext_fleet.prior_arms.check_data", lambda *told: {})
        make_fleet_prior(fleet_arms([str(one) for one in data]), out, CONFIG)
    return out, data


@pytest.fixture(scope="module")
def new(made, tmp_path_factory) -> dict[str, _core.Bundle]:
    """A new arm trained on seconds of motion, with the fleet's prior and without."""
    folder = tmp_path_factory.mktemp("new")
    data = load_dataset(dataset(folder / "data", moving(70, SECONDS, (0.75, 1.15))))
    like = load_like(made[0])
    return {
        name: train_bundle(data, folder / f"{name}.tauext", config=CONFIG, check=False, start=known)
        for name, known in (("like", like), ("alone", NOTHING))
    }


@pytest.mark.slow
@pytest.mark.parametrize("tie", [1e-5, 1e-4, 1e-3])
def test_links_can_be_whichever_ridge_rounding_chooses(made, tmp_path, monkeypatch, tie):
    """A ridge one step stronger ended in a rotor inertia of -1.3 once, and training in an error of the core."""
    monkeypatch.setattr("tauext.fit.regression.RIDGE_TIE", tie)
    monkeypatch.setattr("tauext_fleet.prior_arms.check_data", lambda *told: {})
    prior = tmp_path / "planar.prior.json"
    make_fleet_prior(fleet_arms([str(one) for one in made[1]]), prior, CONFIG)
    data = load_dataset(dataset(tmp_path / "data", moving(70, SECONDS, (0.75, 1.15))))
    bundle = train_bundle(data, tmp_path / "new.tauext", config=CONFIG, check=False, start=load_like(prior))
    assert bundle.prior.corrected_links and all(link.rotor_inertia >= 0 for link in bundle.prior.corrected_links)


def rms(bundle: _core.Bundle) -> np.ndarray:
    """Of tau_ext on other motion of the new arm, whose friction is known."""
    other = moving(71, 60.0, (0.75, 1.15))
    said = _core.estimate(bundle, *other.signals, 1, None)
    return np.sqrt(np.mean(said["tau_ext"][200:] ** 2, axis=0))


@pytest.mark.slow
def test_friction_of_each_arm_is_predicted_by_that_of_the_fleet(made):
    facts = load_fleet_prior(made[0]).facts
    healthy = np.mean([one[0] for one in FRICTION])
    for one, (shoulder, _) in zip(facts["arms"], FRICTION, strict=True):
        factor, error = one["friction"]["shoulder"]
        assert factor == pytest.approx(shoulder / healthy, abs=0.05) and 0 < error < 0.05
    assert facts["spread"]["shoulder"]["spread"] == pytest.approx(0.14, abs=0.08)


@pytest.mark.slow
def test_the_odd_joint_counts_for_less_and_is_marked(made):
    facts = load_fleet_prior(made[0]).facts
    trust = [one["trust"] for one in facts["arms"]]
    assert trust[-1]["elbow"] < 0.1 and trust[-1]["shoulder"] == 1
    assert all(one["elbow"] > 0.5 for one in trust[:-1])
    assert facts["arms"][-1]["friction"]["elbow"][0] == pytest.approx(3.0, rel=0.1)  # the others are 1 on average
    lines = table(facts).splitlines()
    assert [line.partition(" ")[0] for line in lines if "*" in line] == ["arm-5"] and "3.00 ± 0.00 *" in lines[6]


def test_the_file_is_read_as_it_was_written(made, tmp_path):
    write_fleet_prior(load_fleet_prior(made[0]), tmp_path / "again.prior.json")
    assert (tmp_path / "again.prior.json").read_bytes() == made[0].read_bytes()


def test_limits_of_a_new_arm_are_the_fleets_and_the_bundle_says_so(made, new):
    like, facts = load_fleet_prior(made[0]), json.loads(new["like"].provenance)
    limits = facts["limits"]
    assert facts["like"]["sha256"] == like.sha256 and len(like.sha256) == 64
    assert facts["like"]["arms"] == [f"arm-{k}" for k in range(len(FRICTION))]
    assert like.errors is not None and like.errors.arms == 5  # without the odd one
    assert new["like"].sliding_limit_nm == pytest.approx(like.errors.sliding_limit_nm)
    assert "5 arms of this type" in limits["sentence"] and limits["like"] is True
    assert "friction_reserve" not in limits
    assert "friction_reserve" in json.loads(new["alone"].provenance)["limits"]


def test_a_new_arm_of_seconds_is_better_with_the_fleet_and_no_motion_is_over_its_limits(new):
    assert (rms(new["like"]) < rms(new["alone"])).all() and rms(new["like"]).max() < 0.2
    other = moving(72, 120.0, (0.75, 1.15))
    said = _core.estimate(new["like"], *other.signals, 1, None)
    level = np.where(said["near_stiction"], new["like"].near_stiction_limit_nm, new["like"].sliding_limit_nm)
    over = np.abs(said["tau_ext"]) > level * said["limit_scale"] + said["doubt"]
    assert over[200:].mean() < 1e-3


def test_motion_that_other_arms_showed_is_familiar(made, new):
    """What a fleet knows of a pose holds for one more arm."""
    pose = moving(0, 150.0, FRICTION[0]).q[5000:5100].copy()  # of the first arm's training
    still = np.zeros_like(pose)
    strange = {name: bundle.coverage.look(pose, still)["share"].max() for name, bundle in new.items()}
    assert strange["like"] < _core.CoverageSettings.WORTH_TELLING


@pytest.mark.parametrize(
    "changes, says",
    [
        ({"rate_hz": 100.0}, "rate hz"),
        ({"joints": ("a", "b")}, "joints"),
        ({"case": "mass"}, "case"),
        ({"units": ("newton_metre", "ampere")}, "units"),
        ({"links": "0" * 64}, "links"),
    ],
)
def test_a_prior_of_another_type_is_refused_in_one_line(made, tmp_path, changes, says):
    like = load_fleet_prior(made[0])
    other = replace(like, type=replace(like.type, **changes))
    data = load_dataset(dataset(tmp_path / "data", moving(70, SECONDS, (1.0, 1.0))))
    with pytest.raises(ConfigError, match=f": {says} = .* must be .* as of the fleet prior"):
        train_bundle(data, tmp_path / "no.tauext", config=CONFIG, check=False, start=Like(other))
    assert not (tmp_path / "no.tauext").exists()


def test_a_fleet_trains_new_arms_with_it(made, tmp_path, monkeypatch):
    data = dataset(tmp_path / "data", moving(70, SECONDS, (0.75, 1.15)))
    shutil.copy(made[0], tmp_path / "a.prior.json")
    text = '[train]\nrecipe = "prior"\nlike = "a.prior.json"\n[[arms]]\nname = "new"\ndataset = "data"\n'
    fleet = write_fleet(tmp_path, text)
    (arm,) = load_fleet(fleet).arms
    assert arm.like == tmp_path / "a.prior.json"
    run_here(fleet, tmp_path / "out", monkeypatch, QUICKER)
    assert json.loads((tmp_path / "out/arms/new/train/told.json").read_text())["like"] == str(arm.like)
    arm.like.write_text(arm.like.read_text() + " ")
    steps = {step.task.stage: step.why for one in plan_fleet(load_fleet(fleet), tmp_path / "out") for step in one.steps}
    assert steps == {"check": "", "train": "inputs changed: train.like", "evaluate": "train is done again"}
    work = {"name": "new", "dataset": str(data), "case": None, "robot": None, "accept": [], "settings": plain(CONFIG)}
    monkeypatch.setattr("tauext.train.stage.check_data", lambda *told: {})
    train_arm(work | {"like": str(made[0])}, tmp_path)
    like = load_fleet_prior(made[0])
    assert json.loads((tmp_path / "new.run.json").read_text())["like"]["sha256"] == like.sha256


@pytest.mark.parametrize(
    ("train", "message"),
    [
        ('like = "none.prior.json"', "none.prior.json: not a readable fleet prior"),
        ('like = "fleet.toml"', "fleet.toml: not a readable fleet prior"),
        ("like = 3", "like = 3 must be text"),
        ('like = "a.prior.json"\nrecipe = "friction"', "recipe = friction must be tauext or prior"),
    ],
)
def test_a_fleet_with_a_wrong_prior_is_refused_before_anything_runs(made, tmp_path, train, message):
    dataset(tmp_path / "data", moving(70, SECONDS, (0.75, 1.15)))
    shutil.copy(made[0], tmp_path / "a.prior.json")
    fleet = write_fleet(tmp_path, f'[train]\n{train}\n[[arms]]\nname = "new"\ndataset = "data"\n')
    with pytest.raises(ConfigError) as refused:
        load_fleet(fleet)
    assert message in str(refused.value) and "arm 'new'" in str(refused.value) and "\n" not in str(refused.value)


def test_too_few_arms_or_one_twice_are_refused(made, tmp_path, capsys):
    data = [str(one) for one in made[1]]
    for arms, out, says in (
        (data[:2], "a.prior.json", "2 arms: a fleet prior needs at least 3"),
        ([*data[:2], data[0]], "a.prior.json", "the same arm twice"),
        (data[:3], "a.json", "a fleet prior's name ends in .prior.json"),
    ):
        assert main(["fleet", "prior", *arms, "--out", str(tmp_path / out)]) == 2
        assert says in capsys.readouterr().err


def test_an_arm_that_cannot_be_used_is_left_out_with_its_reason(made, tmp_path):
    data = [str(one) for one in made[1][:3]]
    broken = tmp_path / "broken"
    said: list[str] = []
    told = SimpleNamespace(say=said.append, progress=SILENT.progress)
    with pytest.raises(ConfigError, match="2 of 3 arms can be used, and 3 are needed"):
        make_fleet_prior(fleet_arms([*data[:2], str(broken)]), tmp_path / "a.prior.json", CONFIG, report=told)
    assert any("broken is left out" in line for line in said)


def test_arms_of_two_types_are_refused(made, tmp_path):
    other = dataset(tmp_path / "other", moving(5, 40.0, (1.0, 1.0), joints=("shoulder", "elbow"), torque_timing="held"))
    arms = fleet_arms([str(made[1][0]), str(other), str(made[1][1])])
    with pytest.raises(ConfigError, match="torque timing = held must be averaged as of arm-0"):
        make_fleet_prior(arms, tmp_path / "a.prior.json", CONFIG)


def with_negative_variance(block: dict) -> dict:
    covariance = np.array(block["covariance"])
    covariance[0, :] = covariance[:, 0] = 0
    covariance[0, 0] = -1.0
    return block | {"covariance": covariance.tolist()}


@pytest.mark.parametrize(
    "damage",
    [
        lambda raw: raw | {"format": 2},
        lambda raw: {key: value for key, value in raw.items() if key != "weights"},
        lambda raw: raw | {"error_nm": [1.0]},
        lambda raw: raw | {"trust": 0},
        lambda raw: raw | {"memory_s": [1e-300] * len(raw["memory_s"])},
        lambda raw: raw | {"weights": raw["weights"] | {"elbow": with_negative_variance(raw["weights"]["elbow"])}},
        lambda raw: raw | {"weights": raw["weights"] | {"links": {"mean": [0.0], "covariance": [[1.0]]}}},
        lambda raw: raw | {"terms": raw["terms"] | {"elbow": [["no_such_kind", 0, 0, 0, 0, 0.0]]}},
        lambda raw: [],
        lambda raw: raw | {"arms": [{"name": "arm-0"}]},
        lambda raw: raw | {"spread": 3},
        lambda raw: raw | {"settings": None},
        lambda raw: {key: value for key, value in raw.items() if key != "left_out"},
        lambda raw: {"format": 1},
    ],
)
def test_show_of_a_damaged_file_is_one_line(made, tmp_path, capsys, damage):
    path = tmp_path / "damaged.prior.json"
    path.write_text(json.dumps(damage(json.loads(made[0].read_text()))))
    assert main(["show", str(path)]) == 2
    said = capsys.readouterr().err.strip()
    assert "\n" not in said and "damaged.prior.json" in said and "fleet prior" in said


def test_show_prints_what_the_next_arm_begins_with(made, capsys):
    assert main(["show", str(made[0]), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    raw = json.loads(made[0].read_text())
    assert told["table"] == table(raw).splitlines() and told["arms"] == 6
    assert told["not_like_the_others"] == {"arm-5": ["elbow", "links"]}
    assert told["limits_sliding_nm"] == dict(zip(raw["type"]["joints"], raw["errors"]["sliding_limit_nm"], strict=True))
    assert told["limits_promise"] == raw["errors"]["facts"]["sentence"]
    assert main(["show", str(made[0])]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[: len(told["table"])] == told["table"]
    assert any(line.split() == ["sha256", load_fleet_prior(made[0]).sha256] for line in lines)


def test_arms_are_named_by_what_tells_their_folders_apart():
    assert distinct([Path("/a/one/data"), Path("/a/two/data")]) == ["one", "two"]
    assert distinct([Path("/a/one"), Path("/b/two")]) == ["one", "two"]
    assert distinct([Path("/a/x/data"), Path("/b/x/data")]) == ["a", "b"]


def test_from_minutes_enough_on_an_arms_limits_follow_from_its_own_errors(made, tmp_path, monkeypatch):
    monkeypatch.setattr("tauext_fleet.like.ENOUGH_S", SECONDS / 2)
    data = load_dataset(dataset(tmp_path / "data", moving(70, SECONDS, (0.75, 1.15))))
    like = load_fleet_prior(made[0])
    bundle = train_bundle(data, tmp_path / "own.tauext", config=CONFIG, check=False, start=Like(like))
    limits = json.loads(bundle.provenance)["limits"]
    assert "like" not in limits and limits["minutes_factor"] == SupportedConfig.unpromised_factor


def test_limits_are_raised_until_no_arm_is_over_those_of_the_others():
    top = np.array([[[1.0, 2.0], [1.0, 1.0]], [[1.5, 2.0], [0.5, 1.0]], [[1.2, 2.2], [0.9, 1.0]]])
    assert factor_of(top) == pytest.approx(1.5 / 1.2)  # the second arm's first joint, sliding
    assert factor_of(np.ones((4, 2, 2))) == 1.0


def test_an_arm_that_errs_twice_as_much_gets_limits_twice_as_high(made):
    errors = load_fleet_prior(made[0]).errors
    assert errors is not None
    one, two = (scale_settings(errors, np.array(size)) for size in ([1.0, 1.0], [2.0, 1.0]))
    for name in ("limit_weights", "sigma_weights", "sigma_near_weights", "largest", "largest_sigma"):
        ratio = np.array(getattr(two, name)).reshape(2, -1), np.array(getattr(one, name)).reshape(2, -1)
        assert ratio[0] == pytest.approx(ratio[1] * [[2.0], [1.0]])


def test_a_bundle_beside_the_data_saves_the_search_for_terms(made, new, tmp_path):
    new["alone"].save(str(tmp_path / "alone.tauext"))
    (arm, *_) = fleet_arms([f"{tmp_path}/alone.tauext:{made[1][0]}", *map(str, made[1][1:3])])
    assert arm.bundle == tmp_path / "alone.tauext" and arm.name == "arm-0"
    own = own_terms_of(arm, CONFIG, (), SILENT)
    assert own.widths_rad == tuple(new["alone"].prior.widths_rad)
    assert own.gain_per_s == new["alone"].observer.gain_per_s and own.type.joints == ("shoulder", "elbow")
