"""Missed collisions against false collisions an hour, for limits from low to high."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from tauext.report.drawing import Drawing
from tauext.report.methods import CurvePoint
from tauext.report.results import EvaluatedBundle, Results
from tauext.report.signals import NotAvailable
from tauext.report.style import GREY, WIDTH_IN, bundle_strokes

MOST_PER_HOUR = 300.0
"""No one bears more false alarms: the axis ends there."""
STRIP = (0.02, 0.4)
"""Where limits without any false collision stand: between these shares of one in the hours tested."""


def draw_missed_curve(results: Results) -> Drawing:
    """One curve a bundle, its limits scaled by a common factor; a mark where its own limits stand.

    The axis of rates is logarithmic. Limits without any false collision stand in a strip at its left, whose place says
    nothing but that: of those, the lowest limits, hence the fewest missed.

    Raises:
        NotAvailable: no bundle has such a curve, or there were no collisions.
    """
    bundles = [bundle for bundle in results.bundles if drawable(bundle)]
    if not bundles:
        raise NotAvailable("the results hold no collisions missed over false alarms")
    hours = max(bundle.hours or 0.0 for bundle in bundles)
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
    axes.annotate(
        f"none in {hours:.3g} h",
        ((left * right) ** 0.5, 1),
        xycoords=("data", "axes fraction"),
        xytext=(0, 3),
        textcoords="offset points",
        ha="center",
        color="#555555",
    )
    figure.legend(loc="outside right upper", handlelength=3)
    return Drawing(
        figure,
        "Collisions missed over false collisions an hour, as all limits of a method are lowered and raised by one "
        "factor: lower and further left is better. The mark is where the method stands with its own limits. In the "
        f"grey strip no false collision fell in {hours:.3g} h of test motion; how far left does not matter there.",
    )


def drawable(bundle: EvaluatedBundle) -> bool:
    latched, points = bundle.measured.latched, bundle.measured.missed_curve
    return bool(bundle.hours and latched and latched.collisions and any(p.false_per_hour is not None for p in points))


def draw_curve(axes: Axes, bundle: EvaluatedBundle, none_at: float, stroke: dict) -> None:
    """The curve from its most false collisions to the first limits without any, and the mark of the method's own.

    Under lower limits yet, alarms run into one another: they become fewer and no better.
    """
    assert bundle.measured.latched is not None  # drawable() looked
    collisions = bundle.measured.latched.collisions
    points = sorted((p for p in bundle.measured.missed_curve if p.false_per_hour is not None), key=lambda p: p.scale)
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
