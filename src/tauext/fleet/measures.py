"""Tables and trends of a fleet's page: arms by joints, friction over dates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np

from tauext.fleet.odds import NAMED

# --- Cells of the fleet's tables: a number, its place in a sorted column, how far out it is, and where it leads.


WATCH = 0.1
FULL = 3.0
"""Spreads from which on the colour is full: one healthy joint in 400."""
LEAST_SPREAD = 0.02
"""Numbers that differ by less than some per cent are the same."""
FAINT = 0.5
"""Cells with fewer spreads are white."""
MORE_RGB, LESS_RGB = (246, 180, 138), (156, 199, 228)


@dataclass(frozen=True)
class Cell:
    """One number or word."""

    text: str
    value: float | None = None
    """For sorting; None: the text is sorted."""
    out: float = 0.0
    """Distance from the centre, in spreads."""
    probability: float | None = None
    """Probability of the deviation named here."""
    link: str = ""
    title: str = ""
    word: bool = False
    long: bool = False

    @property
    def classes(self) -> str:
        """CSS classes of the cell: named, to be watched, or words."""
        p = self.probability or 0.0
        if p >= NAMED:
            return "more named" if self.out > 0 else "less named"
        return "watch" if p >= WATCH else "word long" if self.long else "word" if self.word else ""

    @property
    def background(self) -> str:
        """Empty: white."""
        return colour(self.out) if abs(self.out) >= FAINT else ""

    @property
    def percent(self) -> str:
        """The probability beside the number if it is large enough to show; else empty."""
        return percent(self.probability) if self.probability is not None and self.probability >= WATCH else ""

    @property
    def sort(self) -> str:
        return "" if self.value is None else f"{self.value:.6g}"


NONE = Cell("–")


def colour(out: float) -> str:
    """Colour of a cell, whiter towards the centre."""
    share = min(abs(out) / FULL, 1.0)
    rgb = MORE_RGB if out > 0 else LESS_RGB
    return "#" + "".join(f"{round(255 + share * (one - 255)):02x}" for one in rgb)


def percent(probability: float) -> str:
    """The probability in per cent; never 100 %, since it comes from a model."""
    return ">99 %" if probability > 0.99 else f"{100 * probability:.0f} %" if probability >= 0.01 else "<1 %"


def number(value: float | None, digits: int = 3) -> str:
    """A number with this many significant digits."""
    if value is None or not np.isfinite(value):
        return "–"
    return f"{value:.{digits}g}" if abs(value) < 10**digits else f"{value:,.0f}"


def outness(values: Sequence[float | None]) -> list[float]:
    """Distance of each number from the median, in robust spreads of its column; 0 with fewer than five."""
    known = np.array([value for value in values if value is not None and value > 0])
    if len(known) < 5:
        return [0.0] * len(values)
    logs = np.log(known)
    middle = float(np.median(logs))
    spread = 1.4826 * float(np.median(np.abs(logs - middle)))
    spread = max(spread, LEAST_SPREAD)
    return [0.0 if value is None or value <= 0 else float((np.log(value) - middle) / spread) for value in values]


def likelier(row: Mapping[str, Any], joint: int) -> tuple[float | None, float]:
    """Probability of the likelier of more and less, and its sign."""
    more, less = ((row.get(key) or [])[joint : joint + 1] for key in ("more", "less"))
    if not more or more[0] is None or less[0] is None:
        return None, 0.0
    return (more[0], 1.0) if more[0] >= less[0] else (less[0], -1.0)


# --- Tables of arms by joints, one for each measure.


Content = Mapping[str, Any]
CONSTANT_SINCE = "Torque constant relative to that of the arm's first date, estimated from gravity."


@dataclass(frozen=True)
class ArmRow:
    arm: str
    link: str
    cells: tuple[Cell, ...]
    failed: bool = False


@dataclass(frozen=True)
class Measure:
    """One table."""

    name: str
    explanation: str
    rows: tuple[ArmRow, ...]
    heads: tuple[str, ...]


def measures(group: Content, arms: Sequence[Content], link: Mapping[str, str]) -> list[Measure]:
    """All measures with data, the most informative first."""
    unit = units_word(group["units"])
    compared = [
        ("since first date", "own", "friction", "Friction by that of the arm's own first date, ± its standard error."),
        (
            "beside the fleet",
            "fleet",
            "friction",
            "Friction at 0.5 rad/s by the middle of the fleet's, ± standard error.",
        ),
        ("constant since", "own", "constant", CONSTANT_SINCE),
        (
            "constant beside the fleet",
            "fleet",
            "constant",
            "Torque constant, as motion shows it, by the fleet's middle.",
        ),
    ]
    plain = [
        ("friction", "friction_nm", f"Friction at 0.5 rad/s, {unit}."),
        ("ripple", "ripple_nm", f"Ripple of motor and gear, amplitude, {unit}."),
        ("limit", "limit_nm", f"Collision limit while the joint moves in the usual way, {unit}."),
        ("limit at rest", "near_stiction_limit_nm", f"Collision limit near standstill, {unit}."),
        ("error", "error_nm", f"Error (RMSE) on free motion that training did not see, {unit}."),
    ]
    found = [relative(group, arms, link, *one) for one in compared]
    found += [absolute(group, arms, link, *one) for one in plain]
    return [one for one in found if any(cell is not NONE for row in one.rows for cell in row.cells)]


def relative(
    group: Content,
    arms: Sequence[Content],
    link: Mapping[str, str],
    name: str,
    against: str,
    what: str,
    explanation: str,
) -> Measure:
    """Factors with their errors, coloured by how far they are from what the arm does and what all arms do."""
    rows, with_arm = [], what == "friction"
    for arm in arms:
        entries, to = (arm["visits"][-1].get(against) or {}).get(what), link.get(arm["serial"], "")
        cells = [
            NONE
            if entries is None or entries["value"][j] is None
            else factor_cell(group, arm, entries, j, against, what, to)
            for j in range(len(group["joints"]))
        ]
        if with_arm:  # what all joints of the arm do together
            factor = float(np.exp(entries["arm"])) if entries and "arm" in entries else None
            cells.append(NONE if factor is None else Cell(f"{factor:.2f}", factor, link=to))
        rows.append(ArmRow(arm["serial"], to, tuple(cells)))
    return Measure(
        name, explanation, tuple(rows), (*group["joints"], "all joints") if with_arm else tuple(group["joints"])
    )


def factor_cell(group: Content, arm: Content, entries: Content, joint: int, against: str, what: str, link: str) -> Cell:
    """One factor: in logarithms beside the centre of the table, by the spread of healthy joints."""
    table = table_of(group, arm, against, what)
    value, error = entries["value"][joint], entries["error"][joint]
    out = 0.0
    if table is not None:
        apart = value - table["centre"][joint]
        out = (apart - entries["arm"]) / float(np.hypot(table["joint_spread"], error))
        value = apart if against == "fleet" else value
    probability, sign = likelier(entries, joint)
    if probability is not None and probability >= 0.1 and out * sign < 0.5:
        out = 0.51 * sign
    factor = float(np.exp(min(value, 20)))
    text = f"{factor:.2f} ± {factor * error:.2f}"
    title = f"{arm['serial']} {group['joints'][joint]}: {text}, {out:+.1f} spreads"
    return Cell(text, factor, out, probability, link, title)


def table_of(group: Content, arm: Content, against: str, what: str) -> Content | None:
    """Variation of healthy arms, from the table of this arm's last date."""
    if against == "fleet":
        return group["tables"].get(f"fleet {what}")
    number = (arm["visits"][-1].get("own") or {}).get("number")
    return group["tables"].get(f"own {what} {number}")


def absolute(
    group: Content, arms: Sequence[Content], link: Mapping[str, str], name: str, key: str, explanation: str
) -> Measure:
    """Numbers as they are, coloured by how far they are from the column's median."""
    joints = range(len(group["joints"]))
    columns = [[at(arm["visits"][-1].get(key), j) for arm in arms] for j in joints]
    out = [outness(column) for column in columns]
    rows = []
    for a, arm in enumerate(arms):
        to = link.get(arm["serial"], "")
        cells = tuple(
            NONE if columns[j][a] is None else Cell(number(columns[j][a]), columns[j][a], out[j][a], link=to)
            for j in joints
        )
        rows.append(ArmRow(arm["serial"], to, cells))
    return Measure(name, explanation, tuple(rows), tuple(group["joints"]))


def at(values: Sequence[float | None] | None, joint: int) -> float | None:
    return values[joint] if values and joint < len(values) else None


def units_word(units: Sequence[str]) -> str:
    """Of all joints; where they differ the bundle's own."""
    return {"N m": "Nm"}.get(units[0], units[0]) if len(set(units)) == 1 else "in the unit of each joint's estimate"


# --- Friction over the dates as small pictures, one a joint: every arm a line, and the band of healthy ones.


WIDTH, HEIGHT = 260, 150
LEFT, RIGHT, TOP, BOTTOM = 34, 8, 8, 20
TICKS = (0.25, 0.5, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.3, 1.5, 2.0, 3.0, 4.0)
MOST_TICKS = 6
MOST_LABELS = 4
MORE, LESS, USUAL = "#d55e00", "#0072b2", "#b5b5b5"


@dataclass(frozen=True)
class Line:
    """One arm's joint: dates by their place on the axis, logarithms."""

    arm: str
    at: tuple[int, ...]
    x: tuple[float, ...]
    way: int  # 1: named for more, -1: for less, 0: not named


def trends(group: Mapping[str, Any], arms: Sequence[Mapping[str, Any]], labels: Sequence[str]) -> list[dict[str, str]]:
    """Of every joint; none where no arm has two dates.

    Args:
        arms: whose visits are of this group.
        labels: of all dates, in their order; a visit's "at" is the index of its own.
    """
    if len(labels) < 2:
        return []
    found = []
    for j, joint in ((None, "all joints together"), *enumerate(group["joints"])):
        lines = [line for arm in arms if (line := line_of(arm, j)) is not None]
        if lines:
            found.append({"joint": joint, "svg": draw(lines, bands(group, j, len(labels)), labels)})
    return found


def line_of(arm: Mapping[str, Any], joint: int | None) -> Line | None:
    """Of a joint beside what its arm does, or of that itself (None); none where it has no second date."""
    at, x, way = [], [], 0
    for visit in arm["visits"]:
        if not visit.get("friction_nm"):
            continue
        own = (visit.get("own") or {}).get("friction")
        whole = own.get("arm", 0.0) if own else 0.0
        value = whole if joint is None else own["value"][joint] if own else 0.0
        if value is None:
            continue
        at.append(visit["at"])
        x.append(value if joint is None else value - whole)
        if own and "more" in own and joint is not None:
            way = 1 if (own["more"][joint] or 0) >= NAMED else -1 if (own["less"][joint] or 0) >= NAMED else 0
    return Line(arm["serial"], tuple(at), tuple(x), way) if len(at) > 1 else None


def bands(group: Mapping[str, Any], joint: int | None, dates: int) -> list[tuple[float, float]]:
    """Low and high of healthy joints at each date; nothing at the first one."""
    out = [(0.0, 0.0)]
    for number in range(1, dates):
        table = group["tables"].get(f"own friction {number}")
        if table is None:
            return []
        half = 2 * table["arm_spread" if joint is None else "joint_spread"]
        middle = 0.0 if joint is None else table["centre"][joint]
        out.append((middle - half, middle + half))
    return out


def draw(lines: Sequence[Line], band: Sequence[tuple[float, float]], labels: Sequence[str]) -> str:
    """The picture as SVG; its text lists what is named."""
    every = [value for line in lines for value in line.x] + [value for pair in band for value in pair]
    low, high = min([*every, -0.1]), max([*every, 0.1])
    low, high = low - 0.05 * (high - low), high + 0.05 * (high - low)

    def px(at: float) -> float:
        return LEFT + (WIDTH - LEFT - RIGHT) * at / (len(labels) - 1)

    def py(value: float) -> float:
        return TOP + (HEIGHT - TOP - BOTTOM) * (high - value) / (high - low)

    parts = []
    if band:
        edge = [*((k, pair[1]) for k, pair in enumerate(band)), *((k, band[k][0]) for k in reversed(range(len(band))))]
        parts.append(f'<polygon points="{points(edge, px, py)}" fill="#eef3ee"/>')
    ticks = [tick for tick in TICKS if low <= np.log(tick) <= high]
    for tick in ticks[:: -(-len(ticks) // MOST_TICKS)]:
        y = py(float(np.log(tick)))
        parts.append(f'<line x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}" stroke="#e3e3e3"/>')
        parts.append(f'<text x="{LEFT - 4}" y="{y + 3:.1f}" text-anchor="end">×{tick:g}</text>')
    step = -(-len(labels) // MOST_LABELS)
    for k in range(0, len(labels), step):
        anchor = "start" if k == 0 else "end" if k == len(labels) - 1 else "middle"
        parts.append(f'<text x="{px(k):.1f}" y="{HEIGHT - 6}" text-anchor="{anchor}">{escape(labels[k])}</text>')
    for line in sorted(lines, key=lambda one: abs(one.way)):
        colour, width = (MORE, 2.2) if line.way > 0 else (LESS, 2.2) if line.way < 0 else (USUAL, 1.0)
        shape = points(list(zip(line.at, line.x, strict=True)), px, py)
        title = f"<title>{escape(line.arm)}: ×{np.exp(line.x[-1]):.2f}</title>"
        parts.append(
            f'<polyline points="{shape}" fill="none" stroke="{colour}" stroke-width="{width}">{title}</polyline>'
        )
        if line.way:
            y = py(line.x[-1])
            place = f'x="{px(line.at[-1]) - 4:.1f}" y="{y - 4:.1f}" text-anchor="end" font-weight="700"'
            parts.append(f"<text {place}>{escape(line.arm)}</text>")
    named = [f"{line.arm} ×{np.exp(line.x[-1]):.2f}" for line in lines if line.way]
    words = f"{len(lines)} arms; named: {', '.join(named) or 'none'}"
    head = f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(words)}">'
    return f"{head}{''.join(parts)}</svg>"


def points(pairs: Sequence[tuple[float, float]], px: Any, py: Any) -> str:
    return " ".join(f"{px(at):.1f},{py(value):.1f}" for at, value in pairs)
