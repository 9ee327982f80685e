"""From bundles in files to a results folder: results.json, estimates, run.json and wall times."""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

from tauext._core import Bundle
from tauext.bundle.bundle_file import load_bundle
from tauext.bundle.loss_history import read_loss_history
from tauext.check.before_training import WORTH_A_WARNING
from tauext.config import checked
from tauext.data.dataset import Dataset
from tauext.data.labels import labels_key
from tauext.data.recording_file import fingerprint
from tauext.errors import ConfigError
from tauext.files.checkpoint import Checkpoint
from tauext.files.provenance import VERSION, provenance, write_json
from tauext.fit.tail import duration
from tauext.progress import SILENT, Reporter
from tauext_lab.evaluate.comparison import evaluate
from tauext_lab.evaluate.config import EventsConfig
from tauext_lab.evaluate.injected import FIRST_S, SLOT_S
from tauext_lab.evaluate.results import EvaluatedBundle, Results, to_json
from tauext_lab.other_methods import OtherMethod


def why_nothing_injected(dataset: Dataset) -> str:
    """Message: why no force could be added to free motion, and what to do."""
    needed = f"free motion of {FIRST_S + SLOT_S:g} s or more without a contact in a test recording"
    if not dataset.split.test:
        needed += ", and the dataset has no test recording"
    return f"{dataset.folder}: inject added no force: it needs {needed}; record some, or evaluate without --inject"


@checked
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
    inject: bool = False,
    others: Mapping[str, OtherMethod] = MappingProxyType({}),
) -> dict[str, Any]:
    """Write results.json, estimates, run.json and wall times for named bundles.

    Returns the content of results.json; docs/reference/files-results.md describes it.
    A killed or interrupted run continues after the last recording that it finished.
    If NAME.run.json exists beside a bundle, the loss history of its training goes into results.json too.

    Args:
        bundles: files by the names that they have in the results.
        out: folder; it is made.
        seed: of the choice of ten collisions, and of random alarms.
        threads: 0: one per core. The result does not depend on it.
        command: what is run, for the report.
        scale: of the paper's experiment, for the report.
        keep_free_estimates: see evaluate.
        sanity: also evaluate detectors without information (always, never, random).
        events: how alarms are compared with labels.
        inject: add forces to free test motion and count the detected ones.
        others: methods of others by the names that they have in the results, compared with labels.

    Raises:
        BundleError: a bundle cannot be read, or a recording does not fit it.
        ConfigError: nothing to evaluate, no free motion to inject forces into, or a damaged run file beside a bundle.
    """
    started = time.monotonic()
    if inject and not dataset.split.test:
        raise ConfigError(why_nothing_injected(dataset))
    loaded = {name: load_bundle(path) for name, path in bundles.items()}
    work = dict(seed=seed, keep_free_estimates=keep_free_estimates, sanity=sanity, events=asdict(events), inject=inject)
    work |= {"others": sorted(others)} if others else {}
    kept = Checkpoint(out / "evaluate.half-done", work_key(dataset, loaded, work), loaded, "tauext_lab")
    histories = {name: read_loss_history(loaded[name], path) for name, path in bundles.items()}
    calibration = dataset.loaders("calibration") or dataset.loaders("validation") or dataset.loaders("train")
    with report.progress("evaluate") as show:
        results = evaluate(
            loaded, dataset.loaders("test"), dataset.loaders("collisions"), out / "estimates", seed,
            threads or os.cpu_count() or 1, lambda what, done, total: show(done, total, "recordings"), histories,
            keep_free_estimates, sanity, events, calibration, kept, inject, others,
        )  # fmt: skip
    if inject and not any(one.forces.added and one.forces.added.events for one in results.bundles):
        kept.end()
        raise ConfigError(why_nothing_injected(dataset))
    write_json({"evaluate_s": time.monotonic() - started}, out / "wall_time_s.json")
    content = write_results(results, out, "tauext evaluate", seed, source_of(dataset, command, scale))
    for words in filter(None, map(unhealthy_words, results.bundles)):
        report.say(words)
    if results.unknown_contact_hours:
        unknown = duration(results.unknown_contact_hours)
        report.say(f"{unknown} of unknown contact (-1) are left out: neither free motion nor contact")
    kept.end()
    return content


def source_of(dataset: Dataset, command: str, scale: str | None) -> dict[str, Any]:
    """Origin of results: the command, the dataset and the recordings that were judged."""
    judged = [*dataset.split.test, *dataset.split.collisions]
    recordings = {name.removesuffix(".parquet"): fingerprint(dataset.folder / name) for name in judged}
    return {"command": command, "dataset": dataset.folder.name, "scale": scale, "recordings": recordings}


def write_results(results: Results, out: Path, program: str, seed: int, source: dict[str, Any]) -> dict[str, Any]:
    """Write results.json and run.json; returns the content of results.json.

    Args:
        program: that evaluated, for run.json.
        source: command, dataset, scale and recordings, for results.json.
    """
    run = provenance(program, {"bundles": [one.name for one in results.bundles]}, seed)
    keep = {key: run[key] for key in ("version", "seed", "machine")}
    write_json(run, out / "run.json")
    content: dict[str, Any] = to_json(replace(results, provenance=source | keep))
    write_json(content, out / "results.json")
    return content


def unhealthy_words(bundle: EvaluatedBundle) -> str:
    """Samples that a bundle's monitor rejected, as text; empty if negligible."""
    rejected, latched = bundle.rejected, bundle.latched
    assert rejected.share is not None and latched is not None
    if rejected.share <= WORTH_A_WARNING and not latched.unhealthy:
        return ""
    causes = ", ".join(f"{name} {share:.1%}" for name, share in rejected.causes.items()) or "warming up"
    return (
        f"{bundle.name}: healthy for {1 - rejected.share:.1%} of the time ({causes}); {latched.unhealthy} of "
        f"{latched.collisions} collisions fell into the rest, where nothing is detected"
    )


def work_key(dataset: Dataset, bundles: Mapping[str, Bundle], settings: dict) -> str:
    """Everything that results depend on: the version, the bundles' bytes, the recordings' files, and settings."""
    files = []
    for set_name in ("train", "validation", "test", "collisions", "calibration"):
        for name in getattr(dataset.split, set_name):
            status = (dataset.folder / name).stat()
            files.append([set_name, name, status.st_size, status.st_mtime_ns])
    digests = [[name, hashlib.sha256(bundle.to_bytes()).hexdigest()] for name, bundle in bundles.items()]
    work = {"version": VERSION, "bundles": digests, "recordings": files, "settings": settings}
    if labels := labels_key(dataset.folder):
        work["labels"] = labels
    return hashlib.sha256(json.dumps(work, default=str).encode()).hexdigest()
