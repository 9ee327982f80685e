"""LeRobot's own parser reads the settings, and those of other robots while this plugin is registered."""

from dataclasses import dataclass
from pathlib import Path

import pytest

draccus = pytest.importorskip("draccus")
pytest.importorskip("lerobot.robots")

from lerobot.robots import RobotConfig  # noqa: E402
from lerobot_robot_tauext import TauextConfig  # noqa: E402
from mock_arm import MockArmConfig  # noqa: E402


@dataclass
class Program:
    robot: RobotConfig


def test_the_command_line_names_the_arm_in_braces():
    options = ["--robot.type=tauext", "--robot.bundle=arm.tauext", "--robot.arm=arm.toml", "--robot.on_collision=hold"]
    options.append("--robot.robot={type: mock_arm, id: inner}")
    robot = draccus.parse(Program, None, options).robot
    assert isinstance(robot, TauextConfig) and robot.bundle == Path("arm.tauext") and robot.on_collision == "hold"
    assert isinstance(robot.wrapped, MockArmConfig) and robot.wrapped.id == "inner"


def test_other_robots_are_still_read():
    robot = draccus.parse(Program, None, ["--robot.type=mock_arm", "--robot.id=alone"]).robot
    assert isinstance(robot, MockArmConfig) and robot.id == "alone"


def test_an_arm_that_lerobot_does_not_know_is_named():
    with pytest.raises(ValueError, match="robot is missing"):
        TauextConfig(bundle=Path("a"), arm=Path("b"))
    unknown = TauextConfig(robot={"type": "no_such_arm"}, bundle=Path("a"), arm=Path("b"))
    with pytest.raises(ValueError, match="no_such_arm"):
        _ = unknown.wrapped
