"""A figure with the words that stand under it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from matplotlib.figure import Figure

from tauext.data.estimates import Estimates
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


def uncertainty_words(estimates: Iterable[Estimates]) -> str:
    """What these estimates' uncertainty is made of: network; prior and network; prior, network and drift."""
    several = list(estimates)
    words = ["prior"] if any(said.prior is not None for said in several) else []
    words += ["network"] + (["drift"] if any(said.drift is not None for said in several) else [])
    return ", ".join(words[:-1]) + " and " + words[-1] if len(words) > 1 else words[0]
