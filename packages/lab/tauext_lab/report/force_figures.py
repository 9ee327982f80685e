"""Figures and tables of forces: the smallest ones noticed, and those added to free motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import matplotlib
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from tauext.errors import ConfigError
from tauext.files.atomic_write import atomic_files
from tauext.fit.tail import duration
from tauext_lab.evaluate.results import EvaluatedBundle, Injected, NoticedAt, NoticedForce
from tauext_lab.report.signals import NotAvailable
from tauext_lab.report.style import (
    CASE_COLOURS,
    GREY,
    RC,
    SLIDING,
    VARIANT_COLOURS,
    WIDTH_IN,
    Drawing,
    bundle_strokes,
    save_png,
    use_log_height,
    use_log_width,
)
from tauext_lab.report.tables import NONE, Row, Table, block, milliseconds

# --- Smallest force on a link that a bundle notices, as a figure and as a table.


COLOURS = (CASE_COLOURS["none"], CASE_COLOURS["exact"], VARIANT_COLOURS["none"], VARIANT_COLOURS["exact"])
"""Colours of limits in their order: collision, contact; or both while sliding, then near stiction."""
MOST_N, EDGE_N = 1000.0, 1950.0
"""Above MOST_N a direction is blind; blind marks are drawn between MOST_N and EDGE_N."""
BLIND_N = 1400.0
UNOBSERVABLE = "unobservable"
CLOSING = (
    "ISO/TS 15066 and your risk assessment define what force is allowed where; these are what tauext would "
    "detect, not what the contact would do."
)

Limit = TypeVar("Limit")
ONE_SIDED_95 = 1.645
"""Standard errors that 95 % of errors are below."""


def joined(limits: Mapping[str, Limit]) -> dict[str, Limit]:
    """Limits by name; limits that notice the same share a name: `collision and contact while sliding`."""
    found: dict[str, Limit] = {}
    for name, entries in limits.items():
        same = next((other for other, those in found.items() if those == entries), None)
        if same is None:
            found[name] = entries
            continue
        (level, _, motion), after = same.partition(" "), name.partition(" ")[2]
        both = f"{level if motion == after else same} and {name}"
        found = {both if other == same else other: those for other, those in found.items()}
    return found


def left_out_words(joints: Sequence[str]) -> str:
    """A sentence about joints that do not answer in N m; empty without any."""
    if not joints:
        return ""
    return f"Without {', '.join(joints)}: their torque constants are unknown, so what they detect is not counted."


def surely(error_share: float) -> float:
    """Multiple of the force that exceeds a limit, above which 19 of 20 forces do, whatever the error's sign."""
    return 1 + ONE_SIDED_95 * error_share


def draw_noticed_force(noticed: NoticedForce | None) -> Drawing:
    """A row a point of the arm: median of every way, nine of ten, and the worst way in the median pose.

    Raises:
        NotAvailable: there are no forces.
    """
    if noticed is None or not noticed.limits:
        raise NotAvailable((noticed and noticed.refused) or "the results hold no forces")
    limits = joined(noticed.limits)
    names = list(limits)
    places = [one.place for one in limits[names[0]]]
    height = 1.3 + max(0.42, 0.17 * len(names)) * len(places)
    figure = Figure(figsize=(WIDTH_IN, height), layout="constrained")
    axes = figure.subplots()
    axes.axvspan(MOST_N, EDGE_N, color=SLIDING, linewidth=0)
    for k, name in enumerate(names):
        colour = COLOURS[k % len(COLOURS)]
        for row, at in enumerate(limits[name]):
            height_at = row + 0.62 * ((k + 0.5) / len(names) - 0.5)
            median, nine = at_or_blind(at.every_way.median_n), at_or_blind(at.every_way.nine_of_ten_n)
            axes.plot([median, nine], [height_at] * 2, color=colour, linewidth=3.2, solid_capstyle="butt")
            axes.plot(median, height_at, marker="o", color=colour, markersize=5.5)
            worst = at_or_blind(at.worst_way.median_n)
            axes.plot(worst, height_at, marker="D", markerfacecolor="white", color=colour, markersize=5)
    axes.set_yticks(range(len(places)), places)
    axes.set_ylim(len(places) - 0.5, -0.5)
    use_log_width(axes)
    axes.set_xlim(right=EDGE_N)
    axes.grid(axis="x")
    axes.grid(visible=False, axis="y")
    axes.set_xlabel("minimum detectable force, N")
    axes.text(BLIND_N, -0.55, UNOBSERVABLE, ha="center", va="bottom", color="#555555")
    figure.legend(handles=handles(names), loc="outside upper left", ncols=4 if len(names) == 1 else 3)
    return Drawing(
        figure,
        f"Minimum detectable force at the end of each link, over {noticed.poses} poses. Dot: the median over poses "
        "and directions; bar: to the force that nine of ten of them are below; diamond: the worst direction in the "
        "median pose. Unobservable: it takes more than 1000 N, or no joint feels it at all."
        f"{' ' if noticed.left_out else ''}{left_out_words(noticed.left_out)}",
    )


def handles(names: list[str]) -> list[Line2D]:
    colours = [COLOURS[k % len(COLOURS)] for k in range(len(names))]
    found = [
        Line2D([], [], color=c, linewidth=3.2, label=f"{n} threshold") for c, n in zip(colours, names, strict=True)
    ]
    dot = {"color": GREY, "linestyle": "none"}
    return [
        *found,
        Line2D([], [], marker="o", label="every way, median", **dot),
        Line2D([], [], color=GREY, linewidth=3.2, label="to 9 of 10"),
        Line2D([], [], marker="D", markerfacecolor="white", label="worst way", **dot),
    ]


def at_or_blind(force_n: float | None) -> float:
    return BLIND_N if force_n is None else force_n


def forces_table(bundles: Sequence[EvaluatedBundle], shown: EvaluatedBundle) -> Table | None:
    """Pushes that the shown bundle detects, a row a limit and place: the smallest one that lasts, and by shape the peak
    from which on 9 of 10 added ones are detected, and their delay. Of other bundles the place of the figure.

    None without any force.
    """
    lasting, added = shown.forces.lasting, shown.forces.added
    limits = joined(lasting.limits) if lasting is not None else {}
    shapes = list(dict.fromkeys(one.shape for one in added.curves)) if added is not None else []
    if not limits and not shapes:
        return None
    rows: list[Row] = []
    for limit, entries in limits.items():
        with_added = added if "collision" in limit else None
        rows += block(limit, [[short(at.place), *stays(at), *hits(with_added, at.place, shapes)] for at in entries])
    named = {at.place for entries in limits.values() for at in entries}
    for bundle in (shown, *(one for one in bundles if one is not shown)):
        if (theirs := bundle.forces.added) is not None and added is not None and added.curves:
            places = dict.fromkeys(one.place for one in theirs.curves) if bundle is shown else [added.place]
            left = [at for at in places if bundle is not shown or at not in named]
            rows += block(bundle.label, [[at, *[NONE] * 5, *hits(theirs, at, shapes)] for at in left], bundle.name)
    groups = (("", 2), ("lasts, every way", 2), ("worst way", 2), ("", 1), *((shape, 2) for shape in shapes))
    unit = "N" if added is None else added.unit
    columns = ("threshold", "at the end of", *("median", "9 of 10"), *("median", "worst"), "unobservable, %")
    return Table(groups, (*columns, *(unit, "ms") * len(shapes)), tuple(rows), words=2)


def stays(at: NoticedAt) -> list[str]:
    """Cells of the smallest force that goes over a limit at one place."""
    forces = [at.every_way.median_n, at.every_way.nine_of_ten_n, at.worst_way.median_n, at.worst_way.worst_n]
    return [*map(newtons, forces), f"{100 * at.worst_way.blind_share:.0f}"]


def hits(added: Injected | None, place: str, shapes: Sequence[str]) -> list[str]:
    """Cells of the peaks from which on 9 of 10 are detected at one place, and of their delay, by shape."""
    curves = () if added is None else added.at(place)
    known = {one.shape: (peak(one.nine_of_ten), milliseconds(one.delay_median_s)) for one in curves}
    return [cell for shape in shapes for cell in known.get(shape, (NONE, NONE))]


def short(place: str) -> str:
    """The place without the part in the column's heading: that a link's end is the next joint."""
    link, _, end = place.partition(", at ")
    return place if end == "its origin" else link


def newtons(force_n: float | None) -> str:
    if force_n is None:
        return f">{MOST_N:g}"
    return f"{force_n:.1f}" if force_n < 10 else f"{force_n:.0f}"


# --- The figure of noticed forces as a file of its own.


def write_noticed_picture(noticed: NoticedForce, picture: Path) -> None:
    """Draw noticed forces as a PNG.

    Raises:
        ConfigError: it cannot be written.
    """
    with matplotlib.rc_context(RC):
        drawing = draw_noticed_force(noticed)
        try:
            picture.parent.mkdir(parents=True, exist_ok=True)
            with atomic_files(picture) as (part,):
                save_png(drawing.figure, part)
        except OSError as error:
            raise ConfigError(f"{picture}: cannot be written ({error.strerror or error})") from error


# --- Detection of forces added to free motion, as a figure and as a table.


ASSUMED = (
    "The forces were added to the recorded motor torque of free motion: the position controller is assumed to hold its "
    "path. Hands and compliance reduce a real force, and a controller that gives way shows less of it, and later."
)


def draw_injected(bundles: Sequence[EvaluatedBundle], shown: EvaluatedBundle) -> Drawing:
    """A column a shape: detected share and delay over the peak at the shown bundle's place, a curve a bundle.

    Raises:
        NotAvailable: no forces were added, or no event fitted into the free motion.
    """
    injected = shown.forces.added
    if injected is None:
        raise NotAvailable("no forces were added to free motion; `tauext evaluate --inject` does so")
    if not injected.curves:
        raise NotAvailable("no force could be added: the free test motion holds none of 4 s, or no joint detects any")
    place, shapes = injected.place, [one.shape for one in injected.at(injected.place)]
    figure = Figure(figsize=(WIDTH_IN, 4.6), layout="constrained")
    panels = figure.subplots(2, len(shapes), sharex="col", sharey="row", squeeze=False)
    strokes = bundle_strokes([bundle.name for bundle in bundles])
    for bundle in bundles:
        theirs = bundle.forces.added
        known = {} if theirs is None else {c.shape: c for c in theirs.at(place)}
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


def what(injected: Injected) -> str:
    return "torques on single joints" if injected.without_forces else "forces in random directions"


def injected_words(injected: Injected) -> str:
    """`30 N (hit of 20 ms, after 35 ms), ...`: the peaks from which on 9 of 10 are detected, at `place`."""
    return ", ".join(
        f"{peak(one.nine_of_ten)} {injected.unit} ({one.shape}, after {milliseconds(one.delay_median_s)} ms)"
        if one.nine_of_ten is not None
        else f"no peak that was tried ({one.shape})"
        for one in injected.at(injected.place)
    )


def pressed_words(injected: Injected) -> str:
    """What is detected of the same forces while the tool presses; empty without it."""
    one = injected.pressed
    if one is None or not one.events:
        return ""
    late = f", after {milliseconds(one.delay_median_s)} ms instead of {milliseconds(one.delay_free_median_s)} ms"
    return (
        f"While the tool presses with {one.least_n:.0f} to {one.most_n:.0f} N, as expected, {one.latched} of "
        f"{one.events} events are detected, in free motion {one.latched_free}{late if one.latched else ''}. Pressing "
        f"alone raised {one.false_collisions} false collisions in {duration(one.hours)}."
    )


def peak(value: float | None) -> str:
    return "none" if value is None else f"{value:.2g}" if value < 10 else f"{value:.0f}"
