"""The dataset folder that the virtual rig writes."""

import json
from dataclasses import replace

import numpy as np
import pytest
from tauext_lab.sim import collect
from tauext_lab.sim.collect import simulate_dataset, simulate_motion
from tauext_lab.sim.config import RigConfig, changed_rig
from tauext_lab.sim.rig import arm_xml, draw_motion, low_pass

from tauext import _core
from tauext.cli import main
from tauext.data.dataset import load_split
from tauext.data.recording_file import load_recording
from tauext.errors import ConfigError
from tauext.robot.read import load_tree, robot_sha256

SMALL = replace(RigConfig(), collision_recording_s=12.0, collisions_per_recording=1)


def simulate_small(folder, progress=None, **changed):
    settings = {"config": SMALL, "seed": 5, "minutes": 1.0, "collision_recordings": 2} | changed
    simulate_dataset(folder, progress=progress, **settings)


def content(folder):
    """Bytes of every file but the wall time."""
    return {p.name: p.read_bytes() for p in sorted(folder.iterdir()) if p.name != "wall_time_s.json"}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rig") / "data"
    simulate_small(folder)
    return folder


def test_folder_holds_what_the_contract_says(dataset):
    split = load_split(dataset)
    assert [len(getattr(split, part)) for part in ("train", "validation", "test", "collisions")] == [14, 3, 3, 2]
    names = {*split.train, *split.validation, *split.test, *split.collisions}
    assert {p.name for p in dataset.iterdir()} == names | {
        "robot.xml",
        "split.json",
        "run.json",
        "wall_time_s.json",
    }
    assert json.loads((dataset / "run.json").read_text())["settings"]["config"]["friction"][0]["coulomb_nm"] > 0
    sha256 = robot_sha256(dataset / "robot.xml")
    kinds = []
    for name in split.collisions + split.train[:2]:
        recording = load_recording(dataset / name)
        assert recording.robot_sha256 == sha256 and recording.torque_timing == "held"
        assert recording.rate_hz == 1000.0 and recording.joints == ("joint1", "joint2")
        assert recording.tau_jts is not None and recording.tau_ext_sensor is not None and recording.q_des is not None
        kinds.append(recording.provenance["contacts"])
    assert kinds == ["pulses", "pads", "none", "none"]


def test_robot_file_has_rotor_inertia_and_the_right_weight(dataset):
    tree = load_tree(dataset / "robot.xml", joints=["joint1", "joint2"])
    assert [link.rotor_inertia for link in tree.links] == [0.6, 0.25]
    assert [link.mass for link in tree.links] == [8.191, 9.920]
    flat = np.array([[np.pi / 2, 0.0]])  # stretched out level: the paper's masses give 54.5 and 15.6 N m
    weight = -hold(tree, flat)
    np.testing.assert_allclose(np.abs(weight), [54.55, 15.65], atol=0.01)


def hold(tree, q):
    """Residual of an observer at rest at q without motor torque, which is -gravity's."""
    n = 1000
    observation = observe(tree, np.tile(q, (n, 1)), np.zeros((n, 2)), np.zeros((n, 2)))
    return observation[-1]


def observe(tree, q, dq, tau):
    settings = _core.ObserverSettings(
        gain_per_s=20.0, timing=_core.TorqueTiming.held, sample_period_ns=1_000_000, network_stride=10
    )
    t_ns = np.arange(len(q), dtype=np.int64) * 1_000_000
    return _core.observe(tree, settings, t_ns, *(np.ascontiguousarray(x) for x in (q, dq, tau))).residual


@pytest.mark.parametrize("kind", ["pulses", "pads"])
def test_observer_of_the_exact_model_finds_external_torque_less_friction(tmp_path, kind):
    robot = tmp_path / "robot.xml"
    robot.write_text(arm_xml(SMALL, true_com=True))
    q_des, dq_des = draw_motion(SMALL.motion, 2, 12_000, SMALL.rate_hz, np.random.default_rng(8))
    truth, tau_ext, _ = simulate_motion(SMALL, kind, q_des, dq_des, 1000, np.random.default_rng(9))
    residual = observe(load_tree(robot), truth.q, truth.dq, truth.drive)
    # Sample k acts until k + 1, when the observer sees it.
    expected = low_pass(tau_ext - truth.friction, 20.0, 1e-3)[:-1]
    difference = (residual[1:] - expected)[500:]
    # beta is known at both ends of a step only, Euler takes it from the first: O(dt) of Coriolis and gravity.
    assert np.abs(difference).max() < 0.1


def test_same_seed_gives_the_same_bytes_for_any_number_of_threads(dataset, tmp_path, monkeypatch):
    monkeypatch.setattr(collect.os, "cpu_count", lambda: 1)
    simulate_small(tmp_path / "again")
    assert content(tmp_path / "again") == content(dataset)


def test_another_seed_gives_other_recordings(dataset, tmp_path):
    simulate_small(tmp_path / "other", seed=6, collision_recordings=0)
    other = load_recording(tmp_path / "other/free-000.parquet")
    assert not np.array_equal(other.q, load_recording(dataset / "free-000.parquet").q)


def test_interrupted_run_goes_on_where_it_stopped(dataset, tmp_path):
    def interrupt(what, done, total):
        if done == 5:
            raise KeyboardInterrupt

    folder = tmp_path / "data"
    with pytest.raises(KeyboardInterrupt):
        simulate_small(folder, interrupt)
    assert not (folder / "split.json").exists() and not list(folder.glob("*.part"))
    whole = {path.name: path.stat().st_mtime_ns for path in folder.glob("*.parquet")}
    assert 5 <= len(whole) < 22
    simulate_small(folder)
    assert {name: (folder / name).stat().st_mtime_ns for name in whole} == whole
    assert content(folder) == content(dataset)


def test_progress_counts_up_to_every_recording(dataset):
    seen = []
    simulate_small(dataset, lambda what, done, total: seen.append((done, total)))
    assert seen == [(k, 22) for k in range(1, 23)]


def test_the_defaults_of_what_the_command_changes_are_the_papers_rig():
    assert changed_rig(17, 1.0) == RigConfig()


def test_encoder_and_friction_are_options_of_the_command_and_stand_in_its_run_file(tmp_path):
    folder = tmp_path / "data"
    options = ["--minutes", "1", "--collision-recordings", "0", "--encoder-bits", "14", "--friction", "1.5"]
    assert main(["simulate", "--out", str(folder), *options]) == 0
    config = json.loads((folder / "run.json").read_text())["settings"]["config"]
    assert config["sensors"]["encoder_counts"] == 2**14
    for joint, paper in zip(config["friction"], RigConfig().friction, strict=True):
        for name in ("coulomb_nm", "static_nm", "viscous_nm_s_rad"):
            assert joint[name] == 1.5 * getattr(paper, name)
        assert (joint["ripple_nm"], joint["bristle_nm_rad"]) == (paper.ripple_nm, paper.bristle_nm_rad)
    counts = load_recording(folder / "free-000.parquet").q / (2 * np.pi / 2**14)
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-6)  # of up to 1e4 counts
    assert np.abs(counts % 2 - 1).min() < 1e-6  # no coarser


def test_folder_of_other_settings_is_refused(dataset, tmp_path):
    with pytest.raises(ConfigError, match=r"holds a dataset of other settings \(seed: 5, not 6\); choose another"):
        simulate_small(dataset, seed=6)
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(ConfigError, match="is not empty and holds no simulated dataset"):
        simulate_small(tmp_path)


def test_too_few_minutes_are_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"minutes = 0.5 must be >= 1: 20 recordings of at least 3 s"):
        simulate_small(tmp_path / "data", minutes=0.5)
