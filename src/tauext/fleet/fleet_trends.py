"""Friction over the dates as small pictures, one a joint: every arm a line, and the band of healthy ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np

from tauext.fleet.fleet_cells import NAMED

WIDTH, HEIGHT = 260, 150
LEFT, RIGHT, TOP, BOTTOM = 34, 8, 8, 20
TICKS = (0.25, 0.5, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.3, 1.5, 2.0, 3.0, 4.0)
MOST_TICKS = 6
MOST_LABELS = 4
MORE, LESS, USUAL = "#d55e00", "#0072b2", "#b5b5b5"


@dataclass(frozen=True)
class Trend:
    joint: str
    svg: str


@dataclass(frozen=True)
class Line:
    """One arm's joint: dates by their place on the axis, logarithms."""

    arm: str
    at: tuple[int, ...]
    x: tuple[float, ...]
    way: int
    """1: named for more, -1: for less, 0: not named."""


def trends(group: Mapping[str, Any], arms: Sequence[Mapping[str, Any]], labels: Sequence[str]) -> list[Trend]:
    """Of every joint; none where no arm has two dates.

    Args:
        arms: whose visits are of this group.
        labels: of all dates, in their order; a visit's "at" says which is its own.
    """
    if len(labels) < 2:
        return []
    found = []
    for j, joint in ((None, "all joints together"), *enumerate(group["joints"])):
        lines = [line for arm in arms if (line := line_of(arm, j)) is not None]
        if lines:
            found.append(Trend(joint, draw(lines, bands(group, j, len(labels)), labels)))
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
    """The picture; its text says what is named."""
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
    said = f"{len(lines)} arms; named: {', '.join(named) or 'none'}"
    head = f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(said)}">'
    return f"{head}{''.join(parts)}</svg>"


def points(pairs: Sequence[tuple[float, float]], px: Any, py: Any) -> str:
    return " ".join(f"{px(at):.1f},{py(value):.1f}" for at, value in pairs)
