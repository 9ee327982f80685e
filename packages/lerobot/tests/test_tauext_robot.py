# ruff: noqa: E402
"""With the real lerobot and simulated servos: recorded, replayed and labelled; held and stopped."""

from __future__ import annotations

import sys
from pathlib import Path

import lerobot_arm as arms
import numpy as np
import pyarrow.parquet as pq
import pytest

pytest.importorskip("lerobot")
make_robot = pytest.importorskip("lerobot.utils.import_utils", exc_type=ImportError)
if not hasattr(make_robot, "register_third_party_plugins"):
    pytest.skip("this lerobot knows no plugins (0.4 and later do)", allow_module_level=True)

from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.robots import RobotConfig, make_robot_from_config
from lerobot_robot_tauext import CollisionStop, Tauext, TauextConfig
from mock_arm import NAMES, MockArm, MockArmConfig, Player
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
