"""The page: what was done, headline numbers, tables and figures, in one HTML file that asks no host for anything."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from pathlib import Path

from jinja2 import Environment, StrictUndefined

from tauext.report import paper, tables
from tauext.report.error_against_sigma import sigma_table
from tauext.report.events import events_table
from tauext.report.first_screen import first_screen, shown_bundle
from tauext.report.injected import ASSUMED
from tauext.report.injected_figure import injected_table
from tauext.report.methods_table import method_errors, methods
from tauext.report.noticed import surely
from tauext.report.noticed_force import CLOSING, noticed_table
from tauext.report.results import EvaluatedBundle, Numbers, Results
from tauext.report.style import bundle_colours
from tauext.report.touches import kinds_table, links_table, links_worth, told_table
from tauext.report.traces import NO_TRACES, PageTraces

TEMPLATE = Path(__file__).with_name("page.html.j2")
PIXELS_PER_INCH = 100
MOST_TILES = 5
"""In one row; more stand in rows of about the same number."""
SCALES = {
    "smoke": "Scale smoke: seconds of data and training, to test that everything runs. The numbers mean nothing.",
    "quick": "Scale quick: less motion, and every model's network by a short training of its own (recipe dense); "
    "tauext's own recipe stands beside them. The paper's recipe, whole and for all five models, is in --scale full.",
    "full": "Scale full: as much data as the paper's, and every model by its whole recipe beside tauext's short one.",
}


@dataclass(frozen=True)
class PageFigure:
    """A figure as the page shows it: a PNG and its caption, or, without one, the reason."""

    png: bytes | None
    caption: str
    width_in: float = 0.0

    @property
    def width_px(self) -> int:
        return round(self.width_in * PIXELS_PER_INCH)

    @property
    def source(self) -> str:
        return "data:image/png;base64," + base64.b64encode(self.png or b"").decode()


@dataclass(frozen=True)
class Tile:
    """One bundle in three numbers."""

    bundle: str
    colour: str
    found: str
    of_what: str
    """What was found."""
    false_alarms: str
    error: str


def render_page(results: Results, figures: dict[str, PageFigure], traces: PageTraces = NO_TRACES) -> str:
    """The whole page.

    Args:
        figures: by the names that the template uses.
        traces: their part of the page.
    """
    colours = bundle_colours([bundle.name for bundle in results.bundles])
    shown = shown_bundle(results)
    noticed = shown.measured.noticed
    ten = [results.collisions[one] for one in results.ten if one in results.collisions]
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    return environment.from_string(TEMPLATE.read_text(encoding="utf-8")).render(
        first=first_screen(results),
        facts=facts(results),
        changed=[(bundle.label, bundle.changed) for bundle in results.bundles if bundle.changed],
        notice=SCALES.get(str(results.provenance.get("scale"))),
        compared=tables.has_paper(results),
        colours=colours,
        tile_columns=-(-len(results.bundles) // -(-len(results.bundles) // MOST_TILES)),
        tiles=[tile(bundle, results, colours[bundle.name]) for bundle in results.bundles],
        near_stiction=f"{results.near_stiction_rad_s:g}",
        methods=methods(results),
        method_errors=method_errors(results),
        sanity=results.sanity,
        events=events_table(results.events) if results.events else None,
        labels=results.events[0] if results.events else None,
        table_one=tables.tables_one(results),
        regions=tables.regions(results),
        limits_move=results.some_limits_move,
        units_note=results.units_note,
        sigma=sigma_table(results),
        touched_links=links_table(results.touches),
        links_worth=[words for one in results.touches if (words := links_worth(one))],
        touch_kinds=kinds_table(results.touches),
        touches_told=told_table(results, results.touches) if results.touches else None,
        extremes=tables.extremes(results),
        noticed=noticed_table(noticed),
        noticed_by=shown.label,
        noticed_refused=noticed and noticed.refused,
        noticed_gain=noticed and noticed.gain_per_s,
        noticed_times=surely(noticed.error_share) if noticed and noticed.error_share else None,
        noticed_closing=CLOSING,
        injected=shown.measured.injected,
        injected_closing=ASSUMED,
        injected_table=injected_table(results.bundles, shown),
        alarms=tables.alarms(results),
        ten_collisions=tables.collisions(results, ten, traces.recordings) if ten else None,
        all_collisions=tables.collisions(results, results.collisions.values(), traces.recordings)
        if results.collisions
        else None,
        collision_count=len(results.collisions),
        ten_count=len(ten),
        paper=paper,
        figures=figures,
        traces=traces,
    )


def facts(results: Results) -> list[tuple[str, str]]:
    """What made these results, as pairs of a word and its value."""
    told = {
        "command": "command",
        "scale": "scale",
        "seed": "seed",
        "dataset": "dataset",
        "machine": "machine",
        "version": "tauext version",
    }
    pairs = [
        (words, str(results.provenance[key])) for key, words in told.items() if results.provenance.get(key) is not None
    ]
    pairs.append(("joints", ", ".join(results.joints)))
    steps = {bundle.label: f"{bundle.steps:,} steps" for bundle in results.bundles if bundle.steps is not None}
    return pairs + ([("training", by_bundle(steps))] if steps else [])


def by_bundle(values: dict[str, str]) -> str:
    """A value of every bundle, by its label; once where all say the same."""
    if len(values) > 1 and len(set(values.values())) == 1:
        return f"{next(iter(values.values()))} each"
    return "; ".join(f"{label} {value}" for label, value in values.items())


def tile(bundle: EvaluatedBundle, results: Results, colour: str) -> Tile:
    """Headline of one bundle; what does not exist is said to be so."""
    found, of_what = headline(bundle, results)
    error = f"L1 {short_list(bundle.l1_nm, results.unit)}"
    return Tile(bundle.label, colour, found, of_what, false_collisions(bundle), error)


def headline(bundle: EvaluatedBundle, results: Results) -> tuple[str, str]:
    """How many collisions it found that it had to, and what those are.

    Those of the table of methods: strong ones, by an alarm that a monitor would have raised. Results that do not know
    them have the ten that were drawn by seed.
    """
    latched = bundle.measured.latched
    if latched is not None and latched.strong:
        return f"{latched.strong_latched} of {latched.strong}", "strong collisions raised an alarm"
    if bundle.ten_found is not None and results.ten:
        return f"{bundle.ten_found} of {len(results.ten)}", "chosen collisions went over a limit"
    return "none tried", "collisions"


def false_collisions(bundle: EvaluatedBundle) -> str:
    """False collisions in test free motion, as the table of methods counts them."""
    count = bundle.measured.false_collisions.count
    if count is None or bundle.hours is None:
        return "false collisions: not available"
    return f"{count:,} false collision{'' if count == 1 else 's'} in {bundle.hours:.2f}\N{NO-BREAK SPACE}h"


def short_list(values: Numbers, unit: str = "Nm") -> str:
    """Two or three joints' numbers in full, more as their range."""
    known = [value for value in values if value is not None]
    if not known:
        return "not available"
    if len(values) <= 3:
        return " / ".join(tables.number(value, 2) for value in values) + f" {unit}"
    return f"{min(known):.2f} to {max(known):.2f} {unit}"
