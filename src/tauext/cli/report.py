"""`tauext report`: figures and one self-contained page from results."""

from __future__ import annotations

from pathlib import Path

from tauext.cli.dataset import Dataset


def report(results: Path, data: Path, out: Path) -> None:
    """Draw Table I and the paper's figures from results: report.html and PNG figures.

    Args:
        results: results folder (`tauext evaluate` makes one).
        data: dataset folder that was evaluated.
        out: folder to write.
    """
    from tauext.report import write_report

    print(write_report(results, Dataset.open(data).folder, out))
