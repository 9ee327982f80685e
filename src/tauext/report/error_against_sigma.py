"""Errors in free motion over the standard error that was told with them, and the shares within it."""

from __future__ import annotations

from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from tauext.report.drawing import Drawing
from tauext.report.methods import SigmaRegion
from tauext.report.results import EvaluatedBundle, Results
from tauext.report.signals import NotAvailable
from tauext.report.style import GREY, WIDTH_IN, bundle_colours, use_log_height, use_log_width
from tauext.report.tables import NONE, Row, Table, whole

REGIONS = {"sliding": "sliding", "near_stiction": "near stiction"}
FEWEST = 100
"""Samples that a bin needs to be drawn."""
MOST_COLUMNS = 4


def with_sigma(results: Results) -> list[EvaluatedBundle]:
    return [bundle for bundle in results.shown if bundle.measured.sigma]


def draw_error_against_sigma(results: Results) -> Drawing:
    """A panel a joint: RMS error over sigma, a dot a bin; on the diagonal sigma is right.

    Raises:
        NotAvailable: no bundle has an error scale.
    """
    bundles = with_sigma(results)
    if not bundles:
        raise NotAvailable("no bundle in the results has an error scale")
    n = len(results.joints)
    columns = min(n, MOST_COLUMNS)
    rows = -(-n // columns)
    figure = Figure(figsize=(min(WIDTH_IN, 1.2 + 3.6 * columns), 0.9 + 3.0 * rows), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False)
    colours = bundle_colours([bundle.name for bundle in results.bundles])
    for joint, axes in enumerate(grid.flat):
        if joint >= n:
            axes.set_axis_off()
            continue
        ends: list[float] = []
        for bundle in bundles:
            for region, of_joints in bundle.measured.sigma.items():
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
        axes.set_xlabel(f"standard error as told, {results.unit_of(joint)}")
        if joint % columns == 0:
            axes.set_ylabel(f"RMS error, {results.unit_of(joint)}")
    ink = "#555555"
    handles = [Line2D([], [], color=colours[b.name], linestyle="none", marker="o", label=b.label) for b in bundles]
    handles += [
        Line2D([], [], color=ink, linestyle="none", marker="o", label="sliding"),
        Line2D([], [], color=ink, linestyle="none", marker="o", markerfacecolor="white", label="near stiction"),
        Line2D([], [], color=GREY, linewidth=1, label="as large as told"),
        Line2D([], [], color=GREY, linewidth=0.8, linestyle="--", label="twice as large"),
    ]
    figure.legend(handles=handles, loc="outside upper left", ncols=6)
    return Drawing(
        figure,
        "Error against standard error on test free motion, where the whole estimate is error: each dot is the root "
        "mean square of the errors of all samples whose standard error fell in one bin, larger where they were more. "
        "On the full line the standard error is right; above it, errors are larger than told." + results.shown_note,
    )


def sigma_table(results: Results) -> Table | None:
    """Shares of errors within one and two standard errors, a row a bundle and joint; None without an error scale."""
    bundles = with_sigma(results)
    if not bundles:
        return None
    columns = ("model", "joint", *("samples", "1 σ", "2 σ") * len(REGIONS))
    rows = []
    for bundle in bundles:
        for joint, name in enumerate(results.joints):
            cells = [bundle.label if joint == 0 else "", name]
            for region in REGIONS:
                cells += region_cells(bundle.measured.sigma[region][joint])
            rows.append(Row(tuple(cells), bundle.name if joint == 0 else None, opens=joint == 0))
    groups = (("", 2), *((f"{words}: errors within, %", 3) for words in REGIONS.values()))
    return Table(groups, columns, tuple(rows), words=2)


def region_cells(region: SigmaRegion) -> list[str]:
    shares = (region.within_one_sigma, region.within_two_sigma)
    return [whole(region.samples), *(NONE if share is None else f"{100 * share:.1f}" for share in shares)]
