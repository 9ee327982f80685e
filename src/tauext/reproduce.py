"""The paper's experiment in its five steps, at three scales."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from tauext.config import PAPER_CASES, TrainConfig
from tauext.data import load_dataset
from tauext.evaluate import evaluate_bundles
from tauext.progress import SILENT, Reporter
from tauext.report import write_report
from tauext.rig import RigConfig, simulate_dataset
from tauext.robot import estimated_model
from tauext.train import finished, look_first, train_on_recordings


@dataclass(frozen=True)
class Scale:
    """How much data and how many steps: never a time limit, so the result is the same on a slow machine."""

    minutes: float
    """Free motion in all."""
    collision_recordings: int
    """Recordings with about ten collisions each."""
    training: TrainConfig
    """How every model case is trained."""
    paper_cases: tuple[str, ...] = ()
    """Cases that are trained by the paper's whole recipe as well; their bundles are named CASE-paper."""


SCALES = {
    "smoke": Scale(
        minutes=2.0, collision_recordings=1, training=TrainConfig(recipe="paper", epochs=1, batch=64, max_steps=20)
    ),
    "quick": Scale(minutes=45.0, collision_recordings=20, training=TrainConfig(recipe="paper", epochs=20, batch=128)),
    "full": Scale(
        minutes=90.0,
        collision_recordings=20,
        training=TrainConfig(recipe="dense"),
        paper_cases=("exact", "none"),
    ),
}


def reproduce_paper(
    out: Path,
    scale_name: str,
    scale: Scale,
    cases: Sequence[str],
    seed: int,
    command: str,
    report: Reporter = SILENT,
) -> Path:
    """Simulate, train, evaluate, report; returns the report. What is done with these settings is not repeated.

    Args:
        command: what is run, for the report.
        report: is told how far it is.
    """
    data = out / "data"
    with report.progress("simulate") as show:
        simulate_dataset(
            data,
            RigConfig(),
            seed,
            scale.minutes,
            scale.collision_recordings,
            lambda what, done, total: show(done, total, what),
        )
    dataset = load_dataset(data)
    jobs = {case: (PAPER_CASES[case], replace(scale.training, seed=seed)) for case in cases}
    paper = TrainConfig(recipe="paper", seed=seed)
    jobs |= {f"{case}-paper": (PAPER_CASES[case], paper) for case in scale.paper_cases if case in cases}
    bundles = {name: out / "bundles" / f"{name}.tauext" for name in jobs}
    missing = [name for name, (case, config) in jobs.items() if not finished(bundles[name], case, config)]
    if missing:
        robot = dataset.robot_file(None)
        training, validation = dataset.recordings("train"), dataset.recordings("validation")
        for name in missing:
            case, config = jobs[name]
            tree = estimated_model(robot, training[0].joints, case)
            looked = look_first(dataset, robot, case, training, validation, config, (), report)
            train_on_recordings(
                tree, robot, case, training, validation, config, bundles[name], report=report, looked=looked
            )
    evaluate_bundles(dataset, bundles, out / "results", seed, 0, command, scale_name, report=report)
    return write_report(out / "results", data, out / "report")
