"""The pictures of docs/forces.md: a push and its signs, link-shapes.png with the shapes of links.

python benchmarks/wrench_pictures.py --out docs/pictures
"""

from __future__ import annotations

import itertools
import tempfile
from pathlib import Path

import mujoco
import numpy as np
from common import arguments
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from scipy.spatial import ConvexHull

from tauext.robot.capsules import link_capsules
from tauext.robot.read import frame_of_joint, load_tree
from tauext.sim.arms import seven_axis_arm

BASE, TOOL = np.array([0.0, 0.0]), np.array([1.62, 0.78])
JOINTS = [BASE, np.array([0.0, 0.55]), np.array([0.52, 1.28]), np.array([1.3, 1.22]), TOOL]
"""Seen from the side, x to the right and z up, [m]."""
TURN = np.radians(-65.0)
"""Of the tool's axes: its z leads on from the last link."""
LEVER_M = 0.1
AXIS, PUSH = 0.3, np.array([0.0, -0.42])
FRAMES, ARM, ON_ARM, ON_HAND = "#1f5fa8", "#c9ced6", "#c0392b", "#8a8f98"


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    shapes_picture(options.out)
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


# --- Shapes of links.


GREY, COLOURS = "#b9c0ca", ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f7f7f")
LIGHT = np.array([0.4, -0.7, 0.6])


def shapes_picture(out: Path) -> None:
    """The simulated seven-axis arm, and the capsules that training makes of it."""
    arm = seven_axis_arm()
    model = mujoco.MjModel.from_xml_string(arm.xml)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "arm.xml"
        path.write_text(arm.xml)
        capsules, _ = link_capsules(path, load_tree(path))
    bare, data = mujoco.MjData(model), mujoco.MjData(model)
    mujoco.mj_kinematics(model, bare)
    data.qpos[:] = arm.home
    mujoco.mj_kinematics(model, data)
    figure = Figure(figsize=(9.0, 3.9), layout="constrained")
    for k, title in enumerate(("what the robot file draws", "capsules of the links, by colour")):
        axes = figure.add_subplot(1, 2, k + 1, projection="3d")
        axes.set_title(title, fontsize=11)
        for body in range(1, model.nbody):
            shape, origin = data.xmat[body].reshape(3, 3), data.xpos[body]
            if k == 0:
                geoms = np.flatnonzero(model.geom_bodyid == body)
                for points in (geom_points(model, int(geom)) for geom in geoms):
                    draw_hull(axes, points @ shape.T + origin, GREY)
                continue
            axis, anchor = frame_of_joint(bare, body - 1)  # the core's frame, as it lies in the body
            turn = bare.xmat[body].reshape(3, 3).T @ axis
            offset = bare.xmat[body].reshape(3, 3).T @ (anchor - bare.xpos[body])
            for one in (capsule for capsule in capsules if capsule.link == body - 1):
                points = capsule_points(np.array(one.start), np.array(one.end), one.radius_m)
                placed = (points @ turn.T + offset) @ shape.T + origin
                draw_hull(axes, placed, COLOURS[(body - 1) % len(COLOURS)])
        axes.set(xlim=(-0.25, 0.75), ylim=(-0.5, 0.5), zlim=(0.1, 0.8))
        axes.set_box_aspect((1, 1, 0.7), zoom=1.5)
        axes.view_init(elev=14, azim=-62)
        axes.set_axis_off()
    figure.savefig(out / "link-shapes.png", dpi=100)


def capsule_points(start: np.ndarray, end: np.ndarray, radius_m: float) -> np.ndarray:
    """Points of a sphere about both ends, (points, 3)."""
    turn, rise = np.meshgrid(np.linspace(0, 2 * np.pi, 24, endpoint=False), np.linspace(-np.pi / 2, np.pi / 2, 13))
    sphere = np.stack([np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)], axis=2).reshape(-1, 3)
    return np.vstack([start + radius_m * sphere, end + radius_m * sphere])


def geom_points(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """Points whose hull is one of MuJoCo's capsules, cylinders or boxes, in the frame of its body, (points, 3)."""
    kind, size = model.geom_type[geom], model.geom_size[geom]
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        points = capsule_points(np.array([0, 0, -size[1]]), np.array([0, 0, size[1]]), size[0])
    elif kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        turn = np.linspace(0, 2 * np.pi, 48, endpoint=False)
        rim = size[0] * np.stack([np.cos(turn), np.sin(turn)], axis=1)
        points = np.vstack([np.column_stack([rim, np.full(len(rim), z)]) for z in (-size[1], size[1])])
    elif kind == mujoco.mjtGeom.mjGEOM_BOX:
        points = size * np.array(list(itertools.product((-1, 1), repeat=3)))
    else:
        raise AssertionError(f"geom {geom} is of kind {kind}")
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
    return points @ rotation.reshape(3, 3).T + model.geom_pos[geom]


def draw_hull(axes, points: np.ndarray, colour: str) -> None:
    """The convex hull of these points, with its shades."""
    hull = ConvexHull(points)
    shade = 0.55 + 0.45 * (hull.equations[:, :3] @ (LIGHT / np.linalg.norm(LIGHT)) + 1) / 2
    rgb = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255
    axes.add_collection3d(Poly3DCollection(points[hull.simplices], facecolors=shade[:, None] * rgb, edgecolors="none"))


if __name__ == "__main__":
    main()
