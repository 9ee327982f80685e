"""The two tables of methods, a row a bundle: alarms, with detectors that know nothing under them; errors and limits."""

from __future__ import annotations

from tauext.report.methods import FalseCollisions, SanityRow
from tauext.report.results import EvaluatedBundle, Numbers, Results
from tauext.report.tables import NONE, Row, Table, limit_heading, milliseconds, number, whole

EACH_JOINT = 2
"""So many joints have a column each; of more, the range over all stands in one, or the table would not fit a page."""


def methods(results: Results) -> Table:
    """False collisions against what was promised, collisions latched, delay; a row a bundle and ignorant detector."""
    groups = [("", 1), ("false collisions, test free motion", 4)]
    groups += [("collisions latched", 2), ("delay against\nthe sensor, ms", 2)]
    columns = ["method", "count", "an hour,\n95 % interval", "promised\nan hour", "kept"]
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
    cells = [bundle.label]
    for values, digits in (
        (bundle.l1_nm, 3),
        (bundle.rmse_sliding_nm, 3),
        (bundle.rmse_near_stiction_nm, 3),
        (bundle.limit_sliding_nm, 2),
        (bundle.limit_near_stiction_nm, 2),
    ):
        cells += [number(value, digits) for value in values] if apart else [number_range(values, digits)]
    return tuple(cells)


def number_range(values: Numbers, digits: int) -> str:
    known = [value for value in values if value is not None]
    return f"{number(min(known), digits)} to {number(max(known), digits)}" if known else NONE


def method_cells(bundle: EvaluatedBundle) -> tuple[str, ...]:
    measured = bundle.measured
    false, latched = measured.false_collisions, measured.latched
    cells = [bundle.label, whole(false.count), interval(false.low, false.high), rate(false.promised), kept(false)]
    if latched is None or not latched.collisions:
        return (*cells, NONE, NONE, NONE, NONE)
    cells += [f"{latched.latched} of {latched.collisions}", f"{latched.strong_latched} of {latched.strong}"]
    cells += [milliseconds(delay, signed=True) for delay in (latched.delay_median_s, latched.delay_p95_s)]
    return tuple(cells)


def sanity_cells(row: SanityRow) -> tuple[str, ...]:
    """Not one error or limit; `found` counts an alarm at any moment of a collision, `latched` one that rises in it."""
    share = row.time_in_alarm_share
    in_alarm = "" if share is None else f"in alarm {100 * share:.3g} % of the time"
    found = f"{row.latched} of {row.collisions} (in alarm at {row.found})"
    return (row.name, rate(row.false_per_hour) + "/h", in_alarm, "", "", found, "", "", "")


def kept(false: FalseCollisions) -> str:
    """Whether the test leaves the promise standing; `far below` where it shows that less would have done."""
    if false.kept is None:
        return NONE
    if not false.kept:
        return "no"
    return "yes" if false.consistent is not False else "yes, far below"


def interval(low: float | None, high: float | None) -> str:
    return NONE if low is None or high is None else f"{rate(low)} to {rate(high)}"


def rate(value: float | None) -> str:
    """A rate an hour to three digits."""
    return NONE if value is None else f"{value:.3g}"
