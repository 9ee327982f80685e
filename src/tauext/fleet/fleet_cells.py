"""Cells of the fleet's tables: a number, its place in a sorted column, how far out it is, and where it leads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

NAMED, WATCH = 0.5, 0.1
FULL = 3.0
"""Spreads from which on the colour is full: one healthy joint in 400."""
LEAST_SPREAD = 0.02
"""Numbers that differ by less than some per cent are the same."""
FAINT = 0.5
"""Fewer are white."""
MORE_RGB, LESS_RGB = (246, 180, 138), (156, 199, 228)


@dataclass(frozen=True)
class Cell:
    """One number or word."""

    text: str
    value: float | None = None
    """For sorting; None: the text is sorted."""
    out: float = 0.0
    """How far from the middle, in spreads."""
    probability: float | None = None
    """Of what is named at this place."""
    link: str = ""
    title: str = ""
    word: bool = False
    long: bool = False

    @property
    def classes(self) -> str:
        """How it looks: named, to be watched, or words."""
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
        """Beside the number where it is worth a look; else empty."""
        return percent(self.probability) if self.probability is not None and self.probability >= WATCH else ""

    @property
    def sort(self) -> str:
        return "" if self.value is None else f"{self.value:.6g}"


NONE = Cell("–")


def colour(out: float) -> str:
    """Whiter the nearer to the middle."""
    share = min(abs(out) / FULL, 1.0)
    rgb = MORE_RGB if out > 0 else LESS_RGB
    return "#" + "".join(f"{round(255 + share * (one - 255)):02x}" for one in rgb)


def percent(probability: float) -> str:
    """Never all of it: a model says it."""
    return ">99 %" if probability > 0.99 else f"{100 * probability:.0f} %" if probability >= 0.01 else "<1 %"


def number(value: float | None, digits: int = 3) -> str:
    """With so many digits that count."""
    if value is None or not np.isfinite(value):
        return "–"
    return f"{value:.{digits}g}" if abs(value) < 10**digits else f"{value:,.0f}"


def outness(values: Sequence[float | None]) -> list[float]:
    """How far each number is from the median of all, in robust spreads of its column; 0 where that tells nothing."""
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
