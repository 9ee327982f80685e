"""Figures of errors: over sigma, over speed, in free motion, in training, over minutes of data."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator, NullLocator

from tauext_lab.evaluate.results import EvaluatedBundle, Results, SigmaRegion, bundle_label
from tauext_lab.report.signals import NotAvailable, Signals
from tauext_lab.report.style import (
    CASE_COLOURS,
    GREY,
    LEGEND_COLUMNS,
    LIMIT,
    LINES,
    MARKS,
    NEAR_STICTION,
    OBSERVER,
    OBSERVER_WIDTH,
    OTHER_COLOURS,
    SLIDING,
    WIDTH_IN,
    Drawing,
    bundle_colours,
    label_joint,
    missing_bundles,
    panel_grid,
    uncertainty_words,
    use_log_counts,
    use_log_height,
    use_log_width,
)
from tauext_lab.report.tables import NONE, Row, Table, block, whole

# --- Errors in free motion over the standard error that was estimated with them, and the shares within it.


REGIONS = {"sliding": "sliding", "near_stiction": "near stiction"}
FEWEST = 100
"""Samples that a bin needs to be drawn."""
MOST_COLUMNS = 4


def with_sigma(results: Results) -> list[EvaluatedBundle]:
    return [bundle for bundle in results.shown if bundle.error_against_sigma]


def draw_error_against_sigma(results: Results) -> Drawing:
    """One panel per joint: RMS error over sigma, one dot per bin; sigma is right on the diagonal.

    Raises:
        NotAvailable: no bundle has an error scale.
    """
    bundles = with_sigma(results)
    if not bundles:
        raise NotAvailable("no bundle in the results has an error scale")
    figure, grid, columns = panel_grid(len(results.joints), MOST_COLUMNS, (1.2, 3.6), (0.9, 3.0))
    colours = bundle_colours([bundle.name for bundle in results.bundles])
    for joint, axes in enumerate(grid):
        ends: list[float] = []
        for bundle in bundles:
            for region in REGIONS:
                of_joints = (bundle.error_against_sigma or {})[region]
                drawn = [one for one in of_joints[joint].bins if one.samples >= FEWEST]
                sizes = [8 + 60 * one.samples / of_joints[joint].samples for one in drawn]
                face = colours[bundle.name] if region == "sliding" else "white"
                points = [one.sigma_rms_nm for one in drawn], [one.error_rms_nm for one in drawn]
                axes.scatter(*points, sizes, color=face, edgecolors=colours[bundle.name], linewidths=1.2, zorder=3)
                ends += points[0]
        if ends:
            between = [min(ends) / 1.3, max(ends) * 1.3]
            axes.plot(between, between, color=GREY, linewidth=1, zorder=2)
            axes.plot(between, [2 * end for end in between], color=GREY, linewidth=0.8, linestyle="--", zorder=2)
        use_log_height(axes)
        use_log_width(axes)
        axes.set_title(results.joints[joint])
        axes.set_xlabel(f"estimated standard error, {results.unit_of(joint)}")
        if joint % columns == 0:
            axes.set_ylabel(f"RMS error, {results.unit_of(joint)}")
    ink = "#555555"
    handles = [Line2D([], [], color=colours[b.name], linestyle="none", marker="o", label=b.label) for b in bundles]
    handles += [
        Line2D([], [], color=ink, linestyle="none", marker="o", label="sliding"),
        Line2D([], [], color=ink, linestyle="none", marker="o", markerfacecolor="white", label="near stiction"),
        Line2D([], [], color=GREY, linewidth=1, label="as large as estimated"),
        Line2D([], [], color=GREY, linewidth=0.8, linestyle="--", label="twice as large"),
    ]
    figure.legend(handles=handles, loc="outside upper left", ncols=6)
    return Drawing(
        figure,
        "Error against standard error on test free motion, where the whole estimate is error: each dot is the root "
        "mean square of the errors of all samples whose standard error fell in one bin, larger where they were more. "
        "On the full line the standard error is right; above it, errors are larger than estimated."
        + results.shown_note,
    )


def sigma_table(results: Results) -> Table | None:
    """Shares of errors within one and two standard errors, by bundle and joint; None without an error scale."""
    bundles = with_sigma(results)
    if not bundles:
        return None
    columns = ("model", "joint", *("samples", "1 σ", "2 σ") * len(REGIONS))
    rows: list[Row] = []
    for bundle in bundles:
        regions = [(bundle.error_against_sigma or {})[region] for region in REGIONS]
        of_joints = zip(results.joints, *regions, strict=True)
        rows += block(bundle.label, ((name, *chain(*map(region_cells, of))) for name, *of in of_joints), bundle.name)
    groups = (("", 2), *((f"{words}: errors within, %", 3) for words in REGIONS.values()))
    return Table(groups, columns, tuple(rows), words=2)


def region_cells(region: SigmaRegion) -> list[str]:
    shares = (region.within_one_sigma, region.within_two_sigma)
    return [whole(region.samples), *(NONE if share is None else f"{100 * share:.1f}" for share in shares)]


# --- Figure 6: error of the estimate over joint speed, on test recordings.


BINS = (300, 200)
SPEED_BINS = 60
"""Bins of the speed for limits that follow the motion."""
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
        limits = bundle.limits.sliding_nm[joint], bundle.limits.near_stiction_nm[joint]
        top = 1.08 * max(largest, *(one or 0 for one in limits)) or 1.0
        for axes, reach in zip(grid[joint], (1.03 * fastest or 1.0, CLOSE_UP * near), strict=True):
            shade(axes, near, reach)
            counts, x, y = np.histogram2d(
                speed[:, joint], error[:, joint], bins=BINS, range=[[-reach, reach], [-top, top]]
            )
            dots = np.ma.masked_equal(counts.T, 0)
            axes.pcolormesh(x, y, dots, cmap=INK, norm=LogNorm(1, max(counts.max(), 10)), rasterized=True, zorder=3)
            if bundle.limits.moving:
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
    if any(limit is not None for limit in bundle.limits.sliding_nm):
        words = "threshold, median at a speed" if bundle.limits.moving else "threshold"
        legend.append(Line2D([], [], color=LIMIT, linestyle="--", label=words))
    figure.legend(handles=legend, loc="outside upper left", ncols=4)
    left = sorted(set(bundle.free_motion.recordings) - set(used))
    return Drawing(
        figure,
        f"Figure 6. Error of the estimate over joint speed, {bundle.label}, {len(speed):,} samples of "
        f"{len(used)} test recordings. Nothing touches the arm, so the whole estimate is error; it is largest near "
        f"stiction, which is why that region has a threshold of its own."
        + (" Thresholds follow the motion, hence differ at one speed, too." if bundle.limits.moving else "")
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
    for name in bundle.free_motion.recordings:
        try:
            recording = signals.recording(name)
            estimates = signals.estimates(bundle.name, recording)
        except NotAvailable:
            continue
        rows = estimates.healthy & np.isfinite(estimates.tau_ext).all(axis=1)
        speeds.append(recording.dq[rows])
        errors.append(estimates.tau_ext[rows])
        limits.append(estimates.limit_nm[rows])
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


# --- Figure 5: observer and uncertainty over time in free motion.


EXCERPT_S = 30.0
NARROWEST_IN = 6.0
"""Else the legend has no room."""


def draw_free_motion(results: Results, signals: Signals) -> Drawing:
    """One column per bundle, one row per joint: the first test recording, from where the estimate begins.

    Raises:
        NotAvailable: no test recording or no estimates of it.
    """
    names = [bundle.name for bundle in results.shown]
    recordings = [name for bundle in results.bundles for name in bundle.free_motion.recordings]
    if not recordings:
        raise NotAvailable("the results name no test recording of free motion")
    recording = signals.recording(recordings[0])
    estimates, missing = signals.by_bundle(names, recording)
    healthy = np.flatnonzero(next(iter(estimates.values())).healthy)
    if len(healthy) == 0:
        raise NotAvailable(f"{recording.name} is shorter than the warm-up of observer and network")
    time_s = recording.time_s
    rows = (time_s >= time_s[healthy[0]]) & (time_s <= time_s[healthy[0]] + EXCERPT_S)
    colours, n = bundle_colours([bundle.name for bundle in results.bundles]), len(recording.joints)
    width = min(WIDTH_IN, max(NARROWEST_IN, 1.5 + 3.2 * len(estimates)))
    figure = Figure(figsize=(width, 0.7 + (1.75 if n <= 3 else 1.25) * n), layout="constrained")
    grid = figure.subplots(n, len(estimates), sharex=True, sharey="row", squeeze=False)
    for column, (bundle, estimate) in enumerate(estimates.items()):
        for joint in range(n):
            axes = grid[joint, column]
            axes.plot(time_s[rows], estimate.residual[rows, joint], color=OBSERVER, linewidth=OBSERVER_WIDTH)
            axes.plot(time_s[rows], estimate.uncertainty[rows, joint], color=colours[bundle])
            axes.margins(x=0)
        grid[0, column].set_title(results.labels[bundle].replace(", ", ",\n"), color=colours[bundle], fontweight="bold")
        grid[-1, column].set_xlabel("time, s")
    for joint, name in enumerate(recording.joints):
        label_joint(grid[joint, 0], name, f"torque, {results.unit_of(joint)}")
    what = uncertainty_words(estimates.values())
    handles = [
        Line2D([], [], color=OBSERVER, linewidth=OBSERVER_WIDTH, label="observer r"),
        Line2D([], [], color="#333333", label=f"{what}, in the colour of its model"),
    ]
    figure.legend(handles=handles, loc="outside upper left", ncols=2)
    return Drawing(
        figure,
        f"Figure 5. Free motion, test recording {recording.name}: output of the momentum observer (grey) and what "
        f"was learned for that model ({what}). In free motion the observer shows what the model gets wrong: that is "
        f"learned. Axes of a row have one scale." + missing_bundles(results, missing) + results.shown_note,
    )


# --- Loss over training: one panel per model, its recipes together.


LOSS_COLUMNS = 5
TRAINING_WIDTH, VALIDATION_WIDTH = 0.7, 1.7
PALE = 0.65
LOSS_GREY = "#555555"


def draw_training_loss(results: Results) -> Drawing:
    """Training and validation loss over steps, both logarithmic; all panels have the same axes.

    Bundles of one model share a panel: the same model on the same data has the same unit of loss, so their heights
    compare. Those of different models do not.

    Raises:
        NotAvailable: no bundle has a history.
    """
    panels: dict[str, list[EvaluatedBundle]] = {}
    for bundle in results.bundles:
        if bundle.loss_history:
            panels.setdefault(bundle.model or bundle.name, []).append(bundle)
    if not panels:
        raise NotAvailable("the results hold no loss history; evaluate bundles with their NAME.run.json beside them")
    colours = bundle_colours([bundle.name for bundle in results.bundles])
    shared = {"sharex": True, "sharey": True}
    figure, grid, columns = panel_grid(len(panels), LOSS_COLUMNS, (1.5, 3.2), (0.6, 2.3), **shared)
    for axes, (name, bundles) in zip(grid, panels.items(), strict=True):
        for bundle in bundles:
            recipe = bundle.label.partition(", ")[2] or (f"{bundle.recipe} recipe" if bundle.recipe else bundle.label)
            draw_history(axes, bundle, recipe, colours[bundle.name])
        if len(bundles) > 1:
            axes.set_title(bundle_label(name), fontweight="bold")
            axes.legend(loc="upper right", handlelength=1.2, borderaxespad=0, labelcolor="linecolor")
        else:
            axes.set_title(bundles[0].label, color=colours[bundles[0].name], fontweight="bold")
    for k, axes in enumerate(grid):
        use_log_counts(axes)
        use_log_height(axes)
        if k + columns >= len(panels):
            axes.set_xlabel("training steps")
            axes.tick_params(labelbottom=True)
    for axes in grid[::columns]:
        axes.set_ylabel("loss")
    handles = [
        Line2D([], [], color=LOSS_GREY, linewidth=TRAINING_WIDTH, alpha=PALE, label="training"),
        Line2D([], [], color=LOSS_GREY, linewidth=VALIDATION_WIDTH, label="validation"),
        Line2D([], [], color=LOSS_GREY, linestyle="none", marker="o", markersize=5, label="lowest validation loss"),
    ]
    figure.legend(handles=handles, loc="outside upper left", ncols=3)
    without = [bundle.label for bundle in results.bundles if not bundle.loss_history]
    return Drawing(
        figure,
        "Loss over training steps, both logarithmic: mean squared error, with residuals in units of the largest one. "
        "That unit is another for every model, so heights compare within a panel only. The training loss is a running "
        "mean, which lags behind." + (f" No history: {'; '.join(without)}." if without else ""),
    )


def draw_history(axes: Axes, bundle: EvaluatedBundle, label: str, colour: str) -> None:
    """Training thin and pale, validation thick, a dot where that is lowest."""
    steps, training, validation = zip(*bundle.loss_history or (), strict=True)
    axes.plot(steps, training, color=colour, linewidth=TRAINING_WIDTH, alpha=PALE)
    axes.plot(steps, validation, color=colour, linewidth=VALIDATION_WIDTH, label=label)
    lowest = validation.index(min(validation))
    axes.plot(steps[lowest], validation[lowest], "o", color=colour, markersize=5, markeredgecolor="white", zorder=5)


# --- Error over the amount of training data.


def draw_learning_curves(results: Results) -> Drawing:
    """L1 in free motion over minutes of training data; a panel a joint, a line a recipe (and model, where they differ).

    Raises:
        NotAvailable: no recipe was trained on two amounts of data.
    """
    lines: dict[tuple[str, str], list[EvaluatedBundle]] = {}
    for bundle in results.bundles:
        if bundle.training_minutes:
            lines.setdefault((bundle.recipe or bundle.name, bundle.case or ""), []).append(bundle)
    minutes = sorted({bundle.training_minutes or 0.0 for bundles in lines.values() for bundle in bundles})
    if all(len({bundle.training_minutes for bundle in of_one}) < 2 for of_one in lines.values()):
        raise NotAvailable("no recipe was trained on two amounts of data")
    several_models = len({model for _, model in lines}) > 1
    figure, grid, _ = panel_grid(len(results.joints), MOST_COLUMNS, (1.8, 3.6), (0.6, 2.9))
    colours = (*CASE_COLOURS.values(), *OTHER_COLOURS)
    for joint, (axes, name) in enumerate(zip(grid, results.joints, strict=True)):
        for k, ((recipe, model), bundles) in enumerate(lines.items()):
            points = sorted(
                (c.training_minutes, c.free_motion.l1_nm[joint])
                for c in bundles
                if c.free_motion.l1_nm[joint] is not None
            )
            if not points:
                continue
            stroke = {"color": colours[k % len(colours)], "marker": MARKS[k % len(MARKS)]}
            label = f"{recipe}, {model}" if several_models and model else recipe
            axes.plot(*zip(*points, strict=True), **stroke, linestyle=LINES[k // 3 % 4], markersize=5, label=label)
        axes.set_xscale("log")
        axes.xaxis.set_minor_locator(NullLocator())
        axes.set_xticks(minutes, [f"{m:.3g}" for m in minutes])
        use_log_height(axes)
        axes.set_title(name)
        axes.set_ylabel(f"L1, {results.unit}")
    figure.supxlabel("training data, minutes", fontsize=9)
    figure.legend(*grid[0].get_legend_handles_labels(), loc="outside upper left", handlelength=3, ncols=LEGEND_COLUMNS)
    return Drawing(
        figure,
        "Learning curves: mean error in test free motion over the minutes of motion that a method was trained on.",
    )
