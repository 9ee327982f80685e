"""How the loss fell in training: one panel a model, its recipes together."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from tauext.report.drawing import Drawing
from tauext.report.naming import bundle_label
from tauext.report.results import EvaluatedBundle, Results
from tauext.report.signals import NotAvailable
from tauext.report.style import WIDTH_IN, bundle_colours

MOST_COLUMNS = 5
TRAINING_WIDTH, VALIDATION_WIDTH = 0.7, 1.7
PALE = 0.65
GREY = "#555555"


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
    rows = -(-len(panels) // MOST_COLUMNS)
    columns = -(-len(panels) // rows)
    size = min(WIDTH_IN, 1.5 + 3.2 * columns), 0.6 + 2.3 * rows
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for axes, (name, bundles) in zip(grid.flat, panels.items(), strict=False):
        for bundle in bundles:
            recipe = bundle.label.partition(", ")[2] or (f"{bundle.recipe} recipe" if bundle.recipe else bundle.label)
            draw_history(axes, bundle, recipe, colours[bundle.name])
        if len(bundles) > 1:
            axes.set_title(bundle_label(name), fontweight="bold")
            axes.legend(loc="upper right", handlelength=1.2, borderaxespad=0, labelcolor="linecolor")
        else:
            axes.set_title(bundles[0].label, color=colours[bundles[0].name], fontweight="bold")
    for axes in grid.flat[len(panels) :]:
        axes.remove()
    for k, axes in enumerate(grid.flat[: len(panels)]):
        axes.set(xscale="log", yscale="log")
        if k + columns >= len(panels):
            axes.set_xlabel("training steps")
            axes.tick_params(labelbottom=True)
    for axes in grid[:, 0]:
        axes.set_ylabel("loss")
    handles = [
        Line2D([], [], color=GREY, linewidth=TRAINING_WIDTH, alpha=PALE, label="training"),
        Line2D([], [], color=GREY, linewidth=VALIDATION_WIDTH, label="validation"),
        Line2D([], [], color=GREY, linestyle="none", marker="o", markersize=5, label="lowest validation loss"),
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
    steps, training, validation = zip(*bundle.loss_history, strict=True)
    axes.plot(steps, training, color=colour, linewidth=TRAINING_WIDTH, alpha=PALE)
    axes.plot(steps, validation, color=colour, linewidth=VALIDATION_WIDTH, label=label)
    lowest = validation.index(min(validation))
    axes.plot(steps[lowest], validation[lowest], "o", color=colour, markersize=5, markeredgecolor="white", zorder=5)
