"""What somebody new types wrong: one line names what is at the path, and the next command."""

from __future__ import annotations

import shutil

import pytest
from made_bundles import pushed, watching_bundle

from tauext.cli import main
from tauext.data.dataset import Split, save_split
from tauext.data.recording_file import save_recording


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
    for log in (tmp_path / "x.csv", tmp_path / "logs" / "x.csv"):
        log.write_text("t,q_0\n0,1\n")
    return tmp_path


NEXT = [
    (
        ("train", "--data", "lone.parquet", "--out", "a.tauext"),
        ["is a recording, not a dataset", "tauext import --new"],
    ),
    (("train", "--data", "data/run.parquet", "--out", "a.tauext"), ["is one recording of a dataset", ": data"]),
    (
        ("train", "--data", "plain", "--out", "a.tauext"),
        ["no split.json", "import --new arm.toml --source plain/run.p"],
    ),
    (("train", "--data", "logs", "--out", "a.tauext"), ["a CSV file", "import --new arm.toml --source logs/x.csv"]),
    (("train", "--data", "x.csv", "--out", "a.tauext"), ["is a CSV file", "import --new arm.toml --source x.csv"]),
    (("train", "--data", "bag", "--out", "a.tauext"), ["a ROS 2 bag", "import --new arm.toml --source bag"]),
    (
        ("train", "--data", "nowhere", "--out", "a.tauext"),
        ["no such dataset folder", "tauext import", "tauext simulate"],
    ),
    (("evaluate", "--data", "lone.parquet", "--bundles", "watching.tauext", "--out", "r"), ["tauext import --new"]),
    (("run", "watching.tauext", "data"), ["data: is a dataset folder", "data/*.parquet"]),
    (("run", "watching.tauext", "plain"), ["plain: is a folder", "plain/*.parquet"]),
    (("run", "watching.tauext", "logs"), ["tauext import --new arm.toml --source logs/x.csv"]),
    (("run", "watching.tauext", "x.csv"), ["x.csv: is a CSV file", "tauext import --new arm.toml --source x.csv"]),
    (("run", "watching.tauext", "watching.tauext"), ["is a bundle, not a recording"]),
    (("run", "lone.parquet", "watching.tauext"), ["lone.parquet: is a recording, not a tauext bundle", "first"]),
    (("run", "x.csv", "lone.parquet"), ["x.csv: is a CSV file, not a tauext bundle"]),
    (("run", "data", "lone.parquet"), ["is a dataset folder, not a bundle", "tauext train --data data"]),
    (("run", "watching.tauext", "lone.parquet", "--load", "2.8"), ["did you mean 'mass=2.8'?"]),
    (("run", "watching.tauext", "lone.parquet", "--load", "2.8kg"), ["did you mean 'mass=2.8'?"]),
    (("check", "--data", "logs"), ["no recording", "tauext import --new arm.toml --source logs/x.csv"]),
    (("check", "--data", "x.csv"), ["tauext import --new arm.toml --source x.csv"]),
    (("show", "x.csv"), ["x.csv", "tauext import"]),
    (("show", "data"), ["is a dataset folder", "tauext check --data data"]),
    (("trian", "--data", "data"), ["there is no command 'trian'; did you mean 'train'?"]),
    (("demo", "--headless-seconds", "five"), ["--headless-seconds", "'five'", "a number"]),
    (("simulate", "--out", "x", "--seed", "one"), ["--seed", "'one'", "a whole number"]),
    (("demo", "--arm", "six"), ["--arm", "'six'", "rig, seven"]),
    (("demo", "--prot", "3"), ["--prot", "--port"]),
]


@pytest.mark.parametrize(("arguments", "words"), NEXT, ids=lambda value: " ".join(value)[:60])
def test_one_line_names_what_is_there_and_the_next_command(place, capsys, arguments, words):
    assert main(list(arguments)) == 2
    out, err = capsys.readouterr()
    assert out == "" and len(err.splitlines()) == 1 and err.startswith("tauext: error: ")
    for word in words:
        assert word in err
    assert "Error parsing" not in err and "<class" not in err


def test_the_commands_that_a_message_names_are_the_ones_that_help(place, capsys):
    assert main(["import", "--new", "arm.toml", "--source", "lone.parquet"]) == 0
    with open("arm.toml", "a") as file:
        file.write('\n[split]\ntrain = ["lone.parquet"]\nvalidation = []\ntest = []\n')
    assert main(["import", "--source", "lone.parquet", "--arm", "arm.toml", "--out", "made"]) == 0
    assert (place / "made" / "split.json").is_file()
