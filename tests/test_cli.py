"""The commands as a user types them: README and docs, help, wrong input, interruption. All below smoke scale."""

import ast
import json
import re
import shlex
from contextlib import redirect_stdout
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import partial
from io import StringIO
from itertools import pairwise
from pathlib import Path

import pytest
from made_results import undrawn

from tauext import _core
from tauext.cli import main
from tauext.cli.experiment import SCALES
from tauext.config import TrainConfig
from tauext.sim.config import RigConfig

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()
STEP_BY_STEP = (ROOT / "docs" / "start" / "research.md").read_text().partition("## Step by step")[2]
SMALLER = {
    "--minutes 20": "--minutes 1",
    "--collision-recordings 6": "--collision-recordings 1",
    "--calibration-hours 1": "--calibration-hours 0.03",
    "--out runs/exact.tauext": "--out runs/exact.tauext --max-steps 10 --batch 8 --prior.most-ripples 0",
    "--recipe dense --max-steps 10000": "--recipe dense --max-steps 10 --batch 8",
    "--scale quick": "--scale smoke",
}
STEPS = 10
SHORTER = partial(RigConfig, collision_recording_s=36.0, collisions_per_recording=4)
SMALLEST = replace(SCALES["smoke"], minutes=1.0, training=replace(SCALES["smoke"].training, max_steps=STEPS))


def commands(text: str) -> list[str]:
    return re.findall(r"^    (tauext \w+ .*)$", text, flags=re.MULTILINE)


@dataclass(frozen=True)
class Done:
    """Every command of the page for research, run in its order, below smoke scale; no picture is drawn."""

    folder: Path
    said: dict[str, list[str]]
    """Lines on stdout, by the verb of the command; of several the last one's."""


@pytest.fixture(scope="module")
def done(tmp_path_factory) -> Done:
    folder, said = tmp_path_factory.mktemp("readme"), {}
    with pytest.MonkeyPatch.context() as patch, undrawn():
        patch.chdir(folder)
        patch.setitem(SCALES, "smoke", SMALLEST)
        patch.setattr("tauext.cli.experiment.RigConfig", SHORTER)
        patch.setattr("tauext.sim.config.changed_rig", lambda *changes: SHORTER())
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


def run(capsys, *arguments: object) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of one command."""
    capsys.readouterr()
    try:
        code = main([str(a) for a in arguments])
    except SystemExit as stop:  # the argument parser's own way out
        code = stop.code or 0
    out, err = capsys.readouterr()
    return code, out, err


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
    assert len(README.splitlines()) <= 120
    assert commands(README) and set(commands(README)) <= set(commands(STEP_BY_STEP))


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
    monkeypatch.setattr("tauext.cli.experiment.RigConfig", SHORTER)
    monkeypatch.setattr("tauext.cli.experiment.write_report", lambda results, data, folder: folder)  # is there already
    assert main(["reproduce", "--scale", "smoke", "--out", "runs/quick", "--cases", "exact"]) == 0
    assert bundle.stat().st_mtime_ns == written_ns
    after = results.read_bytes()
    assert json.loads(after)["bundles"] == json.loads(before)["bundles"][:1]


def test_the_same_seed_gives_the_same_bundle_bytes_in_another_folder(workplace, capsys, tmp_path):
    data = workplace / "runs/quick/data"
    options = (
        "--data",
        data,
        "--case",
        "none",
        "--recipe",
        "paper",
        "--max-steps",
        STEPS,
        "--batch",
        64,
        "--epochs",
        1,
    )
    assert run(capsys, "train", *options, "--out", tmp_path / "none.tauext")[0] == 0
    assert (tmp_path / "none.tauext").read_bytes() == (workplace / "runs/quick/bundles/none.tauext").read_bytes()


def test_show_tells_what_a_bundle_and_a_recording_hold(workplace, capsys):
    code, out, _ = run(capsys, "show", workplace / "runs/none.tauext")
    assert code == 0 and "100 steps of 10 ms" in out and "joint1" in out and "2202" in out
    code, out, _ = run(capsys, "show", workplace / "runs/none.tauext", "--json")
    assert json.loads(out)["network"]["hidden"] == 20
    code, out, _ = run(capsys, "show", workplace / "runs/data/collisions-000.parquet", "--json")
    assert code == 0 and json.loads(out)["rate [Hz]"] == 1000.0


def test_the_plain_observer_is_a_bundle_too(workplace, capsys, tmp_path):
    data, out = workplace / "runs/data", tmp_path / "observer.tauext"
    assert run(capsys, "train", "--data", data, "--recipe", "observer", "--out", out)[0] == 0
    assert not _core.Bundle.load(str(out)).has_network
    assert run(capsys, "evaluate", "--data", data, "--bundles", out, "--out", tmp_path / "results")[0] == 0


COMMANDS = "simulate import train calibrate refit evaluate report run monitor load show reproduce fleet".split()


@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_help_answers_for_every_command(capsys, command):
    code, out, _ = run(capsys, *([command] if command else []), "--help")
    assert code == 0 and "usage: tauext" in out


def options_of(text: str) -> list[str]:
    return re.findall(r"^  (--[\w.-]+)", text, flags=re.MULTILINE)


def test_help_of_train_has_the_common_options_first_and_all_when_asked(capsys):
    """Held against the fields of the settings themselves, so that no option is lost in the arrangement."""
    short, everything = (run(capsys, "train", word)[1] for word in ("--help", "--help-all"))
    named = {"--data", "--out", "--case", "--robot", "--like", "--accept"}
    for field in fields(TrainConfig):
        value = getattr(TrainConfig(), field.name)
        inner = [f"--{field.name}.{one.name}" for one in fields(value)] if is_dataclass(value) else []
        named |= {name.replace("_", "-") for name in inner or [f"--{field.name}"]}
    assert sorted(options_of(everything)) == sorted(named)
    assert options_of(short) == options_of(everything)[: len(options_of(short))] and len(options_of(short)) < 20
    assert options_of(short)[:2] == ["--data", "--out"] and {"--case", "--recipe"} <= set(options_of(short))
    assert f"{len(named) - len(options_of(short))} more" in short and "--help-all" in short
    for text in (short, everything):
        assert max(len(line) for line in text.splitlines() if "{" not in line) <= 100
    assert "a checkpoint beside it is written every 20 s, and kept" in " ".join(short.split())


WRONG = [
    (("train", "--data", "nowhere", "--out", "a.tauext"), ["nowhere", "tauext simulate"]),
    (("train", "--data", "{data}", "--out", "a.bundle"), ["a.bundle", ".tauext"]),
    (("train", "--data", "{data}", "--out", "a.tauext", "--robot", "arm.urdf"), ["arm.urdf", "robot file"]),
    (("train", "--data", "{data}", "--out", "a.tauext", "--robot", "{other}"), ["joint1", "shoulder"]),
    (("train", "--data", "{data}", "--out", "a.tauext", "--batch", "0"), ["batch", ">= 1"]),
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
    (("simulate", "--out", "x", "--encoder-bits", "11"), ["encoder_bits = 11", "12 to 24"]),
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
    code, out, err = run(capsys, *(a.format(**paths) for a in arguments))
    assert code == 2 and out == ""
    assert len(err.strip().splitlines()) == 1, err
    assert err.startswith("tauext: error: ")
    for part in says:
        assert part in err


@pytest.mark.parametrize("arguments", [("trian",), ("train", "--dta", "x"), ("train", "--data", "x", "--case", "bent")])
def test_a_mistyped_command_option_or_choice_exits_with_2(capsys, arguments):
    code, out, err = run(capsys, *arguments)
    assert code == 2 and out == "" and arguments[-1] in err


def test_ctrl_c_while_training_keeps_a_checkpoint_that_the_same_command_goes_on_from(
    workplace, capsys, tmp_path, monkeypatch
):
    out = tmp_path / "none.tauext"
    options = ("train", "--data", workplace / "runs/quick/data", "--case", "none", "--out", out)
    options += ("--recipe", "paper", "--max-steps", STEPS, "--batch", 64, "--epochs", 1)
    with monkeypatch.context() as patch:
        calls = []
        step = _core.lstm_gradient

        def interrupted(*arguments):
            calls.append(1)
            if len(calls) == 8:
                raise KeyboardInterrupt
            return step(*arguments)

        patch.setattr(_core, "lstm_gradient", interrupted)
        code, _, err = run(capsys, *options)
    assert code == 130 and "goes on from there" in err
    assert (tmp_path / "none.checkpoint.npz").exists() and not out.exists()
    assert run(capsys, *options)[0] == 0
    assert out.read_bytes() == (workplace / "runs/quick/bundles/none.tauext").read_bytes()
    assert not (tmp_path / "none.checkpoint.npz").exists()


def help_texts():
    """Every text that a verb's --help shows for one option, with the place that it stands at."""
    source = Path(__file__).parent.parent / "src" / "tauext"
    for file in (source / "config.py", source / "sim" / "config.py", source / "sources" / "ros2_settings.py"):
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
    allowed = re.compile(r"with --json, how many|with --source ur, a file")
    wrong = [name for name, text in found.items() if fragment.match(text) and not allowed.match(text)]
    assert not wrong and not [name for name, text in found.items() if text.endswith("...")]
