"""Tables of the report: results beside the paper's, and the comparison of methods."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

from jinja2 import Environment, StrictUndefined

from tauext.fit.tail import duration
from tauext_lab.evaluate.results import (
    CollisionVerdict,
    EvaluatedBundle,
    EventCounts,
    Events,
    FreeMotion,
    LabelledCollision,
    Numbers,
    Results,
    SanityRow,
    Touches,
    TouchEstimate,
)
from tauext_lab.report import paper

# --- The page's tables: ours beside the paper's where the paper has a number, a dash where there is none.


NONE = "–"
NOT_MEASURED = "not measured"
"""In free motion, of which the dataset has none."""


@dataclass(frozen=True)
class Row:
    """Cells of one line; `bundle` gives its colour, `opens` a line above it, `link` an address to its second cell."""

    cells: tuple[str, ...]
    bundle: str | None = None
    opens: bool = False
    link: str = ""


@dataclass(frozen=True)
class Table:
    """`groups` are headings over the columns, each with how many columns it spans; `words` columns are left-aligned."""

    groups: tuple[tuple[str, int], ...]
    columns: tuple[str, ...]
    rows: tuple[Row, ...]
    words: int


def block(label: str, lines: Iterable[Sequence[str]], bundle: str | None = None) -> list[Row]:
    """Rows about one thing: label, colour and the line above are the first row's alone."""
    rows = enumerate(lines)
    return [Row((label if k == 0 else "", *one), bundle if k == 0 else None, opens=k == 0) for k, one in rows]


LOOK = Path(__file__).with_name("look.css")
"""Style that pages share: colours, light and dark, wide tables, figures."""


def render_template(template: Path, **facts: Any) -> str:
    """A page, by jinja; a name that it lacks is an error."""
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    look = LOOK.read_text(encoding="utf-8").rstrip()
    return environment.from_string(template.read_text(encoding="utf-8")).render(facts, look=look)


def plural(count: int, word: str) -> str:
    return f"{count:,} {word}{'' if count == 1 else 's'}"


def decimals(value: float | None, digits: int = 3, missing: str = NONE) -> str:
    """A number with so many decimals; `missing`, a dash, where there is none."""
    return missing if value is None else f"{value:.{digits}f}".replace("-", "−")


def whole(value: int | None, missing: str = NONE) -> str:
    return missing if value is None else f"{value:,}"


def free_of(bundle: EvaluatedBundle) -> str:
    """What stands for a missing number of free motion: a dash, or NOT_MEASURED where there was no free motion."""
    return NOT_MEASURED if bundle.free_motion.hours == 0 else NONE


def milliseconds(value_s: float | None, signed: bool = False) -> str:
    """A time in whole milliseconds, without the unit."""
    if value_s is None:
        return NONE
    rounded = round(value_s * 1e3)
    return f"{rounded:{'+' if signed and rounded else ''}d}".replace("-", "−")


def duration_or_dash(hours: float | None) -> str:
    """`24 s`, `33.5 minutes`, `10.2 h`; a dash where there is no time at all."""
    return duration(hours) if hours else NONE


def has_paper(results: Results) -> bool:
    """Whether the paper's arm has as many joints and some bundle is the paper's."""
    return len(results.joints) == paper.JOINTS and any(bundle.model in paper.L1_NM for bundle in results.bundles)


@dataclass(frozen=True)
class Measure:
    """One quantity a joint: ours, and the paper's by case."""

    heading: str
    ours: Callable[[EvaluatedBundle], Numbers]
    published: Mapping[str, tuple[float | None, ...]] | None = None
    digits: int = 3
    factor: float = 1.0
    of_free_motion: bool = True


def by_joint(
    results: Results, measures: Iterable[Measure], last: Mapping[str, Callable[[EvaluatedBundle], str]] | None = None
) -> Table:
    """One row per bundle and joint; our value and the paper's, if published, are side by side.

    Args:
        last: texts of the last columns by their headings, once a bundle.
    """
    measures = tuple(measures)
    show_paper = has_paper(results)
    published = [m.published if show_paper else None for m in measures]
    groups = [("", 2), *((m.heading, 1 if p is None else 2) for m, p in zip(measures, published, strict=True))]
    columns = ["model", "joint"]
    for known in published:
        columns += ["ours"] if known is None else ["ours", "paper"]
    if last:
        groups.append(("training", len(last)))
        columns += last

    def cells(bundle: EvaluatedBundle, joint: int) -> list[str]:
        found = [results.joints[joint]]
        for measure, known in zip(measures, published, strict=True):
            ours = measure.ours(bundle)[joint]
            missing = free_of(bundle) if measure.of_free_motion else NONE
            found.append(decimals(None if ours is None else measure.factor * ours, measure.digits, missing))
            if known is not None:
                found.append(
                    decimals(
                        known[bundle.model][joint] if bundle.model and bundle.model in known else None, measure.digits
                    )
                )
        return found + [text(bundle) if joint == 0 else "" for text in (last or {}).values()]

    rows: list[Row] = []
    for bundle in results.bundles:
        rows += block(bundle.label, (cells(bundle, joint) for joint in range(len(results.joints))), bundle.name)
    return Table(tuple(groups), tuple(columns), tuple(rows), words=2)


def tables_one(results: Results) -> list[tuple[str, Table]]:
    """The paper's Table I, with a heading, of each recipe that several of the paper's models were trained by.

    The paper's own recipe comes first. One table without a heading where there are not several.
    """
    bundles = results.bundles
    counts = Counter(bundle.recipe for bundle in bundles if bundle.model)
    several = [recipe for recipe, count in counts.items() if recipe is not None and count > 1]
    if len(several) < 2:
        return [("", table_one(results))]
    several.sort(key=lambda recipe: recipe != "paper")
    headings = {"paper": "By the paper's own recipe", None: "Others"}
    of = {recipe: [b for b in bundles if b.recipe == recipe and b.model] for recipe in several}
    rest = [bundle for bundle in bundles if not any(bundle in those for those in of.values())]
    parts = [*of.items(), *([(None, rest)] if rest else [])]
    return [
        (headings.get(recipe, f"By recipe {recipe}"), table_one(replace(results, bundles=tuple(those))))
        for recipe, those in parts
    ]


def table_one(results: Results) -> Table:
    """Errors on test free motion; how each was trained, where that differs."""
    unit, squared = results.unit, "N²m²" if results.unit == "Nm" else f"({results.unit})²"
    several_recipes = len({bundle.recipe for bundle in results.bundles}) > 1
    last = {"recipe": lambda bundle: bundle.recipe or NONE} if several_recipes else {}
    if len({bundle.training_minutes for bundle in results.bundles}) > 1:
        last |= {"motion": lambda bundle: duration_or_dash((bundle.training_minutes or 0.0) / 60)}
    return by_joint(
        results,
        (
            Measure(f"L1, {unit}", lambda bundle: bundle.free_motion.l1_nm, paper.L1_NM),
            Measure(f"L2 (RMSE), {unit}", lambda bundle: bundle.free_motion.l2_nm, paper.L2_NM),
            Measure(f"MSE, {squared}", lambda bundle: bundle.free_motion.mse_nm2, paper.MSE_NM2),
        ),
        last=last | {"steps": lambda bundle: whole(bundle.steps)},
    )


def regions(results: Results) -> Table:
    """Errors and limits, sliding and near stiction."""
    limit, unit = limit_heading(results), results.unit
    return by_joint(
        results,
        (
            Measure(f"RMSE sliding, {unit}", lambda bundle: bundle.free_motion.rmse_sliding_nm, paper.RMSE_SLIDING_NM),
            Measure(
                f"RMSE near stiction, {unit}",
                lambda bundle: bundle.free_motion.rmse_near_stiction_nm,
                paper.RMSE_NEAR_STICTION_NM,
            ),
            Measure(
                "share near stiction, %", lambda bundle: bundle.free_motion.near_stiction_share, digits=1, factor=100.0
            ),
            Measure(
                f"{limit} sliding, {unit}",
                lambda bundle: bundle.limits.sliding_nm,
                paper.LIMIT_SLIDING_NM,
                digits=2,
                of_free_motion=False,
            ),
            Measure(
                f"{limit} near stiction, {unit}",
                lambda bundle: bundle.limits.near_stiction_nm,
                digits=2,
                of_free_motion=False,
            ),
        ),
    )


def limit_heading(results: Results) -> str:
    return "threshold in usual motion,\n" if results.some_limits_move else "threshold"


def extremes(results: Results) -> Table:
    """Largest observer output in free motion: how large the uncertainty is that the network has to learn."""
    heading = f"largest |r|, {results.unit}"
    measure = Measure(heading, lambda bundle: bundle.free_motion.observer_peak_nm, paper.OBSERVER_PEAK_NM, digits=1)
    return by_joint(results, (measure,))


def alarms(results: Results) -> Table:
    """One row per bundle: collisions found, false alarms, training."""
    show_paper = has_paper(results)
    groups = [
        ("", 1),
        ("collisions found", 3 if show_paper else 2),
        ("over a threshold in free motion", 3),
        ("training", 4),
    ]
    of = f"of the {len(results.ten_collisions)}"
    columns = ["model", of, *([f"paper, of {paper.COLLISIONS}"] if show_paper else []), "of all"]
    columns += ["of", "times", "an hour", "recipe", "epochs", "batch", "steps"]
    rows = []
    for bundle in results.bundles:
        known = paper.FOUND if bundle.model in paper.L1_NM else None
        cells = [bundle.label, whole(bundle.ten_found), *([whole(known)] if show_paper else []), found_of(bundle)]
        cells += [
            duration_or_dash(bundle.free_motion.hours),
            whole(bundle.free_motion.false_alarms, free_of(bundle)),
            decimals(bundle.free_motion.false_alarms_per_hour, 1, free_of(bundle)),
        ]
        cells += [bundle.recipe or NONE, whole(bundle.epochs), whole(bundle.batch), whole(bundle.steps)]
        rows.append(Row(tuple(cells), bundle.name, opens=True))
    return Table(tuple(groups), tuple(columns), tuple(rows), words=1)


def found_of(bundle: EvaluatedBundle) -> str:
    if not bundle.verdicts:
        return NONE
    return f"{sum(v.found for v in bundle.verdicts.values())} of {len(bundle.verdicts)}"


def collisions(results: Results, chosen: Iterable[LabelledCollision], traced: Collection[str] = ()) -> Table:
    """One row a collision; a bundle's cell gives its delay and, in brackets, the delay against the sensor.

    The first column is the collision's number in figure 7, if shown there. Recordings that are
    `traced` lead to the collision in the page's traces.
    """
    headings = [in_lines(bundle.label) for bundle in results.bundles]
    groups = (("", 5), ("sensor peak, Nm", len(results.joints)), ("delay (against the sensor), ms", len(headings)))
    columns = ("figure 7", "recording", "kind", "touched", "onset, s", *results.joints, *headings)
    rows = []
    for collision in chosen:
        link = results.joints[collision.link] if 0 <= collision.link < len(results.joints) else NONE
        numbered = str(results.ten_collisions.index(collision.id) + 1) if collision.id in results.ten_collisions else ""
        cells = [numbered, collision.recording, collision.kind, f"link of {link}" if link != NONE else NONE]
        cells += [decimals(collision.start_s, 2), *(decimals(peak, 1) for peak in collision.sensor_peak_nm)]
        cells += [verdict_text(bundle.verdicts.get(collision.id)) for bundle in results.bundles]
        window = f"t={collision.start_s - 1:.3f},{collision.start_s + 1:.3f}"
        link = f"#recording={quote(collision.recording)}&{window}" if collision.recording in traced else ""
        rows.append(Row(tuple(cells), link=link))
    return Table(groups, columns, tuple(rows), words=4)


def in_lines(label: str) -> str:
    """A bundle as the heading of a narrow column."""
    return label.replace(", ", ",\n").replace(" + ", " +\n").replace(" recipe", "\nrecipe")


def verdict_text(verdict: CollisionVerdict | None) -> str:
    if verdict is None:
        return NONE
    if not verdict.found:
        return "not found"
    against = milliseconds(verdict.delay_against_sensor_s, signed=True)
    return f"{milliseconds(verdict.delay_s)} ({against})"


# --- The two tables of methods, a row a bundle: alarms, also of detectors without information; errors and limits.


EACH_JOINT = 2
"""Up to this number, each joint has a column; more joints share one column with their range, to fit a page."""


def methods(results: Results) -> Table:
    """False collisions against what limits are set for, collisions latched, delay; a row a bundle and detector."""
    groups = [("", 1), ("false collisions in free motion", 4)]
    groups += [("collisions latched", 2), ("delay against\nthe sensor, ms", 2)]
    columns = ["method", "count", "an hour,\n95 % interval", "set for\nan hour", "kept"]
    columns += ["of all", "of strong", "median", "95 %"]
    rows = [Row(method_cells(bundle), bundle.name, opens=True) for bundle in results.bundles]
    rows += [Row(sanity_cells(row), opens=k == 0) for k, row in enumerate(results.sanity)]
    return Table(tuple(groups), tuple(columns), tuple(rows), words=1)


def method_errors(results: Results) -> Table:
    """Errors and limits of every method, a joint or as their range over the joints."""
    limit, unit = limit_heading(results), results.unit
    apart = len(results.joints) <= EACH_JOINT
    headings = [f"L1, {unit}", f"RMSE sliding,\n{unit}", f"RMSE near\nstiction, {unit}"]
    headings += [f"{limit} sliding,\n{unit}", f"{limit} near\nstiction, {unit}"]
    groups = [("", 1), *((heading, len(results.joints) if apart else 1) for heading in headings)]
    columns = ["method", *(results.joints if apart else (f"{len(results.joints)} joints",)) * len(headings)]
    rows = [Row(error_cells(bundle, apart), bundle.name, opens=True) for bundle in results.bundles]
    return Table(tuple(groups), tuple(columns), tuple(rows), words=1)


def error_cells(bundle: EvaluatedBundle, apart: bool) -> tuple[str, ...]:
    """apart: every joint has a cell."""
    cells, free, limits = [bundle.label], bundle.free_motion, bundle.limits
    for values, digits, missing in (
        (free.l1_nm, 3, free_of(bundle)),
        (free.rmse_sliding_nm, 3, free_of(bundle)),
        (free.rmse_near_stiction_nm, 3, free_of(bundle)),
        (limits.sliding_nm, 2, NONE),
        (limits.near_stiction_nm, 2, NONE),
    ):
        cells += (
            [decimals(value, digits, missing) for value in values] if apart else [number_range(values, digits, missing)]
        )
    return tuple(cells)


def number_range(values: Numbers, digits: int, missing: str = NONE) -> str:
    known = [value for value in values if value is not None]
    return f"{decimals(min(known), digits)} to {decimals(max(known), digits)}" if known else missing


def method_cells(bundle: EvaluatedBundle) -> tuple[str, ...]:
    free, latched = bundle.free_motion, bundle.latched
    low, high = free.false_collisions_interval_per_hour or (None, None)
    cells = [bundle.label, whole(free.false_collisions, free_of(bundle)), interval(low, high)]
    cells += [set_for(free), kept(free)]
    if latched is None or not latched.collisions:
        return (*cells, NONE, NONE, NONE, NONE)
    cells += [f"{latched.latched} of {latched.collisions}", f"{latched.strong_latched} of {latched.strong}"]
    cells += [
        milliseconds(delay, signed=True)
        for delay in (latched.delay_against_sensor_median_s, latched.delay_against_sensor_p95_s)
    ]
    return tuple(cells)


def sanity_cells(row: SanityRow) -> tuple[str, ...]:
    """Not one error or limit; `found` counts an alarm at any moment of a collision, `latched` one that rises in it."""
    share = row.time_in_alarm_share
    in_alarm = "" if share is None else f"in alarm {100 * share:.3g} % of the time"
    found = f"{row.latched} of {row.collisions} (in alarm at {row.found})"
    return (row.name, rate(row.false_per_hour) + "/h", in_alarm, "", "", found, "", "", "")


def set_for(free: FreeMotion) -> str:
    """Rate that limits are set for; of extrapolated limits also the upper end of its interval."""
    most, words = free.at_most_per_hour, rate(free.promised_per_hour)
    return words if most in (None, free.promised_per_hour) else f"{words}, at most {rate(most)}"


def kept(free: FreeMotion) -> str:
    """Whether the test agrees with what limits are set for; `far below` if the rate is much lower."""
    if free.promise_kept is None:
        return NONE
    if not free.promise_kept:
        return "no"
    return "yes" if free.promise_consistent is not False else "yes, far below"


def interval(low: float | None, high: float | None) -> str:
    return NONE if low is None or high is None else f"{rate(low)} to {rate(high)}"


def rate(value: float | None) -> str:
    """A rate an hour to three digits."""
    return NONE if value is None else f"{value:.3g}"


# --- The table of labelled events: found, how late, false alarms an hour of free time, moving and resting apart.


OWN = "the robot's own tau_ext"


def events_of(results: Results) -> list[tuple[str, str | None, Events]]:
    """Label, bundle's name and results of every method compared with labels; none without labels."""
    found: list[tuple[str, str | None, Events]] = [
        (one.label, one.name, one.events) for one in results.bundles if one.events
    ]
    found += [(one.name, None, one.events) for one in results.others]
    found += [(OWN, None, results.own_torque.events)] if results.own_torque else []
    return found if any(events.all.events for *_, events in found) else []


def events_table(results: Results) -> Table | None:
    """One row a method and state that occurred; None where nothing was labelled."""
    groups = (("", 3), ("delay from label, ms", 2), ("delay from onset, ms", 2), ("alarms outside of events", 3))
    columns = ("method", "arm", "found", "median", "95 %", "median", "95 %", "count", "in", "an hour")
    rows = []
    for label, name, events in events_of(results):
        for state in ("all", "moving", "resting"):
            counts: EventCounts = getattr(events, state)
            if state == "all" or counts.events or counts.free_hours:
                whole = state == "all"
                rows.append(Row((label if whole else "", state, *event_cells(counts)), name, opens=whole))
    return Table(groups, columns, tuple(rows), words=2) if rows else None


def event_cells(counts: EventCounts) -> tuple[str, ...]:
    delays = (
        counts.delay_median_s,
        counts.delay_p95_s,
        counts.delay_from_onset_median_s,
        counts.delay_from_onset_p95_s,
    )
    return (
        f"{counts.found} of {counts.events}" if counts.events else NONE,
        *(milliseconds(delay) for delay in delays),
        f"{counts.false_alarms:,}",
        duration_or_dash(counts.free_hours),
        decimals(counts.false_alarms_per_hour, 1),
    )


# --- Reported links and kinds of collisions, compared with the labels.


KINDS = ("impact", "push", "clamp", "load", "unknown")


def touched(results: Results) -> list[tuple[EvaluatedBundle, Touches]]:
    """Bundles that reported a link or a kind, with both."""
    return [(b, b.touches) for b in results.bundles if b.touches and (b.touches.links or b.touches.kinds)]


def links_table(results: Results) -> Table | None:
    """A row a bundle and touched link; None where no link was reported."""
    placing = [(bundle, one.links) for bundle, one in touched(results) if one.links is not None]
    if not placing:
        return None
    joints = placing[0][1].joints
    rows: list[Row] = []
    for bundle, links in placing:
        lines = [
            (joint, *(str(count or "") for count in counts), f"{counts[k] / sum(counts):.0%}")
            for k, (joint, counts) in enumerate(zip(links.joints, links.table, strict=True))
            if sum(counts)
        ]
        rows += block(bundle.label, lines, bundle.name)
    groups = (("", 1), ("touched", 1), ("estimated to be on the link of", len(joints)), ("", 1))
    return Table(groups, ("model", "link of", *joints, "right"), tuple(rows), words=2)


def links_worth(label: str, one: Touches) -> str:
    """`exact: the right link first in 6 of 8 collisions, among the first two in 7; stated with 90% or more in 3`."""
    links = one.links
    if links is None:
        return ""
    stated = f"stated with {one.stated_from:.0%} or more in {links.stated}"
    right = f", right in {links.stated_right} of them" if links.stated else ""
    return (
        f"{label}: the right link first in {links.first} of {links.collisions} collisions, among the first two in "
        f"{links.first_two}; {stated}{right}"
    )


def kinds_table(results: Results) -> Table | None:
    """A row a bundle and the recordings' word for their contacts; None where no kind was estimated."""
    rows: list[Row] = []
    for bundle, one in touched(results):
        lines = [(word, *(str(of.get(kind) or "") for kind in KINDS)) for word, of in sorted(one.kinds.items())]
        rows += block(bundle.label, lines, bundle.name)
    groups = (("", 2), ("estimated to be", len(KINDS)))
    return Table(groups, ("model", "contacts", *KINDS), tuple(rows), words=2) if rows else None


def touch_estimates_table(results: Results) -> Table | None:
    """A row a collision: the estimate of each bundle; None where no bundle has any."""
    touches = touched(results)
    if not touches:
        return None
    estimates = [{one.id: one for one in touch.reported} for _, touch in touches]
    rows = []
    for collision in results.collisions:
        link = results.joints[collision.link] if 0 <= collision.link < len(results.joints) else NONE
        cells = [collision.recording, decimals(collision.start_s, 2), collision.kind, link]
        rows.append(Row((*cells, *(touch_estimate_words(one.get(collision.id)) for one in estimates))))
    columns = ("recording", "onset, s", "kind", "link of", *(bundle.label for bundle, _ in touches))
    groups = (("", 2), ("labelled", 2), ("estimated: link, newtons, kind", len(touches)))
    return Table(groups, columns, tuple(rows), words=1)


def touch_estimate_words(estimate: TouchEstimate | None) -> str:
    """`joint4 83%, 34 N, push`; a dash where no alarm was raised."""
    if estimate is None:
        return NONE
    parts = [f"{one.joint} {one.probability:.0%}" for one in estimate.links[:1]]
    parts += [] if estimate.force_n is None or not estimate.links else [f"{estimate.force_n:.0f} N"]
    return ", ".join([*parts, *([estimate.kind] if estimate.kind not in (None, "none") else [])]) or NONE
