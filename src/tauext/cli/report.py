"""`tauext report`: figures and one self-contained page from results, or of one flight."""

from __future__ import annotations

import sys
from pathlib import Path

from tauext.cli.place_argument import PlaceArg
from tauext.errors import ConfigError
from tauext.files.copies import local_beside, local_folder, staged
from tauext.files.places import Place


def report(
    out: PlaceArg,
    results: PlaceArg | None = None,
    data: PlaceArg | None = None,
    flight: PlaceArg | None = None,
    page_mb: float = 9.5,
    trace_methods: tuple[str, ...] = (),
) -> None:
    """Draw Table I and the paper's figures from results, or what happened in one flight: an HTML page and PNG figures.

    Give --results and --data, or --flight. The page holds traces to zoom into; it is one file and needs no network.

    Args:
        out: folder to write the page and its figures to; a page that is there is replaced, and said to be.
        results: results folder to draw (`tauext evaluate` makes one).
        data: dataset folder that was evaluated.
        flight: flight to draw (FLIGHT.parquet, `tauext run --flights` writes them), or a folder of flights, of which
            the newest is drawn.
        page_mb: largest size of the page; traces fill it, in as much detail as there is room for. 0: no traces.
        trace_methods: bundles whose traces stand in the page, by their names; default: the best five.
    """
    from tauext.cli.place_argument import tell_replaced
    from tauext.data.dataset import load_dataset
    from tauext.report.flight import write_flight_report
    from tauext.report.page import write_report

    if flight is not None:
        if results is not None or data is not None:
            raise ConfigError("give either --results and --data, or --flight; not both")
        if trace_methods:
            raise ConfigError("--trace-methods chooses among the methods of --results; a flight has one")
        there = {page.name for page in out.glob("*.html")}
        with staged(out, fresh=True) as folder:
            page = out / write_flight_report(local_flight(flight), folder, page_mb).name
        if page.name in there:
            print(f"tauext: {page} was there already and is replaced", file=sys.stderr)
        print(page)
    elif results is not None and data is not None:
        tell_replaced(out / "report.html")
        with staged(out, fresh=True) as folder:
            page = write_report(local_folder(results), load_dataset(data).folder, folder, page_mb, trace_methods)
        print(out / page.name)
    else:
        missing = "--results" if results is None else "--data"
        raise ConfigError(
            f"{missing} is missing: give --results and --data (a report of results), or --flight (of one)"
        )


def local_flight(flight: Place) -> Path:
    """A flight with what stands beside it, or a folder of them, on this machine."""
    return local_folder(flight) if flight.is_dir() else local_beside(flight)
