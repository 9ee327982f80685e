"""Files that sources read: one that breaks a rule is refused, and the message names the rule."""

from __future__ import annotations

import json

import pytest
from made_servos import ELBOW

from tauext.data.servo_types import load_lerobot_calibration
from tauext.errors import ConfigError
from tauext.sources.damiao import load_can_bus
from tauext.sources.servo_bus_file import load_servo_bus
from tauext.sources.ur import load_torque_constants

CAN_BUS = [
    ("", "joints is missing"),
    ("[joints.a]\n", r"\[joints.a\] id is missing"),
    ("[joints.a]\nid = 0x7ff\n", "id = 2047 must be a whole number from 1 to 2046"),
    ("[joints.a]\nid = 1.5\n", "id = 1.5 must be a whole number"),
    ("[joints.a]\nid = 1\nsign = 2\n", "sign = 2 must be 1 or -1"),
    ("[joints.a]\nid = 1\nrange = 2\n", "unknown key 'range' in .joints.a.; the nearest known is 'ranges'"),
    ("[joints.a]\nid = 1\nranges = 2\n", r"ranges = 2 must be \[PMAX, VMAX, TMAX\]"),
    ("ask = false\n[joints.a]\nid = 1\n", r"ranges = \[PMAX, VMAX, TMAX\] is missing: with ask = false"),
    ("ask = 1\n[joints.a]\nid = 1\n", "ask = 1 must be true or false"),
    ("interface = 1\n[joints.a]\nid = 1\n", "interface = 1 must be one of python-can"),
    ("[joints.a]\nid = 1\n[joints.b]\nid = 0x21\nanswer_id = 0x11\n", "joints 'a' and 'b' cannot be distinguished"),
]
SERVO_BUS = [
    ("", "no joints"),
    ("baud = 1\n[joints.a]\nid = 1\n", "baud = 1 must be a whole number from 9600 to 4"),
    ("bauds = 1\n", "unknown key 'bauds' at the top; the nearest known is 'baud'"),
    ("[joints.a]\nzero = 1\n", r"\[joints.a\] id is missing"),
    ("[joints.a]\nid = 253\n", "id = 253 must be a whole number from 0 to 252"),
    ("[joints.a]\nid = 1.5\n", "id = 1.5 must be a whole number"),
    ("[joints.a]\nid = 1\nsign = 0\n", "sign = 0 must be 1 or -1"),
    ("[joints.a]\nid = 1\nsign = true\n", "sign = True must be 1 or -1"),
    ("[joints.a]\nid = 1\nmulti_turn = 1\n", "multi_turn = 1 must be true or false"),
    ("[joints.a]\nid = 1\ntype = 1\n", "type = 1 must be a servo's name"),
    ("[joints.a]\nid = 1\nzeros = 1\n", "unknown key 'zeros' in .joints.a."),
    ("[joints.a]\nid = 1\n[joints.b]\nid = 1\n", "joints 'a' and 'b' have the same id, 1"),
    ("joints = 3\n", r"joints = 3 must be tables \[joints.NAME\]"),
    ("joints.a = 3\n", r"\[joints.a\] is 3, must be a table"),
    ("calibration = 3\n", "calibration = 3 must be the path"),
    ('calibration = "none.json"\n', "none.json: there is no such LeRobot calibration file"),
    ("[", "not readable as TOML"),
]
CALIBRATION = [
    ("[", "not readable as JSON"),
    ("[]", "must be motors by name"),
    ("{}", "must be motors by name"),
    ('{"a": 3}', "motor 'a': is 3, must be a table"),
    (json.dumps({"a": {"id": 1}}), "motor 'a': drive_mode is missing"),
    (json.dumps({"a": ELBOW | {"range_min": 1.5}}), "'a': range_min = 1.5 must be a whole number"),
    (json.dumps({"a": ELBOW | {"range_min": True}}), "'a': range_min = True must be a whole number"),
    (json.dumps({"a": ELBOW | {"range_min": 3084}}), "range_min = 3084 must be below range_max = 3084"),
    (json.dumps({"a": ELBOW | {"id": 254}}), "id = 254 must be a whole number from 0 to 252"),
    (json.dumps({"a": ELBOW | {"drive_mode": -1}}), "drive_mode = -1 must be a whole number from 0 to 255"),
    (json.dumps({"a": ELBOW, "b": ELBOW}), "motors 'a' and 'b' have one id, 3"),
]
CONSTANTS = [
    ("", "nm_per_ampere is missing"),
    ("[nm_per_ampere]\nbase = 0\n", "base = 0 must be a number .*, not 0"),
    ("[nm_per_ampere]\nbase = 'x'\n", "base = 'x' must be a number"),
    ("[nm_per_ampere]\nbasis = 1\n", "unknown key 'basis' in .nm_per_ampere.; the nearest known is 'base'"),
    ("[nm_per_amp]\n", "unknown key 'nm_per_amp' at the top"),
]


def load_ur_constants(path):
    return load_torque_constants(path, ("base",))


KINDS = [
    (load_can_bus, CAN_BUS),
    (load_servo_bus, SERVO_BUS),
    (load_lerobot_calibration, CALIBRATION),
    (load_ur_constants, CONSTANTS),
]


@pytest.mark.parametrize("load, text, message", [(load, *case) for load, cases in KINDS for case in cases])
def test_a_file_that_breaks_a_rule_says_which(tmp_path, load, text, message):
    path = tmp_path / "file.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message):
        load(path)


@pytest.mark.parametrize(
    "load, message",
    [
        (load_servo_bus, "none.toml: there is no such file; docs/servo-arms.md has an example"),
        (load_lerobot_calibration, "there is no such LeRobot calibration file"),
        (load_ur_constants, "there is no such file$"),
    ],
)
def test_a_file_that_does_not_exist_is_named(tmp_path, load, message):
    with pytest.raises(ConfigError, match=message):
        load(tmp_path / "none.toml")
