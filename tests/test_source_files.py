"""Files that sources read: one that breaks a rule is refused, and the message names the rule."""

from __future__ import annotations

import json

import pytest
from made_servos import ELBOW

from tauext.data.servo_types import load_lerobot_calibration
from tauext.errors import ConfigError
from tauext.sources.ur import load_torque_constants

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
    ("[nm_per_ampere]\nbasis = 1\n", ".nm_per_ampere. unknown key 'basis'; the nearest known is 'base'"),
    ("[nm_per_amp]\n", "unknown key 'nm_per_amp'"),
]


def load_ur_constants(path):
    return load_torque_constants(path, ("base",))


KINDS = [
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
        (load_lerobot_calibration, "there is no such LeRobot calibration file"),
        (load_ur_constants, "there is no such file$"),
    ],
)
def test_a_file_that_does_not_exist_is_named(tmp_path, load, message):
    with pytest.raises(ConfigError, match=message):
        load(tmp_path / "none.toml")
