"""Figure 6: error of the estimate over joint speed, on test recordings."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from tauext.report.drawing import Drawing
from tauext.report.results import EvaluatedBundle, Results
from tauext.report.signals import NotAvailable, Signals
from tauext.report.style import LIMIT, NEAR_STICTION, SLIDING, WIDTH_IN, label_joint

BINS = (300, 200)
SPEED_BINS = 60
"""Of limits that follow the motion."""
MOST_NAMED = 5
CLOSE_UP = 5
"""The right column shows this many times the near-stiction speed."""
INK = LinearSegmentedColormap.from_list("ink", ["#7fb2d9", "#0072b2", "#00314f"])


def draw_error_over_speed(results: Results, signals: Signals) -> Drawing:
    """One row a joint: all speeds, and the neighbourhood of standstill; every healthy sample of the test set counts.

    Raises:
        NotAvailable: no test recording has estimates of the bundle.
    """
    bundle = results.bundle("exact")
    speed, error, limit, used = collect(bundle, signals)
    n, near = len(results.joints), results.near_stiction_rad_s
    figure = Figure(figsize=(WIDTH_IN, 0.7 + (2.5 if n <= 3 else 1.7) * n), layout="constrained")
    grid = figure.subplots(n, 2, sharey="row", squeeze=False, width_ratios=[3, 2])
    for joint, name in enumerate(results.joints):
        fastest, largest = np.abs(speed[:, joint]).max(), np.abs(error[:, joint]).max()
        limits = bundle.limit_sliding_nm[joint], bundle.limit_near_stiction_nm[joint]
        top = 1.08 * max(largest, *(one or 0 for one in limits)) or 1.0
        for axes, reach in zip(grid[joint], (1.03 * fastest or 1.0, CLOSE_UP * near), strict=True):
            shade(axes, near, reach)
            counts, x, y = np.histogram2d(
                speed[:, joint], error[:, joint], bins=BINS, range=[[-reach, reach], [-top, top]]
            )
            dots = np.ma.masked_equal(counts.T, 0)
            axes.pcolormesh(x, y, dots, cmap=INK, norm=LogNorm(1, max(counts.max(), 10)), rasterized=True, zorder=3)
            if bundle.limits_move:
                draw_typical_limit(axes, speed[:, joint], limit[:, joint], reach)
            else:
                draw_limits(axes, *limits, near, reach)
            axes.set(xlim=(-reach, reach), ylim=(-top, top))
            axes.xaxis.set_major_locator(MaxNLocator(6))
        label_joint(grid[joint, 0], name, f"error, {results.unit_of(joint)}")
    for axes, title in zip(grid[0], ("all speeds", f"close-up of |speed| < {CLOSE_UP * near:g} rad/s"), strict=True):
        axes.set_title(title)
    for axes in grid[-1]:
        axes.set_xlabel("joint speed, rad/s")
    legend = [
        Patch(color=SLIDING, label="sliding region"),
        Patch(color=NEAR_STICTION, label=f"near stiction, |speed| < {near:g} rad/s"),
        Patch(color="#0072b2", label="samples, darker where more"),
    ]
    if any(limit is not None for limit in bundle.limit_sliding_nm):
        words = "limit, median at a speed" if bundle.limits_move else "limit"
        legend.append(Line2D([], [], color=LIMIT, linestyle="--", label=words))
    figure.legend(handles=legend, loc="outside upper left", ncols=4)
    left = sorted(set(bundle.recordings) - set(used))
    return Drawing(
        figure,
        f"Figure 6. Error of the estimate over joint speed, {bundle.label}, {len(speed):,} samples of "
        f"{len(used)} test recordings. Nothing touches the arm, so the whole estimate is error; it is largest near "
        f"stiction, which is why that region has a limit of its own."
        + (" Limits follow the motion, hence differ at one speed, too." if bundle.limits_move else "")
        + left_out(left),
    )


def left_out(names: Sequence[str]) -> str:
    """A sentence for the caption: an evaluation of many hours keeps the estimates of a few recordings only."""
    if not names:
        return ""
    if len(names) > MOST_NAMED:
        return f" {len(names)} more test recordings have no estimates kept."
    return f" Left out, since their files are missing: {', '.join(names)}."


def collect(bundle: EvaluatedBundle, signals: Signals) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[str]]:
    """Speed, error and limit of every healthy sample, each (samples, joints), and the recordings that they are of."""
    speeds, errors, limits, used = [], [], [], []
    for name in bundle.recordings:
        try:
            recording = signals.recording(name)
            said = signals.estimates(bundle.name, recording)
        except NotAvailable:
            continue
        rows = said.healthy & np.isfinite(said.tau_ext).all(axis=1)
        speeds.append(recording.dq[rows])
        errors.append(said.tau_ext[rows])
        limits.append(said.limit[rows])
        used.append(name)
    if sum(map(len, speeds)) == 0:
        raise NotAvailable(f"no test recording is there with its estimates of bundle {bundle.label}")
    return np.concatenate(speeds), np.concatenate(errors), np.concatenate(limits), used


def shade(axes: Axes, near: float, reach: float) -> None:
    """Sliding region and near-stiction band as background."""
    axes.axvspan(-reach, reach, color=SLIDING, linewidth=0, zorder=0)
    axes.axvspan(-near, near, color=NEAR_STICTION, linewidth=0, zorder=1)


def draw_typical_limit(axes: Axes, speed: np.ndarray, limit: np.ndarray, reach: float) -> None:
    """The median of limits that follow the motion in each bin of speed, on both sides of zero."""
    edges = np.linspace(-reach, reach, SPEED_BINS + 1)
    place = np.digitize(speed, edges)
    inside = [limit[place == k] for k in range(1, SPEED_BINS + 1)]
    median = np.array([np.median(values) if len(values) else np.nan for values in inside])
    for sign in (-1, 1):
        axes.stairs(sign * median, edges, baseline=None, color=LIMIT, linestyle="--", linewidth=1, zorder=4)


def draw_limits(axes: Axes, sliding: float | None, near_stiction: float | None, near: float, reach: float) -> None:
    """Both limits, each over its region, on both sides of zero."""
    for sign in (-1, 1):
        if sliding is not None:
            axes.hlines(
                [sign * sliding] * 2, [-reach, near], [-near, reach], color=LIMIT, linestyle="--", lw=1, zorder=4
            )
        if near_stiction is not None:
            axes.hlines(sign * near_stiction, -near, near, color=LIMIT, linestyle="--", lw=1, zorder=4)
