"""A picture of an imported recording: position, velocity and torque of each joint, beside what they should follow."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from tauext._core import Tree
from tauext.data.recording import Recording
from tauext_lab.report.style import RC, WIDTH_IN, save_png

SHOWN_S = 60.0
"""Length of motion drawn, from its start, [s]."""
POINTS = 1500
"""Most points of a line: more than the picture resolves."""
MEASURED, EXPECTED = "#000000", "#0072b2"


def draw_joints(recording: Recording, tree: Tree | None, torque_unit: str, path: Path) -> Path:
    """Write a picture with a row a joint: position, velocity with the derivative of the position, torque with gravity.

    Args:
        tree: model of the same joints; None: torque alone.
        torque_unit: of the recording, as the axis names it.
    """
    end = int(np.searchsorted(recording.time_s, SHOWN_S)) + 1
    shown = slice(0, end, max(1, end // POINTS))
    time_s, q, dq, tau = (getattr(recording, name)[shown] for name in ("time_s", "q", "dq", "tau"))
    slopes = np.gradient(q, time_s, axis=0) if len(q) > 1 else np.zeros_like(q)
    gravity = None if tree is None else tree.momentum(q, np.zeros_like(q))[1]
    with matplotlib.rc_context(RC):
        height_in = 0.8 + 1.2 * len(recording.joints)
        figure = Figure(figsize=(1.5 * WIDTH_IN, height_in))  # a fixed layout takes half the time of a computed one
        figure.subplots_adjust(0.04, 0.5 / height_in, 0.99, 1 - 0.3 / height_in, wspace=0.15, hspace=0.3)
        grid = figure.subplots(len(recording.joints), 3, sharex=True, squeeze=False)
        for j, (left, middle, right) in enumerate(grid):
            left.plot(time_s, q[:, j], color=MEASURED, linewidth=0.8)
            left.text(0.01, 1.0, recording.joints[j], transform=left.transAxes, va="bottom")  # names may be long
            middle.plot(time_s, slopes[:, j], color=EXPECTED, linewidth=1.6)
            middle.plot(time_s, dq[:, j], color=MEASURED, linewidth=0.7)
            if gravity is not None:
                right.plot(time_s, gravity[:, j], color=EXPECTED, linewidth=1.6)
            right.plot(time_s, tau[:, j], color=MEASURED, linewidth=0.7)
        grid[0, 0].set_title("position, rad", loc="right")
        grid[0, 1].set_title("velocity; blue: derivative of the position, rad/s", loc="left")
        grid[0, 2].set_title(
            f"torque{'' if gravity is None else '; blue: gravity of the model'}, {torque_unit}", loc="left"
        )
        for axes in grid[-1]:
            axes.set_xlabel("time, s")
        return save_png(figure, path)
