"""What force on the arm each bundle notices: at the ends of links, a bar from the usual to the worst."""

from __future__ import annotations

from matplotlib.figure import Figure

from tauext.report.drawing import Drawing
from tauext.report.methods import NoticedForce
from tauext.report.results import EvaluatedBundle, Results
from tauext.report.signals import NotAvailable
from tauext.report.style import WIDTH_IN, bundle_colours
from tauext.report.tables import NONE, Row, Table

SHOWN = ("collision", "in motion")
"""Level and region of the figure."""


def noticing(results: Results) -> list[EvaluatedBundle]:
    return [bundle for bundle in results.shown if bundle.measured.noticed]


def noticed_table(results: Results) -> Table | None:
    """A row a bundle and point; None where no bundle tells forces."""
    bundles = noticing(results)
    if not bundles:
        return None
    heads = [(one.level, one.region) for one in bundles[0].measured.noticed[0].forces]
    columns = ("model", "at", *("any way", "worst way") * len(heads))
    rows = []
    for bundle in bundles:
        for number, point in enumerate(bundle.measured.noticed):
            by_head = {(one.level, one.region): one for one in point.forces}
            cells = [bundle.label if number == 0 else "", point.where]
            for head in heads:
                cells += force_cells(by_head.get(head))
            rows.append(Row(tuple(cells), bundle.name if number == 0 else None, opens=number == 0))
    groups = (("", 2), *((f"{level}, {region}, N", 2) for level, region in heads))
    return Table(groups, columns, tuple(rows), words=2)


def force_cells(force: NoticedForce | None) -> list[str]:
    if force is None:
        return [NONE, NONE]
    median, worst = force.worst_way_n
    return [newtons(force.median_n), f"{newtons(median)} ({newtons(worst)})"]


def newtons(value: float | None) -> str:
    return "never" if value is None else f"{value:.3g}"


def draw_noticed(results: Results) -> Drawing:
    """Bars of the worst direction's median, to a whisker of the worst pose; dots of all directions' median.

    Raises:
        NotAvailable: no bundle tells forces.
    """
    bundles = noticing(results)
    if not bundles:
        raise NotAvailable("no bundle in the results tells forces")
    colours = bundle_colours([bundle.name for bundle in results.bundles])
    points = [point.where for point in bundles[0].measured.noticed]
    figure = Figure(figsize=(WIDTH_IN, 1.2 + 0.42 * len(points) * max(1, 0.6 * len(bundles))), layout="constrained")
    axes = figure.subplots()
    height = 0.8 / len(bundles)
    for k, bundle in enumerate(bundles):
        for row, point in enumerate(bundle.measured.noticed):
            force = next((one for one in point.forces if (one.level, one.region) == SHOWN), None)
            if force is None:
                continue
            at, (median, worst) = row + (k - (len(bundles) - 1) / 2) * height, force.worst_way_n
            axes.barh(at, median or 0, 0.9 * height, color=colours[bundle.name], alpha=0.5)
            if median is not None and worst is not None:
                axes.plot([median, worst], [at, at], color=colours[bundle.name], linewidth=1.5)
                axes.plot([worst], [at], "|", color=colours[bundle.name])
            if force.median_n is not None:
                label = bundle.label if row == len(bundle.measured.noticed) - 1 else None
                axes.plot([force.median_n], [at], "o", color=colours[bundle.name], markersize=5, label=label)
            else:
                axes.annotate("never", (0, at), (4, 0), textcoords="offset points", va="center", color="#555555")
    axes.set_yticks(range(len(points)), points)
    axes.invert_yaxis()
    axes.set_xlabel("force that is noticed as a collision, in motion, N")
    if len(bundles) > 1:
        axes.legend(loc="lower right")
    return Drawing(
        figure,
        "Force that stays and is noticed as a collision in motion: the median over poses and directions (dots), of "
        "each pose's worst direction (bars), and of the worst pose (whiskers; none where a pose hides a direction).",
    )
