"""The commands as a user types them: README and docs, help, wrong input, interruption. All below smoke scale."""

import ast
import json
import re
import shlex
import tomllib
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from functools import partial
from io import StringIO
from itertools import pairwise
from pathlib import Path

import pytest
import tauext_lab.sim.collect  # noqa: F401  before RigConfig is a function: classes derive from it
from made_results import run_command, undrawn
from tauext_lab.reproduce import SCALES
from tauext_lab.sim.config import RigConfig

from tauext import _core
from tauext.cli import main
from tauext.cli.commands import OWN
from tauext.cli.train import alarm_settings, train_settings
from tauext.config import AlarmConfig, DriftConfig, TrainConfig
from tauext.files.typed_table import field_help, read_table

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()
STEP_BY_STEP = (ROOT / "docs" / "paper.md").read_text().partition("## Step by step")[2]
SMALLER = {
    "--minutes 20": "--minutes 1",
    "--collision-recordings 6": "--collision-recordings 1",
    "--calibration-hours 1": "--calibration-hours 0.03",
    "--out runs/exact.tauext": "--out runs/exact.tauext --config few.toml",
    "--recipe dense --max-steps 10000": "--recipe dense --max-steps 10 --batch 8",
    "--in-hours 0.25": "--in-hours 0.25 --accept limit-wide",  # after 10 steps
    "--scale quick": "--scale smoke",
}
STEPS = 10
SHORTER = partial(RigConfig, collision_recording_s=36.0, collisions_per_recording=4)
SMALLEST = replace(SCALES["smoke"], minutes=1.0, training=replace(SCALES["smoke"].training, max_steps=STEPS))


def commands(text: str) -> list[str]:
    return re.findall(r"^    (tauext \w+ .*)$", text, flags=re.MULTILINE)


@dataclass(frozen=True)
class Done:
    """Every command of the steps on the paper's page, run in its order, below smoke scale; no picture is drawn."""

    folder: Path
    said: dict[str, list[str]]
    """Lines on stdout, by the verb of the command; of several the last one's."""


@pytest.fixture(scope="module")
def done(tmp_path_factory) -> Done:
    folder, said = tmp_path_factory.mktemp("readme"), {}
    (folder / "few.toml").write_text("[prior]\nmost_ripples = 0\n")
    with pytest.MonkeyPatch.context() as patch, undrawn():
        patch.chdir(folder)
        patch.setitem(SCALES, "smoke", SMALLEST)
        patch.setattr("tauext_lab.sim.config.RigConfig", SHORTER)
        patch.setattr("tauext_lab.sim.config.changed_rig", lambda *changes: SHORTER())
        for command in commands(STEP_BY_STEP):
            for quick, smoke in SMALLER.items():
                command = command.replace(quick, smoke)
            with redirect_stdout(StringIO()) as out:
                assert main(shlex.split(command)[1:]) == 0, command
            said[shlex.split(command)[1]] = out.getvalue().splitlines()
    return Done(folder, said)


@pytest.fixture(scope="module")
def workplace(done) -> Path:
    return done.folder


@pytest.mark.slow
def test_every_command_step_by_step_works_as_written(workplace):
    assert len(commands(STEP_BY_STEP)) >= 9
    for made in (
        "data/split.json",
        "exact.tauext",
        "results/results.json",
        "report/report.html",
        "calibrated.tauext",
        "compared/bundles/friction.tauext",
        "comparison/report.html",
        "flight-report",
        "quick/report",
    ):
        assert (workplace / "runs" / made).exists(), made


def test_the_readme_is_short_and_its_commands_are_among_those_that_were_run():
    assert len(README.splitlines()) <= 107
    endless = {line for line in commands(README) if line.startswith("tauext commission ")}  # test_commission_command.py
    assert commands(README) and set(commands(README)) - endless <= set(commands(STEP_BY_STEP))


def test_the_python_of_the_readme_runs(workplace, monkeypatch):
    monkeypatch.chdir(workplace)
    (block,) = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    exec(compile(block, "README.md", "exec"), {})


def test_every_make_target_and_link_of_the_readme_exists():
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), flags=re.MULTILINE))
    assert set(re.findall(r"\bmake ([a-z-]+)", README)) <= targets
    for link in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", README):
        assert (ROOT / link).exists(), link


def test_reproduce_covers_all_five_cases_and_prints_the_report_last(done):
    assert done.said["reproduce"][-1] == "runs/quick/report/report.html"
    results = json.loads((done.folder / "runs/quick/results/results.json").read_text())
    assert [bundle["name"] for bundle in results["bundles"]] == ["exact", "mass", "com", "mass+com", "none"]
    assert results["provenance"]["scale"] == "smoke"
    assert all(bundle["loss_history"][-1][0] == bundle["steps"] for bundle in results["bundles"])


def test_reproduce_a_second_time_gives_the_same_results_and_trains_nothing_anew(workplace, monkeypatch):
    """Of one case: to evaluate takes as long for each."""
    results, bundle = (workplace / "runs/quick" / path for path in ("results/results.json", "bundles/exact.tauext"))
    before, written_ns = results.read_bytes(), bundle.stat().st_mtime_ns
    monkeypatch.chdir(workplace)
    monkeypatch.setitem(SCALES, "smoke", SMALLEST)
    monkeypatch.setattr("tauext_lab.sim.config.RigConfig", SHORTER)
    monkeypatch.setattr("tauext_lab.report.page.write_report", lambda results, data, folder: folder)  # is there already
    assert main(["reproduce", "--scale", "smoke", "--out", "runs/quick", "--cases", "exact"]) == 0
    assert bundle.stat().st_mtime_ns == written_ns
    after = results.read_bytes()
    assert json.loads(after)["bundles"] == json.loads(before)["bundles"][:1]


def test_the_same_seed_gives_the_same_bundle_bytes_in_another_folder(workplace, capsys, tmp_path):
    data = workplace / "runs/quick/data"
    (tmp_path / "once.toml").write_text("epochs = 1\nbatch = 64\n")
    options = ("--data", data, "--case", "none", "--recipe", "paper", "--config", tmp_path / "once.toml")
    options += ("--max-steps", STEPS)
    assert run_command(capsys, "train", *options, "--out", tmp_path / "none.tauext")[0] == 0
    assert (tmp_path / "none.tauext").read_bytes() == (workplace / "runs/quick/bundles/none.tauext").read_bytes()


def test_show_tells_what_a_bundle_and_a_recording_hold(workplace, capsys):
    code, out, _ = run_command(capsys, "show", workplace / "runs/none.tauext")
    assert code == 0 and "window_steps 100, step_s 0.01" in out and "joint1" in out and "2202" in out
    code, out, _ = run_command(capsys, "show", workplace / "runs/none.tauext", "--json")
    assert json.loads(out)["network"]["hidden"] == 20
    code, out, _ = run_command(capsys, "show", workplace / "runs/data/collisions-000.parquet", "--json")
    assert code == 0 and json.loads(out)["rate_hz"] == 1000.0


def test_the_plain_observer_is_a_bundle_too(workplace, capsys, tmp_path):
    data, out = workplace / "runs/data", tmp_path / "observer.tauext"
    wide = ("--accept", "limit-wide")
    assert run_command(capsys, "train", "--data", data, "--recipe", "observer", "--out", out, *wide)[0] == 0
    assert not _core.Bundle.load(str(out)).has_network
    assert run_command(capsys, "evaluate", "--data", data, "--bundles", out, "--out", tmp_path / "results")[0] == 0


@pytest.mark.parametrize("command", ["", *OWN])
def test_help_answers_for_every_command(capsys, command):
    code, out, _ = run_command(capsys, *([command] if command else []), "--help")
    assert code == 0 and "usage: tauext" in out


def test_train_has_few_options_and_a_file_for_all_settings(capsys):
    code, text, _ = run_command(capsys, "train", "--help")
    options = re.findall(r"^[│ ] {1,2}(--[\w.-]+)", text, flags=re.MULTILINE)
    assert code == 0 and options[:3] == ["--data", "--out", "--config"] and {"--case", "--recipe"} <= set(options)
    assert len(options) <= 21 and "--help-config" in text
    assert "a checkpoint beside it is written every 20 s" in " ".join(re.sub(r"[│|]", "", text).split())
    code, text, _ = run_command(capsys, "train", "--help-config")
    keys = tomllib.loads(re.sub(r"^# (\w+ = [^# \n])", r"\1", text, flags=re.MULTILINE))
    assert code == 0 and read_table(TrainConfig, keys, "all:") == TrainConfig()
    for name in (*field_help(TrainConfig), *field_help(AlarmConfig), *field_help(DriftConfig)):
        assert re.search(rf"^(# {name} =.*|\[{name}\])$", text, flags=re.MULTILINE)


def test_options_of_the_command_line_replace_keys_of_the_file(tmp_path):
    file = tmp_path / "study.toml"
    file.write_text('recipe = "prior"\nepochs = 3\nseed = 1\n[alarm]\nin_hours = 2\nconfidence = 0.9\n')
    found = train_settings(file, {"recipe": "paper", "seed": 0, "in_hours": 4.0})
    assert found == TrainConfig(recipe="paper", epochs=3, alarm=AlarmConfig(in_hours=4.0, confidence=0.9))
    assert alarm_settings(file, {"false_alarms": 2.0}) == AlarmConfig(2.0, 2.0, 0.9)
    assert train_settings(None, {"minutes": 2.0}) == TrainConfig(minutes=2.0)


BAD_KEYS = [
    ("hiden = 3", [], "study.toml: unknown key 'hiden'; the nearest known is 'hidden'"),
    ("[drift]\nfreeze_s = -1", [], "study.toml: [drift] freeze_s = -1 must be a number from 0 to 60"),
    ("[observer]\ngain_per_s = true", [], "gain_per_s = True must be a number > 0"),
    ('recipe = "lstm"', [], "study.toml: recipe = 'lstm' must be one of tauext, prior"),
    ("epochs = 3", [], "study.toml: epochs = 3 must be left out with recipe prior"),
    ("epochs = 3", ["--minutes", "-1"], "error: --minutes = -1.0 must be a number > 0"),
    ("epochs = ", [], "study.toml: not readable as TOML"),
]


@pytest.mark.parametrize("text, options, says", BAD_KEYS)
def test_a_wrong_key_of_the_file_is_refused_in_one_line(tmp_path, capsys, text, options, says):
    (tmp_path / "study.toml").write_text(text)
    arguments = ("--data", "x", "--out", "a.tauext", "--config", tmp_path / "study.toml", *options)
    code, _, err = run_command(capsys, "train", *arguments)
    assert code == 2 and len(err.splitlines()) == 1 and says in err


WRONG = [
    (("train", "--data", "nowhere", "--out", "a.tauext"), ["nowhere", "tauext simulate"]),
    (("train", "--data", "{data}", "--out", "a.bundle"), ["a.bundle", ".tauext"]),
    (("train", "--data", "{data}", "--out", "a.tauext", "--robot", "arm.urdf"), ["arm.urdf", "robot file"]),
    (("train", "--data", "{data}", "--out", "a.tauext", "--robot", "{other}"), ["joint1", "shoulder"]),
    (("train", "--data", "{data}", "--out", "a.tauext", "--batch", "0"), ["batch", "a whole number from 1"]),
    (("evaluate", "--data", "{data}", "--bundles", "gone.tauext", "--out", "r"), ["gone.tauext", "tauext train"]),
    (("evaluate", "--data", "{data}", "--bundles", "{broken}", "--out", "r"), ["broken.tauext", "not a tauext bundle"]),
    (("evaluate", "--data", "{data}", "--out", "r"), ["nothing to evaluate", "--baselines"]),
    (("evaluate", "--data", "{data}", "--out", "r", "--methods", "prior"), ["--methods", "--baselines"]),
    (("evaluate", "--data", "{data}", "--out", "r", "--baselines", "--methods", "kalman"), ["kalman", "paper-lstm"]),
    (("report", "--results", "nowhere", "--data", "{data}", "--out", "r"), ["nowhere"]),
    (("show", "gone.tauext"), ["gone.tauext"]),
    (("show", "{other}"), [".tauext", ".parquet"]),
    (
        ("simulate", "--out", "{data}", "--minutes", "3", "--collision-recordings", "1", "--calibration-hours", "0.03"),
        ["holds a dataset of other settings (collision_recording_s: 36.0, not 90.0)"],
    ),
    (("simulate", "--out", "x", "--minutes", "-1"), ["minutes", "> 0"]),
    (("simulate", "--out", "x", "--encoder-bits", "11"), ["--encoder-bits = 11", "12 to 24"]),
    (("simulate", "--out", "x", "--friction", "0"), ["friction = 0", "0.1 to 10"]),
    (("refit", "gone.tauext", "--data", "{data}", "--out", "a.tauext"), ["gone.tauext", "tauext train"]),
    (
        ("calibrate", "--bundle", "gone.tauext", "--data", "{data}", "--out", "a.tauext"),
        ["gone.tauext", "tauext train"],
    ),
]


@pytest.mark.parametrize("arguments, says", WRONG, ids=lambda value: "-".join(map(str, value))[:60])
def test_wrong_input_gets_one_line_that_says_what_is_wrong_and_exit_code_2(
    workplace, capsys, tmp_path, monkeypatch, arguments, says
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "broken.tauext").write_text("no bundle")
    (tmp_path / "other.xml").write_text(
        '<mujoco><worldbody><body><joint name="shoulder" type="hinge"/>'
        '<inertial pos="0 0 1" mass="1" diaginertia="1 1 1"/></body></worldbody></mujoco>'
    )
    paths = {"data": workplace / "runs/data", "other": "other.xml", "broken": "broken.tauext"}
    code, out, err = run_command(capsys, *(a.format(**paths) for a in arguments))
    assert code == 2 and out == ""
    assert len(err.strip().splitlines()) == 1, err
    assert err.startswith("tauext: error: ")
    for part in says:
        assert part in err


@pytest.mark.parametrize("arguments", [("trian",), ("train", "--dta", "x"), ("train", "--data", "x", "--case", "bent")])
def test_a_mistyped_command_option_or_choice_exits_with_2(capsys, arguments):
    code, out, err = run_command(capsys, *arguments)
    assert code == 2 and out == "" and arguments[-1] in err


def test_ctrl_c_while_training_keeps_a_checkpoint_that_the_same_command_goes_on_from(
    workplace, capsys, tmp_path, monkeypatch
):
    out = tmp_path / "none.tauext"
    options = ("train", "--data", workplace / "runs/quick/data", "--case", "none", "--out", out)
    (tmp_path / "once.toml").write_text("epochs = 1\n")
    options += ("--recipe", "paper", "--max-steps", STEPS, "--batch", 64, "--config", tmp_path / "once.toml")
    with monkeypatch.context() as patch:
        calls = []
        step = _core.lstm_gradient

        def interrupted(*arguments):
            calls.append(1)
            if len(calls) == 8:
                raise KeyboardInterrupt
            return step(*arguments)

        patch.setattr(_core, "lstm_gradient", interrupted)
        code, _, err = run_command(capsys, *options)
    assert code == 130 and "continues from there" in err
    assert (tmp_path / "none.checkpoint.npz").exists() and not out.exists()
    assert run_command(capsys, *options)[0] == 0
    assert out.read_bytes() == (workplace / "runs/quick/bundles/none.tauext").read_bytes()
    assert not (tmp_path / "none.checkpoint.npz").exists()


def help_texts():
    """Every text that a verb's --help shows for one option, with the place that it stands at."""
    source = Path(__file__).parent.parent / "src" / "tauext"
    settings = source.parents[1].glob("packages/*/*/settings.py")
    lab = source.parents[1] / "packages/lab/tauext_lab"
    for file in (source / "config.py", lab / "sim" / "config.py", *settings):
        for node in ast.walk(ast.parse(file.read_text())):
            body = node.body if isinstance(node, ast.ClassDef) else []
            for field, text in pairwise(body):
                if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr):
                    yield f"{file.name} {node.name}.{ast.unparse(field.target)}", ast.literal_eval(text.value)
    for file in (source / "cli").glob("*.py"):
        for node in ast.parse(file.read_text()).body:
            text = ast.get_docstring(node) if isinstance(node, ast.FunctionDef) else None
            for name, said in re.findall(r"^    (\w+): (.+)", (text or "").partition("Args:\n")[2], re.MULTILINE):
                yield f"{file.name} {name}", said


def test_every_help_text_stands_alone():
    found = dict(help_texts())
    assert len(found) > 120
    fragment = re.compile(
        r"(of|and|but|or|as|the same|none|0|with|asked|about|so (many|long)|from|by|at)\b|\.\.\.", re.I
    )
    allowed = re.compile(r"with --source ur, a file")
    wrong = [name for name, text in found.items() if fragment.match(text) and not allowed.match(text)]
    assert not wrong and not [name for name, text in found.items() if text.endswith("...")]
