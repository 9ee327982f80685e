"""An arm on a topic describes itself before a bundle exists: joints, rate, publisher, and what its effort is."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import pytest
from made_ros2 import DOMAIN, Robot, own_space

pytest.importorskip("cyclonedds")

from tauext_commission import connect as connecting
from tauext_commission.connect import connect, settled
from tauext_lab.sim.source import write_robot_file
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


@pytest.mark.slow
@pytest.mark.parametrize(("factor", "code"), [(1.0, ""), (-1.0, "effort-sign"), (0.09, "effort-scale")])
def test_an_arm_in_another_process_is_described_and_its_effort_judged_within_ten_seconds(
    factor, code, request, tmp_path, monkeypatch
):
    monkeypatch.setattr(connecting, "LOOK_S", 10.0)
    settings = Ros2Settings(topic=f"{own_space(request)}/joint_states", domain=DOMAIN)
    arm = [sys.executable, str(Path(__file__).with_name("made_ros2_arm.py")), str(DOMAIN), settings.topic, str(factor)]
    process = subprocess.Popen(arm)
    try:
        options = {"ros2": settings}
        connected = connect(lambda: open_source("ros2", options)[0], write_robot_file("rig", tmp_path), wait_s=30.0)
    finally:
        process.kill()
        process.wait()
    assert connected.facts.settings.joints == ("joint1", "joint2")
    assert connected.facts.settings.period_ns == 4_000_000 and connected.facts.signal == "unknown"
    faults = {live.code for live in connected.lives if live.severity == "fault"}
    assert faults == ({code} if code else set()), connected.lives
    assert settled(connected.facts, connected.lives).signal == ("current" if code == "effort-scale" else "unknown")
