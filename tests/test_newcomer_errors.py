"""What somebody new types wrong: one line names what is at the path, and the next command."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from made_arms import six_axis, six_axis_tree, urdf
from made_bundles import pushed, watching_bundle
from made_recordings import Drive, made_motion

from tauext.cli import main
from tauext.data.dataset import Split, save_split
from tauext.data.recording_file import save_recording
from tauext.data.servo import AMPERES, FROM_AMPERES


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A bundle, a recording, a dataset, a folder of recordings, folders with logs, and a log."""
    monkeypatch.chdir(tmp_path)
    watching_bundle().save("watching.tauext")
    save_recording(pushed(), tmp_path / "lone.parquet")
    for folder in ("data", "plain", "logs", "bag"):
        (tmp_path / folder).mkdir()
    for folder in ("data", "plain"):
        shutil.copy("lone.parquet", tmp_path / folder / "run.parquet")
    save_split(Split(("run.parquet",), (), ()), tmp_path / "data")
    (tmp_path / "bag" / "metadata.yaml").touch()
    (tmp_path / "half").mkdir()  # what Ctrl-C leaves of a simulation
    shutil.copy("lone.parquet", tmp_path / "half" / "free-000.parquet")
    (tmp_path / "half" / "run.json").write_text('{"command": "simulate"}')
    for log in (tmp_path / "x.csv", tmp_path / "logs" / "x.csv"):
        log.write_text("t,q_0\n0,1\n")
    return tmp_path


NEW = "import --new arm.toml --source"
OUT = "--out a.tauext"
NEXT = [
    (
        f"train --data half {OUT}",
        ["half: holds an interrupted simulation", "the same `tauext simulate --out half`, run again, completes it"],
    ),
    (f"train --data lone.parquet {OUT}", ["is a recording, not a dataset", "tauext import --new"]),
    (f"train --data data/run.parquet {OUT}", ["is one recording of a dataset", ": data"]),
    (f"train --data plain {OUT}", ["no split.json", f"{NEW} plain/run.p"]),
    (f"train --data logs {OUT}", ["a CSV file", f"{NEW} logs/x.csv"]),
    (f"train --data x.csv {OUT}", ["is a CSV file", f"{NEW} x.csv"]),
    (f"train --data bag {OUT}", ["a ROS 2 bag", f"{NEW} bag"]),
    (f"train --data nowhere {OUT}", ["no such dataset folder", "tauext import", "tauext simulate"]),
    ("evaluate --data lone.parquet --bundles watching.tauext --out r", ["tauext import --new"]),
    ("run watching.tauext data", ["data: is a dataset folder", "data/*.parquet"]),
    ("run watching.tauext plain", ["plain: is a folder", "plain/*.parquet"]),
    ("run watching.tauext logs", [f"tauext {NEW} logs/x.csv"]),
    ("run watching.tauext x.csv", ["x.csv: is a CSV file", f"tauext {NEW} x.csv"]),
    ("run watching.tauext watching.tauext", ["is a bundle, not a recording"]),
    ("run lone.parquet watching.tauext", ["lone.parquet: is a recording, not a tauext bundle", "first"]),
    ("run x.csv lone.parquet", ["x.csv: is a CSV file, not a tauext bundle"]),
    ("run data lone.parquet", ["is a dataset folder, not a bundle", "tauext train --data data"]),
    ("run watching.tauext lone.parquet --load 2.8", ["did you mean 'mass=2.8'?"]),
    ("run watching.tauext lone.parquet --load 2.8kg", ["did you mean 'mass=2.8'?"]),
    ("check --data logs", ["no recording", f"tauext {NEW} logs/x.csv"]),
    ("check --data x.csv", [f"tauext {NEW} x.csv"]),
    ("show x.csv", ["x.csv", "tauext import"]),
    ("show data", ["is a dataset folder", "tauext check --data data"]),
    (
        "label --dataset data --bundle arm.toml --arm watching.tauext --out l",
        ["watching.tauext: not readable as TOML (it is a bundle)"],
    ),
    ("import --source x.csv --arm lone.parquet --out l", ["lone.parquet: not readable as TOML"]),
    ("trian --data data", ["there is no command 'trian'; did you mean 'train'?"]),
    ("commission --disk-gb five", ["--disk-gb", "'five'", "a number"]),
    ("simulate --out x --seed one", ["--seed", "'one'", "a whole number"]),
    ("commission --no-page --source sim:six --out l", ["sim:six", "sim:rig, sim:seven"]),
    ("train --backend numpi", ["--backend", "'numpi'"]),
    ("commission --prot 3", ["--prot", "--port"]),
]


@pytest.mark.parametrize(("arguments", "words"), NEXT, ids=lambda value: "".join(value)[:60])
def test_one_line_names_what_is_there_and_the_next_command(place, capsys, arguments, words):
    assert main(arguments.split()) == 2
    out, err = capsys.readouterr()
    assert out == "" and len(err.splitlines()) == 1 and err.startswith("tauext: error: ")
    assert [word for word in words if word not in err] == []
    assert "Error parsing" not in err and "<class" not in err


def test_the_help_begins_with_usage_and_commands(capsys):
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    assert text.startswith("usage: tauext COMMAND") and text.index("  train ") < text.index("Order of work")
    assert len(text.partition("Order of work")[2].splitlines()) <= 6


def test_a_current_is_in_amperes_and_warnings_are_counted_as_they_are_shown(capsys, tmp_path):
    path = saved_motion(tmp_path, nm_per_a=(12.0, 9.0, 9.0, 4.5, 4.5, 4.5), torque=AMPERES)
    main(["check", "--data", path])
    text = capsys.readouterr().out
    head = next(line for line in text.splitlines() if line.startswith("joint "))
    assert "torque A" in head and "unexplained A" in head and "Nm" not in head
    for severity in ("fault", "warning", "note"):
        shown = sum(line.startswith(f"{severity}: ") for line in text.splitlines())
        assert f"{shown} {severity}{'s' * (shown != 1)}" in text.splitlines()[-1]
    assert main(["show", path]) == 0
    assert "largest tau [A]" in capsys.readouterr().out


def saved_motion(folder: Path, nm_per_a: tuple = (), torque: str = "") -> str:
    """A minute of the six-axis arm, with its robot file; in amperes where the drives' constants are given."""
    drive = Drive(nm_per_a=nm_per_a) if nm_per_a else Drive()
    (recording,) = made_motion(six_axis_tree(folder), 1, rate_hz=100.0, pieces=1, drive=drive).recordings
    provenance = {"torque": torque} if torque else recording.provenance
    save_recording(replace(recording, name="run", provenance=provenance), folder / "run.parquet")
    (folder / "robot.urdf").write_text(urdf(six_axis()))
    return str(folder / "run.parquet")


@pytest.mark.parametrize(
    ("torque", "remedy"),
    [
        (AMPERES, "-> no action is needed: `train` fits the torque constants. Factors"),
        (FROM_AMPERES, '-> the torque constant of the import is wrong ("unknown" lets `train` fit it); else'),
    ],
)
def test_the_remedy_of_a_scale_depends_on_who_knows_the_torque_constant(capsys, tmp_path, torque, remedy):
    path = saved_motion(tmp_path, nm_per_a=(12.0,) * 6, torque=torque)
    main(["check", "--data", path, "--robot", str(tmp_path / "robot.urdf")])
    text = capsys.readouterr().out
    assert "warning: effort-scale (" in text and remedy in text


def test_training_prints_its_phases(capsys, tmp_path):
    saved_motion(tmp_path)
    save_split(Split(("run.parquet",), (), ()), tmp_path)
    main(["train", "--data", str(tmp_path), "--recipe", "friction", "--out", str(tmp_path / "a.tauext")])
    err = capsys.readouterr().err
    phases = ("checking the data", "observing the motion", "fitting friction and model", "finding the thresholds")
    places = [err.find(phase) for phase in phases]
    assert -1 not in places and places == sorted(places), err


def test_the_commands_that_a_message_names_are_the_ones_that_help(place, capsys):
    assert main(["import", "--new", "arm.toml", "--source", "lone.parquet"]) == 0
    with open("arm.toml", "a") as file:
        file.write('\n[split]\ntrain = ["lone.parquet"]\nvalidation = []\ntest = []\n')
    assert main(["import", "--source", "lone.parquet", "--arm", "arm.toml", "--out", "made"]) == 0
    assert (place / "made" / "split.json").is_file()
