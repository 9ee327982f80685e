"""Draws every figure and writes the page."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import matplotlib

from tauext.errors import ConfigError
from tauext.files.place import Place
from tauext.files.room import expect_folder
from tauext.files.whole_file import whole_folder
from tauext.report.after_contact import draw_after_contact
from tauext.report.collisions_over_time import draw_collisions
from tauext.report.drawing import Drawing, save_png
from tauext.report.error_against_sigma import draw_error_against_sigma
from tauext.report.error_over_speed import draw_error_over_speed
from tauext.report.first_screen import shown_bundle
from tauext.report.found_curve import draw_found_curve
from tauext.report.free_motion import draw_free_motion
from tauext.report.injected_figure import draw_injected
from tauext.report.learning_curves import draw_learning_curves
from tauext.report.missed_curve import draw_missed_curve
from tauext.report.noticed_force import draw_noticed_force
from tauext.report.page import PageFigure, render_page
from tauext.report.results_file import load_results
from tauext.report.same_dataset import expect_same_dataset
from tauext.report.signals import NotAvailable, Signals
from tauext.report.strength import draw_strength
from tauext.report.style import RC
from tauext.report.three_collisions import draw_three_collisions
from tauext.report.traces import PAGE_MB, PageTraces, chosen_bundles, or_reason, results_traces
from tauext.report.training_loss import draw_training_loss

LARGEST_PAGE_MB = 1000.0
"""No browser opens a larger one."""


def write_report(
    results_dir: Path, dataset_dir: Place, out_dir: Path, page_mb: float = PAGE_MB, trace_methods: Sequence[str] = ()
) -> Path:
    """Write `figures/*.png` and `report.html`, one page that needs no other file; returns its path.

    What is missing (a bundle, a recording, estimates, a number) is said on the page where it would stand.

    Args:
        results_dir: what `tauext evaluate` wrote.
        dataset_dir: the dataset that was evaluated.
        page_mb: size that interactive traces fill the page up to, [MB]; where figures and tables leave no room there
            are none.
        trace_methods: bundles whose traces stand in the page; none: the five best.

    Raises:
        ConfigError: results.json is missing or damaged, or of another dataset; out_dir cannot be written, page_mb < 0,
            or there is no such bundle.
        RecordingError: a recording or an estimates file is damaged, or they do not belong together.
    """
    check_page_mb(page_mb)
    expect_folder(out_dir)
    results = load_results(results_dir)
    expect_same_dataset(results, results_dir, dataset_dir)
    chosen_bundles(results, trace_methods)
    signals = Signals(dataset_dir, results_dir, results.joints)
    # Those of recordings first: what does not belong together is refused soon.
    draw: dict[str, Callable[[], Drawing]] = {
        "figure-5-free-motion": partial(draw_free_motion, results, signals),
        "figure-6-error-over-speed": partial(draw_error_over_speed, results, signals),
        "figure-7-collisions": partial(draw_collisions, results, signals),
        "figure-8-three-collisions": partial(draw_three_collisions, results, signals),
        "missed-curve": partial(draw_missed_curve, results),
        "strength": partial(draw_strength, results),
        "after-contact": partial(draw_after_contact, results),
        "learning-curves": partial(draw_learning_curves, results),
        "training-loss": partial(draw_training_loss, results),
        "error-against-sigma": partial(draw_error_against_sigma, results),
        "found-curve": partial(draw_found_curve, results),
        "noticed-force": lambda: draw_noticed_force(shown_bundle(results).measured.noticed),
        "injected": lambda: draw_injected(results.bundles, shown_bundle(results)),
    }
    page = out_dir / "report.html"
    try:
        with whole_folder(out_dir) as part:
            figures = {name: make_figure(one, part / "figures" / f"{name}.png") for name, one in draw.items()}
            linked = PageTraces("", tuple(collision.recording for collision in results.collisions.values()))
            room = page_mb * 1e6 - len(render_page(results, figures, linked).encode())
            traces = or_reason(partial(results_traces, results, signals, room, trace_methods))
            (part / page.name).write_bytes(render_page(results, figures, traces).encode())
        for name, figure in figures.items():
            if figure.png is None:
                (out_dir / "figures" / f"{name}.png").unlink(missing_ok=True)  # of results that had it
    except OSError as error:
        raise ConfigError(f"{out_dir}: the report cannot be written ({error.strerror or error})") from error
    return page


def check_page_mb(page_mb: float) -> None:
    if not 0 <= page_mb <= LARGEST_PAGE_MB:
        raise ConfigError(f"page_mb = {page_mb:g} must be a number of megabytes, 0 to {LARGEST_PAGE_MB:g}")


def make_figure(draw: Callable[[], Drawing], path: Path) -> PageFigure:
    """Draw and save one figure; where it cannot be drawn, the reason in its place."""
    title = path.stem.replace("-", " ").capitalize()
    path.parent.mkdir(parents=True, exist_ok=True)
    with matplotlib.rc_context(RC):
        try:
            drawing = draw()
            save_png(drawing.figure, path)
        except NotAvailable as reason:
            return PageFigure(png=None, caption=f"{title} is not available: {reason}.")
        except (ArithmeticError, ValueError) as error:  # numbers that no axis holds: 1e308 in a damaged file
            path.unlink(missing_ok=True)
            return PageFigure(png=None, caption=f"{title} cannot be drawn: {error}.")
    return PageFigure(png=path.read_bytes(), caption=drawing.caption, width_in=drawing.figure.get_figwidth())
