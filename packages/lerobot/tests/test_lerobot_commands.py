# ruff: noqa: E402
"""lerobot-record and lerobot-replay themselves, as a user runs them, on simulated servos."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import lerobot_arm as arms
import numpy as np
import pytest

pytest.importorskip("lerobot")
record_command = pytest.importorskip("lerobot.scripts.lerobot_record", exc_type=ImportError)
replay_command = pytest.importorskip("lerobot.scripts.lerobot_replay", exc_type=ImportError)

from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig
from mock_arm import NAMES, Player, Plug
from tauext_lerobot.labels import label_dataset

import tauext
from tauext.data.description import load_arm

EPISODES, SECONDS = 2, 3


@TeleoperatorConfig.register_subclass("mock_leader")
@dataclass(kw_only=True)
class MockLeaderConfig(TeleoperatorConfig):
    """A leader that plays a demonstration."""


class MockLeader(Plug, Teleoperator):
    config_class = MockLeaderConfig
    name = "mock_leader"
    action_features = dict.fromkeys(NAMES, float)
    feedback_features: dict = {}

    def __init__(self, config: MockLeaderConfig):
        super().__init__(config)
        self._player = Player(101)

    def get_action(self) -> dict:
        return self._player.action()

    def send_feedback(self, feedback: dict) -> None:
        pass


def run(command, monkeypatch, *options: object) -> None:
    """Its main(), with these options."""
    monkeypatch.setattr(sys, "argv", ["lerobot", *map(str, options)])
    command.main()


@pytest.fixture
def home(tmp_path, monkeypatch):
    """No calibration of an arm that is there, and nothing asked over the network."""
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    return tmp_path


def robot_options(trained: Path, **settings: str) -> list[str]:
    inner = "{type: mock_arm, id: inner}"
    options = ["type=tauext", "id=test", f"bundle={trained / 'arm.tauext'}", f"arm={trained / 'arm.toml'}"]
    options += [f"robot={inner}", *(f"{name}={value}" for name, value in settings.items())]
    return [f"--robot.{option}" for option in options]


@pytest.mark.parametrize("on_collision", ["none", "hold"])
def test_a_recording_of_lerobots_command_has_the_features_and_gives_them_again(
    trained, home, monkeypatch, on_collision
):
    settings = {} if on_collision == "none" else {"on_collision": on_collision}
    robot = robot_options(trained, **settings)
    dataset = [
        "repo_id=test/recorded", f"root={home / 'recorded'}", "single_task=follow", f"fps={arms.FPS}",
        f"episode_time_s={SECONDS}", "reset_time_s=0.5", f"num_episodes={EPISODES}", "push_to_hub=false", "video=false",
    ]  # fmt: skip
    options = [*robot, "--teleop.type=mock_leader", *(f"--dataset.{one}" for one in dataset), "--play_sounds=false"]
    run(record_command, monkeypatch, *options)
    (root,) = [path for path in home.glob("recorded*") if (path / "meta").is_dir()]
    kept = LeRobotDataset("test/recorded", root=root)
    names = kept.features["observation.state"]["names"]
    added = [f"{motor}.tau_ext" for motor in arms.MOTORS] + ["contact", "collision"]
    assert names[-len(added) :] == added
    # A loaded machine drops frames, never half of them.
    assert kept.num_episodes == EPISODES and kept.num_frames > EPISODES * SECONDS * arms.FPS / 2
    state = np.stack([np.asarray(row) for row in kept.hf_dataset["observation.state"]])
    assert np.isfinite(state[-1]).all() and state[-1, -2] in (0, 1)
    bundle, arm = tauext.load_bundle(trained / "arm.tauext"), load_arm(trained / "arm.toml")
    report = label_dataset(root, bundle, arm, home / "again")
    assert report.held == report.equal == report.frames == kept.num_frames
    replayed = ["repo_id=test/recorded", f"root={root}", "episode=1", f"fps={arms.FPS}"]
    run(replay_command, monkeypatch, *robot, *(f"--dataset.{one}" for one in replayed), "--play_sounds=false")
