"""The table and the picture of an imported dataset: a swap shows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from made_arms import six_axis_tree
from made_recordings import made_motion
from tauext_lab.report.joint_picture import draw_joints

from tauext.check.motion import joint_table


def test_a_swap_of_two_joints_shows_in_both_correlations(tmp_path):
    tree = six_axis_tree(tmp_path)
    (recording,) = made_motion(tree, 1.0, pieces=1).recordings

    def correlations(**changes) -> np.ndarray:
        return np.array([row[4:] for row in joint_table([replace(recording, **changes)], tree, "Nm")[1:]], dtype=float)

    head, first, *_ = joint_table([recording], None, "Nm")
    assert head[3] == "torque Nm" and first[0] == recording.joints[0] and first[5] == "-"
    assert first[1] == f"{recording.q[:, 0].min():.2f} to {recording.q[:, 0].max():.2f}"
    right, swapped = correlations(), [0, 2, 1, 3, 4, 5]
    assert right.shape == (6, 2) and (right[:, 0] >= 0.99).all()
    assert (np.abs(correlations(dq=recording.dq[:, swapped])[1:3, 0]) < 0.5).all()  # independent moves
    assert (correlations(tau=recording.tau[:, swapped])[1:3, 1] < right[1:3, 1]).all()
    assert draw_joints(recording, tree, "Nm", tmp_path / "joints.png").stat().st_size > 10_000
