"""An arm on a topic describes itself before a bundle exists: joints, rate and publisher."""

from __future__ import annotations

import threading
import time
from dataclasses import replace

import pytest
from made_ros2 import DOMAIN, Robot, own_space

pytest.importorskip("cyclonedds")

from tauext_ros2.settings import Ros2Settings

from tauext.errors import ConfigError
from tauext.monitor.source import SourceFacts, SourceSettings
from tauext.robot.write import write_placeholder
from tauext.sources.open import open_source

WAIT_S = 20.0


@pytest.mark.slow
def test_joints_rate_and_publisher_are_found_out(request, tmp_path):
    settings = Ros2Settings(topic=own_space(request) + "/joint_states", domain=DOMAIN)

    def described(wait_s: float, robot=None, **changed) -> SourceFacts:
        source, _ = open_source("ros2", {"ros2": replace(settings, **changed)})
        return source.describe(wait_s, robot)

    with pytest.raises(ConfigError, match="no publisher of sensor_msgs/JointState in domain"):
        described(0.3)
    arm, gripper = Robot(settings, ("b", "a"), 4_000_000), Robot(settings, ("finger_joint",), 1_000_000)
    ended = threading.Event()
    fields: dict = {}

    def drive() -> None:
        while not ended.wait(0.004):
            arm.send(**fields)
            gripper.send(4)

    thread = threading.Thread(target=drive, daemon=True)
    thread.start()
    try:
        facts = described(WAIT_S)
        assert facts.settings == SourceSettings(("b", "a"), 4_000_000, ("N m", "N m"), "instant")
        assert facts.signal == "unknown" and "until the arm's motion shows another kind" in facts.notes[-1]
        ordered = described(WAIT_S, write_placeholder(["a", "b", "c"], tmp_path))
        assert ordered.settings.joints == ("a", "b")
        fields["effort"] = []
        time.sleep(0.05)
        with pytest.raises(ConfigError, match="effort is empty"):
            described(0.5, names=("a", "b"))
        fields["effort"] = [float("nan"), 1.0]
        with pytest.raises(ConfigError, match="no finite position, velocity and effort of b"):
            described(0.5, names=("a", "b"))
    finally:
        ended.set()
        thread.join()
