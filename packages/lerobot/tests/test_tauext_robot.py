# ruff: noqa: E402
"""With the real lerobot and simulated servos: recorded, replayed and labelled; held and stopped; its settings."""

from __future__ import annotations

import sys
from dataclasses import dataclass, make_dataclass
from pathlib import Path

import lerobot_arm as arms
import numpy as np
import pyarrow.parquet as pq
import pytest

pytest.importorskip("lerobot")
make_robot = pytest.importorskip("lerobot.utils.import_utils", exc_type=ImportError)
if not hasattr(make_robot, "register_third_party_plugins"):
    pytest.skip("this lerobot knows no plugins (0.4 and later do)", allow_module_level=True)

import draccus
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.robots import RobotConfig, make_robot_from_config
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig
from lerobot_robot_tauext import CollisionStop, Tauext, TauextConfig
from mock_arm import NAMES, MockArm, MockArmConfig, Player, Plug
from tauext_lerobot.labels import label_dataset

import tauext
from tauext.data.description import load_arm

ADDED = ["shoulder.tau_ext", "elbow.tau_ext", "wrist.tau_ext", "contact", "collision"]
SEED, WALL = 101, 120


def wrapped(trained: Path, wall_at: int = 0, inner: dict | None = None, **settings) -> Tauext:
    config = TauextConfig(
        id="test",
        calibration_dir=trained / "calibration",
        robot=MockArmConfig(id="inner", calibration_dir=trained / "calibration", wall_at=wall_at, **(inner or {})),
        bundle=trained / "arm.tauext",
        arm=trained / "arm.toml",
        **settings,
    )
    robot = make_robot_from_config(config)
    assert isinstance(robot, Tauext) and isinstance(robot.robot, MockArm)
    robot.connect()
    return robot


def record(robot: Tauext, root: Path, episodes: int = 3, frames: int = 150, added=ADDED) -> list[np.ndarray]:
    """As lerobot-record does; what the robot said of each recorded frame is returned, an array an episode."""
    from lerobot.datasets import aggregate_pipeline_dataset_features, create_initial_features
    from lerobot.processor import make_default_processors
    from lerobot.utils.feature_utils import build_dataset_frame, combine_feature_dicts

    teleop, _, observation = make_default_processors()
    features = combine_feature_dicts(
        aggregate_pipeline_dataset_features(
            pipeline=teleop, initial_features=create_initial_features(action=robot.action_features)
        ),
        aggregate_pipeline_dataset_features(
            pipeline=observation, initial_features=create_initial_features(observation=robot.observation_features)
        ),
    )
    dataset = LeRobotDataset.create("test/arm", arms.FPS, features, root=root, robot_type=robot.name, use_videos=False)
    player, said = Player(SEED), []
    for number in range(episodes):
        of_episode = []
        for k in range(frames + 10):  # ten ticks of reset after each
            seen = robot.get_observation()
            action = player.action()
            robot.send_action(action)
            if k >= frames:
                continue
            of_episode.append([seen[name] for name in added])
            frame = build_dataset_frame(dataset.features, seen, prefix="observation")
            frame |= build_dataset_frame(dataset.features, action, prefix="action")
            dataset.add_frame({**frame, "task": "follow"})
        if number == 1:
            dataset.clear_episode_buffer()  # to be recorded again
            continue
        dataset.save_episode()
        said.append(np.array(of_episode))
    dataset.finalize()
    return said


def held(root: Path) -> tuple[LeRobotDataset, dict[str, np.ndarray]]:
    dataset = LeRobotDataset("test/arm", root=root)
    state = np.stack([np.asarray(row) for row in dataset.hf_dataset["observation.state"]])
    names = dataset.features["observation.state"]["names"]
    return dataset, dict(zip(names, state.T, strict=True)) | {
        "episode": np.asarray(dataset.hf_dataset["episode_index"])
    }


def test_lerobot_finds_it_by_its_name(trained):
    make_robot.register_third_party_plugins()
    assert RobotConfig.get_choice_class("tauext") is TauextConfig
    assert "lerobot_robot_tauext" in sys.modules


def loaded(trained: Path):
    return tauext.load_bundle(trained / "arm.tauext"), load_arm(trained / "arm.toml")


@pytest.mark.parametrize("settings", [{}, {"on_collision": "hold"}])
def test_a_recorded_dataset_gives_the_same_again_to_the_last_bit(trained, tmp_path, settings):
    robot = wrapped(trained, wall_at=380, **settings)
    said = record(robot, tmp_path / "recorded")
    dataset, columns = held(tmp_path / "recorded")
    assert dataset.num_episodes == 2
    goals = [f"{name}.goal" for name in arms.MOTORS] if settings else []
    assert list(dataset.features["observation.state"]["names"]) == [*NAMES, *goals, *ADDED]
    for number, live in enumerate(said):
        stored = np.array([columns[name][columns["episode"] == number] for name in ADDED]).T
        np.testing.assert_array_equal(stored, live)
        assert (stored[0, -2:] == -1).all() and (stored[-1, -2:] >= 0).all()
    assert (columns["contact"] == 1).any()
    report = label_dataset(tmp_path / "recorded", *loaded(trained), tmp_path / "again")
    assert report.held == report.equal == report.frames == 300
    again = held(tmp_path / "again")[1]
    for name, values in columns.items():
        np.testing.assert_array_equal(again[name], values)


def test_a_dataset_of_state_and_action_gets_what_the_robot_would_have_sent(trained, tmp_path):
    """Recorded without tauext, labelled after; lerobot reads it, and its statistics are lerobot's."""
    from lerobot.datasets.compute_stats import compute_episode_stats

    live = wrapped(trained, wall_at=WALL)
    record(live, tmp_path / "with")
    plain = wrapped(trained, wall_at=WALL).robot
    plain.start_episode = lambda: None
    record(plain, tmp_path / "without", added=())
    label_dataset(tmp_path / "without", *loaded(trained), tmp_path / "labelled")
    dataset, columns = held(tmp_path / "labelled")
    for name, values in held(tmp_path / "with")[1].items():
        np.testing.assert_array_equal(columns[name], values)
    assert dataset[0]["observation.state"].shape == (8,) and dataset.meta.features["observation.state"]["shape"] == (8,)
    recorded_stats = LeRobotDataset("test/arm", root=tmp_path / "with").meta.stats["observation.state"]
    for kind, value in dataset.meta.stats["observation.state"].items():
        near = 0.1 if kind.startswith("q") else 1e-5  # lerobot reads quantiles off a histogram
        np.testing.assert_allclose(value, recorded_stats[kind], rtol=1e-5, atol=near)
    state = np.stack([np.asarray(row) for row in dataset.hf_dataset["observation.state"]])[:150]
    features = {"observation.state": dataset.features["observation.state"]}
    own = compute_episode_stats({"observation.state": state}, features)["observation.state"]["std"]
    row = pq.read_table(tmp_path / "labelled/meta/episodes/chunk-000/file-000.parquet").to_pylist()[0]
    np.testing.assert_allclose(row["stats/observation.state/std"], own, rtol=1e-3, atol=1e-6)


def test_a_collision_is_held_in_the_tick_that_finds_it(trained):
    robot, player = wrapped(trained, wall_at=WALL, on_collision="hold"), Player(SEED)
    before = None
    for _ in range(400):
        sent = len(robot.robot.sent)
        seen = robot.get_observation()
        if seen["collision"] == 1:
            before = {name: seen[name] for name in NAMES}
            assert robot.robot.sent[sent:] == [before]  # in this very call
            break
        robot.send_action(player.action())
    assert before is not None
    far = {name: value + 30 for name, value in before.items()}
    for _ in range(20):
        assert robot.send_action(far) == before
        seen = robot.get_observation()
    robot.robot.arm.wall = None
    for _ in range(60):  # the goal comes back to where the arm stands, and nothing touches it any more
        robot.send_action(before)
        robot.get_observation()
    near = {name: value + 1 for name, value in before.items()}
    assert robot.send_action(near) == near


def test_a_stop_ends_the_program_and_holds(trained):
    robot, player = wrapped(trained, wall_at=WALL, on_collision="stop"), Player(SEED)
    with pytest.raises(CollisionStop, match="the arm collided .* check what it touches"):
        for _ in range(400):
            seen = robot.get_observation()
            robot.send_action(player.action())
    assert robot.robot.sent[-1] == pytest.approx({name: robot.robot.sent[-1][name] for name in NAMES})
    with pytest.raises(CollisionStop, match="is stopped"):
        robot.send_action(player.action())
    assert seen["collision"] == 0
    robot.connect()
    assert robot.get_observation()["contact"] == -1


def test_a_clipped_goal_is_recorded(trained):
    robot = wrapped(trained, inner={"max_relative_target": 5.0})
    assert "elbow.goal" in robot.observation_features


def test_wrong_settings_are_refused(trained):
    with pytest.raises(ValueError, match="on_collision = 'freeze' must be one of none, hold, stop"):
        wrapped(trained, on_collision="freeze")
    with pytest.raises(ValueError, match="resume_within = 0 must be > 0"):
        wrapped(trained, resume_within=0)


# --- Settings, by LeRobot's own parser.


Program = make_dataclass("Program", [("robot", RobotConfig)])  # with the type itself, not its name


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


# --- lerobot-record and lerobot-replay themselves, as a user runs them.


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
    lerobot_record = pytest.importorskip("lerobot.scripts.lerobot_record", exc_type=ImportError)
    lerobot_replay = pytest.importorskip("lerobot.scripts.lerobot_replay", exc_type=ImportError)
    settings = {} if on_collision == "none" else {"on_collision": on_collision}
    robot = robot_options(trained, **settings)
    dataset = [
        "repo_id=test/recorded", f"root={home / 'recorded'}", "single_task=follow", f"fps={arms.FPS}",
        f"episode_time_s={SECONDS}", "reset_time_s=0.5", f"num_episodes={EPISODES}", "push_to_hub=false", "video=false",
    ]  # fmt: skip
    options = [*robot, "--teleop.type=mock_leader", *(f"--dataset.{one}" for one in dataset), "--play_sounds=false"]
    run(lerobot_record, monkeypatch, *options)
    (root,) = [path for path in home.glob("recorded*") if (path / "meta").is_dir()]
    kept = LeRobotDataset("test/recorded", root=root)
    names = kept.features["observation.state"]["names"]
    assert names[-len(ADDED) :] == ADDED
    # A loaded machine drops frames, never half of them.
    assert kept.num_episodes == EPISODES and kept.num_frames > EPISODES * SECONDS * arms.FPS / 2
    state = np.stack([np.asarray(row) for row in kept.hf_dataset["observation.state"]])
    assert np.isfinite(state[-1]).all() and state[-1, -2] in (0, 1)
    report = label_dataset(root, *loaded(trained), home / "again")
    assert report.held == report.equal == report.frames == kept.num_frames
    replayed = ["repo_id=test/recorded", f"root={root}", "episode=1", f"fps={arms.FPS}"]
    run(lerobot_replay, monkeypatch, *robot, *(f"--dataset.{one}" for one in replayed), "--play_sounds=false")
