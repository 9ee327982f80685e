"""What tauext is compared with: each method a bundle, its limits set as tauext's, from few minutes too."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tauext_lab.baselines import finished, train_baselines
from tauext_lab.sim.collect import simulate_dataset, simulate_recording
from tauext_lab.sim.config import RigConfig

from tauext import _core
from tauext.cli import main
from tauext.config import PAPER_CASES, AlarmConfig, FilterConfig, TrainConfig
from tauext.data.dataset import load_dataset, save_split
from tauext.errors import BundleError, ConfigError
from tauext.fit.tail import FalseAlarmBudget, Promise
from tauext.progress import Silent
from tauext.recipes import RECIPES, baselines
from tauext.robot.model_case import estimated_model
from tauext.train.preparation import TrainingInput, training_settings
from tauext.train.stage import train_on_recordings

EXACT = PAPER_CASES["exact"]
BUDGET = AlarmConfig(false_alarms=1, in_hours=0.005)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """20 recordings of 6 s and six of 10 s to calibrate on."""
    folder = tmp_path_factory.mktemp("baselines") / "data"
    rig = RigConfig()  # without what recipe friction has no term for
    friction = tuple(replace(joint, load_share=0.0) for joint in rig.friction)
    links = tuple(replace(link, true_com_m=link.com_m) for link in rig.links)
    config = replace(rig, recording_s=10.0, friction=friction, links=links)
    simulate_dataset(folder, config, 1, 2.0, 0, calibration_hours=60 / 3600)
    return load_dataset(folder)


def trained(dataset, out: Path, case="exact", **settings) -> _core.Bundle:
    """The bundle of a recipe, loaded; no calibration."""
    robot = dataset.robot_file(None)
    training, validation = dataset.recordings("train"), dataset.recordings("validation")
    tree = estimated_model(robot, training[0].joints, PAPER_CASES[case])
    train_on_recordings(
        TrainingInput(robot, PAPER_CASES[case], training, validation, model=tree), TrainConfig(**settings), out
    )
    return _core.Bundle.load(str(out))


class Listener(Silent):
    """Keeps the sentences."""

    def __init__(self) -> None:
        self.sentences: list[str] = []

    def say(self, sentence: str) -> None:
        self.sentences.append(sentence)


def said_of(bundle, recording) -> dict:
    return _core.estimate(bundle, recording.t_ns, recording.q, recording.dq, recording.tau, 1)


def test_a_friction_bundle_is_the_observer_less_friction_with_limits_by_speed_alone(dataset, tmp_path):
    friction = trained(dataset, tmp_path / "friction.tauext", recipe="friction")
    observer = trained(dataset, tmp_path / "observer.tauext", recipe="observer")
    assert len(friction.prior.terms) == 6 and friction.region_width == -1
    assert not friction.prior.widths_rad and not friction.prior.corrected_links and not friction.has_network
    made = dataset.recordings("test")[0]
    ours, plain = said_of(friction, made), said_of(observer, made)
    np.testing.assert_array_equal(ours["residual"], plain["residual"])
    healthy = ours["health"] == 1
    rms = [np.sqrt(np.mean(said["tau_ext"][healthy] ** 2, axis=0)) for said in (ours, plain)]
    # Friction is some 10 Nm; what Coulomb and viscous parts leave of LuGre, ripple and noise is far less.
    assert (rms[0] < 0.3 * rms[1]).all()
    facts = json.loads(friction.provenance)["prior"]["friction"]["joint1"]
    assert facts["coulomb_nm"] == pytest.approx(RigConfig().friction[0].coulomb_nm, rel=0.2)


@pytest.mark.parametrize("recipe", [row.name for row in RECIPES.values() if not row.learns and row.name != "observer"])
def test_other_observers_are_bundles_too(dataset, tmp_path, recipe):
    filters = FilterConfig(high_pass_per_s=4.0, low_pass_per_s=50.0)
    bundle = trained(dataset, tmp_path / f"{recipe}.tauext", recipe=recipe, filters=filters)
    filtered = {"highpass": (4.0, 0.0), "bandpass": (4.0, 50.0)}.get(recipe, (0.0, 0.0))
    method = "momentum" if recipe.endswith("pass") else recipe
    assert bundle.observer.method == getattr(_core.ResidualMethod, method)
    assert (bundle.observer.high_pass_per_s, bundle.observer.low_pass_per_s) == filtered
    said = said_of(bundle, dataset.recordings("validation")[0])
    assert (said["health"] == 1).any() and not said["detection"].any()  # its limits are the largest errors there


def test_the_velocity_observer_needs_a_model(dataset, tmp_path):
    with pytest.raises(ConfigError, match="recipe = velocity needs a model, which the case 'none' lacks"):
        trained(dataset, tmp_path / "a.tauext", "none", recipe="velocity")


def test_settings_that_a_recipe_does_not_use_are_not_compared():
    other = TrainConfig(filters=FilterConfig(1.0, 2.0))
    filtered = ["highpass", "bandpass"]
    for recipe in (name for name in RECIPES if name not in filtered):
        assert training_settings(EXACT, replace(other, recipe=recipe)) == training_settings(
            EXACT, TrainConfig(recipe=recipe)
        )
    for recipe in filtered:
        assert training_settings(EXACT, replace(other, recipe=recipe))["config"]["filters"]["high_pass_per_s"] == 1.0


# --- minutes


@pytest.mark.slow
def test_two_minutes_are_enough_for_the_whole_recipe(tmp_path):
    made = [simulate_recording(RigConfig(), "free", 50.0, seed=3, number=k) for k in range(5)]
    robot, out = tmp_path / "robot.xml", tmp_path / "two.tauext"
    from tauext_lab.sim.rig import arm_xml

    robot.write_text(arm_xml(RigConfig()))
    config = TrainConfig(recipe="tauext", minutes=2.0, max_steps=50, batch=8)
    train_on_recordings(TrainingInput(robot, EXACT, made[:3], made[3:]), config, out)
    bundle = _core.Bundle.load(str(out))
    facts, run = json.loads(bundle.provenance), json.loads(out.with_suffix(".run.json").read_text())
    assert facts["training_minutes"] == run["training_minutes"] == 2.0
    assert run["settings"]["config"]["minutes"] == 2.0
    assert [len(run["recordings"][part]) for part in ("train", "validation")] == [3, 2]  # 50 + 50 + 20 s, 50 + 10 s
    said = said_of(bundle, made[4])
    # Friction of some 10 Nm is gone; noise of the filtered torque alone is 0.1 Nm.
    assert (np.sqrt(np.nanmean(said["tau_ext"] ** 2, axis=0)) < [1.5, 0.75]).all()


def test_the_minutes_are_reported_also_where_all_are_used(dataset, tmp_path):
    bundle = trained(dataset, tmp_path / "all.tauext", recipe="observer")
    assert json.loads(bundle.provenance)["training_minutes"] == pytest.approx(14 * 6 / 60)


def test_more_minutes_than_there_are_are_refused(dataset, tmp_path):
    with pytest.raises(ConfigError, match=r"minutes = 3 must be at most 1.4: the training recordings have no more"):
        trained(dataset, tmp_path / "a.tauext", recipe="observer", minutes=3.0)
    with pytest.raises(ConfigError, match="minutes = -1 must be a number > 0"):
        TrainConfig(minutes=-1)


# --- calibrate


def calibrated(bundle: Path, dataset, out: Path, *options: str) -> int:
    return main(["calibrate", "--bundle", str(bundle), "--data", str(dataset.folder), "--out", str(out), *options])


def test_calibrate_gives_a_bundle_the_limits_that_training_would_and_changes_nothing_else(dataset, tmp_path, capsys):
    options = dict(recipe="observer", alarm=BUDGET)
    plain = trained(dataset, tmp_path / "bundle.tauext", **options, limits="paper")
    before = (tmp_path / "bundle.tauext").read_bytes()
    robot, training = dataset.robot_file(None), dataset.recordings("train")
    promised = tmp_path / "trained" / "bundle.tauext"
    train_on_recordings(
        TrainingInput(robot, EXACT, training, dataset.recordings("validation"), dataset.loaders("calibration")),
        TrainConfig(**options, limits="asked"),
        promised,
    )
    capsys.readouterr()
    out = tmp_path / "new.tauext"
    budget = ("--false-alarms", "1", "--in-hours", "0.005")
    assert calibrated(tmp_path / "bundle.tauext", dataset, out, *budget, "--accept", "limit-wide") == 0
    said = capsys.readouterr().out.splitlines()
    assert said[0].startswith("At most 1 false alarm in 18 s") and said[1] == str(out)
    new, expected = _core.Bundle.load(str(out)), _core.Bundle.load(str(promised))
    assert new.sliding_limit_nm != plain.sliding_limit_nm
    facts, then = json.loads(new.provenance), json.loads(expected.provenance)
    assert facts["limits"] == then["limits"] and facts["limits"]["sentence"] == said[0]
    assert facts["limits"]["recordings"] == [f"calibration-{k:04d}" for k in range(6)]
    assert facts["calibrated"]["settings"]["alarm"]["in_hours"] == 0.005
    assert facts["settings"] == json.loads(plain.provenance)["settings"]  # of the training
    new.provenance = expected.provenance
    assert new.to_bytes() == expected.to_bytes()
    assert (tmp_path / "bundle.tauext").read_bytes() == before
    run = json.loads(out.with_suffix(".run.json").read_text())
    assert run == facts | {"loss_history": []}


def test_calibrate_refuses_what_it_cannot_serve_in_words(dataset, tmp_path, capsys):
    path = tmp_path / "bundle.tauext"
    bundle = trained(dataset, path, recipe="observer")
    capsys.readouterr()  # what training said of its limits
    assert calibrated(tmp_path / "gone.tauext", dataset, tmp_path / "b.tauext") == 2
    assert calibrated(path, dataset, tmp_path / "b.bundle") == 2
    assert calibrated(path, dataset, path) == 2
    assert calibrated(path, replace(dataset, folder=tmp_path), tmp_path / "b.tauext") == 2
    words = ("there is no such bundle", "a bundle's name ends in .tauext", "stays as it is", "split.json")
    for line, expected in zip(capsys.readouterr().err.splitlines(), words, strict=True):
        assert line.startswith("tauext: error: ") and expected in line
    links = bundle.links
    links[0].joint_name = "other"
    bundle.links = links
    bundle.save(str(path))
    assert calibrated(path, dataset, tmp_path / "b.tauext") == 2
    assert "is for joints other, joint2; recording calibration-0000 has joint1, joint2" in capsys.readouterr().err
    assert issubclass(BundleError, Exception) and not (tmp_path / "b.tauext").exists()


def test_calibrate_without_calibration_recordings_says_how_to_get_some(dataset, tmp_path, capsys):
    """A real arm has no simulator: its motion is recorded."""
    trained(dataset, tmp_path / "bundle.tauext", recipe="observer")
    capsys.readouterr()
    for name, command in (("simulated", "simulate"), ("real", "tauext import")):
        folder = tmp_path / name
        shutil.copytree(dataset.folder, folder)
        save_split(replace(dataset.split, calibration=()), folder)
        run = json.loads((folder / "run.json").read_text())
        (folder / "run.json").write_text(json.dumps(run | {"command": command}))
        data = replace(dataset, folder=folder)
        assert calibrated(tmp_path / "bundle.tauext", data, tmp_path / "b.tauext") == 2
        said = capsys.readouterr().err
        train = ["train", "--data", str(folder), "--out", str(tmp_path / "t.tauext"), "--limits", "promised"]
        assert main(train) == 2
        for words in (said, capsys.readouterr().err):
            assert ("`tauext simulate --calibration-hours 24` makes some" in words) == (name == "simulated")
            assert ("record more of the arm's motion without touches" in words) == (name == "real")
            assert words.count("\n") == 1


def test_calibrate_refuses_limits_that_hardly_a_touch_exceeds(dataset, tmp_path, capsys):
    """The plain observer's limits hold all of the friction: 76 % of the largest torque of joint 2."""
    bundle, out = tmp_path / "bundle.tauext", tmp_path / "out" / "new.tauext"
    trained(dataset, bundle, recipe="observer", limits="paper")
    budget = ("--false-alarms", "1", "--in-hours", "0.005")
    capsys.readouterr()
    assert calibrated(bundle, dataset, out, *budget) == 2
    said = capsys.readouterr()
    assert said.out == "" and "so its thresholds are refused" in said.err and "limit-wide (joint joint2)" in said.err
    assert not out.parent.exists() or not [one for one in out.parent.iterdir() if "half-done" not in one.name]
    assert calibrated(bundle, dataset, out, *budget, "--accept", "limit-wide:joint2") == 0
    found = json.loads(_core.Bundle.load(str(out)).provenance)["limit_findings"]
    assert [(one["code"], one["severity"], one["joint"]) for one in found] == [("limit-wide", "fault", "joint2")]
    assert "fault: limit-wide: joint2: " in capsys.readouterr().err


@pytest.mark.slow
def test_a_worse_promise_replaces_a_better_one_only_if_asked_for_or_accepted(dataset, tmp_path, capsys):
    """Of a day, by a minute that supports 1 in 19 s."""
    good, bad, wide = tmp_path / "good.tauext", tmp_path / "bad.tauext", ("--accept", "limit-wide")
    bundle = trained(dataset, good, recipe="observer", limits="paper")
    assert calibrated(good, dataset, bad, *wide) == 0
    assert "in place of" not in capsys.readouterr().err  # the paper's limits promise nothing
    bad.unlink()
    promise = Promise(FalseAlarmBudget(1, 8), 24.5).summary()
    bundle.provenance = json.dumps(json.loads(bundle.provenance) | {"limits": {"promise": promise, "sentence": "x"}})
    bundle.save(str(good))
    assert calibrated(good, dataset, bad, *wide) == 2
    said = capsys.readouterr().err
    compared = r"1 in 1[89][.\d]* s from 5[.\d]+ s, in place of 1 in 8 h from 24.5 h of calibration in good.tauext"
    assert re.search(f"false alarm rate that the data prove: {compared}\n", said), said
    assert re.search(rf"promise-worse: [^\n]*\n      {compared}\n      -> keep the bundle, record [.\d]+ h more", said)
    assert "--accept promise-worse" in said and not bad.exists()
    assert calibrated(good, dataset, bad, *wide, "promise-worse") == 0
    facts = json.loads(_core.Bundle.load(str(bad)).provenance)
    assert "promise-worse" in [one["code"] for one in facts["limit_findings"]]
    assert re.fullmatch(f"false alarm rate that the data prove: {compared}", facts["limits"]["replaces"])
    capsys.readouterr()
    assert main(["show", str(bad)]) == 0
    assert "fault: promise-worse  " in capsys.readouterr().out
    # A budget that this minute supports was asked for: stated beside the old one, and written.
    assert calibrated(good, dataset, bad, "--false-alarms", "1", "--in-hours", "0.005", *wide) == 0
    assert "1 in 18 s from 5" in capsys.readouterr().err


# --- all of them


def test_baselines_are_trained_once_with_promised_limits(dataset, tmp_path):
    names = ("friction", "observer")
    bundles = train_baselines(dataset, None, "com", tmp_path, seed=0, threads=1, names=names)
    assert list(bundles) == ["observer", "friction"]  # simplest first
    for name, path in bundles.items():
        assert path == tmp_path / f"{name}.tauext"
        facts = json.loads(_core.Bundle.load(str(path)).provenance)
        assert (facts["recipe"], facts["case"]) == (name, "com") and "false alarm" in facts["limits"]["sentence"]
    written = {path: path.stat().st_mtime_ns for path in bundles.values()}
    again = train_baselines(dataset, None, "com", tmp_path, 0, 1, names=(*names, "prior"), skip=["prior"])
    assert again == bundles and {path: path.stat().st_mtime_ns for path in again.values()} == written
    settings = TrainConfig(recipe="observer", limits="promised", threads=2)
    assert finished(bundles["observer"], PAPER_CASES["com"], settings)
    with pytest.raises(ConfigError, match="observer.tauext: it was trained with other settings"):
        train_baselines(dataset, None, "mass", tmp_path, 0, 1, names=names)


def test_what_cannot_be_is_left_out_with_its_reason(dataset, tmp_path):
    heard = Listener()
    assert train_baselines(dataset, None, "none", tmp_path, 0, 1, names=("velocity",), report=heard) == {}
    (said,) = heard.sentences
    assert said.startswith("velocity is left out: recipe = velocity needs a model")
    with pytest.raises(ConfigError, match="baseline 'observr' does not exist; they are observer, friction, "):
        train_baselines(dataset, None, "exact", tmp_path, 0, 1, skip=("observr",))


def test_the_baselines_begin_with_the_observer_and_end_with_tauext_and_every_recipe_is_known():
    known = baselines()
    assert [*known][0] == "observer" and [*known][-1] == "tauext"
    assert set(RECIPES) - set(known.values()) == {"paper"} and known["paper-lstm"] == "dense"
    for recipe in known.values():
        TrainConfig(recipe=recipe).resolved()
