"""The table and the picture of an imported dataset: a swap shows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from made_arms import six_axis_tree
from made_recordings import made_motion
from tauext_lab.report.joint_picture import draw_joints

from tauext.check.motion import joint_motions, joint_table


def test_a_swap_of_two_joints_shows_in_both_correlations(tmp_path):
    tree = six_axis_tree(tmp_path)
    (recording,) = made_motion(tree, 1.0, pieces=1).recordings
    right = joint_motions([recording], tree)
    assert all(one.velocity_correlation > 0.99 for one in right)
    swapped = [0, 2, 1, 3, 4, 5]
    velocity = joint_motions([replace(recording, dq=recording.dq[:, swapped])], tree)
    torque = joint_motions([replace(recording, tau=recording.tau[:, swapped])], tree)
    for j in (1, 2):
        assert abs(velocity[j].velocity_correlation) < 0.5  # independent moves
        assert torque[j].gravity_correlation < right[j].gravity_correlation
    assert (right[0].low_rad, right[0].high_rad) == (recording.q[:, 0].min(), recording.q[:, 0].max())
    assert np.isnan(joint_motions([recording], None)[1].gravity_correlation)
    rows = joint_table(right, "Nm")
    assert [row[0] for row in rows] == ["joint", *recording.joints] and {len(row) for row in rows} == {6}
    assert draw_joints(recording, tree, "Nm", tmp_path / "joints.png").stat().st_size > 10_000
