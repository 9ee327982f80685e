"""The page of one flight: what happened in words and numbers, and its figures."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from jinja2 import Environment, StrictUndefined

from tauext.bundle.units import SEVERAL
from tauext.errors import ConfigError
from tauext.files.room import expect_folder
from tauext.files.whole_file import whole_folder
from tauext.report.flight_figures import draw_close, draw_flight, heading_words
from tauext.report.flight_file import Flight, load_flight
from tauext.report.page import PageFigure
from tauext.report.traces import NO_TRACES, PAGE_MB, PageTraces, flight_traces, or_reason
from tauext.report.write import check_page_mb, make_figure

TEMPLATE = Path(__file__).with_name("flight.html.j2")


def write_flight_report(flight_path: Path, out_dir: Path, page_mb: float = PAGE_MB) -> Path:
    """Write FLIGHT.html, one page that needs no other file, and figures/FLIGHT*.png; returns the page's path.

    Args:
        flight_path: FLIGHT.parquet that `tauext run` or `monitor` wrote, or a folder of flights: then its newest.
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
        with whole_folder(out_dir) as part:
            figures = [make_figure(one, part / "figures" / f"{stem}.png") for stem, one in draw.items()]
            room = page_mb * 1e6 - len(render_flight(flight, figures[::-1]).encode())
            traces = or_reason(partial(flight_traces, flight, room))
            (part / page.name).write_bytes(render_flight(flight, figures[::-1], traces).encode())
    except OSError as error:
        raise ConfigError(f"{out_dir}: the report cannot be written ({error.strerror or error})") from error
    return page


def render_flight(flight: Flight, figures: list[PageFigure], traces: PageTraces = NO_TRACES) -> str:
    """The whole page."""
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    return environment.from_string(TEMPLATE.read_text(encoding="utf-8")).render(
        name=flight.recording.name,
        headline=flight.explanation[0],
        explanation=flight.explanation[1:],
        facts=facts(flight),
        columns=[column.format(**heading_words(flight)) for column in COLUMNS],
        rows=event_rows(flight),
        figures=figures,
        traces=traces,
    )


def facts(flight: Flight) -> list[tuple[str, str]]:
    """Where the flight comes from, as pairs of a word and its value."""
    recording = flight.recording
    known = {word: flight.facts.get(word) for word in ("recording", "bundle", "version")}
    pairs = [(word, str(value)) for word, value in known.items() if value is not None]
    kept = f"{recording.samples:,} at {recording.rate_hz:g} Hz"
    if dropped := flight.facts.get("dropped_samples"):
        kept += f"; {dropped} more could not be kept"
    return [*pairs, ("samples", kept), ("torque is", recording.torque_timing), *loads(flight)]


def loads(flight: Flight) -> list[tuple[str, str]]:
    """What the arm was taken to carry, where it ever carried anything; flights of older versions do not know."""
    words: list[str] = []
    for since_s, mass_kg in flight.loads:
        words.append(f"{mass_kg:.4g} kg" + (f" from {since_s:+.3f} s on" if words else ""))
    return [("carried", ", ".join(words))] if words else []


COLUMNS = (
    "joint",
    "tau_ext, {unit}",
    "standard error, {unit}",
    "{level} limit, {unit}",
    "margin, {unit}",
    "observer, {unit}",
    "{learned}, {unit}",
    "motor torque, {torque_unit}",
    "speed, rad/s",
    "region",
)
FIELDS = ("tau_ext_nm", "contact_sigma_nm", "limit_nm", "margin_nm", "residual_nm", "uncertainty_nm", "tau", "dq_rad_s")


def event_rows(flight: Flight) -> list[tuple[bool, list[str]]]:
    """What was said of each joint at the event, and whether it is the event's joint; a dash where no number exists."""
    rows, n = [], len(flight.recording.joints)
    regions = flight.event.get("near_stiction") or [None] * n
    for j, joint in enumerate(flight.recording.joints):
        said = {field: (flight.event.get(field) or [None] * n)[j] for field in FIELDS}
        if flight.limit_level == "contact":
            said |= contact_margin((flight.event.get("contact_limit_nm") or [None] * n)[j], said["tau_ext_nm"])
        values = said.values()
        cells = ["–" if value is None else f"{value:.3f}".replace("-", "−") for value in values]
        name = f"{joint} [{flight.estimate_unit_of(j)}]" if flight.estimate_unit == SEVERAL else joint
        region = {None: "–", True: "near stiction", False: "sliding"}[regions[j]]
        rows.append((joint == flight.event["joint"], [name, *cells, region]))
    return rows


def contact_margin(limit: float | None, tau_ext: float | None) -> dict[str, float | None]:
    """The contact limit in the place of the collision's, and the margin to it."""
    return {"limit_nm": limit, "margin_nm": None if limit is None or tau_ext is None else limit - abs(tau_ext)}
