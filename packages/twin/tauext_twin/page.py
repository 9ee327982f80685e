"""A twin as a page and as a table."""

from __future__ import annotations

import base64
from io import BytesIO
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import tauext_lab.report.style
from matplotlib import rc_context
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation
from tauext_lab.report.style import DPI, RC

from tauext._core import JointType
from tauext.files.atomic_write import atomic_write
from tauext.progress import aligned
from tauext_twin.arm import Arm

COLUMNS = {
    "frictionloss": "frictionloss, N m",
    "damping": "damping, N m s/rad",
    "armature": "armature, kg m²",
    "mass": "mass, kg",
    "com_x": "com x, m",
    "com_y": "com y, m",
    "com_z": "com z, m",
}


LABELS = {"frictionloss": "friction {:.3g} N m", "armature": "rotor {:.3g} kg m²", "mass": "mass {:.3g} kg"}
VIEW = np.array([[0.86, -0.5, 0.0], [-0.17, -0.29, 0.94]])
"""Right and up on the page, in base axes: from the front right, slightly from above."""


def cell(of: dict[str, Any]) -> str:
    """Value, standard error, and the file's value where the twin's differs."""
    digits = max(0, 1 - int(np.floor(np.log10(max(of["standard_error"], 1e-4)))))
    text = f"{of['value']:.{digits}f} ± {of['standard_error']:.{digits}f}"
    return text + (f" (file {of['file']:.{digits}f})" if of["written"] else "")


def table(content: dict[str, Any]) -> list[str]:
    """The terminal's table: parameters and held-out torque, a row a joint."""
    rows = [["joint", *list(COLUMNS.values())[:4], "torque RMSE, file", "twin"]]
    for name, joint in content["joints"].items():
        errors = [f"{content['torque'][name][key]:.3g}" for key in ("rmse_file", "rmse_twin")]
        rows.append([name, *(cell(joint[what]) for what in list(COLUMNS)[:4]), *errors])
    return aligned(rows)


def write_page(content: dict[str, Any], arm: Arm, path: Path) -> None:
    """Write the page of a NAME.twin.json: one file that needs no network."""
    look = Path(tauext_lab.report.style.__file__).with_name("look.css").read_text()
    loader = jinja2.FileSystemLoader(Path(__file__).parent)
    template = jinja2.Environment(loader=loader, autoescape=True).get_template("page.html.j2")
    rows = [
        (name, [(cell(joint[what]), joint[what]["written"]) for what in COLUMNS])
        for name, joint in content["joints"].items()
    ]
    groups = list(next(iter(content["torque"].values()))["not_held"])
    text = template.render(
        content,
        look=look,
        columns=COLUMNS.values(),
        rows=rows,
        groups=groups,
        arm_figure=arm_figure(content, arm),
        curves_figure=curves_figure(content),
    )
    with atomic_write(path) as part:
        part.write_text(text, encoding="utf-8")


def arm_figure(content: dict[str, Any], arm: Arm) -> str:
    """The arm in a recorded pose: shapes of links, else bars from joint to joint; what the twin's file changes is in
    colour, with its values. PNG in base64."""
    tree, pose, frames = arm.setup.tree, arm.test[0].q[arm.test[0].samples // 2], [(np.eye(3), np.zeros(3))]
    for link, angle in zip(tree.links, pose, strict=True):
        turn, origin = frames[link.parent + 1]  # the base comes first
        origin, turn = origin + turn @ link.translation, turn @ np.reshape(link.rotation, (3, 3))
        if link.type == JointType.revolute:
            turn = turn @ Rotation.from_rotvec([0, 0, angle]).as_matrix()
        else:
            origin = origin + angle * turn[:, 2]
        frames.append((turn, origin))
    shapes = [(one.link, one.start, one.end, one.radius_m) for one in arm.bundle.capsules]
    known, reach = {number for number, *_ in shapes}, max(float(np.linalg.norm(origin)) for _, origin in frames)
    bars = [(link.parent, link.translation) for link in tree.links]
    bars.append((tree.size - 1, tree.links[-1].com))
    shapes += [(number, [0.0] * 3, end, 0.015 * reach) for number, end in bars if number not in known]
    changed = [[what for what in LABELS if one[what]["written"]] for one in content["joints"].values()]
    points, joints = np.array([VIEW @ origin for _, origin in frames[1:]]), list(content["joints"].items())
    with rc_context(RC):
        drawn = Figure(figsize=(9, 0.8 + 0.45 * len(changed)))
        axes = drawn.add_axes((0.03, 0.05, 0.35, 0.9))
        axes.set_aspect("equal")
        axes.axis("off")
        for number, start, end, radius_m in shapes:
            turn, origin = frames[number + 1]
            ends = np.array([VIEW @ (origin + turn @ one) for one in (start, end)])
            colour = "#9cc3df" if number >= 0 and "mass" in changed[number] else "#c8ccd0"
            axes.plot(*ends.T, color=colour, linewidth=400 * radius_m / reach, solid_capstyle="round", clip_on=False)
        heights = np.linspace(0.08, 0.92, len(points))
        for j, height in zip(np.argsort(points[:, 1], kind="stable"), heights, strict=True):
            name, one = joints[j]
            values = [LABELS[what].format(one[what]["value"]) for what in changed[j]]
            colour = "#0072b2" if values else "#8a8a8a"
            axes.plot(*points[j], "o", color=colour, markersize=9, clip_on=False)
            line = {"arrowstyle": "-", "color": colour, "linewidth": 0.6, "relpos": (0, 0.5)}
            text = f"{name}: {', '.join(values) or 'as in the file'}"
            axes.annotate(
                text, points[j], (0.46, height), "data", "figure fraction", color=colour, va="center", arrowprops=line
            )
        return _png(drawn)


def curves_figure(content: dict[str, Any]) -> str:
    """Held-out torque of each joint: measured, of the file as it came, of the twin; PNG in base64."""
    curves, names = content["curves"], list(content["joints"])
    with rc_context(RC):
        drawn = Figure(figsize=(9, 0.5 + 1.3 * len(names)), layout="constrained")
        rows = drawn.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
        time_s = curves["step_s"] * np.arange(len(curves["measured"][0]))
        for j, (name, axes) in enumerate(zip(names, rows, strict=True)):
            for key, colour, width in (
                ("measured", "#000000", 1.6),
                ("file", "#b0b0b0", 1.0),
                ("twin", "#0072b2", 1.0),
            ):
                axes.plot(time_s, curves[key][j], color=colour, linewidth=width, label=key)
            one = content["torque"][name]
            errors = f"RMSE {one['rmse_file']:.3g} with the file, {one['rmse_twin']:.3g} with the twin"
            axes.set_title(f"{name}, {one['unit']}: {errors}", loc="left")
        rows[-1].set_xlabel("time, s")
        drawn.legend(*rows[0].get_legend_handles_labels(), loc="outside upper right", ncols=3)
        return _png(drawn)


def _png(drawn: Figure) -> str:
    buffer = BytesIO()
    drawn.savefig(buffer, dpi=DPI)
    return base64.b64encode(buffer.getvalue()).decode()
