"""Colours, sizes and captions of figures."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from tauext.bundle.estimates import Estimates
from tauext_lab.evaluate.results import Results, model_of

# --- Style of figures: one colour a bundle throughout, text that is legible at the page's width, no decoration.


WIDTH_IN = 10.0
"""Width of every figure; the page shows an inch as 100 pixels, so that 9 points are 12.5 pixels."""
DPI = 180

OBSERVER = "#b0b0b0"
OBSERVER_WIDTH = 3.2
SENSOR = "#000000"
CONTACT = "#fbe3cf"
NEAR_STICTION = "#f5d5b8"
SLIDING = "#e9f1f8"
LIMIT = "#404040"
BAND = 0.25
"""Opacity of a band of one standard error, in the colour of its curve."""

# Okabe and Ito's palette, distinguishable for colour-blind readers; black is the sensor's.
CASE_COLOURS = {"exact": "#0072b2", "mass": "#e69f00", "com": "#009e73", "mass+com": "#cc79a7", "none": "#d55e00"}
VARIANT_COLOURS = {"exact": "#56b4e9", "mass": "#8f6200", "com": "#00563f", "mass+com": "#85406a", "none": "#7d3000"}
"""A second bundle of the same model has its colour, lighter or darker."""
OTHER_COLOURS = ("#7f3c8d", "#6b6b00", "#00a0a8", "#a0522d", "#708090", "#b3123f", "#1f2f70")

MARKS = "osD^vPX<>*hp"
LINES = ("-", (0, (5, 1.5)), (0, (1.5, 1)), (0, (6, 1.5, 1.5, 1.5)))
LEGEND_COLUMNS = 6
GREY = "#8a8a8a"
"""Colour of baselines, which are not methods."""

RC = {
    "text.parse_math": False,  # names of joints may have dollar signs
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.titley": 1.0,  # the default position; computing it from what is above the axes is slow
    "axes.labelsize": 9,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "legend.fontsize": 9,
    "legend.frameon": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.6,
    "axes.edgecolor": "#555555",
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.grid.axis": "y",
    "grid.color": "#e3e3e3",
    "grid.linewidth": 0.5,
    "xtick.color": "#333333",
    "ytick.color": "#333333",
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "lines.linewidth": 1.1,
    "lines.solid_joinstyle": "round",
    "figure.facecolor": "white",
    "figure.constrained_layout.h_pad": 0.05,
    "figure.constrained_layout.w_pad": 0.04,
}


def bundle_colours(names: Sequence[str]) -> dict[str, str]:
    """A colour for every bundle: the paper's and one more of each model have their own, others the rest in order.

    The plain observer is what methods are compared with, hence grey. Where no bundle is of the paper's, its colours are
    free, and taken first: they are the easiest to distinguish.
    """
    known = CASE_COLOURS | {"observer": GREY}
    own = {name: known.get(name) or VARIANT_COLOURS.get(model_of(name) or "") for name in names}
    paper = [*CASE_COLOURS.values(), *VARIANT_COLOURS.values()]
    free = (*OTHER_COLOURS, *(c for c in paper if c not in own.values()))
    if not set(own.values()) & set(paper):
        free = (*CASE_COLOURS.values(), *OTHER_COLOURS, *VARIANT_COLOURS.values())
    colours: dict[str, str] = {}
    others = 0
    for name in names:
        colour = own[name]
        if colour is None or colour in colours.values():
            colour = free[others % len(free)]
            others += 1
        colours[name] = colour
    return colours


def bundle_strokes(names: Sequence[str]) -> dict[str, dict]:
    """Keyword arguments of a curve for every bundle: its colour, a mark of its own and one of four kinds of line.

    So a dozen curves can be distinguished without their colours.
    """
    colours = bundle_colours(names)
    return {
        name: {"color": colours[name], "marker": MARKS[k % len(MARKS)], "linestyle": LINES[k // 3 % len(LINES)]}
        for k, name in enumerate(names)
    }


def use_log_height(axes: Axes) -> None:
    """A logarithmic vertical axis with plain numbers at 1, 2 and 5 of every decade."""
    axes.set_yscale("log")
    _number_plainly(axes.yaxis)


def use_log_width(axes: Axes) -> None:
    """Use a logarithmic horizontal axis with plain numbers."""
    axes.set_xscale("log")
    _number_plainly(axes.xaxis)


def use_log_counts(axes: Axes) -> None:
    """Use a logarithmic horizontal axis for counts from tens to millions, with numbers at 100, 1k, 10k."""
    axes.set_xscale("log")
    _number_plainly(axes.xaxis, (1,))
    axes.xaxis.set_major_formatter(
        FuncFormatter(lambda value, _: f"{value / 1e3:g}k" if value >= 1e3 else f"{value:g}")
    )


def _number_plainly(axis: Axis, marks: Sequence[int] = (1, 2, 5)) -> None:
    axis.set_major_locator(LogLocator(subs=marks))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def panel_grid(
    count: int, most_columns: int, width_in: tuple[float, float], height_in: tuple[float, float], **share: bool
) -> tuple[Figure, list[Axes], int]:
    """A figure of so many panels in rows of about the same number, its axes, and the number of columns.

    Args:
        width_in: of what all columns share, and of each column; WIDTH_IN at most in all.
        height_in: of what all rows share, and of each row.
    """
    rows = -(-count // most_columns)
    columns = -(-count // rows)
    size = min(WIDTH_IN, width_in[0] + width_in[1] * columns), height_in[0] + height_in[1] * rows
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False, **share)
    for axes in grid.flat[count:]:
        axes.remove()
    return figure, list(grid.flat[:count]), columns


def write_above(axes: Axes, x: float, text: str, **style: str) -> None:
    """A word above the axes, centred at this place of the horizontal axis."""
    to = {"xycoords": ("data", "axes fraction"), "xytext": (0, 3), "textcoords": "offset points"}
    axes.annotate(text, (x, 1), ha="center", **to, **style)


def sentence(text: str) -> str:
    """With a capital at its start, the rest as it is."""
    return text[:1].upper() + text[1:]


LETTERS_A_LINE = 14
"""Letters of a name beside a row of 1.2 inches."""


def name_lines(name: str) -> str:
    """A joint's name in lines that fit beside a row of a figure, broken behind `_`, `-`, `.`, `/` and blanks."""
    lines = [""]
    for part in re.findall(r"[^_\-./ ]*[_\-./ ]*", name):
        for piece in (part[k : k + LETTERS_A_LINE] for k in range(0, len(part), LETTERS_A_LINE)):
            if len(lines[-1]) + len(piece) > LETTERS_A_LINE and lines[-1]:
                lines.append("")
            lines[-1] += piece
    return "\n".join(lines)


def label_joint(axes: Axes, joint: str, quantity: str = "torque, Nm") -> None:
    """Name a row by its joint."""
    axes.set_ylabel(f"{name_lines(joint)}\n{quantity}")


# --- A figure and its caption.


@dataclass(frozen=True)
class Drawing:
    figure: Figure
    caption: str


def save_png(figure: Figure, path: Path) -> Path:
    """Save the figure with one drawing, which computes the layout, too; `figure.savefig` draws twice."""
    figure.set_dpi(DPI)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # a letter of a joint's name that the font lacks
        FigureCanvasAgg(figure).print_png(path, metadata={"Software": None})
    return path


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
    if all(one.band_nm is None for one in estimates):
        return ""
    return " Bands are one standard error to either side; a contact widens them until the joint slides again."


def uncertainty_words(estimates: Iterable[Estimates]) -> str:
    """Sources of these estimates' uncertainty: prior; network; prior, network and drift; or `nothing learned`."""
    several = list(estimates)
    words = ["prior"] if any(one.prior is not None for one in several) else []
    words += ["network"] if any(one.has_network for one in several) else []
    words += ["drift"] if any(one.drift is not None for one in several) else []
    if not words:
        return "nothing learned"
    return ", ".join(words[:-1]) + " and " + words[-1] if len(words) > 1 else words[0]
