"""`tauext bench`: every method on every track, one result each, kept as it is finished; bench.json and bench.html."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tauext.config import CaseName
from tauext.data.dataset import Dataset
from tauext.data.free_motion import total_s
from tauext.errors import ConfigError, TauextError
from tauext.files.plain_file import FORMAT, read_json
from tauext.files.provenance import VERSION, provenance, write_json
from tauext.progress import SILENT, Reporter
from tauext_lab.bench.methods import Given, Method, Quietly, blind, method_of
from tauext_lab.bench.page import write_page
from tauext_lab.bench.scores import judge, summary
from tauext_lab.bench.track import Track, digest, folds, load_track, make_dataset, package_tracks, track_folder


@dataclass(frozen=True)
class Settings:
    """Settings of a run, on all of which a result depends."""

    per_hour: float = 1.0
    case: CaseName | None = None
    seed: int = 0
    threads: int = 0


def run_bench(
    tracks: Sequence[Path],
    methods: Sequence[str],
    out: Path,
    data: Path | None = None,
    settings: Settings = Settings(),
    report: Reporter = SILENT,
    command: str = "tauext_lab.bench.run.run_bench()",
) -> dict[str, Any]:
    """Run methods on tracks and write OUT/bench.json and OUT/bench.html; returns the content of bench.json.

    A track or method that cannot be run is one sentence of `missing`, and does not stop the others. Results that are
    finished are kept in OUT/TRACK/METHOD.json, and used again as long as track, method and settings are the same.

    Args:
        tracks: folders or names, see track_folder(); none: all of the package.
        data: see fetch().

    Raises:
        ConfigError: an unknown track or method.
    """
    folders = {folder.name: folder for folder in map(track_folder, tracks or package_tracks())}
    loaded = {name: load_track(folder) for name, folder in folders.items()}
    known = [method_of(name) for name in methods]
    if len({method.name for method in known}) < len(known):
        raise ConfigError(f"methods must differ in their names: {', '.join(method.name for method in known)}")
    results: list[dict[str, Any]] = []
    missing: list[str] = []
    for name, track in loaded.items():
        try:
            dataset = make_dataset(track, folders[name], data, out / name, report)
            results.append(_on_track(name, track, folders[name], dataset, known, out / name, settings, report, missing))
        except (TauextError, OSError) as error:
            missing.append(f"track {name}: {error}")
            report.say(missing[-1])
    run = provenance("tauext bench", {"command": command}, settings.seed)
    content = {
        "format": FORMAT,
        "provenance": {"command": command} | {key: run[key] for key in ("version", "seed", "machine")},
        "false_alarms_per_hour": settings.per_hour,
        "tracks": results,
        "missing": missing,
    }
    write_json(content, out / "bench.json")
    write_page(content, out / "bench.html")
    return content


def _on_track(
    name: str,
    track: Track,
    folder: Path,
    dataset: Dataset,
    methods: Sequence[Method],
    out: Path,
    settings: Settings,
    report: Reporter,
    missing: list[str],
) -> dict[str, Any]:
    """All methods on one track; appends to `missing` a sentence for each that failed."""
    rows = []
    for method in methods:
        key = hashlib.sha256(
            json.dumps([VERSION, digest(folder), method.key(), vars(settings) | {"threads": 0}]).encode()
        ).hexdigest()
        kept = out / f"{method.name}.json"
        row = read_json(kept) if kept.is_file() else {}
        if row.get("key") != key:
            report.say(f"{name}: {method.name}")
            try:
                row = {"name": method.name, "key": key} | _scores(name, track, dataset, method, out, settings, report)
            except TauextError as error:
                missing.append(f"{method.name} on {name}: {error}")
                report.say(missing[-1])
                continue
            write_json(row, kept)
        rows.append({key: value for key, value in row.items() if key != "key"})
    facts = {"name": name, "title": track.title, "evidence": track.evidence, "labels": track.labels}
    files = [{"name": one.name, "sha256": one.sha256, "licence": one.licence} for one in track.files]
    joints = list(next(loader() for loader in dataset.loaders("train")).joints)
    return facts | {"joints": joints, "files": files, "methods": rows}


def _scores(
    name: str, track: Track, dataset: Dataset, method: Method, out: Path, settings: Settings, report: Reporter
) -> dict[str, Any]:
    judged, fit_s, estimate_s, samples, minutes = [], 0.0, 0.0, 0, []
    for number, fold in enumerate(folds(track, dataset)):
        work = out / "work" / f"{number}"
        work.mkdir(parents=True, exist_ok=True)
        given = Given(
            fold, name, track.train, track.accept, settings.case, settings.seed, settings.threads, work,
            Quietly(report),
        )  # fmt: skip
        minutes.append(total_s(given.training()) / 60)
        started = time.perf_counter()
        estimator = method.fit(given)
        fit_s += time.perf_counter() - started
        for loader in (*fold.loaders("test"), *fold.loaders("collisions")):
            recording = loader()
            asked = blind(recording)
            started = time.perf_counter()
            answer = estimator(asked)
            estimate_s += time.perf_counter() - started
            samples += recording.samples
            judged.append(judge(recording, answer, track))
    facts = {"training_minutes": sum(minutes) / len(minutes), "recordings": len(judged), "fit_s": round(fit_s, 1)}
    return facts | {"us_per_sample": 1e6 * estimate_s / samples} | summary(judged, settings.per_hour, track.timed)
