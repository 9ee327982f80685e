"""Share of collisions latched and their delay, over how hard they were."""

from __future__ import annotations

from matplotlib.figure import Figure

from tauext.report.drawing import Drawing
from tauext.report.results import Results
from tauext.report.signals import NotAvailable
from tauext.report.style import WIDTH_IN, bundle_strokes, use_log_height


def draw_strength(results: Results) -> Drawing:
    """Two panels over the same bins of peak torque; one curve a bundle.

    Raises:
        NotAvailable: the results hold no collisions by strength.
    """
    bins = {
        (b.low_nm, b.high_nm): b.collisions
        for bundle in results.bundles
        for b in bundle.measured.by_strength
        if b.collisions
    }
    if not bins:
        raise NotAvailable("the results hold no collisions by strength")
    edges = sorted(bins, key=lambda edge: edge[0])
    figure = Figure(figsize=(WIDTH_IN, 4.0), layout="constrained")
    share, delay = figure.subplots(1, 2)
    strokes = bundle_strokes([bundle.name for bundle in results.bundles])
    for bundle in results.bundles:
        known = {(b.low_nm, b.high_nm): b for b in bundle.measured.by_strength if b.collisions}
        at = [k for k, edge in enumerate(edges) if edge in known]
        here = [known[edges[k]] for k in at]
        style = strokes[bundle.name] | {"markersize": 4.5}
        share.plot(at, [100 * b.latched / b.collisions for b in here], **style, label=bundle.label)
        timed = [(k, 1e3 * b.delay_median_s) for k, b in zip(at, here, strict=True) if b.delay_median_s is not None]
        if timed:
            delay.plot(*zip(*timed, strict=True), **style)
    for axes in (share, delay):
        axes.set_xticks(range(len(edges)), [bin_label(edge, bins[edge]) for edge in edges])
        axes.set_xlim(-0.4, len(edges) - 0.6)
        axes.set_xlabel("peak of the sensor reference, Nm; below, collisions")
    share.set(ylim=(-3, 103), ylabel="latched, %")
    delay.set(ylabel="median delay from the onset, ms")
    use_log_height(delay)
    figure.legend(loc="outside right upper", handlelength=3)
    return Drawing(
        figure,
        "Left, the share of collisions that were latched over how hard they were: the sensor reference's peak on the "
        "joint where it is largest. Right, the median time from the onset of contact to the alarm, of those latched: "
        "a method that latches only the hardest of a bin looks faster there than it is.",
    )


def bin_label(edge: tuple[float, float | None], collisions: int) -> str:
    low, high = edge
    words = f"over {low:g}" if high is None else f"under {high:g}" if low == 0 else f"{low:g}–{high:g}"
    return f"{words}\n{collisions}"
