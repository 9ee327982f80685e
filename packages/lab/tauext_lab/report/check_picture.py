"""Measured and predicted torque, one row per joint, and a picture of each joint."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tauext.check.examine import Diagnosis
from tauext.check.finding import Plot, Plots
from tauext.check.joint_fit import FitRows
from tauext.progress import SILENT, Reporter
from tauext_lab.report.style import LIMIT, RC, WIDTH_IN, label_joint, save_png

SHOWN_S = 60.0
"""Length of motion drawn, from its start; more would be illegible."""
MEASURED, PREDICTED, LEFT = "#000000", "#0072b2", "#d55e00"
BREAK_S = 0.5
"""Between rows further apart no line is drawn."""


def draw(diagnosis: Diagnosis, folder: Path, report: Reporter = SILENT) -> list[Path]:
    """Write torque.png, all joints, torque-1.png ..., one a joint over all of the motion, and the plots of packages'
    checks, servos.png, if one is notable.

    Without a fit there is no torque to draw.
    """
    plots = [plots() for plots in diagnosis.plots]
    servos = any(one.notable for one in plots)
    if diagnosis.rows is None:
        return [save_png(_servos(diagnosis.joints, plots), folder / "servos.png")] if servos else []
    count = 1 + len(diagnosis.joints) + servos
    with matplotlib.rc_context(RC), report.progress("draw") as show:
        show(0, count, "pictures")
        paths = [save_png(_all(diagnosis), folder / "torque.png")]
        for j in range(len(diagnosis.joints)):
            show(len(paths), count, "pictures")
            paths.append(save_png(_one(diagnosis, j), folder / f"torque-{j + 1}.png"))
        if servos:
            show(len(paths), count, "pictures")
            paths.append(save_png(_servos(diagnosis.joints, plots), folder / "servos.png"))
        show(count, count, "pictures")
    return paths


def _rows(diagnosis: Diagnosis) -> FitRows:
    assert diagnosis.rows is not None  # checked by draw()
    return diagnosis.rows


def _all(diagnosis: Diagnosis) -> Figure:
    n = len(diagnosis.joints)
    figure = Figure(figsize=(WIDTH_IN, 0.6 + 1.35 * n), layout="constrained")
    grid = figure.subplots(n, 1, sharex=True, squeeze=False)[:, 0]
    time = _rows(diagnosis).time_s
    shown = time <= time[0] + SHOWN_S
    for j, axes in enumerate(grid):
        _curves(axes, diagnosis, j, shown)
        label_joint(axes, diagnosis.joints[j], "Nm")
    grid[-1].set_xlabel("time, s")
    figure.legend(*grid[0].get_legend_handles_labels(), loc="outside upper center", ncols=3)
    return figure


def _one(diagnosis: Diagnosis, j: int) -> Figure:
    figure = Figure(figsize=(WIDTH_IN, 4.6), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1.4))
    rows, fit = _rows(diagnosis), diagnosis.fits[j]
    _curves(above, diagnosis, j, np.ones(len(rows.time_s), dtype=bool), left=False)
    label_joint(above, diagnosis.joints[j])
    time, left = _broken(rows.time_s, rows.tau[:, j] - fit.predicted)
    below.plot(time, left, color=LEFT, linewidth=0.8)
    below.axhline(0, color=LIMIT, linewidth=0.6)
    label_joint(below, "not explained")
    below.set_xlabel("time, s")
    above.set_title(
        f"spread {fit.torque_nm:.3g} Nm: gravity {fit.gravity_nm:.3g}, inertia {fit.inertial_nm:.2g}, "
        f"friction {fit.friction_nm:.3g}; not explained {fit.error_nm:.2g} Nm",
        loc="left",
    )
    figure.legend(*above.get_legend_handles_labels(), loc="outside upper center", ncols=3)
    return figure


def _servos(joints: Sequence[str], columns: Sequence[Plots]) -> Figure:
    """The plots of packages' checks: a row a joint, a column a check."""
    figure = Figure(figsize=(WIDTH_IN, 0.9 + 1.5 * len(joints)), layout="constrained")
    grid = figure.subplots(len(joints), len(columns), squeeze=False)
    for k, column in enumerate(columns):
        for axes, plot in zip(grid[:, k], column.of_joints, strict=True):
            if plot is not None:
                _plot(axes, plot)
        grid[0, k].set_title(column.title, loc="left")
        grid[-1, k].set_xlabel(column.x_label)
    for axes, joint in zip(grid[:, 0], joints, strict=True):
        axes.set_ylabel(joint)
    return figure


def _plot(axes: Axes, plot: Plot) -> None:
    if plot.points is not None:
        axes.plot(*plot.points, ".", color=MEASURED, markersize=1.5)
        axes.plot(*plot.line, color=PREDICTED, linewidth=0.9)
    else:
        axes.plot(*plot.line, color=MEASURED, linewidth=1.0)
    axes.set_ylim(*plot.y_range)
    if plot.shaded is not None:
        axes.axvspan(0, plot.shaded, color=PREDICTED, alpha=0.15, linewidth=0)
    if plot.mark is not None:
        axes.axvline(plot.mark, color=LEFT, linewidth=1.0)


def _curves(axes: Axes, diagnosis: Diagnosis, j: int, shown: np.ndarray, left: bool = True) -> None:
    rows, predicted = _rows(diagnosis), diagnosis.fits[j].predicted
    curves = [("measured", rows.tau[:, j], MEASURED, 1.6), ("model and friction", predicted, PREDICTED, 0.9)]
    if left:
        curves.append(("difference", rows.tau[:, j] - predicted, LEFT, 0.8))
    for label, values, colour, width in curves:
        axes.plot(*_broken(rows.time_s[shown], values[shown]), color=colour, linewidth=width, label=label)


def _broken(time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """With NaN where rows are apart, so that no line is drawn across."""
    gaps = np.flatnonzero(np.diff(time) > BREAK_S) + 1
    return np.insert(time, gaps, np.nan), np.insert(values, gaps, np.nan)
