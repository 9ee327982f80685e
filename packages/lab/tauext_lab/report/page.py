"""The page of a report: summary, numbers, figures and traces."""

from __future__ import annotations

import base64
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib

from tauext.check.before_training import WORTH_A_WARNING
from tauext.errors import ConfigError
from tauext.files.atomic_write import atomic_folder
from tauext.files.preflight import expect_folder
from tauext.fit.tail import duration
from tauext_lab.evaluate.results import EvaluatedBundle, FreeMotion, Numbers, Results, load_results
from tauext_lab.report import paper, tables
from tauext_lab.report.collision_figures import (
    draw_after_contact,
    draw_collisions,
    draw_found_curve,
    draw_missed_curve,
    draw_strength,
)
from tauext_lab.report.error_figures import (
    draw_error_against_sigma,
    draw_error_over_speed,
    draw_free_motion,
    draw_learning_curves,
    draw_training_loss,
    sigma_table,
)
from tauext_lab.report.force_figures import (
    ASSUMED,
    CLOSING,
    draw_injected,
    draw_noticed_force,
    forces_table,
    injected_words,
    pressed_words,
    surely,
)
from tauext_lab.report.signals import NotAvailable, Signals, expect_same_dataset
from tauext_lab.report.style import RC, Drawing, bundle_colours, save_png
from tauext_lab.report.tables import decimals, method_errors, methods, milliseconds, plural, render_template
from tauext_lab.report.three_collisions import draw_three_collisions
from tauext_lab.report.traces import NO_TRACES, PAGE_MB, PageTraces, chosen_bundles, or_reason, results_traces

# --- The first screen: the test, one method's results, its limitations, and the next steps.


MOST_FALSE_PER_HOUR = 1.0
"""Rate of false alarms at which methods are compared by their misses."""
NO_ALARMS_BELOW = 3.0
"""Without one false alarm in T hours the rate is below 3/T with 95 %: exp(-3) = 0.05."""
RELIABLE = 0.9
"""Share of collisions of one strength with an alarm above which this strength counts as reliably found."""
FEW_HOURS = 1.0
"""With less test motion, a rate an hour is uncertain."""
MOST_JOINTS = 8
"""Largest number of joints whose limits are listed one by one."""
MOST_LETTERS = 16
"""Longest name of a joint that fits into a card beside its limit."""
CONTACT_KINDS = {"pads": "by padded bodies", "pulses": "by force pulses"}


@dataclass(frozen=True)
class Glance:
    """A number and what it means."""

    value: str
    means: str


@dataclass(frozen=True)
class Step:
    """An instruction and its command; empty: no command."""

    words: str
    command: str = ""


@dataclass(frozen=True)
class FirstScreen:
    """Its parts in their order on the page."""

    tested: str
    method: str  # label of the method whose numbers are shown
    why: str  # why this method is shown
    glances: tuple[Glance, ...]
    unseen: tuple[str, ...]
    steps: tuple[Step, ...]


def first_screen(results: Results) -> FirstScreen:
    """The first screen of the method with the fewest misses."""
    bundle = shown_bundle(results)
    several = len(results.bundles) > 1
    return FirstScreen(
        tested=tested(results, bundle),
        method=bundle.label,
        why=f"of {len(results.bundles)} bundles it misses the fewest collisions; others follow"
        if several and bundle.latched and bundle.latched.latched
        else "",
        glances=()
        if is_smoke(results)
        else (found(bundle), false_alarms(bundle), delay(bundle), limits(results, bundle)),
        unseen=tuple(unseen(results, bundle)),
        steps=tuple(steps(results, bundle)),
    )


def is_smoke(results: Results) -> bool:
    """The results only show that everything runs: their numbers are no headline."""
    return results.provenance.get("scale") == "smoke"


def shown_bundle(results: Results) -> EvaluatedBundle:
    """The bundle with the fewest misses at no more than one false alarm an hour, then the smallest errors."""

    def rank(bundle: EvaluatedBundle) -> tuple[float, int, float]:
        points = bundle.missed_curve
        missed = [p.missed for p in points if p.false_per_hour is not None and p.false_per_hour <= MOST_FALSE_PER_HOUR]
        latched = bundle.latched
        errors = [error for error in bundle.free_motion.l1_nm if error is not None]
        return min(missed, default=math.inf), -(latched.latched if latched else 0), sum(errors)

    return min(results.bundles, key=rank)


def tested(results: Results, bundle: EvaluatedBundle) -> str:
    """A sentence about the test data."""
    hours = bundle.free_motion.hours
    motion = f"{duration(hours)} of motion in which nothing touched the arm" if hours else "no free motion"
    kinds = Counter(collision.kind for collision in results.collisions)
    counted = [f"{count} {CONTACT_KINDS[kind]}" for kind, count in sorted(kinds.items()) if kind in CONTACT_KINDS]
    known = (
        f" ({', '.join(counted)})" if sum(kinds[kind] for kind in CONTACT_KINDS) == kinds.total() and counted else ""
    )
    touches = f"{plural(kinds.total(), 'collision')}{known}" if kinds else "no collision"
    unknown = results.unknown_contact_hours
    left_out = f" {duration(unknown)} of unknown contact are left out." if unknown else ""
    return f"Tested on {motion}, and on {touches}; none of it was used in training.{left_out}{rejected_words(bundle)}"


def rejected_words(bundle: EvaluatedBundle) -> str:
    """A sentence about the time in which nothing could be detected; empty if negligible."""
    share = bundle.rejected.share
    if not share or share <= WORTH_A_WARNING:
        return ""
    causes = f" ({', '.join(bundle.rejected.causes)})" if bundle.rejected.causes else ""
    return f" The monitor was not healthy for {share:.0%} of the time{causes}; nothing is detected then."


def found(bundle: EvaluatedBundle) -> Glance:
    latched = bundle.latched
    value, words = collisions_latched(bundle)
    if latched is None or not latched.collisions:
        return Glance(value, f"{words}, so the share found is unknown")
    strong = " (every method must latch those)" if latched.strong else ""
    if latched.unhealthy:
        why = f"; {latched.unhealthy} came while the monitor was not healthy, and nothing is detected"
    else:
        why = "" if latched.latched else "; none pushed a joint over its threshold for as long as an alarm takes"
    return Glance(value, words + strong + why)


def collisions_latched(bundle: EvaluatedBundle) -> tuple[str, str]:
    """How many of all collisions were latched, and what is counted, with the same count of the strong ones.

    `148 of 200`, `collisions latched, 110 of 110 strong ones`; headline and cards show the same.
    """
    latched = bundle.latched
    if latched is None or not latched.collisions:
        return tables.NONE, "no collisions tested"
    strong = f"{latched.strong_latched} of {latched.strong} strong ones" if latched.strong else "none of them strong"
    return f"{latched.latched} of {latched.collisions}", f"collisions latched, {strong}"


def false_alarms(bundle: EvaluatedBundle) -> Glance:
    free = bundle.free_motion
    count, hours = free.false_collisions, free.hours
    if count is None or not hours:
        return Glance(tables.NOT_MEASURED, false_collisions_words(free))
    low, high = free.false_collisions_interval_per_hour or (None, None)
    if count == 0:
        rate = f"fewer than {plain(NO_ALARMS_BELOW / hours)} an hour, the bound of a test this short"
    else:
        rate = f"{plain(count / hours)} an hour"
        if low is not None and high is not None:
            rate += f" (the truth lies between {plain(low)} and {plain(high)}, 95 %)"
    return Glance(f"{count:,}", f"{false_collisions_words(free)}: {rate}")


def delay(bundle: EvaluatedBundle) -> Glance:
    latched = bundle.latched
    if latched is None or latched.delay_median_s is None:
        return Glance("–", "delay from the touch to the alarm: not available")
    most = f"; 95 % within {milliseconds(latched.delay_p95_s)} ms" if latched.delay_p95_s is not None else ""
    return Glance(
        f"{milliseconds(latched.delay_median_s)} ms",
        f"from the first touch to the alarm, for half of them{most} (soft touches take long to grow)",
    )


def limits(results: Results, bundle: EvaluatedBundle) -> Glance:
    words = "push on a joint that raises an alarm while it moves" + (
        " in the usual way; the threshold follows the motion" if bundle.limits.moving else ""
    )
    near = joint_list(results, bundle.limits.near_stiction_nm)
    at_rest = f"; at rest or creeping: {near}" if near else ""
    return Glance(joint_list(results, bundle.limits.sliding_nm) or "–", f"{words}{at_rest}")


def unseen(results: Results, bundle: EvaluatedBundle) -> list[str]:
    """Its limitations, with the test's results."""
    lines = ["Touches that push every joint by less than its threshold." + weak_words(bundle)]
    lines.append(
        "Forces that turn no joint: along a link towards the base, or through a joint's axis. Encoders and motors do "
        "not feel them."
    )
    lines.append(
        "A payload that training did not have: a new tool or workpiece causes the residual of a lasting touch until "
        "the payload is set in the monitor or the arm is trained with it."
    )
    lines.append("The first second after a start, while the filters fill.")
    return lines


def weak_words(bundle: EvaluatedBundle) -> str:
    """The misses among collisions too weak to be found reliably."""
    bins = [one for one in bundle.by_strength if one.collisions]
    dim = [k for k, one in enumerate(bins) if one.latched < RELIABLE * one.collisions]
    if not dim or bins[dim[-1]].peak_nm_to is None:
        return ""
    below = bins[: dim[-1] + 1]
    missed = sum(one.collisions - one.latched for one in below)
    total = sum(one.collisions for one in below)
    return f" Of {plural(total, 'collision')} below {below[-1].peak_nm_to:g} Nm it missed {missed}."


def steps(results: Results, bundle: EvaluatedBundle) -> list[Step]:
    """What to do next."""
    free, lines = bundle.free_motion, list[Step]()
    if rejected_words(bundle):
        words = "Find out why the monitor rejects so much, record or import again, and evaluate again:"
        lines.append(Step(words, "tauext check"))
    if free.promised_per_hour is None:
        words = (
            "The thresholds have no target false alarm rate. Record an hour or more of the arm's own work with nothing "
        )
        lines.append(Step(f"{words}touching it, and set the thresholds for an acceptable rate:", "tauext calibrate"))
    elif free.promise_kept is False:
        most = free.promised_per_hour if free.at_most_per_hour is None else free.at_most_per_hour
        words = f"The thresholds allow at most {plain(most)} false alarms an hour, and the test had more. "
        words += "Find out what differs (load, speed, temperature), record it, and set new thresholds:"
        lines.append(Step(words, "tauext calibrate"))
    if free.hours and free.hours < FEW_HOURS:
        rate = plain(NO_ALARMS_BELOW / free.hours)
        words = f"{duration(free.hours)} of test motion cannot show a rate below {rate} an hour. Record more before "
        lines.append(Step(f"{words}relying on the result."))
    if not results.collisions:
        lines.append(Step("Record touches and label their times. Without them the share found is unknown."))
    else:
        lines.append(Step("Check the missed collisions: each has a row below, and the traces show it."))
    command = f"tauext run {bundle.name}.tauext RECORDING.parquet --acknowledge-after-s 1"
    lines.append(Step("Run it on a recording:", command))
    lines.append(Step("Keep the arm's own safety functions enabled. tauext is not a safety function."))
    return lines


def joint_list(results: Results, values: Numbers) -> str:
    """`joint1 1.3, joint2 0.5 Nm`; of many joints or long names their range; empty where no number exists."""
    known = [(name, k) for k, name in enumerate(results.joints) if values[k] is not None]
    if not known:
        return ""
    if len(known) > MOST_JOINTS or (len(known) > 1 and max(len(name) for name, _ in known) > MOST_LETTERS):
        several = [value for value in values if value is not None]
        return f"{decimals(min(several), 1)} to {decimals(max(several), 1)} {results.unit}"
    apart = "\N{NO-BREAK SPACE}"  # of a number and its name or unit
    return ", ".join(f"{name}{apart}{decimals(values[k], 1)}" for name, k in known) + f"{apart}{results.unit}"


def plain(value: float) -> str:
    """Two digits, without an exponent."""
    return f"{value:.0f}" if value >= 10 else f"{value:.2g}"


# --- The page: what was done, headline numbers, tables and figures, in one HTML file without requests to any host.


TEMPLATE = Path(__file__).with_name("page.html.j2")
PIXELS_PER_INCH = 100
MOST_TILES = 5
"""Number in one row; more are spread over rows of about the same number."""
SCALES = {
    "smoke": "Scale smoke: seconds of data and training, to test that everything runs. The numbers mean nothing.",
    "quick": "Scale quick: less motion, and every model's network by a short training of its own (recipe dense); "
    "tauext's own recipe is shown, too. The paper's recipe, complete and for all five models, is in --scale full.",
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
    latched: str
    of_what: str
    """What was found."""
    false_collisions: str
    error: str


def render_page(results: Results, figures: dict[str, PageFigure], traces: PageTraces = NO_TRACES) -> str:
    """The whole page.

    Args:
        figures: by the names that the template uses.
        traces: their part of the page.
    """
    colours = bundle_colours([bundle.name for bundle in results.bundles])
    shown = shown_bundle(results)
    return render_template(
        TEMPLATE,
        first=first_screen(results),
        facts=facts(results),
        changed=[
            (bundle.label, list(changed.items()))
            for bundle in results.bundles
            if (changed := bundle.changed_since_training)
        ],
        notice=SCALES.get(str(results.provenance.get("scale"))),
        compared=tables.has_paper(results),
        colours=colours,
        tile_columns=-(-len(results.bundles) // -(-len(results.bundles) // MOST_TILES)),
        tiles=[] if is_smoke(results) else [tile(bundle, results, colours[bundle.name]) for bundle in results.bundles],
        near_stiction=f"{results.near_stiction_rad_s:g}",
        methods=methods(results),
        method_errors=method_errors(results),
        sanity=results.sanity,
        events=tables.events_table(results),
        labels=next((events for *_, events in tables.events_of(results)), None),
        table_one=tables.tables_one(results),
        regions=tables.regions(results),
        limits_move=results.some_limits_move,
        units_note=results.units_note,
        sigma=sigma_table(results),
        touched_links=tables.links_table(results),
        links_worth=[words for one, its in tables.touched(results) if (words := tables.links_worth(one.label, its))],
        touch_kinds=tables.kinds_table(results),
        touch_estimates=tables.touch_estimates_table(results),
        extremes=tables.extremes(results),
        **forces_of(shown, results),
        alarms=tables.alarms(results),
        ten_collisions=tables.collisions(results, results.ten, traces.recordings) if results.ten else None,
        all_collisions=tables.collisions(results, results.collisions, traces.recordings)
        if results.collisions
        else None,
        collision_count=len(results.collisions),
        ten_count=len(results.ten),
        paper=paper,
        figures=figures,
        traces=traces,
    )


def forces_of(shown: EvaluatedBundle, results: Results) -> dict[str, Any]:
    """What push is detected: one that lasts, and added ones."""
    lasting, added = shown.forces.lasting, shown.forces.added
    return {
        "forces_table": forces_table(results.bundles, shown),
        "forces_of": shown.label,
        "lasting": lasting,
        "lasting_times": surely(lasting.error_share) if lasting and lasting.error_share else None,
        "lasting_closing": CLOSING,
        "added": added,
        "added_words": injected_words(added) if added and added.curves else "",
        "pressed_words": pressed_words(added) if added else "",
        "added_closing": ASSUMED,
    }


def facts(results: Results) -> list[tuple[str, str]]:
    """Origin of these results, as pairs of a name and a value."""
    names = {
        "command": "command",
        "scale": "scale",
        "seed": "seed",
        "dataset": "dataset",
        "machine": "machine",
        "version": "tauext version",
    }
    pairs = [
        (words, str(results.provenance[key])) for key, words in names.items() if results.provenance.get(key) is not None
    ]
    pairs.append(("joints", ", ".join(results.joints)))
    steps = {bundle.label: f"{bundle.steps:,} steps" for bundle in results.bundles if bundle.steps is not None}
    return pairs + ([("training", by_bundle(steps))] if steps else [])


def by_bundle(values: dict[str, str]) -> str:
    """A value of every bundle, by its label; once if all are equal."""
    if len(values) > 1 and len(set(values.values())) == 1:
        return f"{next(iter(values.values()))} each"
    return "; ".join(f"{label} {value}" for label, value in values.items())


def tile(bundle: EvaluatedBundle, results: Results, colour: str) -> Tile:
    """Headline of one bundle; missing numbers are named as missing."""
    latched, of_what = collisions_latched(bundle)
    error = f"L1 {short_list(bundle.free_motion.l1_nm, results.unit)}"
    return Tile(bundle.label, colour, latched, of_what, false_collisions(bundle.free_motion), error)


def false_collisions_words(free: FreeMotion) -> str:
    """`false collisions in 5.93 minutes of free motion`, without the count."""
    if free.false_collisions is None or not free.hours:
        return "false collisions: not measured, no free motion tested"
    return f"false collision{'' if free.false_collisions == 1 else 's'} in {duration(free.hours)} of free motion"


def false_collisions(free: FreeMotion) -> str:
    """`0 false collisions in 5.93 minutes of free motion`, the count of the headline and the table of methods."""
    count = "" if free.false_collisions is None or not free.hours else f"{free.false_collisions:,} "
    return count + false_collisions_words(free)


def short_list(values: Numbers, unit: str = "Nm") -> str:
    """Two or three joints' numbers in full, more as their range."""
    known = [value for value in values if value is not None]
    if not known:
        return tables.NOT_MEASURED
    if len(values) <= 3:
        return " / ".join(tables.decimals(value, 2) for value in values) + f" {unit}"
    return f"{min(known):.2f} to {max(known):.2f} {unit}"


# --- Draws every figure and writes the page.


LARGEST_PAGE_MB = 1000.0
"""No browser opens a larger one."""


def write_report(
    results_dir: Path, dataset_dir: Path, out_dir: Path, page_mb: float = PAGE_MB, trace_methods: Sequence[str] = ()
) -> Path:
    """Write `figures/*.png` and `report.html`, one page that needs no other file; returns its path.

    What is missing (a bundle, a recording, estimates, a number) is named on the page in its place.

    Args:
        results_dir: what `tauext evaluate` wrote.
        dataset_dir: the dataset that was evaluated.
        page_mb: size that interactive traces fill the page up to, [MB]; where figures and tables leave no room there
            are none.
        trace_methods: bundles whose traces are in the page; none: the five best.

    Raises:
        ConfigError: results.json is missing or damaged, or of another dataset; out_dir cannot be written, page_mb < 0,
            or there is no such bundle.
        RecordingError: a recording or an estimates file is damaged, or they do not belong together.
    """
    check_page_mb(page_mb)
    expect_folder(out_dir)
    results = load_results(results_dir)
    expect_same_dataset(results, results_dir, dataset_dir)
    chosen_bundles(results, trace_methods)
    signals = Signals(dataset_dir, results_dir, results.joints)
    # Figures of recordings first, so that files that do not belong together are refused early.
    draw: dict[str, Callable[[], Drawing]] = {
        "figure-5-free-motion": partial(draw_free_motion, results, signals),
        "figure-6-error-over-speed": partial(draw_error_over_speed, results, signals),
        "figure-7-collisions": partial(draw_collisions, results, signals),
        "figure-8-three-collisions": partial(draw_three_collisions, results, signals),
        "missed-curve": partial(draw_missed_curve, results),
        "strength": partial(draw_strength, results),
        "after-contact": partial(draw_after_contact, results),
        "learning-curves": partial(draw_learning_curves, results),
        "training-loss": partial(draw_training_loss, results),
        "error-against-sigma": partial(draw_error_against_sigma, results),
        "found-curve": partial(draw_found_curve, results),
        "noticed-force": lambda: draw_noticed_force(shown_bundle(results).forces.lasting),
        "injected": lambda: draw_injected(results.bundles, shown_bundle(results)),
    }
    page = out_dir / "report.html"
    try:
        with atomic_folder(out_dir) as part:
            figures = {name: make_figure(one, part / "figures" / f"{name}.png") for name, one in draw.items()}
            linked = PageTraces("", tuple(collision.recording for collision in results.collisions))
            room = page_mb * 1e6 - len(render_page(results, figures, linked).encode())
            traces = or_reason(partial(results_traces, results, signals, room, trace_methods))
            (part / page.name).write_bytes(render_page(results, figures, traces).encode())
        for name, figure in figures.items():
            if figure.png is None:
                (out_dir / "figures" / f"{name}.png").unlink(missing_ok=True)  # of results that had it
    except OSError as error:
        raise ConfigError(f"{out_dir}: the report cannot be written ({error.strerror or error})") from error
    return page


def check_page_mb(page_mb: float) -> None:
    if not 0 <= page_mb <= LARGEST_PAGE_MB:
        raise ConfigError(f"page_mb = {page_mb:g} must be a number of megabytes, 0 to {LARGEST_PAGE_MB:g}")


def make_figure(draw: Callable[[], Drawing], path: Path) -> PageFigure:
    """Draw and save one figure; where it cannot be drawn, the reason in its place."""
    title = path.stem.replace("-", " ").capitalize()
    path.parent.mkdir(parents=True, exist_ok=True)
    with matplotlib.rc_context(RC):
        try:
            drawing = draw()
            save_png(drawing.figure, path)
        except NotAvailable as reason:
            return PageFigure(png=None, caption=f"{title} is not available: {reason}.")
        except (ArithmeticError, ValueError) as error:  # numbers that no axis holds: 1e308 in a damaged file
            path.unlink(missing_ok=True)
            return PageFigure(png=None, caption=f"{title} cannot be drawn: {error}.")
    return PageFigure(png=path.read_bytes(), caption=drawing.caption, width_in=drawing.figure.get_figwidth())
