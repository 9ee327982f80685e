"""The paper's experiment in its five steps, at three scales."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from tauext.cli.dataset import Dataset
from tauext.cli.evaluate import evaluate_bundles
from tauext.cli.model_case import estimated_model
from tauext.cli.progress import ProgressBar
from tauext.cli.train import train_bundle
from tauext.cli.train_settings import finished
from tauext.config import PAPER_CASES, TrainConfig
from tauext.report import write_report
from tauext.rig import RigConfig, simulate_dataset


@dataclass(frozen=True)
class Scale:
    """How much data and how many steps: never a time limit, so the result is the same on a slow machine."""

    minutes: float
    """Free motion in all."""
    collision_recordings: int
    """Recordings with about ten collisions each."""
    training: TrainConfig
    """Of every case."""
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


def reproduce_paper(out: Path, scale_name: str, scale: Scale, cases: Sequence[str], seed: int) -> Path:
    """Simulate, train, evaluate, report; returns the report. What is done with these settings is not repeated."""
    data = out / "data"
    with ProgressBar("simulate") as bar:
        simulate_dataset(
            data,
            RigConfig(),
            seed,
            scale.minutes,
            scale.collision_recordings,
            lambda what, done, total: bar.update(done, total, what),
        )
    dataset = Dataset.open(data)
    jobs = {case: (case, replace(scale.training, seed=seed)) for case in cases}
    jobs |= {
        f"{case}-paper": (case, TrainConfig(recipe="paper", seed=seed)) for case in scale.paper_cases if case in cases
    }
    bundles = {name: out / "bundles" / f"{name}.tauext" for name in jobs}
    missing = [name for name, (case, config) in jobs.items() if not finished(bundles[name], case, config)]
    if missing:
        training, validation = dataset.recordings("train"), dataset.recordings("validation")
        for name in missing:
            case, config = jobs[name]
            robot = dataset.robot_file(None)
            tree = estimated_model(robot, training[0], PAPER_CASES[case])
            train_bundle(tree, robot, PAPER_CASES[case], training, validation, config, bundles[name])
    evaluate_bundles(dataset, bundles, out / "results", seed, threads=0, scale=scale_name)
    return write_report(out / "results", data, out / "report")
