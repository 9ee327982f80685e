"""`tauext report`: figures and one self-contained page from results, or of one flight."""

from __future__ import annotations

from pathlib import Path

from tauext.cli.dataset import Dataset
from tauext.errors import ConfigError


def report(out: Path, results: Path | None = None, data: Path | None = None, flight: Path | None = None) -> None:
    """Draw Table I and the paper's figures from results, or what happened in one flight: an HTML page and PNG figures.

    Give --results and --data, or --flight.

    Args:
        out: folder to write.
        results: results folder (`tauext evaluate` makes one).
        data: dataset folder that was evaluated.
        flight: flight (FLIGHT.parquet, `tauext run --flights` writes them), or a folder of flights: its newest.
    """
    from tauext.report import write_flight_report, write_report

    if flight is not None:
        if results is not None or data is not None:
            raise ConfigError("give either --results and --data, or --flight; not both")
        print(write_flight_report(flight, out))
    elif results is not None and data is not None:
        print(write_report(results, Dataset.open(data).folder, out))
    else:
        missing = "--results" if results is None else "--data"
        raise ConfigError(
            f"{missing} is missing: give --results and --data (a report of results), or --flight (of one)"
        )
