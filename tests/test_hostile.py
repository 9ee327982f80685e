"""Hostile cases of tests/hostile, which draws ten thousand: every one ends as it must."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hostile.cases import KEYS, OPTIONS
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
