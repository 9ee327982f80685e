"""The pictures of benchmarks/feeling.py."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from felt.arm import Wall
from felt.session import Course

LEADER, FOLLOWER = "#1f6fb4", "#c8501e"


def draw(pair: Sequence[Course], wall: Wall, out: Path) -> None:
    """Without and with the tank, side by side: height of both hands, torque of the lift, energy given."""
    figure, axes = plt.subplots(3, 2, figsize=(9.5, 6.2), sharex=True, sharey="row", constrained_layout=True)
    for column, (course, title) in enumerate(zip(pair, ("energy not kept", "energy kept by the tank"), strict=True)):
        t = course.t_s
        height, torque, energy = axes[:, column]
        height.axhspan(-40, 1000 * wall.at_m, color="0.9")
        height.plot(t, 1000 * course.leader_tip[:, 2], color=LEADER, label="leader")
        height.plot(t, 1000 * course.follower_tip[:, 2], color=FOLLOWER, lw=1.2, label="follower")
        height.set_title(title)
        torque.plot(t, course.outside_nm[:, 1], color=FOLLOWER, lw=1.0, label="of the table, at the follower")
        torque.plot(t, course.torque_nm[:, 1], color=LEADER, label="of the leader's motor")
        energy.plot(t, 1000 * course.given_j, color=LEADER)
        energy.axhline(0, color="0.6", lw=0.8)
        energy.set_xlabel("time, s")
        for axis in axes[:, column]:
            axis.grid(color="0.92")
    axes[0, 0].set_ylabel("height of the hand, mm")
    axes[1, 0].set_ylabel("torque of the lift, N m")
    axes[2, 0].set_ylabel("energy the motors gave, mJ")
    axes[2, 0].set_yscale("symlog", linthresh=100)
    axes[0, 0].set_ylim(-20, None)
    for axis in axes[:2, 0]:
        axis.legend(loc="lower left", fontsize=8)
    figure.savefig(out, dpi=110)
    plt.close(figure)
