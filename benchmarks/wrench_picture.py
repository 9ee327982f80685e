"""The picture of docs/wrench.md: an arm that is pushed, the axes that the push is told along, and its signs.

python benchmarks/wrench_picture.py --out docs/pictures
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

BASE, TOOL = np.array([0.0, 0.0]), np.array([1.62, 0.78])
JOINTS = [BASE, np.array([0.0, 0.55]), np.array([0.52, 1.28]), np.array([1.3, 1.22]), TOOL]
"""Seen from the side, x to the right and z up, [m]."""
TURN = np.radians(-65.0)
"""Of the tool's axes: its z leads on from the last link."""
LEVER_M = 0.1
AXIS, PUSH = 0.3, np.array([0.0, -0.42])
FRAMES, ARM, ON_ARM, ON_HAND = "#1f5fa8", "#c9ced6", "#c0392b", "#8a8f98"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    with rc_context({"font.size": 11, "font.family": "DejaVu Sans"}):
        figure = Figure(figsize=(8.2, 4.6), layout="constrained")
        draw(figure.add_subplot())
        figure.savefig(options.out / "wrench-signs.png", dpi=110)


def draw(axes: Axes) -> None:
    """Arm, both frames, and the push with its counterpart."""
    axes.set(aspect="equal", xlim=(-0.55, 3.55), ylim=(-0.12, 1.72))
    axes.axis("off")
    axes.plot([-0.35, 0.35], [-0.03, -0.03], color="#6b7078", lw=3)
    for start, end in zip(JOINTS[:-1], JOINTS[1:], strict=True):
        axes.plot(*zip(start, end, strict=True), color=ARM, lw=15, solid_capstyle="round", zorder=1)
    for joint in JOINTS[1:-1]:
        axes.plot(*joint, "o", color="white", mec="#6b7078", mew=2, ms=10, zorder=2)
    frame(axes, BASE, 0.0, "base")
    frame(axes, TOOL, TURN, "tool0")
    above = TOOL - PUSH + [0.0, 0.06]
    arrow(axes, above, above + PUSH, ON_ARM, 3)
    z, x = tool_axes()
    push = 20.0 * PUSH / np.linalg.norm(PUSH)
    told = f"""what the hand does to the arm is told:
force = (0, 0, {push[1]:.0f}) N  along the base's axes
force = ({push @ x:.0f}, 0, {push @ z:.0f}) N  along tool0's own
moment = (0, 0, 0) N m  about tool0's origin;
{LEVER_M:g} m out along its z: ({0:g}, {LEVER_M * (push @ x):.1f}, 0) N m"""
    words(axes, above + [0.08, -0.08], told.replace("-", "−"), ON_ARM)
    below = TOOL + [0.42, -0.46]
    arrow(axes, below, below - 0.8 * PUSH, ON_HAND, 2, "--")
    words(axes, below + [0.08, 0.14], "what the arm does to the hand\nis the opposite, and is not told", ON_HAND)
    words(axes, [0.05, 1.62], "y points into the page, at both frames", "#444a52")


def tool_axes() -> tuple[np.ndarray, np.ndarray]:
    """z and x of the tool in the picture's plane: y points into the page at both frames."""
    z = np.array([np.cos(TURN), np.sin(TURN)])
    return z, np.array([z[1], -z[0]])


def frame(axes: Axes, origin: np.ndarray, turn: float, name: str) -> None:
    """x and z axes of a frame; the base's z is up."""
    z, x = (np.array([0.0, 1.0]), np.array([1.0, 0.0])) if not turn else tool_axes()
    for way, letter in ((x, "x"), (z, "z")):
        arrow(axes, origin, origin + AXIS * way, FRAMES, 2)
        words(axes, origin + (AXIS + 0.07) * way, letter, FRAMES, "center")
    axes.plot(*origin, "o", color=FRAMES, ms=6, zorder=4)
    beside, where = ([-0.1, 0.08], "right") if turn == 0 else ([0.1, 0.02], "left")
    words(axes, origin + beside, name, FRAMES, where)


def arrow(axes: Axes, start, end, color: str, width: float, style: str = "-") -> None:
    arrows = {"arrowstyle": "-|>,head_width=0.35,head_length=0.7", "color": color, "lw": width, "ls": style}
    axes.annotate("", end, start, arrowprops=arrows | {"shrinkA": 0, "shrinkB": 0}, zorder=3)


def words(axes: Axes, at, text: str, color: str, where: str = "left") -> None:
    axes.text(*at, text, color=color, ha=where, va="center", zorder=5)


if __name__ == "__main__":
    main()
