"""Figure 7: observer and uncertainty over time, without a model, while the ten collisions happen."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from tauext.bundle.estimates import Estimates
from tauext.data.recording import Recording
from tauext.report.drawing import Drawing, uncertainty_words
from tauext.report.results import Collision, Results
from tauext.report.signals import NotAvailable, Signals
from tauext.report.style import (
    CONTACT,
    LIMIT,
    OBSERVER,
    OBSERVER_WIDTH,
    WIDTH_IN,
    bundle_colours,
    label_joint,
    sentence,
)

BEFORE_S, LENGTH_S, AFTER_S = 0.8, 3.0, 0.7
JOINT_AT = "#9a9a9a"
LIMIT_LINE: dict[str, Any] = {"color": LIMIT, "linestyle": "--", "linewidth": 0.7, "zorder": 1.5}


@dataclass(frozen=True)
class Excerpt:
    """A stretch of one recording around a collision, and where it stands on the joined axis."""

    collision: Collision
    recording: Recording
    said: Estimates
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
    excerpts = cut_excerpts(
        [results.collisions[one] for one in results.ten if one in results.collisions], bundle.name, signals
    )
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
    what = uncertainty_words([excerpts[0].said])
    handles = [
        Line2D([], [], color=OBSERVER, linewidth=OBSERVER_WIDTH, label="observer r"),
        Line2D([], [], color=colour, label=what),
        Patch(color=CONTACT, label="contact"),
    ]
    moves = excerpts[0].said.limits_move
    if moves:
        handles.insert(2, Line2D([], [], label="± limit", **LIMIT_LINE))
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
        + (" The limit follows the motion: a collision is where the observer leaves it." if moves else ""),
    )


def cut_excerpts(collisions: list[Collision], bundle: str, signals: Signals) -> list[Excerpt]:
    """Longer than 3 s only where the contact itself is longer; cut short at the ends of its recording."""
    loaded: dict[str, tuple[Recording, Estimates]] = {}
    excerpts, shown_at_s = [], 0.0
    for collision in collisions:
        if collision.recording not in loaded:
            recording = signals.recording(collision.recording)
            loaded[collision.recording] = recording, signals.estimates(bundle, recording)
        recording, said = loaded[collision.recording]
        begin_s = collision.start_s - BEFORE_S
        end_s = max(begin_s + LENGTH_S, collision.end_s + AFTER_S)
        inside = np.flatnonzero((recording.time_s >= begin_s) & (recording.time_s <= end_s))
        if len(inside) == 0:
            raise NotAvailable(f"collision {collision.id} lies outside its recording")
        excerpt = Excerpt(collision, recording, said, int(inside[0]), int(inside[-1]), shown_at_s)
        excerpts.append(excerpt)
        shown_at_s += excerpt.length_s
    return excerpts


def draw_excerpt(axes: Axes, excerpt: Excerpt, joint: int, colour: str, results: Results) -> None:
    """Its curves, its limits where they move, every contact in it, and the line where the one before it ends."""
    rows = slice(excerpt.first, excerpt.last + 1)
    begin_s, end_s = excerpt.recording.time_s[[excerpt.first, excerpt.last]]
    for other in results.collisions.values():
        if other.recording == excerpt.collision.recording and other.start_s < end_s and other.end_s > begin_s:
            span = excerpt.shown(np.clip([other.start_s, other.end_s], begin_s, end_s))
            axes.axvspan(*span, color=CONTACT, linewidth=0, zorder=0)
    shown_s = excerpt.shown(excerpt.recording.time_s[rows])
    axes.plot(shown_s, excerpt.said.r[rows, joint], color=OBSERVER, linewidth=OBSERVER_WIDTH)
    uncertainty = excerpt.said.uncertainty[rows, joint]
    axes.plot(shown_s, uncertainty, color=colour)
    if excerpt.said.limits_move:
        for side in (-1, 1):
            axes.plot(shown_s, uncertainty + side * excerpt.said.limit[rows, joint], **LIMIT_LINE)
    if excerpt.shown_at_s > 0:
        axes.axvline(excerpt.shown_at_s, color=JOINT_AT, linewidth=0.7)


def label_excerpts(top: Axes, bottom: Axes, excerpts: list[Excerpt]) -> None:
    """A number above each excerpt; below, the time at which its contact begins in its own recording."""
    for number, excerpt in enumerate(excerpts, 1):
        middle = excerpt.shown((excerpt.collision.start_s + excerpt.collision.end_s) / 2)
        top.annotate(
            str(number),
            (middle, 1),
            xycoords=("data", "axes fraction"),
            xytext=(0, 3),
            textcoords="offset points",
            ha="center",
            fontweight="bold",
        )
    bottom.set_xticks(
        [excerpt.shown(excerpt.collision.start_s) for excerpt in excerpts],
        [f"{excerpt.collision.start_s:.2f} s" for excerpt in excerpts],
    )
    bottom.set_xlabel(
        f"onset of each contact, counted from the start of its recording; excerpts of {LENGTH_S:g} s, joined"
    )
