"""What is asked for against what is there, outputs that come together or not at all, and how a command then ends."""

import os
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import pytest
from tauext_lab.sim import collect

from tauext import _core
from tauext.cli import main
from tauext.config import MOST_HIDDEN, TrainConfig
from tauext.errors import ConfigError
from tauext.files import preflight
from tauext.files.atomic_write import atomic_files, atomic_folder
from tauext.files.plain_file import json_of, read_text, toml_of
from tauext.train.stage import expect_size


def refused(capsys, *arguments: object) -> str:
    """The one line of a command that is refused with status 2."""
    capsys.readouterr()
    assert main([str(argument) for argument in arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("tauext: error: ")
    return line


def test_files_that_belong_together_appear_together_or_not_at_all(tmp_path):
    first, last = tmp_path / "a.run.json", tmp_path / "a.tauext"
    last.write_text("old")
    with pytest.raises(RuntimeError), atomic_files(first, last) as (part, _):
        part.write_text("new")
        raise RuntimeError
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"a.tauext": "old"}
    with atomic_files(first, last) as parts:
        for part in parts:
            part.write_text("new")
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"a.tauext": "new", "a.run.json": "new"}


def test_a_folder_s_files_come_at_the_end_and_others_stay(tmp_path):
    (tmp_path / "report").mkdir()
    (tmp_path / "report/mine.txt").write_text("mine")
    for fails in (True, False):
        with pytest.raises(RuntimeError) if fails else nullcontext():
            with atomic_folder(tmp_path / "report") as part:
                (part / "figures").mkdir()
                (part / "figures/a.png").write_text("a")
                if fails:
                    raise RuntimeError
        names = sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file())
        assert names == (["report/mine.txt"] if fails else ["report/figures/a.png", "report/mine.txt"])


@pytest.mark.parametrize(
    ("size", "told"), [(0, "0 bytes"), (999, "999 bytes"), (4096, "4.1 kB"), (2.5e9, "2.5 GB"), (3.6e15, "3.6 PB")]
)
def test_sizes_are_reported_in_words(size, told):
    assert preflight.in_words(size) == told


def test_what_memory_disk_and_time_do_not_hold_is_refused_with_both_numbers(tmp_path, monkeypatch):
    monkeypatch.setattr(preflight, "free_memory", lambda: 8 * 10**9)
    preflight.expect_memory(7e9, "x")
    with pytest.raises(ConfigError, match=r"batch = 9 needs 9 GB of memory, and 8 GB are free"):
        preflight.expect_memory(9e9, "batch = 9")
    monkeypatch.setattr(preflight.shutil, "disk_usage", lambda folder: SimpleNamespace(free=5_000_000))
    preflight.expect_folder(tmp_path / "new/folder", 4e6)
    with pytest.raises(
        ConfigError, match="the output needs 6 MB of disk, and 5 MB are free; free some, or choose another place"
    ):
        preflight.expect_folder(tmp_path / "new/folder", 6e6)
    preflight.expect_time(86400.0, "x")
    with pytest.raises(ConfigError, match="it takes 2 years at least"):
        preflight.expect_time(2 * 365.25 * 86400, "it")


@pytest.mark.parametrize("place", ["file/x.tauext", "folder.tauext", "pipe.tauext", "/dev/full", "/dev/full/x.tauext"])
def test_a_place_where_no_file_can_stand_is_refused(place, tmp_path):
    (tmp_path / "file").touch()
    (tmp_path / "folder.tauext").mkdir()
    os.mkfifo(tmp_path / "pipe.tauext")
    with pytest.raises(ConfigError, match="choose another"):
        preflight.expect_new_file(tmp_path / place)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("simulate --out d --minutes 1e9", "of disk, and"),
        ("simulate --out d --minutes inf", "minutes = inf must be > 0"),
        ("simulate --out d --seed -1", "seed = -1 must be >= 0"),
        ("simulate --out d --collision-recordings 100000000000", "of disk, and"),
        ("simulate --out /dev/full", "/dev/full: full is no folder"),
        ("simulate --out d --minutes x", "--minutes takes a number, not 'x'"),
        ("simulate --out d --minutez 1", "Unrecognized options: --minutez"),
        ("commission --source sim:rig --out d --port 65536", "port = 65536 must be 1 to 65535"),
        ("run a.tauext b.parquet --speed 1e-300", "speed = 1e-300 must be > 0: 1e-6 to 1e6"),
    ],
)
def test_absurd_sizes_are_refused_in_one_line_and_leave_nothing(arguments, said, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert said in refused(capsys, *arguments.split())
    assert not list(tmp_path.iterdir())


def test_a_training_that_no_machine_finishes_is_refused():
    expect_size(TrainConfig())
    expect_size(TrainConfig(recipe="paper"))
    with pytest.raises(ConfigError, match="of memory, and"):
        expect_size(TrainConfig(recipe="tauext", batch=10**12))
    with pytest.raises(ConfigError, match="years at least"):
        expect_size(TrainConfig(recipe="dense", max_steps=10**12))


def test_the_largest_network_is_the_core_s():
    with pytest.raises(ConfigError, match="hidden = 257 must be a whole number from 1 to 256"):
        TrainConfig(hidden=MOST_HIDDEN + 1)
    assert _core.LstmShape(3, MOST_HIDDEN, 1).parameter_count > 0


def test_a_simulation_that_fails_before_its_first_recording_blocks_no_other(tmp_path, capsys, monkeypatch):
    def full(*_):
        raise ConfigError("the disk is full")

    monkeypatch.setattr(collect, "save_recording", full)
    assert "the disk is full" in refused(capsys, "simulate", "--out", tmp_path / "data", "--minutes", 1)
    assert not list(tmp_path.iterdir())


def test_what_is_no_file_is_not_read(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", tmp_path, Path("/dev/zero")):
        with pytest.raises(OSError):
            read_text(path)
    for parse in (json_of, lambda text: toml_of(f"x = {text}")):
        with pytest.raises(ValueError, match="nested too deeply"):
            parse("[" * 100_000 + "]" * 100_000)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
def test_an_output_that_is_full_is_an_error_in_one_line():
    command = [sys.executable, "-m", "tauext", "--help"]
    with open("/dev/full", "w") as full:
        ended = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
        (line,) = ended.stderr.splitlines()
        assert ended.returncode == 2 and line.startswith("tauext: error: output: cannot be read or written (")
        assert subprocess.run([*command[:-1], "show", "x"], stderr=full, check=False).returncode == 2
