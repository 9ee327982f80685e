"""The table of recipes: a new baseline is one row and one fit function; and a stage tells only its reporter."""

import json
import subprocess
import sys
from contextlib import contextmanager
from dataclasses import replace
from importlib import import_module
from importlib.metadata import EntryPoint
from pathlib import Path
from pkgutil import resolve_name
from typing import get_args

import numpy as np
import pytest
from made_arms import planar_arm
from test_few_data import motion

from tauext import _core, plugins
from tauext.bundle.estimates import OK
from tauext.cli.show import prior_words
from tauext.config import PAPER_CASES, TrainConfig
from tauext.data.free_motion import cut
from tauext.data.recording import Recording
from tauext.errors import ConfigError, TrainingError
from tauext.files.typed_table import field_help, hints_of
from tauext.recipes import RECIPES, baselines
from tauext.train.preparation import TrainingInput, training_settings, why_impossible
from tauext.train.stage import train_on_recordings

EXACT, NONE = PAPER_CASES["exact"], PAPER_CASES["none"]
EXAMPLE = Path(__file__).parent.parent / "examples" / "04_plugin"


class Heard:
    """A reporter that keeps what it is told."""

    def __init__(self) -> None:
        self.sentences, self.steps, self.titles = [], [], []

    def say(self, sentence: str) -> None:
        self.sentences.append(sentence)

    @contextmanager
    def progress(self, title: str):
        self.titles.append(title)
        yield lambda done, of, note: self.steps.append((done, of, note))


def trained_on(
    out: Path, config: TrainConfig, *training: Recording, validation=(), **more
) -> tuple[_core.Bundle, dict]:
    """The bundle of these recordings, and its facts."""
    given = TrainingInput(Path(), EXACT, list(training), list(validation), model=planar_arm())
    train_on_recordings(given, config, out, **more)
    bundle = _core.Bundle.load(str(out))
    return bundle, json.loads(bundle.provenance)


@pytest.fixture
def unlimited(monkeypatch):
    """No robot file: what the drives can give is unknown."""
    monkeypatch.setattr("tauext.train.preparation.torque_limits", lambda robot, joints: np.full(len(joints), np.inf))


@pytest.fixture
def viscous(monkeypatch):
    """The recipe of the example package: its row is found by an entry point."""
    monkeypatch.syspath_prepend(str(EXAMPLE))
    import_module("my_recipe")
    found = {plugins.RECIPES: [EntryPoint("viscous", "my_recipe:RECIPE", plugins.RECIPES)]}
    monkeypatch.setattr(plugins, "entry_points", lambda group: found.get(group, []))


def test_a_regression_baseline_is_one_row_and_one_fit_function(tmp_path, viscous, unlimited, capsys):
    out, heard = tmp_path / "viscous.tauext", Heard()
    config = TrainConfig(recipe="viscous")
    bundle, facts = trained_on(out, config, motion(60.0), validation=[motion(20.0, seed=1)], report=heard)
    assert facts["recipe"] == "viscous" and facts["prior"]["friction"]["elbow"]["viscous_nm_s_rad"] > 2.0
    assert [term.kind.name for term in bundle.prior.terms] == ["constant", "viscous"] * 2 and not bundle.has_network
    assert heard.sentences[-1].startswith("viscous: took ")
    made = motion(20.0, seed=2)
    said = _core.estimate(bundle, *made.signals, 1)
    healthy = said["health"] == OK
    rms = {name: np.sqrt(np.mean(said[name][healthy] ** 2, axis=0)) for name in ("residual", "tau_ext")}
    assert (rms["tau_ext"] < 0.5 * rms["residual"]).all()  # most of 3 Nm Coulomb and 2 Nm s/rad viscous friction
    assert list(baselines())[:2] == ["viscous", "observer"]  # the last row comes first
    assert "Coulomb" not in (
        shown := prior_words(facts["prior"], {"elbow": "Nm", "shoulder": "Nm"})["friction of elbow"]
    )
    assert shown.startswith("viscous ")
    assert any(sentence.startswith("viscous: error on left-out motion") for sentence in heard.sentences)
    assert capsys.readouterr() == ("", "")  # a stage prints nothing


def test_what_an_added_recipe_does_not_use_follows_from_its_row(viscous):
    kept = training_settings(EXACT, TrainConfig(recipe="viscous"))["config"]
    assert not {"threads", "targets", "prior", "gate_margin", "drift", "filters"} & kept.keys()
    assert kept == training_settings(EXACT, TrainConfig(recipe="friction"))["config"] | {"recipe": "viscous"}


def test_the_help_offers_the_rows_of_tauext_and_of_packages_with_their_summaries(viscous):
    words = field_help(TrainConfig)["recipe"]
    assert get_args(hints_of(TrainConfig)["recipe"]) == (*RECIPES, "viscous")
    assert "viscous: constant and viscous friction of each joint, fitted." in words
    for recipe in RECIPES.values():
        assert recipe.summary.strip() and not recipe.summary.endswith("."), recipe.name
        assert f"{recipe.name}: {recipe.summary}" in words


def test_what_a_row_names_exists():
    for recipe in RECIPES.values():
        assert recipe.fit is None or callable(resolve_name(recipe.fit))
        assert getattr(_core.ResidualMethod, recipe.method)
        assert {"threads", "filters"} <= {*recipe.unused} or recipe.high_pass
        assert all(hasattr(TrainConfig, name) for name in (*recipe.unused, *recipe.defaults) if name not in FACTORIES)
    named = [recipe.baseline for recipe in RECIPES.values() if recipe.baseline]
    assert len(set(named)) == len(named)


FACTORIES = {"prior", "drift", "filters"}
"""Fields of TrainConfig that are made anew for each."""


def test_a_recipe_that_divides_by_the_inertia_needs_a_model():
    impossible = [name for name, recipe in RECIPES.items() if why_impossible(recipe, NONE)]
    assert impossible == ["velocity"] and not any(why_impossible(recipe, EXACT) for recipe in RECIPES.values())


def test_an_unknown_recipe_is_refused_with_those_that_exist():
    with pytest.raises(ConfigError, match="recipe = lstm must be one of tauext, prior, paper"):
        TrainConfig(recipe="lstm")


def test_training_tells_its_reporter_how_far_it_is_and_prints_nothing(tmp_path, unlimited, capsys):
    heard = Heard()
    config = TrainConfig(recipe="dense", max_steps=20, batch=4, hidden=2, targets=20, seed=1)
    out = tmp_path / "small.tauext"
    trained_on(out, config, motion(40.0), report=heard)
    assert heard.titles == ["train small"] and heard.steps[-1][:2] == (20, 20)
    assert any("validate, " in sentence for sentence in heard.sentences)
    assert capsys.readouterr() == ("", "")


def test_the_settings_need_neither_numpy_nor_the_stages():
    code = "import sys, tauext.config; assert not {'numpy', 'tauext.fit', 'tauext.train'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def with_gaps(recording: Recording, every_s: float) -> Recording:
    """A tenth of a second lost every so often; the chain warms up for half a second after each."""
    keep = recording.time_s % every_s > 0.1
    return cut(recording, keep)


def test_a_bundle_that_rejects_its_own_training_motion_is_warned_of(tmp_path, unlimited):
    gaps = with_gaps(motion(60.0), 10.0)
    heard, out, config = Heard(), tmp_path / "arm.tauext", TrainConfig(recipe="observer")
    _, facts = trained_on(out, config, gaps, motion(20.0, seed=1, name="even"), report=heard)
    warned = [said for said in heard.sentences if "rejects" in said]
    assert len(warned) == 1 and f"of '{gaps.name}'" in warned[0] and "without losing samples" in warned[0]
    facts = facts["rejected"]
    # Five gaps behind the first healthy sample, 10/K0 = 0.5 s each, in 79 s.
    assert list(facts["causes"]) == ["gap"] and facts["share"] == pytest.approx(2.5 / 79, abs=0.005)


def test_a_bundle_that_rejects_a_fifth_of_its_training_motion_is_refused_unless_accepted(tmp_path, unlimited):
    gaps, out, config = with_gaps(motion(40.0), 1.5), tmp_path / "arm.tauext", TrainConfig(recipe="observer")
    with pytest.raises(TrainingError, match=r"rejects 3\d\.\d% of its own training motion \(gap.*--accept rejected"):
        trained_on(out, config, gaps)
    assert not out.exists()
    assert trained_on(out, config, gaps, accept=("rejected",))[1]["rejected"]["share"] > 0.3


def stretched(recording: Recording, percent: int) -> Recording:
    """Its clock runs slower by so much; the rate stays what it was stated to be."""
    first = recording.t_ns[0]
    return replace(recording, t_ns=first + (recording.t_ns - first) * (100 + percent) // 100)


def test_a_monitor_takes_the_rates_of_its_training_and_no_others(tmp_path, unlimited):
    """The mean of an exponential second ends at 1.08."""
    out, config = tmp_path / "arm.tauext", TrainConfig(recipe="observer")
    even, slow = motion(40.0, seed=1, name="even"), stretched(motion(40.0), 8)
    bundle, _ = trained_on(out, config, even, slow)
    assert bundle.rate_tolerance == pytest.approx(0.08, abs=1e-4)
    for recording, cause in ((slow, False), (stretched(motion(40.0), 10), True)):
        causes = _core.estimate(bundle, *recording.signals, 1)["causes"]
        assert ("wrong rate" in _core.cause_names(int(np.bitwise_or.reduce(causes)))) is cause
    assert trained_on(out, config, even)[0].rate_tolerance == _core.RATE_TOLERANCE_RANGE[0] == 0.05
    with pytest.raises(TrainingError, match="made.*differs by more than 15% from the sample period, 8 ms"):
        trained_on(out, config, even, stretched(motion(40.0), 18))
