"""Bus files of serial servos: ours, LeRobot's calibration, and what is refused."""

from __future__ import annotations

import json

from made_servos import ELBOW

from tauext.sources.servo_bus_file import TEMPLATE, ServoJoint, load_servo_bus


def test_the_template_is_a_bus_file(tmp_path):
    path = tmp_path / "bus.toml"
    path.write_text(TEMPLATE)
    file = load_servo_bus(path)
    assert file.joints == {"shoulder_pan": ServoJoint("shoulder_pan", 1)} and file.baud == 1_000_000
    path.write_text(
        TEMPLATE.replace("\n# sign", "\nsign").replace("\n# multi", "\nmulti").replace("\n# type", "\ntype")
    )
    assert load_servo_bus(path).joints["shoulder_pan"] == ServoJoint("shoulder_pan", 1, 2048.0, -1, True, "sts3215")


def test_a_calibration_of_lerobot_is_a_bus_file_or_the_beginning_of_one(tmp_path):
    (tmp_path / "arm.json").write_text(json.dumps({"elbow_flex": ELBOW, "grip": ELBOW | {"id": 6}}))
    elbow = ServoJoint("elbow_flex", 3, 1977.5, 1, homing_offset=-1470)
    assert load_servo_bus(tmp_path / "arm.json").joints["elbow_flex"] == elbow
    path = tmp_path / "bus.toml"
    path.write_text('calibration = "arm.json"\nbaud = 500000\n[joints.grip]\nsign = -1\n[joints.extra]\nid = 7\n')
    file = load_servo_bus(path)
    assert file.baud == 500_000 and list(file.joints) == ["elbow_flex", "grip", "extra"]
    assert file.joints["elbow_flex"] == elbow
    assert file.joints["grip"] == ServoJoint("grip", 6, 1977.5, -1, homing_offset=-1470)
