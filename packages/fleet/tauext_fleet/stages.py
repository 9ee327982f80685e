"""The stages: each calls the function of its command with one thread, and writes into a folder of its own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from tauext_lab.evaluate.config import EventsConfig

from tauext.config import TrainConfig
from tauext.files.typed_table import read_table
from tauext_fleet.config import CalibrateStage, EvaluateStage
from tauext_fleet.task import Stage

COMMAND = "tauext fleet run"


def import_arm(work: Mapping[str, Any], part: Path) -> None:
    """The dataset folder NAME, and the changes to the numbers in NAME.txt."""
    from tauext.data.importing import import_dataset

    messages: list[str] = []
    sources = [Path(source) for source in work["sources"]]
    import_dataset(sources, Path(work["description"]), part / work["name"], "tauext", messages.append)
    (part / "import.txt").write_text("\n".join(messages) + "\n")


def check_arm(work: Mapping[str, Any], part: Path) -> str | None:
    """check.txt and check.json, as `tauext check --out` writes them; pictures are left to that command."""
    from tauext.check.before_training import is_accepted
    from tauext.check.examine import as_files, examine, gather
    from tauext.check.finding import by_code
    from tauext.files.provenance import write_json

    recordings, free, robot = gather((Path(work["dataset"]),), path_of(work, "robot"))
    diagnosis = examine(recordings, robot, None, free)
    text, content = as_files(diagnosis, (recording.name for recording in recordings), robot is None)
    (part / "check.txt").write_text(text + "\n")
    write_json(content, part / "check.json")
    refused = [f for f in diagnosis.findings if f.severity == "fault" and not is_accepted(f, work["accept"])]
    if not refused:
        return None
    found = []
    for code, same in by_code(refused).items():
        joints = [joint for joint in dict.fromkeys(finding.joint for finding in same) if joint]
        found.append(f"{code} ({', '.join(joints)})" if joints else code)
    return f"{len(refused)} fault{'s' * (len(refused) > 1)}: {', '.join(found)}; see check.txt"


def train_arm(work: Mapping[str, Any], part: Path) -> None:
    """The bundle NAME.tauext with the files beside it."""
    from tauext.data.dataset import load_dataset
    from tauext.train.preparation import NOTHING
    from tauext.train.stage import train_bundle
    from tauext_fleet.like import load_like

    config = replace(read_table(TrainConfig, work["settings"], "train:"), threads=1)
    dataset, out = load_dataset(Path(work["dataset"])), part / f"{work['name']}.tauext"
    known = path_of(work, "like")
    start = NOTHING if known is None else load_like(known)
    train_bundle(dataset, out, work["case"], path_of(work, "robot"), config, accept=work["accept"], start=start)


def calibrate_arm(work: Mapping[str, Any], part: Path) -> None:
    """The bundle NAME.tauext with other limits."""
    from tauext.data.dataset import load_dataset
    from tauext.train.calibrate import recalibrate

    settings = read_table(CalibrateStage, work["settings"], "calibrate:")
    dataset, out = load_dataset(Path(work["dataset"])), part / f"{work['name']}.tauext"
    recalibrate(
        Path(work["bundle"]),
        dataset,
        out,
        settings.alarm,
        threads=1,
        refit_error_scale=settings.refit_error_scale,
        accept=work["accept"],
    )


def evaluate_arm(work: Mapping[str, Any], part: Path) -> None:
    """The results folder."""
    from tauext_lab.evaluate.results_folder import evaluate_bundles

    from tauext.data.dataset import load_dataset

    settings = read_table(EvaluateStage, work["settings"], "evaluate:")
    evaluate_bundles(
        load_dataset(Path(work["dataset"])),
        {work["name"]: Path(work["bundle"])},
        part,
        settings.seed,
        threads=1,
        command=COMMAND,
        keep_free_estimates=settings.keep_free_estimates,
        events=EventsConfig(settings.shortest_event_s, settings.tolerance_s),
    )


def path_of(work: Mapping[str, Any], key: str) -> Path | None:
    return None if work[key] is None else Path(work[key])


STAGES: dict[str, Stage] = {
    "import": import_arm,
    "check": check_arm,
    "train": train_arm,
    "calibrate": calibrate_arm,
    "evaluate": evaluate_arm,
}
