"""Angles from LeRobot's calibration files, against LeRobot's own equations written once more, from counts to values."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from made_servos import ELBOW
from tauext_lerobot.calibration import MotorCalibration, load_lerobot_calibration

from tauext.errors import ConfigError


def normalised_by_lerobot(count: int, motor: MotorCalibration, lowest: float, turned: bool) -> np.float32:
    """LeRobot 0.6, motors_bus.py `_normalize`: bounded, scaled, turned round by drive_mode where the bus does that."""
    bounded = min(motor.range_max, max(motor.range_min, count))
    share = (bounded - motor.range_min) / (motor.range_max - motor.range_min)
    if lowest == 0:
        value = share * 100
        return np.float32(100 - value if turned and motor.drive_mode else value)
    value = share * 200 - 100
    return np.float32(-value if turned and motor.drive_mode else value)


@pytest.mark.parametrize("drive_mode, turned", [(0, True), (1, True), (1, False)])
@pytest.mark.parametrize("lowest", [-100.0, 0.0])
def test_every_count_comes_back_from_the_value_that_lerobot_stores(lowest, drive_mode, turned):
    motor = MotorCalibration("elbow", 3, drive_mode, 0, 871, 3084)
    counts = np.arange(871, 3085)
    stored = np.array([normalised_by_lerobot(k, motor, lowest, turned) for k in counts])
    q = motor.radians_of_normalised(stored, lowest, turned)
    np.testing.assert_array_equal(q, (counts - 1977.5) * 2 * math.pi / 4096)
    assert q[0] < 0 < q[-1]  # angles rise with counts, whichever way the values run
    np.testing.assert_array_equal(q, motor.radians_of_counts(counts))


def test_a_goal_is_the_count_that_lerobot_sends():
    motor = MotorCalibration("elbow", 3, 0, 0, 871, 3084)
    rng = np.random.default_rng(3)
    action = rng.uniform(-100, 100, 500).astype(np.float32)
    sent = [int(((float(a) + 100) / 200) * (3084 - 871) + 871) for a in action]  # LeRobot 0.6, `_unnormalize`
    np.testing.assert_array_equal(motor.radians_of_normalised(action, sent=True), motor.radians_of_counts(sent))


def test_what_was_not_measured_stays_so_and_other_units_are_refused():
    motor = MotorCalibration("elbow", 3, 0, 0, 871, 3084)
    assert np.isnan(motor.radians_of_normalised(np.array([np.nan, 0.0]))[0])
    with pytest.raises(ConfigError, match="'elbow': -170.5 is no value from -100 to 100; is it in degrees"):
        motor.radians_of_normalised(np.array([3.0, np.nan, -170.5]))
    with pytest.raises(ConfigError, match="'elbow': -1 is no value from 0 to 100"):
        motor.counts_of_normalised(np.array([-1.0]), lowest=0.0)


def test_a_file_of_lerobot_is_read(tmp_path):
    path = tmp_path / "my_follower.json"
    path.write_text(json.dumps({"elbow_flex": ELBOW, "gripper": ELBOW | {"id": 6, "drive_mode": 1}}))
    motors = load_lerobot_calibration(path)
    assert motors["elbow_flex"] == MotorCalibration("elbow_flex", 3, 0, -1470, 871, 3084)
    assert motors["gripper"].id == 6 and motors["gripper"].drive_mode == 1 and list(motors) == ["elbow_flex", "gripper"]


BROKEN = [
    ("[", "not readable as JSON"),
    ("{}", "must be motors by name"),
    ('{"a": 3}', "motor 'a': is 3, must be a table"),
    (json.dumps({"a": {"id": 1}}), "motor 'a': drive_mode is missing"),
    (json.dumps({"a": ELBOW | {"range_min": 1.5}}), "'a': range_min = 1.5 must be a whole number"),
    (json.dumps({"a": ELBOW | {"range_min": 3084}}), "range_min = 3084 must be below range_max = 3084"),
    (json.dumps({"a": ELBOW | {"id": 254}}), "id = 254 must be a whole number from 0 to 252"),
    (json.dumps({"a": ELBOW, "b": ELBOW}), "motors 'a' and 'b' have one id, 3"),
]


@pytest.mark.parametrize("text, message", BROKEN)
def test_a_file_that_breaks_a_rule_is_refused_by_the_rule(tmp_path, text, message):
    path = tmp_path / "my_follower.json"
    with pytest.raises(ConfigError, match="there is no such LeRobot calibration file"):
        load_lerobot_calibration(path)
    path.write_text(text)
    with pytest.raises(ConfigError, match=message):
        load_lerobot_calibration(path)
