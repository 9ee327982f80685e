"""A figure with the words that stand under it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from matplotlib.figure import Figure

from tauext.report.results import Results


@dataclass(frozen=True)
class Drawing:
    figure: Figure
    caption: str


def missing_bundles(results: Results, names: Sequence[str]) -> str:
    """A sentence for the caption: which bundles are not drawn, and why; empty where all are."""
    if not names:
        return ""
    return f" Not drawn, since their estimates are missing: {'; '.join(results.labels[n] for n in names)}."
