"""The page of one flight: text, numbers and figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from tauext.bundle.estimates import OK
from tauext.bundle.units import SEVERAL
from tauext.errors import ConfigError, RecordingError
from tauext.files.atomic_write import atomic_folder, atomic_write
from tauext.files.preflight import expect_folder
from tauext.progress import Show
from tauext_lab.report.flight_file import Flight, flights_in, load_flight
from tauext_lab.report.page import PageFigure, check_page_mb, make_figure
from tauext_lab.report.style import (
    LIMIT,
    NEAR_STICTION,
    OBSERVER,
    OBSERVER_WIDTH,
    WIDTH_IN,
    Drawing,
    draw_band,
    name_lines,
    uncertainty_words,
)
from tauext_lab.report.tables import render_template
from tauext_lab.report.trace_packing import GAP_PERIODS
from tauext_lab.report.traces import NO_TRACES, PAGE_MB, PageTraces, flight_traces, or_reason

# --- Figures of a flight: all joints from beginning to end, and a close-up of the event.


TAU_EXT = "#0072b2"
UNCERTAINTY = "#009e73"
MEASURED = "#333333"
EVENT = "#d55e00"
LOAD = "#cc79a7"
NOT_OK = "#dcdcdc"
CLOSE_BEFORE_S, CLOSE_AFTER_S = 0.15, 0.35
COLUMNS = {
    "tau_ext": "external torque, {unit}",
    "observer": "observer; {learned}, {unit}",
    "tau": "motor torque, {torque_unit}",
    "dq": "speed, rad/s",
    "q": "position, rad",
}


def heading_words(flight: Flight) -> dict[str, str]:
    """Units, the level whose limits are listed, and what is taken off the observer's output."""
    return {
        "unit": flight.estimate_unit,
        "torque_unit": flight.torque_unit,
        "level": flight.limit_level,
        "learned": uncertainty_words([flight.estimates]),
    }


def draw_flight(flight: Flight) -> Drawing:
    """A row a joint: external torque with its limits, observer and uncertainty, motor torque, speed."""
    joints, n = flight.recording.joints, len(flight.recording.joints)
    columns = ("tau_ext", "observer", "tau", "dq")
    figure = Figure(figsize=(WIDTH_IN, 0.9 + (1.75 if n <= 3 else 1.2) * n), layout="constrained")
    grid = figure.subplots(n, len(columns), sharex=True, squeeze=False, width_ratios=(1.7, 1.2, 1, 1))
    for joint, name in enumerate(joints):
        for axes, column in zip(grid[joint], columns, strict=True):
            draw_signal(axes, flight, column, joint, slice(None))
        grid[joint, 0].set_ylabel(name_lines(name), fontweight="bold" if name == flight.event["joint"] else "normal")
    for axes, column in zip(grid[0], columns, strict=True):
        axes.set_title(COLUMNS[column].format(**heading_words(flight)))
    for axes in grid[-1]:
        axes.set_xlabel("time since the event, s")
    figure.legend(handles=legend(flight, columns), loc="outside upper left", ncols=4)
    return Drawing(
        figure,
        f"All that the event log holds, {flight.since_s[0]:+.2f} s to {flight.since_s[-1]:+.2f} s around the event. "
        f"A joint is found in {flight.limit_level} where its external torque leaves the thresholds."
        + (f" {flight.event['joint']} is the event's joint." if flight.event["joint"] else "")
        + carried_words(flight),
    )


def carried_words(flight: Flight) -> str:
    """The assumed load, for the caption."""
    if not flight.loads:
        return ""
    first, *later = (f"{mass_kg:.3g} kg" if mass_kg else "nothing" for _, mass_kg in flight.loads)
    changes = zip(later, flight.loads[1:], strict=True)
    stages = [first, *(f"{words} from {since_s:+.2f} s on" for words, (since_s, _) in changes)]
    return f" It was taken to carry {', '.join(stages)}."


def draw_close(flight: Flight) -> Drawing:
    """The event's joint around the event: four signals, one above the other."""
    joint, fault = flight.joint, flight.event["what"] == "fault"
    columns = ("tau_ext", "tau", "q", "dq") if fault else ("tau_ext", "observer", "tau", "dq")
    rows = np.flatnonzero((flight.since_s >= -CLOSE_BEFORE_S) & (flight.since_s <= CLOSE_AFTER_S))
    part = slice(rows[0], rows[-1] + 1) if len(rows) else slice(0, 0)
    figure = Figure(figsize=(WIDTH_IN, 5.2), layout="constrained")
    grid = figure.subplots(2, 2, sharex=True)
    for axes, column in zip(grid.flat, columns, strict=True):
        draw_signal(axes, flight, column, joint, part, unit_s=1e-3)
        axes.set_title(COLUMNS[column].format(**heading_words(flight)))
    for axes in grid[-1]:
        axes.set_xlim(-CLOSE_BEFORE_S * 1e3, CLOSE_AFTER_S * 1e3)
        axes.set_xlabel("time since the event, ms")
    figure.legend(handles=legend(flight, columns), loc="outside upper left", ncols=4)
    name = flight.recording.joints[joint]
    chosen = (
        "the event's joint"
        if flight.event["joint"]
        else "the joint nearest to its threshold, since no one had the event"
    )
    return Drawing(figure, f"The event from close by: {name}, {chosen}.")


def draw_signal(axes: Axes, flight: Flight, column: str, joint: int, part: slice, unit_s: float = 1.0) -> None:
    """One signal of one joint, over the regions that its limits and its health make."""
    estimates, recording = flight.estimates, flight.recording
    since = flight.since_s[part] / unit_s
    period = 1 / recording.rate_hz / unit_s
    if column in ("tau_ext", "observer"):
        shade(axes, since, estimates.near_stiction[part, joint], NEAR_STICTION, 0)
    shade(axes, since, estimates.health[part] != OK, NOT_OK, 1)
    if column == "tau_ext":
        limit = flight.limit_nm[part, joint]
        for side in (-1, 1):
            axes.plot(*broken(since, side * limit, period), color=LIMIT, linestyle="--", linewidth=0.9, zorder=3)
        curves: list[tuple[np.ndarray, dict[str, Any]]] = [(estimates.tau_ext[part, joint], {"color": TAU_EXT})]
        if estimates.band_nm is not None:
            whole_s, centre = broken(since, estimates.tau_ext[part, joint], period)
            draw_band(axes, whole_s, centre, broken(since, estimates.band_nm[part, joint], period)[1], TAU_EXT)
    elif column == "observer":
        curves = [
            (estimates.residual[part, joint], {"color": OBSERVER, "linewidth": OBSERVER_WIDTH}),
            (estimates.uncertainty[part, joint], {"color": UNCERTAINTY}),
        ]
    else:
        curves = [(getattr(recording, column)[part, joint], {"color": MEASURED, "linewidth": 0.8})]
    for values, style in curves:
        axes.plot(*broken(since, values, period), zorder=4, **style)
    if not any(np.isfinite(values).any() for values, _ in curves):
        axes.text(0.5, 0.5, "none", transform=axes.transAxes, ha="center", va="center", color="#777777", zorder=6)
    axes.axvline(0, color=EVENT, linewidth=1, zorder=5)
    for since_s, _ in flight.loads[1:]:
        if len(since) and since[0] <= since_s / unit_s <= since[-1]:
            axes.axvline(since_s / unit_s, color=LOAD, linewidth=1, linestyle=":", zorder=5)
    if len(since) > 1:
        axes.set_xlim(min(since[0], 0), max(since[-1], 0))


def shade(axes: Axes, since: np.ndarray, where: np.ndarray, colour: str, zorder: int) -> None:
    """The axes' full height where the condition holds."""
    if where.any():
        axes.fill_between(
            since, 0, 1, where=where, step="post", color=colour, linewidth=0, zorder=zorder,
            transform=axes.get_xaxis_transform(),
        )  # fmt: skip


def broken(since: np.ndarray, values: np.ndarray, period: float) -> tuple[np.ndarray, np.ndarray]:
    """The curve with a hole where samples are missing, so that no line is drawn over them."""
    holes = np.flatnonzero(np.diff(since) > GAP_PERIODS * period) + 1
    return np.insert(since, holes, np.nan), np.insert(values.astype(float), holes, np.nan)


def legend(flight: Flight, columns: Sequence[str]) -> list[Line2D | Patch]:
    """Curves, then marks and regions."""
    sigma = flight.estimates.band_nm
    lines = [
        Line2D([], [], color=TAU_EXT, label="external torque" + ("" if sigma is None else " ± standard error")),
        Line2D([], [], color=LIMIT, linestyle="--", linewidth=0.9, label=f"{flight.limit_level} threshold"),
    ]
    if "observer" in columns:
        lines += [
            Line2D([], [], color=OBSERVER, linewidth=OBSERVER_WIDTH, label="observer r"),
            Line2D([], [], color=UNCERTAINTY, label=uncertainty_words([flight.estimates])),
        ]
    return [
        *lines,
        Line2D([], [], color=MEASURED, linewidth=0.8, label="measured"),
        Line2D([], [], color=EVENT, linewidth=1, label=flight.event["what"]),
        *[Line2D([], [], color=LOAD, linewidth=1, linestyle=":", label="load changed")][: len(flight.loads[1:])],
        Patch(color=NEAR_STICTION, label="near stiction"),
        Patch(color=NOT_OK, label="health not ok"),
    ]


# --- The page of one flight: figures, text and numbers; and of a folder, with an index.


TEMPLATE = Path(__file__).with_name("flight.html.j2")
INDEX = Path(__file__).with_name("flights.html.j2")


@dataclass(frozen=True)
class FlightEntry:
    """A flight in the index of a folder."""

    name: str
    page: str
    """File name of its page; empty: there is none."""
    words: str
    """Headline of the flight, or the reason why it has no page."""


def write_flights_report(folder: Path, out_dir: Path, page_mb: float = PAGE_MB, show: Show | None = None) -> Path:
    """Write a page for every flight of a folder, and index.html that lists them; returns the path of the index.

    A damaged flight has its reason in the index instead of a page.

    Args:
        page_mb: largest size of each page, [MB].
        show: is called with the number of flights done and of all.

    Raises:
        ConfigError: the folder has no flights, or out_dir cannot be written.
        RecordingError: every flight is damaged; the error is that of the first one.
    """
    paths, entries, damaged = flights_in(folder), list[FlightEntry](), list[RecordingError]()
    for done, path in enumerate(paths, 1):
        try:
            page = write_flight_report(path, out_dir, page_mb)
            entries.append(FlightEntry(path.stem, page.name, load_flight(path).explanation[0]))
        except RecordingError as error:
            damaged.append(error)
            entries.append(FlightEntry(path.stem, "", str(error)))
        if show is not None:
            show(done, len(paths), "")
    if len(damaged) == len(paths):
        raise damaged[0]
    index = out_dir / "index.html"
    with atomic_write(index) as part:
        part.write_bytes(render_template(INDEX, folder=folder.name, flights=entries).encode())
    return index


def write_flight_report(flight_path: Path, out_dir: Path, page_mb: float = PAGE_MB) -> Path:
    """Write FLIGHT.html, one page that needs no other file, and figures/FLIGHT*.png; returns the page's path.

    Args:
        flight_path: FLIGHT.parquet that `tauext run` or `monitor` wrote.
        page_mb: size that interactive traces fill the page up to, [MB]; where figures leave no room there are none.

    Raises:
        ConfigError: there is no such flight, out_dir cannot be written, or page_mb < 0.
        RecordingError: a file is damaged, no flight, or of another one.
    """
    check_page_mb(page_mb)
    expect_folder(out_dir)
    flight = load_flight(flight_path)
    name = flight.recording.name
    draw = {name: partial(draw_flight, flight), f"{name}-close": partial(draw_close, flight)}
    page = out_dir / f"{name}.html"
    try:
        with atomic_folder(out_dir) as part:
            figures = [make_figure(one, part / "figures" / f"{stem}.png") for stem, one in draw.items()]
            room = page_mb * 1e6 - len(render_flight(flight, figures[::-1]).encode())
            traces = or_reason(partial(flight_traces, flight, room))
            (part / page.name).write_bytes(render_flight(flight, figures[::-1], traces).encode())
    except OSError as error:
        raise ConfigError(f"{out_dir}: the report cannot be written ({error.strerror or error})") from error
    return page


def render_flight(flight: Flight, figures: list[PageFigure], traces: PageTraces = NO_TRACES) -> str:
    """The whole page."""
    return render_template(
        TEMPLATE,
        headline=flight.explanation[0],
        explanation=flight.explanation[1:],
        facts=facts(flight),
        columns=[column.format(**heading_words(flight)) for column in JOINT_COLUMNS],
        rows=event_rows(flight),
        figures=figures,
        traces=traces,
    )


def facts(flight: Flight) -> list[tuple[str, str]]:
    """The flight's origin, as pairs of a name and a value."""
    recording = flight.recording
    known = {word: flight.facts.get(word) for word in ("recording", "bundle", "version")}
    pairs = [(word, str(value)) for word, value in known.items() if value is not None]
    kept = f"{recording.samples:,} at {recording.rate_hz:g} Hz"
    if dropped := flight.facts.get("dropped_samples"):
        kept += f"; {dropped} more could not be kept"
    return [*pairs, ("samples", kept), ("torque is", recording.torque_timing), *loads(flight)]


def loads(flight: Flight) -> list[tuple[str, str]]:
    """The assumed load, if there was any."""
    words: list[str] = []
    for since_s, mass_kg in flight.loads:
        words.append(f"{mass_kg:.4g} kg" + (f" from {since_s:+.3f} s on" if words else ""))
    return [("carried", ", ".join(words))] if words else []


JOINT_COLUMNS = (
    "joint",
    "tau_ext, {unit}",
    "standard error, {unit}",
    "{level} threshold, {unit}",
    "margin, {unit}",
    "observer, {unit}",
    "{learned}, {unit}",
    "motor torque, {torque_unit}",
    "speed, rad/s",
    "region",
)
FIELDS = ("tau_ext_nm", "contact_sigma_nm", "limit_nm", "margin_nm", "residual_nm", "uncertainty_nm", "tau", "dq_rad_s")


def event_rows(flight: Flight) -> list[tuple[bool, list[str]]]:
    """The estimates of each joint at the event, and whether it is the event's joint; a dash where no number exists."""
    rows, regions = [], flight.event["near_stiction"]
    for j, joint in enumerate(flight.recording.joints):
        fields = {field: flight.event[field][j] for field in FIELDS}
        if flight.limit_level == "contact":
            fields |= contact_margin(flight.event["contact_limit_nm"][j], fields["tau_ext_nm"])
        values = fields.values()
        cells = ["–" if value is None else f"{value:.3f}".replace("-", "−") for value in values]
        name = f"{joint} [{flight.estimate_unit_of(j)}]" if flight.estimate_unit == SEVERAL else joint
        region = "near stiction" if regions[j] else "sliding"
        rows.append((joint == flight.event["joint"], [name, *cells, region]))
    return rows


def contact_margin(limit: float | None, tau_ext: float | None) -> dict[str, float | None]:
    """The contact limit instead of the collision's, and the margin to it."""
    return {"limit_nm": limit, "margin_nm": None if limit is None or tau_ext is None else limit - abs(tau_ext)}
