"""Buses of serial servos: their files, ours and LeRobot's, and what the commands refuse in one line.

docs/servo-arms.md: its arm.toml and its bus file; README.md: its Python.
"""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pytest
from doc_pages import Page
from made_bundles import watching_bundle
from made_servos import ELBOW
from tauext_lerobot.servo_bus_file import ServoJoint, servo_bus

from tauext.cli import main
from tauext.data.description import parse_arm
from tauext.errors import ConfigError
from tauext.monitor.cell_file import load_cell


def test_a_calibration_of_lerobot_describes_joints(tmp_path):
    (tmp_path / "arm.json").write_text(json.dumps({"elbow_flex": ELBOW, "grip": ELBOW | {"id": 6}}))
    elbow = ServoJoint("elbow_flex", 3, 1977.5, 1, homing_offset=-1470)
    path = tmp_path / "cell.toml"
    path.write_text(
        '[bus]\ncalibration = "arm.json"\nbaud = 500000\n[bus.joints.grip]\nsign = -1\n[bus.joints.extra]\nid = 7\n'
    )
    file = servo_bus(load_cell(path))
    assert file.baud == 500_000 and list(file.joints) == ["elbow_flex", "grip", "extra"]
    assert file.joints["elbow_flex"] == elbow
    assert file.joints["grip"] == ServoJoint("grip", 6, 1977.5, -1, homing_offset=-1470)


SERVO_BUS = [
    ("[bus]\n", "no joints"),
    ("[bus]\nbaud = 1\n[bus.joints.a]\nid = 1\n", "baud = 1 must be a whole number from 9600 to 4"),
    ("[bus]\nbauds = 1\n", "unknown key 'bauds'; the nearest known is 'baud'"),
    ("[bus]\n[bus.joints.a]\nzero = 1\n", r"\[bus.joints.a\] id is missing"),
    ("[bus]\n[bus.joints.a]\nid = 253\n", "id = 253 must be a whole number from 0 to 252"),
    ("[bus]\n[bus.joints.a]\nid = 1\nsign = true\n", "sign = True must be one of 1, -1"),
    ("[bus]\n[bus.joints.a]\nid = 1\nmulti_turn = 1\n", "multi_turn = 1 must be true or false"),
    ("[bus]\n[bus.joints.a]\nid = 1\ntype = 1\n", "type = 1 must be text"),
    ("[bus]\n[bus.joints.a]\nid = 1\nzeros = 1\n", ".bus.joints.a. unknown key 'zeros'"),
    ("[bus]\n[bus.joints.a]\nid = 1\n[bus.joints.b]\nid = 1\n", "joints 'a' and 'b' have the same id, 1"),
    ("[bus]\njoints.a = 3\n", r"a = 3 must be|is 3, must be"),
    ('[bus]\ncalibration = "none.json"\n', "none.json: there is no such LeRobot calibration file"),
]


@pytest.mark.parametrize("text, message", SERVO_BUS)
def test_a_file_that_breaks_a_rule_says_which(tmp_path, text, message):
    path = tmp_path / "file.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message):
        servo_bus(load_cell(path))


MONITOR = "monitor watching.tauext --source"
COMMISSION = "commission --out cell --no-page --source"


@pytest.mark.parametrize(
    ("words", "error"),
    [
        (f"{MONITOR} feetech:/dev/ttyACM0", "--source feetech:PORT needs --cell FILE with a table [bus]"),
        (f"{MONITOR} damiao:can0", "--source damiao:CAN needs --cell FILE with a table [bus]"),
        (f"{MONITOR} dynamixel:/dev/ttyUSB0 --cell none.toml", "none.toml: there is no such file; docs/running.md"),
        (f"{MONITOR} feetech", "--source 'feetech' must be one of replay:FILE, ur:HOST"),
        (f"{COMMISSION} feetech:/dev/null", "needs --cell FILE with a table [bus]"),
        (f"{COMMISSION} damiao:can0 --cell cell.toml", "has no way to stop its robot"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(words, error, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    watching_bundle().save("watching.tauext")
    (tmp_path / "cell.toml").write_text('[bus.joints.a]\nid = 1\n[reactions.r]\non = ["collision"]\nstop = true\n')
    assert main(words.split()) == 2
    said = capsys.readouterr().err
    assert said.startswith("tauext: error: ") and error in said and said.count("\n") == 1
    assert not (tmp_path / "cell").exists()


PAGE = "servo-arms.md"


def test_the_files_of_the_page_are_valid(tmp_path):
    arm, guard, bus = Page(PAGE).blocks("toml")
    assert "[grip]" in guard  # what a guard learned: test_guard.py reads it
    assert parse_arm(arm).servo.torque_from == "goal"
    (tmp_path / "my_follower.json").write_text(json.dumps({"shoulder_pan": ELBOW | {"id": 1}}))
    (tmp_path / "cell.toml").write_text(bus)
    joint = servo_bus(load_cell(tmp_path / "cell.toml")).joints["shoulder_pan"]
    assert joint == ServoJoint("shoulder_pan", 1, 2048.0, -1, False, "sts3215", -1470)


def test_the_leader_feedback_of_the_readme_runs():
    (program,) = Page("../packages/lerobot/README.md").blocks("python")
    rng = np.random.default_rng(0)
    ok, ticks = object(), iter([5.0, 5.0])

    def latest():
        return SimpleNamespace(tau_ext=np.full(6, next(ticks)), sigma_nm=np.full(6, 0.1), health=ok)

    here = {
        "estimates": SimpleNamespace(tau_ext=0.1 * rng.standard_normal((99, 6)), sigma_nm=np.full((99, 6), 0.1)),
        "latest": latest, "q_leader": np.zeros(6), "dt_s": 0.02, "Health": SimpleNamespace(ok=ok),
    }  # fmt: skip
    with pytest.raises(StopIteration):
        exec(program, here)
    assert (here["torque_nm"] > 0).all()
