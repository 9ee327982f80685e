"""Error over how much was recorded for training."""

from __future__ import annotations

from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from tauext.report.drawing import Drawing
from tauext.report.results import EvaluatedBundle, Results
from tauext.report.signals import NotAvailable
from tauext.report.style import CASE_COLOURS, LEGEND_COLUMNS, LINES, MARKS, OTHER_COLOURS, WIDTH_IN, use_log_height

MOST_COLUMNS = 4


def draw_learning_curves(results: Results) -> Drawing:
    """L1 in free motion over minutes of training data; a panel a joint, a line a recipe (and model, where they differ).

    Raises:
        NotAvailable: no recipe was trained on two amounts of data.
    """
    lines: dict[tuple[str, str], list[EvaluatedBundle]] = {}
    for bundle in results.bundles:
        if bundle.measured.training_minutes:
            lines.setdefault((bundle.recipe or bundle.name, bundle.measured.model_case or ""), []).append(bundle)
    minutes = sorted({bundle.measured.training_minutes or 0.0 for bundles in lines.values() for bundle in bundles})
    if all(len({bundle.measured.training_minutes for bundle in of_one}) < 2 for of_one in lines.values()):
        raise NotAvailable("no recipe was trained on two amounts of data")
    several_models = len({model for _, model in lines}) > 1
    rows = -(-len(results.joints) // MOST_COLUMNS)
    columns = -(-len(results.joints) // rows)
    figure = Figure(figsize=(min(WIDTH_IN, 1.8 + 3.6 * columns), 0.6 + 2.9 * rows), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False)
    colours = (*CASE_COLOURS.values(), *OTHER_COLOURS)
    for joint, (axes, name) in enumerate(zip(grid.flat, results.joints, strict=False)):
        for k, ((recipe, model), bundles) in enumerate(lines.items()):
            points = sorted(
                (c.measured.training_minutes, c.l1_nm[joint]) for c in bundles if c.l1_nm[joint] is not None
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
    for axes in grid.flat[len(results.joints) :]:
        axes.remove()
    figure.supxlabel("training data, minutes", fontsize=9)
    handles, labels = grid.flat[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", handlelength=3, ncols=LEGEND_COLUMNS)
    return Drawing(
        figure,
        "Learning curves: mean error in test free motion over the minutes of motion that a method was trained on.",
    )
