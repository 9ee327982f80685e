"""What is detected of forces that were added to free motion, as a figure and as a table."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.figure import Figure

from tauext.report.drawing import Drawing
from tauext.report.injected import ASSUMED, Injected, milliseconds, number
from tauext.report.noticed import left_out_words
from tauext.report.results import EvaluatedBundle
from tauext.report.signals import NotAvailable
from tauext.report.style import WIDTH_IN, bundle_strokes, use_log_height, use_log_width
from tauext.report.tables import Row, Table


def draw_injected(bundles: Sequence[EvaluatedBundle], shown: EvaluatedBundle) -> Drawing:
    """A column a shape: detected share and delay over the peak at the shown bundle's place, a curve a bundle.

    Raises:
        NotAvailable: no forces were added, or no event fitted into the free motion.
    """
    injected = shown.measured.injected
    if injected is None:
        raise NotAvailable("no forces were added to free motion; `tauext evaluate --inject` does so")
    if not injected.curves:
        raise NotAvailable("no force could be added: the free test motion holds none of 4 s, or no joint notices any")
    place, shapes = injected.place, [one.shape for one in injected.at(injected.place)]
    figure = Figure(figsize=(WIDTH_IN, 4.6), layout="constrained")
    panels = figure.subplots(2, len(shapes), sharex="col", sharey="row", squeeze=False)
    strokes = bundle_strokes([bundle.name for bundle in bundles])
    for bundle in bundles:
        known = {} if bundle.measured.injected is None else {c.shape: c for c in bundle.measured.injected.at(place)}
        style = strokes[bundle.name] | {"markersize": 3.5, "linewidth": 1.3}
        for k, shape in enumerate(shapes):
            bins = [one for one in known[shape].bins if one.events] if shape in known else []
            at = [one.middle for one in bins]
            line = panels[0, k].plot(at, [100 * one.latched / one.events for one in bins], **style)
            if k == 0:
                line[0].set_label(bundle.label)
            late = [(one.middle, 1e3 * one.delay_median_s) for one in bins if one.delay_median_s is not None]
            if late:
                panels[1, k].plot(*zip(*late, strict=True), **style)
    for k, shape in enumerate(shapes):
        panels[0, k].set_title(shape)
        panels[0, k].axhline(90, color="#888888", linewidth=0.6, linestyle=":")
        use_log_width(panels[0, k])
    panels[0, 0].set(ylim=(-3, 103), ylabel="detected, %")
    panels[1, 0].set_ylabel("median delay, ms")
    use_log_height(panels[1, 0])
    figure.supxlabel(f"peak, {injected.unit}", fontsize=9)
    figure.legend(loc="outside upper left", ncols=4, handlelength=3)
    return Drawing(
        figure,
        f"What is detected of {what(injected)} that were added to free motion at {place}, over the peak; below, the "
        f"median time from the onset to the alarm, of those detected. {ASSUMED}"
        f"{' ' if injected.left_out else ''}{left_out_words(injected.left_out)}",
    )


def injected_table(bundles: Sequence[EvaluatedBundle], shown: EvaluatedBundle) -> Table | None:
    """Peaks from which on 9 of 10 are detected and the delay from there on: every place of the shown bundle, and the
    place of the figure for the others."""
    injected = shown.measured.injected
    if injected is None or not injected.curves:
        return None
    place, shapes = injected.place, list(dict.fromkeys(one.shape for one in injected.curves))
    rows = []
    for bundle in (shown, *(one for one in bundles if one is not shown)):
        theirs = bundle.measured.injected
        if theirs is None:
            continue
        places = list(dict.fromkeys(one.place for one in theirs.curves)) if bundle is shown else [place]
        for k, at in enumerate(places):
            known = {one.shape: one for one in theirs.at(at)}
            cells = [bundle.label if k == 0 else "", at]
            for shape in shapes:
                one = known.get(shape)
                cells += [
                    "–" if one is None else number(one.nine_of_ten),
                    "–" if one is None else milliseconds(one.delay_median_s),
                ]
            rows.append(Row(tuple(cells), bundle=bundle.name if k == 0 else None, opens=k == 0))
    groups = (("", 2), *((shape, 2) for shape in shapes))
    return Table(groups, ("", "at", *(injected.unit, "ms") * len(shapes)), tuple(rows), words=2)


def what(injected: Injected) -> str:
    return "torques on single joints" if injected.without_forces else "forces in random directions"
