"""A figure with the words that stand under it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from tauext.bundle.estimates import Estimates
from tauext.report.results import Results
from tauext.report.style import BAND, DPI


@dataclass(frozen=True)
class Drawing:
    figure: Figure
    caption: str


def save_png(figure: Figure, path: Path) -> None:
    """As `figure.savefig` does, with one drawing instead of two: the layout is computed by the drawing itself."""
    figure.set_dpi(DPI)
    FigureCanvasAgg(figure).print_png(path, metadata={"Software": None})


def draw_band(axes: Axes, time: np.ndarray, centre: np.ndarray, sigma: np.ndarray | None, colour: str) -> None:
    """One standard error to either side of a curve, where it is known."""
    if sigma is not None:
        axes.fill_between(time, centre - sigma, centre + sigma, color=colour, alpha=BAND, linewidth=0, zorder=2.5)


def missing_bundles(results: Results, names: Sequence[str]) -> str:
    """A sentence for the caption: which bundles are not drawn, and why; empty where all are."""
    if not names:
        return ""
    return f" Not drawn, since their estimates are missing: {'; '.join(results.labels[n] for n in names)}."


def sigma_words(estimates: Iterable[Estimates]) -> str:
    """A sentence for the caption: what the band is; empty where no estimate has one."""
    if all(said.band_nm is None for said in estimates):
        return ""
    return " Bands are one standard error to either side; a contact widens them until the joint slides again."


def uncertainty_words(estimates: Iterable[Estimates]) -> str:
    """What these estimates' uncertainty is made of: prior; network; prior, network and drift; nothing, said so."""
    several = list(estimates)
    words = ["prior"] if any(said.prior is not None for said in several) else []
    words += ["network"] if any(said.has_network for said in several) else []
    words += ["drift"] if any(said.drift is not None for said in several) else []
    if not words:
        return "nothing learned"
    return ", ".join(words[:-1]) + " and " + words[-1] if len(words) > 1 else words[0]
