"""Share of the collisions found, over how strong they were."""

from __future__ import annotations

from matplotlib.figure import Figure

from tauext.report.drawing import Drawing
from tauext.report.results import Results
from tauext.report.signals import NotAvailable
from tauext.report.style import WIDTH_IN, bundle_colours


def draw_found_curve(results: Results) -> Drawing:
    """One step of the axis a bin of peak over limit; a bin's count of collisions stands under it.

    Raises:
        NotAvailable: the results hold no collision.
    """
    edges = sorted(
        {(b.low, b.high) for bundle in results.shown for b in bundle.found_curve if b.collisions}, key=lambda e: e[0]
    )
    if not edges:
        raise NotAvailable("the results hold no collisions")
    names = [bundle.name for bundle in results.shown]
    colours = bundle_colours([bundle.name for bundle in results.bundles])
    figure = Figure(figsize=(WIDTH_IN, 3.4), layout="constrained")
    axes = figure.subplots()
    for k, bundle in enumerate(results.shown):
        shift = 0.09 * (k - (len(names) - 1) / 2) if len(names) < 9 else 0.0
        bins = {(b.low, b.high): b for b in bundle.found_curve if b.collisions}
        places = [at for at, edge in enumerate(edges) if edge in bins]
        shares = [100 * bins[edges[at]].found / bins[edges[at]].collisions for at in places]
        sizes = [12 * bins[edges[at]].collisions ** 0.5 + 10 for at in places]
        shifted = [at + shift for at in places]
        axes.plot(shifted, shares, color=colours[bundle.name], linewidth=0.8, alpha=0.6)
        axes.scatter(shifted, shares, sizes, color=colours[bundle.name], zorder=3, label=bundle.label)
    first_over = next((at for at, (low, _) in enumerate(edges) if low >= 1), None)
    if first_over is not None:
        axes.axvline(first_over - 0.5, color="#555555", linestyle="--", linewidth=1)
        axes.annotate(
            "the limit",
            (first_over - 0.5, 1),
            xycoords=("data", "axes fraction"),
            xytext=(0, 3),
            textcoords="offset points",
            ha="center",
            color="#555555",
        )
    axes.set_xticks(range(len(edges)), [bin_label(results, edge) for edge in edges])
    axes.set(xlabel="peak of the sensor reference over the limit; below, collisions in the bin", ylabel="found, %")
    axes.set(ylim=(-6, 106), xlim=(-0.5, len(edges) - 0.5))
    figure.legend(loc="outside upper left", ncols=-(-len(names) // -(-len(names) // 5)))
    return Drawing(
        figure,
        "Collisions found over how hard they were: the peak of the sensor reference on the joint where it is largest "
        "in units of the limit that holds there at that moment. Limits differ from bundle to bundle, and so do the "
        "counts; a larger dot stands for more collisions." + results.shown_note,
    )


def bin_label(results: Results, edge: tuple[float, float | None]) -> str:
    """Range of a bin, and how many collisions fall in it; a range where bundles differ."""
    low, high = edge
    counts = [b.collisions for bundle in results.shown for b in bundle.found_curve if (b.low, b.high) == edge]
    count = f"{min(counts)}" if min(counts) == max(counts) else f"{min(counts)}–{max(counts)}"
    return (f"{low:g}–{high:g}" if high is not None else f"over {low:g}") + f"\n{count}"
