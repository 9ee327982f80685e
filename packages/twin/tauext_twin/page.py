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
from tauext_lab.report.style import DPI, RC

from tauext.files.atomic_write import atomic_write

COLUMNS = {
    "frictionloss": "frictionloss, N m",
    "damping": "damping, N m s/rad",
    "armature": "armature, kg m²",
    "mass": "mass, kg",
    "com_x": "com x, m",
    "com_y": "com y, m",
    "com_z": "com z, m",
}


def cell(of: dict[str, Any]) -> str:
    """Value, standard error, and the file's value where the twin's differs."""
    digits = max(0, 1 - int(np.floor(np.log10(max(of["standard_error"], 1e-4)))))
    text = f"{of['value']:.{digits}f} ± {of['standard_error']:.{digits}f}"
    return text + (f" (file {of['file']:.{digits}f})" if of["written"] else "")


def table(content: dict[str, Any]) -> list[str]:
    """The terminal's table: parameters and held-out torque, a row a joint."""
    head = ["joint", *list(COLUMNS.values())[:4], "torque RMSE, file", "twin"]
    rows = [head]
    for name, joint in content["joints"].items():
        one = content["torque"][name]
        errors = [f"{one[key]:.3g}" for key in ("rmse_file", "rmse_twin")]
        rows.append([name, *(cell(joint[what]) for what in list(COLUMNS)[:4]), *errors])
    widths = [max(len(row[k]) for row in rows) for k in range(len(head))]
    return ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]


def write_page(content: dict[str, Any], path: Path) -> None:
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
        figure=figure(content["torque"]),
        curves_figure=curves_figure(content),
    )
    with atomic_write(path) as part:
        part.write_text(text, encoding="utf-8")


def figure(torque: dict[str, Any]) -> str:
    """Bars of the torque's RMSE by joint, as a share of its RMS, PNG in base64."""
    with rc_context(RC):
        drawn = Figure(figsize=(9, 0.6 + 0.45 * len(torque)), layout="constrained")
        axes, at = drawn.subplots(), np.arange(len(torque))
        for key, label, colour, beside in (
            ("rmse_file", "file", "#b0b0b0", 0.2),
            ("rmse_twin", "twin", "#0072b2", -0.2),
        ):
            share = [100 * one[key] / max(one["rms"], 1e-12) for one in torque.values()]
            bars = axes.barh(at + beside, share, 0.38, color=colour, label=label)
            axes.bar_label(bars, [f" {one[key]:.3g} {one['unit']}" for one in torque.values()])
        axes.set_yticks(at, list(torque))
        axes.invert_yaxis()
        axes.set_xlabel("RMSE, % of the torque's RMS")
        axes.margins(x=0.12)
        drawn.legend(loc="outside upper right", ncols=2)
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
            axes.set_title(f"{name}, {content['torque'][name]['unit']}", loc="left")
        rows[-1].set_xlabel("time, s")
        drawn.legend(*rows[0].get_legend_handles_labels(), loc="outside upper right", ncols=3)
        return _png(drawn)


def _png(drawn: Figure) -> str:
    buffer = BytesIO()
    drawn.savefig(buffer, dpi=DPI)
    return base64.b64encode(buffer.getvalue()).decode()
