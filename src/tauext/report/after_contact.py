"""Error after a contact is over, beside that in free motion."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tauext.report.drawing import Drawing
from tauext.report.methods import Aftermath
from tauext.report.results import Results
from tauext.report.signals import NotAvailable
from tauext.report.style import LEGEND_COLUMNS, WIDTH_IN, bundle_strokes, use_log_height

MOST_COLUMNS = 4


def draw_after_contact(results: Results) -> Drawing:
    """A panel a joint, and one for the contacts reported; a curve a bundle over the time since the last touch.

    Raises:
        NotAvailable: no bundle has them.
    """
    bundles = [bundle for bundle in results.bundles if bundle.measured.after_contact and bundle.measured.after_nothing]
    if not bundles or not any(b.hours for bundle in bundles for b in bundle.measured.after_contact):
        raise NotAvailable("the results hold no time after contacts")
    panels: list[tuple[str, str, Callable[[Aftermath], float | None]]] = [
        (name, f"RMSE, {results.unit_of(j)}", partial(error_of, j)) for j, name in enumerate(results.joints)
    ]
    panels.append(("contact alarms that begin", "an hour", lambda entry: entry.contacts_per_hour))
    rows = -(-len(panels) // MOST_COLUMNS)
    columns = -(-len(panels) // rows)
    figure = Figure(figsize=(WIDTH_IN, 0.6 + 2.9 * rows), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False)
    strokes = bundle_strokes([bundle.name for bundle in results.bundles])
    for axes, (title, quantity, value) in zip(grid.flat, panels, strict=False):
        for bundle in bundles:
            nothing = bundle.measured.after_nothing
            entries = [*bundle.measured.after_contact, *([nothing] if nothing else [])]
            draw_entries(axes, [value(entry) for entry in entries], strokes[bundle.name], bundle.label)
        bins = [f"{entry.from_s:g}\nto {entry.to_s:g}" for entry in bundles[0].measured.after_contact]
        axes.set_xticks(range(len(bins) + 1), [*bins, "free\nmotion"], fontsize=8)
        axes.set_title(title)
        axes.set_ylabel(quantity)
        if quantity == "an hour":
            axes.set_ylim(0, max(axes.get_ylim()[1], 1))
        else:
            use_log_height(axes)
    for axes in grid.flat[len(panels) :]:
        axes.remove()
    figure.supxlabel("time since the end of the last contact, s", fontsize=9)
    handles, labels = grid.flat[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", handlelength=3, ncols=LEGEND_COLUMNS)
    return Drawing(
        figure,
        "What a contact leaves behind: error of the estimate while nothing touches the arm any more, and at the right "
        "of each panel in motion without contacts. A network whose window still holds the contact errs more than that. "
        f"Last panel, alarms of the contact level that begin there. {hours_of(bundles[0].measured.after_contact):.2g} "
        "h lie after contacts.",
    )


def hours_of(entries: tuple[Aftermath, ...]) -> float:
    return sum(entry.hours for entry in entries)


def error_of(joint: int, entry: Aftermath) -> float | None:
    return entry.rmse_nm[joint]


def draw_entries(axes: Axes, values: list[float | None], stroke: dict, label: str) -> None:
    """Bins joined by a line, free motion apart."""
    known = [(k, value) for k, value in enumerate(values[:-1]) if value is not None]
    if known:
        axes.plot(*zip(*known, strict=True), **stroke, markersize=4.5, label=label)
    if values[-1] is not None:
        axes.plot(len(values) - 1, values[-1], color=stroke["color"], marker=stroke["marker"], markersize=6)
