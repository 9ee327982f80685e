"""Hostile cases of tests/hostile, which draws ten thousand: every one ends as it must."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hostile.cases import KEYS, OPTIONS, Case
from hostile.judge import faults_of
from hostile.values import hostile_words


@pytest.mark.skipif(sys.platform != "linux", reason="limits and processes as Linux has them")
@pytest.mark.slow
def test_hostile_cases_end_as_they_must():
    program = Path(__file__).with_name("hostile")
    command = [sys.executable, str(program), "--quick", "--cases", "100", "--seed", "100"]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert "| all | 100 |" in ended.stdout


def test_the_options_of_every_command_are_found():
    names = {option.name for option in OPTIONS["train"]}
    assert {"--data", "--config", "--max-steps", "--in-hours", "--seed"} <= names
    assert {"max_steps", "observer.gain_per_s", "alarm.holds_s"} <= {name for name, _ in KEYS}
    assert "--json" in {option.name for option in OPTIONS["run"]}
    assert "--ros2.topic" in {option.name for option in OPTIONS["monitor"]}
    words = {tuple(hostile_words(OPTIONS["simulate"][1], np.random.default_rng(k))) for k in range(200)}
    assert ("--minutes", "inf") in words and ("--minutes", "-1") in words


@pytest.mark.parametrize(
    ("status", "error", "fault"),
    [
        (2, "tauext: error: seed = -1 must be 0 or more\n", ""),
        (2, "tauext: error: one\ntauext: error: two\n", "2 lines of error"),
        (2, "said something else\n", "0 lines of error"),
        (1, "Traceback (most recent call last):\n", "traceback"),
        (1, "", "exit status 1 belongs to check alone"),
        (3, "", "exit status 3"),
        (-11, "", "crashed with signal 11 (SIGSEGV)"),
        (0, "x.py:3: RuntimeWarning: overflow\n", "beside its own words"),
    ],
)
def test_the_judge_tells_a_bad_ending_from_a_good_one(status, error, fault, tmp_path):
    faults = faults_of(Case("options", ["simulate"], ""), status, error, "", tmp_path)
    assert (fault in "; ".join(faults)) if fault else not faults


def test_the_judge_finds_what_is_left_half_written(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out/a.run.json").write_text("{}")
    line = "tauext: error: no\n"
    assert "refused, and left out/a.run.json" in faults_of(Case("output", ["train"], ""), 2, line, "", tmp_path)
    (tmp_path / "out/a.run.json").write_text("{")
    assert any("half-written" in fault for fault in faults_of(Case("output", ["train"], ""), 0, "", "", tmp_path))
    (tmp_path / "out/a.run.json").unlink()
    (tmp_path / "out/a.tauext.part").touch()
    assert "left out/a.tauext.part" in faults_of(Case("output", ["run"], ""), 0, "", "", tmp_path)
