"""The researcher's bench of tauext: simulated arms, evaluation, baselines, reports and the paper's experiment.

A package of its own, found by its entry points. In Python: `evaluate_bundles` measures bundles on a dataset,
`write_report` draws what it found, and `load_network` reads a network of PyTorch for `tauext.train_bundle`.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import TYPE_CHECKING

from tauext.cli.commands import Command
from tauext.monitor.sink_kind import SinkKind, Watched

if TYPE_CHECKING:
    from tauext_lab.mcap.sink import McapSink

SIMULATE = Command("make a dataset of the paper's two-axis rig", "tauext_lab.commands:simulate", title="Recordings")
EVALUATE = Command(
    "measure errors, false alarms and delays of bundles on a dataset", "tauext_lab.commands:evaluate", title="Results"
)
REPORT = Command(
    "draw an HTML page of results, one event log or commissioned arms", "tauext_lab.commands:report", title="Results"
)
BENCH = Command(
    "compare methods, also your own, at equal false alarms on recordings with contacts",
    "tauext_lab.commands:bench",
    title="Results",
)
REPRODUCE = Command(
    "repeat the paper's experiment: simulate, train, evaluate and report",
    "tauext_lab.reproduce:reproduce",
    title="Results",
)
"""The commands, found by their entry points."""


def open_mcap(path: Path, watched: Watched) -> McapSink:
    """See SinkKind.open."""
    from tauext_lab.mcap.sink import McapSink

    return McapSink(path, watched.bundle, watched.source, watched.wrench, patient=not watched.is_live)


MCAP = SinkKind(
    open_mcap,
    "file (*.mcap) for samples, estimates, forces and events, which Foxglove, Rerun and PlotJuggler open. A killed "
    "process leaves a file that they can recover. None: none is written.",
)
"""The sink of --mcap, found by its entry point."""

_WHERE = {"evaluate_bundles": "evaluate.results_folder", "write_report": "report.page", "load_network": "own_network"}


def __getattr__(name: str) -> object:
    if name not in _WHERE:
        raise AttributeError(f"module 'tauext_lab' has no attribute {name!r}")
    return getattr(importlib.import_module(f"tauext_lab.{_WHERE[name]}"), name)
