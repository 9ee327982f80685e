"""The page's tables: ours beside the paper's where the paper has a number, a dash where there is none."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from urllib.parse import quote

from tauext.report import paper
from tauext.report.results import Case, Collision, Numbers, Results, Verdict

NONE = "–"


@dataclass(frozen=True)
class Row:
    """Cells of one line; `case` gives its colour, `opens` a line above it, `link` an address to its second cell."""

    cells: tuple[str, ...]
    case: str | None = None
    opens: bool = False
    link: str = ""


@dataclass(frozen=True)
class Table:
    """`groups` are headings over the columns, each with how many columns it spans; `words` columns are left-aligned."""

    groups: tuple[tuple[str, int], ...]
    columns: tuple[str, ...]
    rows: tuple[Row, ...]
    words: int


def number(value: float | None, digits: int = 3) -> str:
    """A number with so many decimals, a dash where there is none."""
    return NONE if value is None else f"{value:.{digits}f}".replace("-", "−")


def whole(value: int | None) -> str:
    return NONE if value is None else f"{value:,}"


def milliseconds(value_s: float | None, signed: bool = False) -> str:
    """A time in whole milliseconds, without the unit."""
    if value_s is None:
        return NONE
    rounded = round(value_s * 1e3)
    return f"{rounded:{'+' if signed and rounded else ''}d}".replace("-", "−")


def has_paper(results: Results) -> bool:
    """Whether the paper's arm has as many joints and some case is the paper's."""
    return len(results.joints) == paper.JOINTS and any(case.model in paper.L1_NM for case in results.cases)


@dataclass(frozen=True)
class Measure:
    """One quantity a joint: ours, and the paper's by case."""

    heading: str
    ours: Callable[[Case], Numbers]
    published: Mapping[str, tuple[float | None, ...]] | None = None
    digits: int = 3
    factor: float = 1.0


def by_joint(
    results: Results, measures: Iterable[Measure], last: Mapping[str, Callable[[Case], str]] | None = None
) -> Table:
    """One row a case and joint; where the paper gives a measure, ours and the paper's stand side by side.

    Args:
        last: texts of the last columns by their headings, once a case.
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
    rows = []
    for case in results.cases:
        for joint, name in enumerate(results.joints):
            cells = [case.label if joint == 0 else "", name]
            for measure, known in zip(measures, published, strict=True):
                ours = measure.ours(case)[joint]
                cells.append(number(None if ours is None else measure.factor * ours, measure.digits))
                if known is not None:
                    cells.append(
                        number(known[case.model][joint] if case.model and case.model in known else None, measure.digits)
                    )
            cells += [text(case) if joint == 0 else "" for text in (last or {}).values()]
            rows.append(Row(tuple(cells), case.name if joint == 0 else None, opens=joint == 0))
    return Table(tuple(groups), tuple(columns), tuple(rows), words=2)


def table_one(results: Results) -> Table:
    """The paper's Table I: errors on test free motion; how each was trained, where that differs."""
    last = {"recipe": lambda case: case.recipe or NONE} if len({case.recipe for case in results.cases}) > 1 else {}
    return by_joint(
        results,
        (
            Measure("L1, Nm", lambda case: case.l1_nm, paper.L1_NM),
            Measure("L2 (RMSE), Nm", lambda case: case.l2_nm, paper.L2_NM),
            Measure("MSE, N²m²", lambda case: case.mse_nm2, paper.MSE_NM2),
        ),
        last=last | {"steps": lambda case: whole(case.steps)},
    )


def regions(results: Results) -> Table:
    """Errors and limits, sliding and near stiction."""
    return by_joint(
        results,
        (
            Measure("RMSE sliding, Nm", lambda case: case.rmse_sliding_nm, paper.RMSE_SLIDING_NM),
            Measure("RMSE near stiction, Nm", lambda case: case.rmse_near_stiction_nm, paper.RMSE_NEAR_STICTION_NM),
            Measure("share near stiction, %", lambda case: case.near_stiction_share, digits=1, factor=100.0),
            Measure("limit sliding, Nm", lambda case: case.limit_sliding_nm, paper.LIMIT_SLIDING_NM, digits=2),
            Measure("limit near stiction, Nm", lambda case: case.limit_near_stiction_nm, digits=2),
        ),
    )


def extremes(results: Results) -> Table:
    """Largest observer output in free motion: how large the uncertainty is that the network has to learn."""
    measure = Measure("largest |r|, Nm", lambda case: case.observer_peak_nm, paper.OBSERVER_PEAK_NM, digits=1)
    return by_joint(results, (measure,))


def alarms(results: Results) -> Table:
    """One row a case: collisions found, false alarms, training."""
    show_paper = has_paper(results)
    groups = [("", 1), ("collisions found", 3 if show_paper else 2), ("free motion", 3), ("training", 4)]
    of = f"of the {len(results.ten)}"
    columns = ["model", of, *([f"paper, of {paper.COLLISIONS}"] if show_paper else []), "of all"]
    columns += ["hours", "false alarms", "per hour", "recipe", "epochs", "batch", "steps"]
    rows = []
    for case in results.cases:
        known = paper.FOUND if case.model in paper.L1_NM else None
        cells = [case.label, whole(case.ten_found), *([whole(known)] if show_paper else []), found_of(case)]
        cells += [number(case.hours, 2), whole(case.false_alarms), number(case.false_alarms_per_hour, 1)]
        cells += [case.recipe or NONE, whole(case.epochs), whole(case.batch), whole(case.steps)]
        rows.append(Row(tuple(cells), case.name, opens=True))
    return Table(tuple(groups), tuple(columns), tuple(rows), words=1)


def found_of(case: Case) -> str:
    if not case.verdicts:
        return NONE
    return f"{sum(v.found for v in case.verdicts.values())} of {len(case.verdicts)}"


def collisions(results: Results, chosen: Iterable[Collision], traced: Collection[str] = ()) -> Table:
    """One row a collision; a case's cell gives its delay and, in brackets, the delay against the sensor.

    The first column is the number that the collision has in figure 7, where it stands in it. Recordings that are
    `traced` lead to the collision in the page's traces.
    """
    headings = [in_lines(case.label) for case in results.cases]
    groups = (("", 5), ("sensor peak, Nm", len(results.joints)), ("delay (against the sensor), ms", len(headings)))
    columns = ("figure 7", "recording", "kind", "touched", "onset, s", *results.joints, *headings)
    rows = []
    for collision in chosen:
        link = results.joints[collision.link] if 0 <= collision.link < len(results.joints) else NONE
        numbered = str(results.ten.index(collision.id) + 1) if collision.id in results.ten else ""
        cells = [numbered, collision.recording, collision.kind, f"link of {link}" if link != NONE else NONE]
        cells += [number(collision.start_s, 2), *(number(peak, 1) for peak in collision.sensor_peak_nm)]
        cells += [verdict_text(case.verdicts.get(collision.id)) for case in results.cases]
        window = f"t={collision.start_s - 1:.3f},{collision.start_s + 1:.3f}"
        link = f"#recording={quote(collision.recording)}&{window}" if collision.recording in traced else ""
        rows.append(Row(tuple(cells), link=link))
    return Table(groups, columns, tuple(rows), words=4)


def in_lines(label: str) -> str:
    """A case as the heading of a narrow column."""
    return label.replace(", ", ",\n").replace(" + ", " +\n").replace(" recipe", "\nrecipe")


def verdict_text(verdict: Verdict | None) -> str:
    if verdict is None:
        return NONE
    if not verdict.found:
        return "not found"
    against = milliseconds(verdict.delay_against_sensor_s, signed=True)
    return f"{milliseconds(verdict.delay_s)} ({against})"
