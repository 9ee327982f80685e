"""From bundles in files to a results folder: results.json, estimates, run.json and wall times."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tauext.config import EventsConfig
from tauext.data import Dataset, load_bundle
from tauext.data.loss_history import read_loss_history
from tauext.evaluate.comparison import evaluate
from tauext.progress import SILENT, Reporter
from tauext.provenance import provenance, write_json


def evaluate_bundles(
    dataset: Dataset,
    bundles: Mapping[str, Path],
    out: Path,
    seed: int = 0,
    threads: int = 0,
    command: str = "tauext.evaluate_bundles()",
    scale: str | None = None,
    keep_free_estimates: int = 20,
    sanity: bool = False,
    events: EventsConfig = EventsConfig(),  # noqa: B008
    report: Reporter = SILENT,
) -> dict[str, Any]:
    """Write results.json, estimates, run.json and wall times for bundles, each by a name of its own.

    Returned is what stands in results.json; docs/files.md says what that is.

    Where a bundle's NAME.run.json stands beside it, the loss history of its training goes into results.json too.

    Args:
        bundles: files by the names that they have in the results.
        out: folder; it is made.
        seed: of the choice of ten collisions, and of random alarms.
        threads: 0: one a core. The result does not depend on it.
        command: what is run, for the report.
        scale: of the paper's experiment, for the report.
        keep_free_estimates: see evaluate.
        sanity: judge detectors that know nothing (always, never, random) beside them.
        events: how alarms are held against labels.

    Raises:
        BundleError: a bundle cannot be read, or a recording does not fit it.
        ConfigError: nothing to evaluate, or a damaged run file beside a bundle.
    """
    started = time.monotonic()
    loaded = {name: load_bundle(path) for name, path in bundles.items()}
    histories = {name: read_loss_history(loaded[name], path) for name, path in bundles.items()}
    with report.progress("evaluate") as show:
        results = evaluate(
            loaded,
            dataset.loaders("test"),
            dataset.loaders("collisions"),
            out / "estimates",
            seed,
            threads or os.cpu_count() or 1,
            lambda what, done, total: show(done, total, "recordings"),
            histories,
            keep_free_estimates,
            sanity,
            events,
            dataset.loaders("calibration") or dataset.loaders("validation") or dataset.loaders("train"),
        )
    run = provenance("tauext evaluate", {"bundles": list(bundles)}, seed)
    source = {"command": command, "dataset": dataset.folder.name, "scale": scale}
    keep = {key: run[key] for key in ("version", "seed", "machine")}
    write_json(run, out / "run.json")
    write_json({"evaluate_s": time.monotonic() - started}, out / "wall_time_s.json")
    results = {"format": 3, "provenance": source | keep} | results
    write_json(results, out / "results.json")
    return results
