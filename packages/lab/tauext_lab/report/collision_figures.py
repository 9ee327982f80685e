"""Figures of collisions: over time, over strength, missed against false, and after contacts."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import NullLocator

from tauext.bundle.estimates import Estimates
from tauext.data.recording import Recording
from tauext.fit.tail import duration
from tauext_lab.evaluate.results import Aftermath, CurvePoint, EvaluatedBundle, LabelledCollision, Results
from tauext_lab.report.signals import NotAvailable, Signals
from tauext_lab.report.style import (
    CONTACT,
    GREY,
    LEGEND_COLUMNS,
    LIMIT,
    OBSERVER,
    OBSERVER_WIDTH,
    WIDTH_IN,
    Drawing,
    bundle_colours,
    bundle_strokes,
    label_joint,
    panel_grid,
    sentence,
    uncertainty_words,
    use_log_height,
    write_above,
)

# --- Figure 7: observer and uncertainty over time, without a model, while the ten collisions happen.


BEFORE_S, LENGTH_S, AFTER_S = 0.8, 3.0, 0.7
JOINT_AT = "#9a9a9a"
LIMIT_LINE: dict[str, Any] = {"color": LIMIT, "linestyle": "--", "linewidth": 0.7, "zorder": 1.5}


@dataclass(frozen=True)
class Excerpt:
    """A stretch of one recording around a collision, and its place on the joined axis."""

    collision: LabelledCollision
    recording: Recording
    estimates: Estimates
    first: int
    last: int
    shown_at_s: float

    @property
    def length_s(self) -> float:
        return float(self.recording.time_s[self.last] - self.recording.time_s[self.first])

    def shown(self, time_s: Any) -> Any:
        """Place on the joined axis of a time of the recording."""
        return time_s - self.recording.time_s[self.first] + self.shown_at_s


def draw_collisions(results: Results, signals: Signals) -> Drawing:
    """One row a joint; excerpts of about 3 s around each of the ten collisions, joined along the axis.

    Raises:
        NotAvailable: no collision was chosen, or a file of the bundle is missing.
    """
    bundle = results.bundle("none")
    excerpts = cut_excerpts(results.ten, bundle.name, signals)
    if not excerpts:
        raise NotAvailable("the results name no collisions to draw")
    colour, n = bundle_colours([c.name for c in results.bundles])[bundle.name], len(results.joints)
    figure = Figure(figsize=(WIDTH_IN, 0.9 + (1.9 if n <= 3 else 1.25) * n), layout="constrained")
    grid = figure.subplots(n, 1, sharex=True, squeeze=False)[:, 0]
    for joint, (axes, name) in enumerate(zip(grid, results.joints, strict=True)):
        for excerpt in excerpts:
            draw_excerpt(axes, excerpt, joint, colour, results)
        label_joint(axes, name, f"torque, {results.unit_of(joint)}")
        axes.set_xlim(0, excerpts[-1].shown_at_s + excerpts[-1].length_s)
    label_excerpts(grid[0], grid[-1], excerpts)
    what = uncertainty_words([excerpts[0].estimates])
    handles = [
        Line2D([], [], color=OBSERVER, linewidth=OBSERVER_WIDTH, label="observer r"),
        Line2D([], [], color=colour, label=what),
        Patch(color=CONTACT, label="contact"),
    ]
    moves = excerpts[0].estimates.limits_move
    if moves:
        handles.insert(2, Line2D([], [], label="± threshold", **LIMIT_LINE))
    figure.legend(handles=handles, loc="outside upper left", ncols=4)
    where: dict[str, list[str]] = {}
    for number, excerpt in enumerate(excerpts, 1):
        where.setdefault(excerpt.recording.name, []).append(str(number))
    places = "; ".join(f"{recording}: {', '.join(numbers)}" for recording, numbers in where.items())
    return Drawing(
        figure,
        f"Figure 7. {sentence(bundle.label)}: observer and {what} while {len(excerpts)} collisions "
        f"happen. What was learned goes on as if nothing touched the arm; what the two differ by is the external "
        f"torque. Excerpts of about {LENGTH_S:g} s are joined at the vertical lines. Recordings: {places}."
        + (" The threshold follows the motion: a collision is where the observer leaves it." if moves else ""),
    )


def cut_excerpts(collisions: tuple[LabelledCollision, ...], bundle: str, signals: Signals) -> list[Excerpt]:
    """Longer than 3 s only where the contact itself is longer; cut short at the ends of its recording."""
    loaded: dict[str, tuple[Recording, Estimates]] = {}
    excerpts, shown_at_s = [], 0.0
    for collision in collisions:
        if collision.recording not in loaded:
            recording = signals.recording(collision.recording)
            loaded[collision.recording] = recording, signals.estimates(bundle, recording)
        recording, estimates = loaded[collision.recording]
        begin_s = collision.start_s - BEFORE_S
        end_s = max(begin_s + LENGTH_S, collision.end_s + AFTER_S)
        inside = np.flatnonzero((recording.time_s >= begin_s) & (recording.time_s <= end_s))
        if len(inside) == 0:
            raise NotAvailable(f"collision {collision.id} lies outside its recording")
        excerpt = Excerpt(collision, recording, estimates, int(inside[0]), int(inside[-1]), shown_at_s)
        excerpts.append(excerpt)
        shown_at_s += excerpt.length_s
    return excerpts


def draw_excerpt(axes: Axes, excerpt: Excerpt, joint: int, colour: str, results: Results) -> None:
    """Its curves, its limits where they move, every contact in it, and the line where the one before it ends."""
    rows = slice(excerpt.first, excerpt.last + 1)
    begin_s, end_s = excerpt.recording.time_s[[excerpt.first, excerpt.last]]
    for other in results.collisions:
        if other.recording == excerpt.collision.recording and other.start_s < end_s and other.end_s > begin_s:
            span = excerpt.shown(np.clip([other.start_s, other.end_s], begin_s, end_s))
            axes.axvspan(*span, color=CONTACT, linewidth=0, zorder=0)
    shown_s = excerpt.shown(excerpt.recording.time_s[rows])
    axes.plot(shown_s, excerpt.estimates.residual[rows, joint], color=OBSERVER, linewidth=OBSERVER_WIDTH)
    uncertainty = excerpt.estimates.uncertainty[rows, joint]
    axes.plot(shown_s, uncertainty, color=colour)
    if excerpt.estimates.limits_move:
        for side in (-1, 1):
            axes.plot(shown_s, uncertainty + side * excerpt.estimates.limit_nm[rows, joint], **LIMIT_LINE)
    if excerpt.shown_at_s > 0:
        axes.axvline(excerpt.shown_at_s, color=JOINT_AT, linewidth=0.7)


def label_excerpts(top: Axes, bottom: Axes, excerpts: list[Excerpt]) -> None:
    """A number above each excerpt; below, the time at which its contact begins in its own recording."""
    for number, excerpt in enumerate(excerpts, 1):
        middle = excerpt.shown((excerpt.collision.start_s + excerpt.collision.end_s) / 2)
        write_above(top, middle, str(number), fontweight="bold")
    bottom.set_xticks(
        [excerpt.shown(excerpt.collision.start_s) for excerpt in excerpts],
        [f"{excerpt.collision.start_s:.2f} s" for excerpt in excerpts],
    )
    bottom.set_xlabel(
        f"onset of each contact, counted from the start of its recording; excerpts of {LENGTH_S:g} s, joined"
    )


# --- Error after a contact, compared with that in free motion.


MOST_COLUMNS = 4


def draw_after_contact(results: Results) -> Drawing:
    """One panel per joint and one for the reported contacts; one curve per bundle over the time since the last touch.

    Raises:
        NotAvailable: no bundle has them.
    """
    known = [(bundle, bundle.after_contact) for bundle in results.bundles if bundle.after_contact]
    if not any(entry.hours for _, after in known for entry in after.bins):
        raise NotAvailable("the results hold no time after contacts")
    panels: list[tuple[str, str, Callable[[Aftermath], float | None]]] = [
        (name, f"RMSE, {results.unit_of(j)}", partial(error_of, j)) for j, name in enumerate(results.joints)
    ]
    panels.append(("contact alarms that begin", "an hour", lambda entry: entry.contacts_per_hour))
    figure, grid, _ = panel_grid(len(panels), MOST_COLUMNS, (WIDTH_IN, 0.0), (0.6, 2.9))
    strokes = bundle_strokes([bundle.name for bundle in results.bundles])
    for axes, (title, quantity, value) in zip(grid, panels, strict=True):
        for bundle, after in known:
            values = [value(entry) for entry in (*after.bins, after.free_motion)]
            draw_entries(axes, values, strokes[bundle.name], bundle.label)
        bins = [f"{entry.from_s:g}\nto {entry.to_s:g}" for entry in known[0][1].bins]
        axes.set_xticks(range(len(bins) + 1), [*bins, "free\nmotion"], fontsize=8)
        axes.set_title(title)
        axes.set_ylabel(quantity)
        if quantity == "an hour":
            axes.set_ylim(0, max(axes.get_ylim()[1], 1))
        else:
            use_log_height(axes)
    figure.supxlabel("time since the end of the last contact, s", fontsize=9)
    hours = sum(entry.hours for entry in known[0][1].bins)
    figure.legend(*grid[0].get_legend_handles_labels(), loc="outside upper left", handlelength=3, ncols=LEGEND_COLUMNS)
    return Drawing(
        figure,
        "What a contact leaves behind: error of the estimate while nothing touches the arm any more, and at the right "
        "of each panel in motion without contacts. A network whose window still holds the contact errs more than that. "
        f"Last panel, alarms of the contact level that begin there. "
        f"{duration(hours)} lie after contacts.",
    )


def error_of(joint: int, entry: Aftermath) -> float | None:
    return entry.rmse_nm[joint]


def draw_entries(axes: Axes, values: list[float | None], stroke: dict, label: str) -> None:
    """Bins joined by a line, free motion apart."""
    known = [(k, value) for k, value in enumerate(values[:-1]) if value is not None]
    if known:
        axes.plot(*zip(*known, strict=True), **stroke, markersize=4.5, label=label)
    if values[-1] is not None:
        axes.plot(len(values) - 1, values[-1], color=stroke["color"], marker=stroke["marker"], markersize=6)


# --- Share of collisions latched and their delay, over their strength.


def draw_strength(results: Results) -> Drawing:
    """Two panels over the same bins of peak torque; one curve a bundle.

    Raises:
        NotAvailable: the results hold no collisions by strength.
    """
    bins = {b.edges: b.collisions for bundle in results.bundles for b in bundle.by_strength if b.collisions}
    if not bins:
        raise NotAvailable("the results hold no collisions by strength")
    edges = sorted(bins, key=lambda edge: edge[0])
    figure = Figure(figsize=(WIDTH_IN, 4.0), layout="constrained")
    share, delay = figure.subplots(1, 2)
    strokes = bundle_strokes([bundle.name for bundle in results.bundles])
    for bundle in results.bundles:
        known = {b.edges: b for b in bundle.by_strength if b.collisions}
        at = [k for k, edge in enumerate(edges) if edge in known]
        here = [known[edges[k]] for k in at]
        style = strokes[bundle.name] | {"markersize": 4.5}
        share.plot(at, [100 * b.latched / b.collisions for b in here], **style, label=bundle.label)
        timed = [(k, 1e3 * b.delay_median_s) for k, b in zip(at, here, strict=True) if b.delay_median_s is not None]
        if timed:
            delay.plot(*zip(*timed, strict=True), **style)
    for axes in (share, delay):
        axes.set_xticks(range(len(edges)), [range_label(edge, bins[edge]) for edge in edges])
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
        "a method that latches only the hardest of a bin appears faster there than it is.",
    )


def range_label(edge: tuple[float, float | None], collisions: int) -> str:
    low, high = edge
    words = f"over {low:g}" if high is None else f"under {high:g}" if low == 0 else f"{low:g}–{high:g}"
    return f"{words}\n{collisions}"


# --- Share of the collisions found, over their strength.


def draw_found_curve(results: Results) -> Drawing:
    """One axis step per bin of peak over limit, with the bin's number of collisions below.

    Raises:
        NotAvailable: the results hold no collision.
    """
    edges = sorted(
        {b.edges for bundle in results.shown for b in bundle.found_curve if b.collisions}, key=lambda e: e[0]
    )
    if not edges:
        raise NotAvailable("the results hold no collisions")
    names = [bundle.name for bundle in results.shown]
    colours = bundle_colours([bundle.name for bundle in results.bundles])
    figure = Figure(figsize=(WIDTH_IN, 3.4), layout="constrained")
    axes = figure.subplots()
    for k, bundle in enumerate(results.shown):
        shift = 0.09 * (k - (len(names) - 1) / 2) if len(names) < 9 else 0.0
        bins = {b.edges: b for b in bundle.found_curve if b.collisions}
        places = [at for at, edge in enumerate(edges) if edge in bins]
        shares = [100 * bins[edges[at]].found / bins[edges[at]].collisions for at in places]
        sizes = [12 * bins[edges[at]].collisions ** 0.5 + 10 for at in places]
        shifted = [at + shift for at in places]
        axes.plot(shifted, shares, color=colours[bundle.name], linewidth=0.8, alpha=0.6)
        axes.scatter(shifted, shares, sizes, color=colours[bundle.name], zorder=3, label=bundle.label)
    first_over = next((at for at, (low, _) in enumerate(edges) if low >= 1), None)
    if first_over is not None:
        axes.axvline(first_over - 0.5, color="#555555", linestyle="--", linewidth=1)
        write_above(axes, first_over - 0.5, "the threshold", color="#555555")
    axes.set_xticks(range(len(edges)), [bin_label(results, edge) for edge in edges])
    axes.set(xlabel="peak of the sensor reference over the threshold; below, collisions in the bin", ylabel="found, %")
    axes.set(ylim=(-6, 106), xlim=(-0.5, len(edges) - 0.5))
    figure.legend(loc="outside upper left", ncols=-(-len(names) // -(-len(names) // 5)))
    return Drawing(
        figure,
        "Collisions found over how hard they were: the peak of the sensor reference on the joint where it is largest "
        "in units of the threshold that holds there at that moment. Thresholds differ from bundle to bundle, and so do "
        "the counts; a larger dot means more collisions." + results.shown_note,
    )


def bin_label(results: Results, edge: tuple[float, float | None]) -> str:
    """Range of a bin and its number of collisions, as a range if bundles differ."""
    low, high = edge
    counts = [b.collisions for bundle in results.shown for b in bundle.found_curve if b.edges == edge]
    count = f"{min(counts)}" if min(counts) == max(counts) else f"{min(counts)}–{max(counts)}"
    return (f"{low:g}–{high:g}" if high is not None else f"over {low:g}") + f"\n{count}"


# --- Missed collisions against false collisions an hour, for limits from low to high.


MOST_PER_HOUR = 300.0
"""Upper end of the axis: more false alarms are of no use."""
STRIP = (0.02, 0.4)
"""Limits without false collisions are drawn between these shares of one false collision in the hours tested."""


def draw_missed_curve(results: Results) -> Drawing:
    """One curve per bundle, its limits scaled by a common factor; a mark at its own limits.

    The axis of rates is logarithmic. Limits without any false collision are drawn in a strip at its left: of those,
    the lowest limits, hence the fewest missed.

    Raises:
        NotAvailable: no bundle has such a curve, or there were no collisions.
    """
    bundles = [bundle for bundle in results.bundles if drawable(bundle)]
    if not bundles:
        raise NotAvailable("the results hold no collisions missed over false alarms")
    hours = max(bundle.free_motion.hours or 0.0 for bundle in bundles)
    left, right = (share / hours for share in STRIP)
    figure = Figure(figsize=(WIDTH_IN, 4.6), layout="constrained")
    axes = figure.subplots()
    axes.axvspan(left, right, color="#f1f1f1", linewidth=0, zorder=0)
    strokes = bundle_strokes([bundle.name for bundle in results.bundles])
    places = np.geomspace(left, right, len(bundles) + 2)[1:-1]  # side by side, so that marks do not cover each other
    for bundle, none_at in zip(bundles, places, strict=True):
        draw_curve(axes, bundle, none_at, strokes[bundle.name])
    chance = next((row for row in results.sanity if row.name == "random" and row.false_per_hour), None)
    if chance and chance.collisions:
        missed = 100 * (1 - chance.latched / chance.collisions)
        axes.plot(
            chance.false_per_hour, missed, "x", color=GREY, markersize=8, markeredgewidth=2, label="random alarms"
        )
    axes.set(xscale="log", xlim=(left, MOST_PER_HOUR), ylim=(-2, 102))
    axes.xaxis.set_minor_locator(NullLocator())
    rates = [10.0**k for k in range(math.ceil(math.log10(right)), 3)]
    axes.set_xticks(rates, [f"{rate:g}" for rate in rates])
    axes.set(xlabel="false collisions an hour of free motion", ylabel="collisions missed, %")
    write_above(axes, (left * right) ** 0.5, f"none in {duration(hours)}", color="#555555")
    figure.legend(loc="outside right upper", handlelength=3)
    return Drawing(
        figure,
        "Collisions missed over false collisions an hour, as all thresholds of a method are lowered and raised by one "
        "factor: lower and further left is better. The mark shows the method with its own thresholds. In the "
        f"grey strip no false collision fell in {duration(hours)} of free motion; how far left does not matter there.",
    )


def drawable(bundle: EvaluatedBundle) -> bool:
    latched, points = bundle.latched, bundle.missed_curve
    return bool(
        bundle.free_motion.hours
        and latched
        and latched.collisions
        and any(p.false_per_hour is not None for p in points)
    )


def draw_curve(axes: Axes, bundle: EvaluatedBundle, none_at: float, stroke: dict) -> None:
    """The curve from its most false collisions to the first limits without any, and the mark of the method's own.

    Under lower limits yet, alarms run into one another: they become fewer and no better.
    """
    assert bundle.latched is not None  # checked by drawable()
    collisions = bundle.latched.collisions
    points = sorted((p for p in bundle.missed_curve if p.false_per_hour is not None), key=lambda p: p.scale)
    rates = [point.false_per_hour or 0.0 for point in points]
    busiest = rates.index(max(rates))
    first_quiet = next((k for k in range(busiest, len(points)) if rates[k] == 0), len(points))

    def place(point: CurvePoint) -> tuple[float, float]:
        return point.false_per_hour or none_at, 100 * point.missed / collisions

    curve = np.array([place(point) for point in points[busiest : first_quiet + 1]])
    axes.plot(*curve.T, **stroke | {"marker": ""}, linewidth=1.6)
    own = next((point for point in points if point.scale == 1), None)
    if own is None:
        axes.plot([], [], **stroke | {"marker": ""}, label=bundle.label)
        return
    at = place(own)
    if own.false_per_hour == 0 and first_quiet < len(points):
        axes.plot([none_at] * 2, [place(points[first_quiet])[1], at[1]], color=stroke["color"], linewidth=1.6)
    axes.plot(*at, color=stroke["color"], marker=stroke["marker"], markersize=9, markeredgecolor="white", zorder=5)
    axes.plot([], [], **stroke, linewidth=1.6, markersize=7, label=bundle.label)
