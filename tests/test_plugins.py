"""Plug-ins: the example package, found by its entry points alone, and packages that are broken."""

from __future__ import annotations

import importlib
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import tomllib
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from made_bundles import pushed, watching_bundle

import tauext.cli.loop_options  # its options are of the packages installed when it is imported: before any is faked
from tauext import cli, plugins
from tauext.check import finding
from tauext.check.examine import examine
from tauext.cli import main
from tauext.cli.progress import Terminal
from tauext.config import TrainConfig
from tauext.data.recording import Recording
from tauext.data.recording_file import save_recording
from tauext.errors import ConfigError
from tauext.monitor.source import SourceSettings
from tauext.sources.open import open_source
from tauext.train.stage import accepted_settings, compare_signals

ROOT = Path(__file__).parent.parent
EXAMPLE = ROOT / "examples" / "04_plugin"
REPLAY = ("--source", "replay:run.parquet", "--speed", "1", "--missing-after-ms", "1e4")


def install(site: Path, name: str, groups: dict[str, dict[str, str]]) -> None:
    """What a package's installer writes about its entry points."""
    info = site / f"{name}-0.1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.1.0\n")
    lines = [
        line for group, names in groups.items() for line in (f"[{group}]", *(f"{k} = {v}" for k, v in names.items()))
    ]
    (info / "entry_points.txt").write_text("\n".join(lines) + "\n")


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Packages beside tauext: the example, one that cannot be imported, one that holds something else."""
    site = tmp_path_factory.mktemp("site")
    project = tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]
    install(site, project["name"], project["entry-points"])
    for file in EXAMPLE.glob("*.py"):
        shutil.copy(file, site)
    broken = {"sources": "no_such:KIND", "commands": "no_such:RUN", "recipes": "no_such:ROW"}
    install(site, "broken", {f"tauext.{group}": {"broken": value} for group, value in broken.items()})
    install(site, "other", {"tauext.sources": {"other": "json:dumps", "ur": "json:dumps"}})
    watching_bundle().save(str(site / "watching.tauext"))
    return site


@contextmanager
def started(site: Path, *words: str):
    """A command with these packages installed, killed after a minute."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(site), *sys.path]), "COLUMNS": "200"}
    command = [sys.executable, "-u", "-m", "tauext", *words]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, env=environment, cwd=site, **pipes, text=True) as process:
        timer = threading.Timer(60, process.kill)
        timer.start()
        yield process
        timer.cancel()


def tauext(site: Path, *words: str) -> tuple[int, str, str]:
    """Exit status, stdout and stderr of a command with these packages installed."""
    with started(site, *words) as done:
        out, err = done.communicate()
    return done.returncode, out, err


def test_the_robot_of_the_example_is_a_source_of_the_monitor(site):
    words = ("monitor", "watching.tauext", "--source", "my-arm:cell7", "--amplitude-rad", "0.3", "--duration-s", "1.3")
    code, out, err = tauext(site, *words)
    assert code == 0 and "my arm cell7" in out, err


@pytest.mark.slow
def test_the_robot_of_the_example_is_commissioned(site):
    with started(site, "commission", "--source", "my-arm:cell7", "--out", "cell7", "--no-page") as process:
        lines = []
        for line in process.stdout:
            lines.append(line)
            if line.startswith("learning"):
                process.send_signal(signal.SIGINT)
        err = process.communicate()[1]
    assert process.returncode == 0 and any(line.startswith("learning") for line in lines), (lines, err)
    described = tomllib.loads((site / "cell7" / "arm.toml").read_text())
    assert described["robot"]["joints"] == ["shoulder", "elbow"], described


def test_the_robot_of_the_example_refuses_a_torque_in_amperes(monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLE))
    arm = importlib.import_module("my_arm").MyArm("cell7", 0.5)
    arm.open(SourceSettings(("a", "b"), 10_000_000, ("N m", "N m")))
    with pytest.raises(ConfigError, match="my arm cell7 measures torques in N m, the bundle has A"):
        arm.open(SourceSettings(("a", "b"), 10_000_000, ("N m", "A")))


def test_the_help_shows_options_commands_and_recipes_of_packages(site):
    _, out, _ = tauext(site, "commission", "--help")
    assert "--amplitude-rad" in out and "my-arm:HOST" in out
    code, out, _ = tauext(site, "--help")
    assert code == 0 and "my-arm     run a bundle on my arm" in out
    assert "broken     plug-in broken (broken, no_such:RUN): cannot be loaded: ModuleNotFoundError" in out
    code, out, _ = tauext(site, "train", "--help")
    words = " ".join(out.replace("│", " ").split())
    assert code == 0 and "viscous: constant and viscous friction of each joint, fitted" in words
    assert "broken: plug-in broken (broken, no_such:ROW): cannot be loaded: ModuleNotFoundError" in words


def test_the_command_of_the_example_runs(site):
    code, out, err = tauext(site, "my-arm", "watching.tauext", "--seconds", "1.3")
    assert code == 0 and "HealthChange" in out and "samples" in out, err


ARM = """\
[robot]
joints = ["shoulder", "elbow"]
[signals]
q.columns = "q"
dq.columns = "dq"
tau.columns = "tau"
"""


def test_the_format_of_the_example_is_imported_and_its_check_finds_the_clipped_velocity(site):
    example = tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]["entry-points"]
    assert {*example} == {*plugins.GROUPS} - {plugins.PARTS}
    t = np.arange(3000) / 100
    w = np.array([1.7, 1.1])
    q = 0.9 * np.sin(np.outer(t, w))
    dq = np.clip(0.9 * w * np.cos(np.outer(t, w)), -1, 1)
    row = np.dtype([("t_us", "<i8"), ("q", "<f4", 2), ("dq", "<f4", 2), ("tau", "<f4", 2)])
    rows = np.array(list(zip((t * 1e6).round().astype(int), q, dq, np.tanh(dq / 0.02), strict=True)), row)
    (site / "run.mylog").write_bytes(b"MYLOG1\n" + rows.tobytes())
    (site / "arm.toml").write_text(ARM)
    code, out, err = tauext(site, "import", "--source", "run.mylog", "--arm", "arm.toml", "--out", "data")
    assert code == 0 and "run: 29.99 s, 100 Hz, 2 joints, 3000 samples" in out, err
    assert "warning: my-arm-clipped (shoulder): its largest velocity is 1 rad/s" in err
    code, out, err = tauext(site, "check", "--data", "data", "--json")
    (clipped,) = [one for one in json.loads(out)["findings"] if one["code"] == "my-arm-clipped"]
    assert clipped["severity"] == "warning" and clipped["joint"] == "shoulder", err


def test_an_output_of_a_package_is_an_option_of_run_and_monitor(site):
    save_recording(pushed(seconds=1.0), site / "run.parquet")
    for words in (("run", "watching.tauext", "run.parquet"), ("monitor", "watching.tauext", *REPLAY)):
        code, out, err = tauext(site, *words, "--my-table", f"{words[0]}.csv")
        assert code == 0 and f"{words[0]}.csv: 1000 rows" in out, err
    assert (site / "run.csv").read_text() == (site / "monitor.csv").read_text()
    code, out, err = tauext(site, *words, "--my-table", "run.csv")
    assert (code, out) == (2, "") and err.endswith("run.csv: exists already; choose another name, or remove it\n")
    code, _, err = tauext(site, "run", "watching.tauext", "run.parquet", "run.parquet", "--my-table", "b.csv")
    assert code == 2 and "--my-table = b.csv must be left out, or given with one recording" in err


@pytest.fixture
def alone(monkeypatch):
    """tauext without any package."""
    monkeypatch.setattr(plugins, "entry_points", lambda group: ())
    finding.added.cache_clear()
    yield
    finding.added.cache_clear()


def test_without_its_package_what_servos_report_is_not_checked_and_a_line_says_so(alone, capsys):
    q, dq, tau = np.random.default_rng(0).normal(size=(3, 300, 2))
    servo = {"servo": {"torque_from": "duty", "velocity_steps": 10}}
    stamps = np.arange(300) * 20_000_000
    run = Recording("run", ("a", "b"), stamps, q, dq, tau, 50.0, "held", "made", "", provenance=servo)
    diagnosis = examine([run], report=Terminal())
    assert not {"torque_is", "turns", "torque_delay_ms"} & {name for fact in diagnosis.facts for name in fact}
    assert "backlash" not in finding.codes() and "unsigned-torque" not in finding.codes()
    how = "'servo-torque' is a plug-in: pip install ./packages/lerobot in the source folder of tauext"
    assert f"the signals of the servos are not checked: {how}" in " ".join(capsys.readouterr().err.split())
    training = SimpleNamespace(training=[run], notes=[])
    compare_signals(training, None, None)
    (note,) = training.notes
    assert note.startswith("The servos' recorded signals are not compared: 'servo-signals' is a plug-in: pip install")
    training = SimpleNamespace(training=[replace(run, provenance={})], notes=[])
    examine(training.training, report=Terminal())
    compare_signals(training, None, None)
    assert "plug-in" not in capsys.readouterr().err and not training.notes


def test_a_source_whose_package_is_not_installed_names_it(monkeypatch):
    added = {}
    for file in (ROOT / "packages").glob("*/pyproject.toml"):
        project = tomllib.loads(file.read_text())["project"]
        added |= {name: file.parent.name for group in project["entry-points"].values() for name in group}
    assert added == {name: folders.split()[-1] for name, folders in plugins.FOLDERS.items()}
    monkeypatch.setattr(plugins, "entry_points", lambda group: ())
    with pytest.raises(ConfigError, match="--source ros2: 'ros2' is a plug-in: pip install ./packages/ros2"):
        open_source("ros2", {})


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("monitor watching.tauext --source broken:x", "plug-in broken (broken, no_such:KIND): cannot be loaded"),
        (
            "monitor watching.tauext --source other",
            "plug-in other (other, json:dumps): must be a tauext.sources.open.SourceKind, not a function",
        ),
        ("broken --help", "plug-in broken (broken, no_such:RUN): cannot be loaded"),
        ("monitor watching.tauext --source ur", "ur:HOST"),  # ours cannot be replaced
        ("train --data data --out arm.tauext --recipe broken", "broken (broken, no_such:ROW): cannot be loaded"),
        (
            "monitor watching.tauext --source my-arm:cell7 --amplitude-rad 2",
            "--amplitude-rad = 2.0 must be > 0, at most 1\n",
        ),
        ("monitor watching.tauext --source my-arm:cell7 --speed 2", "--speed is for source replay, not for my-arm"),
    ],
)
def test_what_does_not_fit_a_package_is_refused_in_one_line(site, words, message):
    code, _, err = tauext(site, *words.split())
    assert code == 2 and message in err and err.count("\n") == 1


TRAIN = "train --data data --out arm.tauext"
IMPORT = "import --source ds --arm arm.toml --out out"
NOT_INSTALLED = [
    (f"{TRAIN} --like arm.prior.json", "", "./packages/fleet"),
    (f"{TRAIN} --network own.npz", "", "./packages/lab"),
    ("refit old.tauext --data data --out arm.tauext --like arm.prior.json", "", "./packages/fleet"),
    ("show arm.prior.json", "", "./packages/fleet"),
    ("fleet run fleet.toml", "'fleet'", "./packages/lab ./packages/fleet"),
    ("monitor arm.tauext --source ros2 --ros2.topic /a", "'ros2'", "./packages/ros2"),
    ("monitor arm.tauext --source ur:a --mcap a.mcap", "'mcap'", "./packages/lab"),
    ("run arm.tauext a.parquet --mcap a.mcap", "'mcap'", "./packages/lab"),
    (IMPORT, "ds: 'lerobot'", "./packages/lerobot"),
    (f"{IMPORT} --format lerobot", "--format = lerobot: 'lerobot'", "./packages/lerobot"),
]


@pytest.mark.parametrize(("words", "what", "packages"), NOT_INSTALLED, ids=lambda value: value)
def test_what_needs_a_package_that_is_not_installed_names_it(
    alone, tmp_path, monkeypatch, capsys, words, what, packages
):
    monkeypatch.chdir(tmp_path)
    for name, text in (("arm.prior.json", "{}"), ("old.tauext", ""), ("arm.toml", ARM), ("ds/meta/info.json", "{}")):
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).write_text(text)
    for module in ("run", "monitor", "source_options", "loop_options"):  # those that hold the options
        monkeypatch.setattr(cli, module, importlib.import_module(f"tauext.cli.{module}"), raising=False)
        monkeypatch.delitem(sys.modules, f"tauext.cli.{module}")
    assert main(words.split()) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and said.endswith(f"{packages} in the source folder of tauext\n")
    assert not what or said.startswith(f"tauext: error: {what} is a plug-in: pip install ")


def test_a_backend_whose_package_is_not_installed_is_named_before_the_training(monkeypatch):
    monkeypatch.setattr("tauext.plugins.entry_points", lambda group: [])
    accepted_settings(TrainConfig(recipe="prior", backend="torch"), ())  # trains no network
    with pytest.raises(ConfigError, match="'torch' is a plug-in: pip install ./packages/lab"):
        accepted_settings(TrainConfig(recipe="paper", backend="torch"), ())
