"""Recordings of real arms, where they are present: imported as their README describes them, or refused rightly.

They lie in the folder that TAUEXT_SHARED_DATA names, or in ../shared/data beside the repository.
"""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_recordings import JOINT_STATES

from tauext.check.motion import stretches
from tauext.check.torque_changes import contacts_at_rest
from tauext.data.assemble import assemble
from tauext.data.description import parse_arm
from tauext.data.importers.open_raw import open_raw
from tauext.errors import RecordingError
from tauext.robot.read import load_tree

SHARED = Path(os.environ.get("TAUEXT_SHARED_DATA", Path(__file__).parents[2] / "shared" / "data"))
pytestmark = pytest.mark.skipif(not SHARED.is_dir(), reason="the shared recordings are not here")

UR_JOINTS = (
    '["shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint"]'
)
PANDA_JOINTS = str([f"panda_joint{k}" for k in range(1, 8)])
UR3 = f"""
[robot]
joints = {UR_JOINTS}
names = ["Base", "Shoulder", "Elbow", "Wrist 1", "Wrist 2", "Wrist 3"]
{JOINT_STATES}
tau.sign = -1
"""
UR10 = f"[robot]\njoints = {UR_JOINTS}\n{JOINT_STATES}"
PANDA = f"[robot]\njoints = {PANDA_JOINTS}\nnames = {[f'fer_joint{k}' for k in range(1, 8)]}\n{JOINT_STATES}"
TOUCHED_PANDA = f"""
[robot]
joints = {PANDA_JOINTS}
[time]
column = "time"
[signals]
q.columns = "q{{index}}"
dq.columns = "dq{{index}}"
tau.columns = "tau_J{{index}}"
tau_ext = {{columns = "tau_ext{{index}}", sign = -1}}
[contact]
column = "label"
"""
KUKA = """
[robot]
joints = ["a1", "a2", "a3", "a4", "a5", "a6"]
gear_ratio = [256.86, 267.43, 252.33, 221, 239.62, 154.32]
[time]
column = "rec.time_cont"
[signals.q]
columns = "rec.act_pos_mot_deg"
unit = "deg"
offset = [0, -90, 90, 0, 0, 0]
[signals.dq]
columns = "rec.act_vel_mot_deg_per_s"
unit = "deg/s"
[signals.tau]
columns = "rec.act_torque_abs_nm"
side = "motor"
"""


def imported(path: str, text: str):
    description = parse_arm(text)
    (source,) = open_raw(SHARED / path, description.topics)
    (recording,) = assemble(source, description)
    return recording


def least_gravity_factor(recording, tree) -> np.ndarray:
    """Slope of the measured torque over the model's gravity, joint by joint."""
    bias = tree.momentum(recording.q, np.zeros_like(recording.q))[1]
    return (bias * recording.tau).sum(0) / np.maximum((bias**2).sum(0), 1e-12)


@pytest.mark.parametrize(
    ("name", "duration_s", "longest_ms"),
    [
        ("id1", 47.5, 9),
        ("id2", 40.9, 9.1),
        ("2019-11-27-11-55-35", 17.4, 20.5),
        ("_2019-11-27-20-59-11", 15.0, 11),
        ("_2019-11-27-21-04-09", 20.5, 11),
        ("_2019-11-27-21-25-26", 25.2, 10),
        ("_2019-11-27-23-05-36", 18.1, 10),
    ],
)
def test_a_ur3_bag_is_imported_with_its_effort_turned(name, duration_s, longest_ms):
    recording = imported(f"ur3_aspectum/{name}.bag", UR3)
    assert recording.duration_s == pytest.approx(duration_s, abs=0.1) and recording.rate_hz == 125
    assert recording.provenance["longest_step_s"] < longest_ms * 1e-3
    assert not any("repeat" in text for text in recording.provenance["counts"])
    assert "tau: sign turned" in recording.provenance["done"]
    if name in ("id1", "id2"):
        assert ((recording.tau * recording.dq).mean(axis=0) > 0).all()  # motors drive: friction only takes


def test_the_ur3_carries_a_tool_that_its_model_lacks():
    factor = least_gravity_factor(imported("ur3_aspectum/id1.bag", UR3), load_tree(SHARED / "models/ur3_robot.urdf"))
    assert 1.3 < factor[1] < 2.0 and 1.4 < factor[2] < 2.3  # README, with friction beside it: 1.6 and 1.8


@pytest.mark.parametrize(
    ("name", "seconds", "rows", "contacts"),
    [
        ("a4", 15.8, 3161, 15),
        ("a6", 16.7, 3341, 15),
        ("b8", 16.6, 3328, 15),
        ("b9", 16.8, 3369, 15),
        ("c3", 15.3, 3054, 15),
        ("d3", 14.9, 2978, 15),
        ("f2", 14.6, 2920, 16),
        ("f4", 14.4, 2876, 16),
    ],
)
def test_a_touched_panda_keeps_its_repeated_rows_and_its_labels(name, seconds, rows, contacts):
    recording = imported(f"panda_mindlab/{name}.csv.gz", TOUCHED_PANDA)
    counts = recording.provenance["counts"]
    stamps = counts["samples dropped: stamp and values repeat the sample before"]
    repeats = counts["repeated samples kept: all values equal the sample before"]
    assert recording.duration_s == pytest.approx(seconds, abs=0.1)
    assert recording.samples + stamps == rows
    assert 8 <= stamps <= 13 and (stamps + repeats) / rows == pytest.approx(0.55, abs=0.01)
    assert recording.rate_hz == 200 and 88 < recording.provenance["measured_hz"] < 92
    assert (np.diff(recording.contact) == 1).sum() + (recording.contact[0] == 1) == contacts
    # tau_J - tau_ext of the file is gravity; turned, tau + tau_ext is.
    gravity = load_tree(SHARED / "models/panda.urdf", recording.joints).momentum(recording.q, 0 * recording.q)[1]
    assert np.abs(np.median(recording.tau + recording.tau_ext - gravity, axis=0)).max() < 0.6


@pytest.mark.parametrize("path", ["panda_exciting", "panda_exciting/panda_exciting_trajectory.db3"])
def test_the_moving_panda_needs_a_standard_type_and_its_stale_samples_are_counted(path):
    recording = imported(f"unisa_bags/{path}", PANDA)
    assert recording.provenance["counts"]["repeated samples kept: all values equal the sample before"] == 14
    assert recording.samples == 727
    assert recording.duration_s == pytest.approx(24.2, abs=0.05) and recording.rate_hz == 30
    assert "no message definitions in the bag: read by the standard ones" in recording.provenance["done"]


@pytest.mark.parametrize("path", ["ur10_exciting", "ur10_exciting/ur10_exciting_trajectory.db3"])
def test_the_ur10_comes_at_8_ms_without_metadata(path):
    recording = imported(f"unisa_bags/{path}", UR10)
    assert (
        recording.samples == 3441
        and recording.rate_hz == 125
        and set(np.diff(recording.t_ns)) <= {7_999_999, 8_000_000, 8_000_001}
    )
    factor = least_gravity_factor(recording, load_tree(SHARED / "models/ur10_robot.urdf"))
    assert 0.8 < factor[1] < 1.1


@pytest.mark.parametrize("path", ["ur10_validation", "ur10_validation/validation_trajectory.db3"])
def test_a_planned_trajectory_is_no_recording(path):
    with pytest.raises(RecordingError, match="JointTrajectory, messages: 1.*planned motion, not measured"):
        open_raw(SHARED / "unisa_bags" / path)


@pytest.mark.parametrize("run", "ABC")
def test_a_kuka_run_comes_to_radians_and_the_joint_side(run):
    recording = imported(f"kr_weigand/2020-10-21_10s_FF_{run}_08ms.mat", KUKA)
    assert recording.samples == 2501 and recording.rate_hz == 250 and recording.duration_s == pytest.approx(10)
    # The run begins near its start pose; its velocity is the derivative of its position, so both units are right.
    np.testing.assert_allclose(recording.q[0], np.deg2rad([0, -90, 90, 0, 0, 0]), rtol=0, atol=0.02)
    slope = np.gradient(recording.q, recording.time_s, axis=0)
    assert np.sum(slope * recording.dq, axis=0) / np.sum(slope**2, axis=0) == pytest.approx(1, abs=0.1)
    assert 3000 < np.abs(recording.tau).max() < 5200


def test_hands_on_a_panda_at_rest_are_found_without_a_model_and_without_labels():
    """A UR3's rests have none, nor have the Panda's once the touches are labelled."""
    touched = [imported(f"panda_mindlab/{name}.csv.gz", TOUCHED_PANDA) for name in ("a4", "a6", "b9", "d3")]
    unlabelled = [replace(one, contact=None) for one in touched]
    (found,) = contacts_at_rest(stretches(unlabelled), unlabelled)
    assert 40 <= int(found.evidence.split()[0]) <= 2 * 60  # 60 touches begin and end
    free = [imported(f"ur3_aspectum/{path.name}", UR3) for path in sorted((SHARED / "ur3_aspectum").glob("*.bag"))]
    for recordings in (touched, free):
        assert not contacts_at_rest(stretches(recordings), recordings)
