"""The picture of links' shapes in docs/wrench.md: the demo's arm, and the capsules that training makes of it.

python benchmarks/shapes_picture.py --out docs/pictures/link-shapes.png
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import mujoco
import numpy as np
import trimesh
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from tauext.page.drawing import shape_mesh
from tauext.robot.capsules import link_capsules
from tauext.robot.load import frame_of_joint, load_tree
from tauext.sim.arms import seven_axis_arm

GREY, COLOURS = "#b9c0ca", ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f7f7f")
LIGHT = np.array([0.4, -0.7, 0.6])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    out = parser.parse_args().out
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
                for mesh in (shape_mesh(model, int(geom)) for geom in geoms):
                    draw(axes, mesh.vertices @ shape.T + origin, mesh.faces, GREY)
                continue
            axis, anchor = frame_of_joint(bare, body - 1)  # the core's frame, as it lies in the body
            turn = bare.xmat[body].reshape(3, 3).T @ axis
            offset = bare.xmat[body].reshape(3, 3).T @ (anchor - bare.xpos[body])
            for one in (capsule for capsule in capsules if capsule.link == body - 1):
                mesh = capsule_mesh(np.array(one.start), np.array(one.end), one.radius_m)
                placed = (mesh.vertices @ turn.T + offset) @ shape.T + origin
                draw(axes, placed, mesh.faces, COLOURS[(body - 1) % len(COLOURS)])
        axes.set(xlim=(-0.25, 0.75), ylim=(-0.5, 0.5), zlim=(0.1, 0.8))
        axes.set_box_aspect((1, 1, 0.7), zoom=1.5)
        axes.view_init(elev=14, azim=-62)
        axes.set_axis_off()
    figure.savefig(out, dpi=100)


def capsule_mesh(start: np.ndarray, end: np.ndarray, radius_m: float) -> trimesh.Trimesh:
    length = float(np.linalg.norm(end - start))
    mesh = trimesh.creation.capsule(height=length, radius=radius_m, count=[16, 16])
    mesh.apply_translation(-mesh.bounds.mean(axis=0))
    turn = trimesh.geometry.align_vectors([0, 0, 1], (end - start) / length) if length > 1e-9 else np.eye(4)
    turn[:3, 3] = (start + end) / 2
    return mesh.apply_transform(turn)


def draw(axes, vertices: np.ndarray, faces: np.ndarray, colour: str) -> None:
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    shade = 0.55 + 0.45 * (normals @ (LIGHT / np.linalg.norm(LIGHT)) + 1) / 2
    rgb = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255
    axes.add_collection3d(Poly3DCollection(corners, facecolors=shade[:, None] * rgb, edgecolors="none"))


if __name__ == "__main__":
    main()
