"""What a training begins with: settings that can be served, recordings, and what their tau is in N m."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from tauext._core import TorqueUnits, Tree
from tauext.config import ModelCase, TrainConfig
from tauext.data.recording import Recording
from tauext.data.standing import standing_joints
from tauext.errors import ConfigError
from tauext.files.place import Place
from tauext.files.provenance import provenance
from tauext.fit.bundle_writing import reference_recording
from tauext.fit.fleet_prior import FleetPrior
from tauext.fit.torque_constants import TorqueConstants
from tauext.fit.training_set import Setup
from tauext.progress import Reporter
from tauext.robot.torque_limits import torque_limits
from tauext.train.calibrate_limits import at_rest_sentence
from tauext.train.motion import TrainingMotion, expect_some, training_motion
from tauext.train.possible import MOST_AT_LIMIT, PossibleMotion, possible_motion
from tauext.train.recordings import chosen_recordings, given_unit
from tauext.train.settings import training_settings, why_impossible


@dataclass(frozen=True)
class Job:
    """One training under way: what is asked, on what, and what its steps have found so far."""

    tree: Tree
    case: ModelCase
    config: TrainConfig
    out: Place
    possible: PossibleMotion
    calibration: list[Callable[[], Recording]]
    """Load recordings, contacts and all."""
    motion: TrainingMotion
    report: Reporter
    run: dict
    """Provenance: settings, versions, seed and the recordings' names."""
    facts: dict = field(default_factory=dict)
    """What was found, for provenance: the steps add to it."""
    like: FleetPrior | None = None
    """What a fleet of arms of this type knows; None: the arm is by itself."""

    @property
    def name(self) -> str:
        """Of the bundle."""
        return self.out.stem

    @property
    def joints(self) -> tuple[str, ...]:
        """Names, in the recordings' order."""
        return self.training[0].joints

    @property
    def training(self) -> list[Recording]:
        """As many minutes as shall be trained on, contacts and all, without samples that are impossible."""
        return self.possible.training

    @property
    def validation(self) -> list[Recording]:
        """Likewise."""
        return self.possible.validation

    @property
    def constants(self) -> TorqueConstants | None:
        """That the recordings' tau is to be multiplied by; None: it is in N m, or nothing tells."""
        return self.possible.constants

    @property
    def units(self) -> TorqueUnits:
        """What the bundle takes and answers in."""
        given = given_unit(self.config, self.training)
        return self.constants.units(given) if self.constants else TorqueUnits(given)

    @property
    def notes(self) -> list[str]:
        """Sentences for people and for the run file: the steps add to it."""
        return self.motion.notes

    @property
    def threads(self) -> int:
        """At least 1."""
        return self.config.threads or os.cpu_count() or 1

    def reference(self, setup: Setup) -> Recording:
        """The recording whose first window the bundle keeps, to replay when it is loaded."""
        return reference_recording(setup, [*self.validation, *self.training])

    def say(self, sentence: str) -> None:
        """Tell the reporter, under the bundle's name."""
        self.report.say(f"{self.name}: {sentence}")


def prepare(
    tree: Tree,
    robot: Path,
    case: ModelCase,
    training: Sequence[Recording],
    validation: Sequence[Recording],
    config: TrainConfig,
    out: Place,
    calibration: Sequence[Callable[[], Recording]],
    report: Reporter,
    like: FleetPrior | None = None,
) -> Job:
    """Choose the minutes, leave out what is impossible, find torque constants, leave contacts out.

    See train_on_recordings for the arguments.

    Raises:
        ConfigError: settings that the case or the recordings cannot serve.
        TrainingError: too little motion, or too much of it is impossible.
    """
    if impossible := why_impossible(config.row, case):
        raise ConfigError(impossible)
    training, validation = chosen_recordings(training, validation, config)
    expect_some(training)
    limits_nm = torque_limits(robot, training[0].joints)
    possible = possible_motion(tree, case, training, validation, limits_nm, config)
    motion = training_motion(possible.training, possible.validation, config)
    out.parent.mkdir(parents=True, exist_ok=True)
    run = provenance("tauext train", training_settings(case, config), config.seed)
    run["recordings"] = {"train": [r.name for r in training], "validation": [r.name for r in validation]}
    job = Job(tree, case, config, out, possible, list(calibration), motion, report, run, like=like)
    if possible.passed.any():
        job.notes.append(passed_sentence(possible.passed, training[0].joints, limits_nm))
    if possible.left_out.found:
        job.notes.insert(0, possible.left_out.sentence())
        job.facts["impossible"] = possible.left_out.facts()
    return job


def passed_sentence(passed: np.ndarray, joints: Sequence[str], limits_nm: np.ndarray) -> str:
    """Which drive limits of the robot file are ignored, and why."""
    named = [f"{name} {limit:g}" for name, limit, one in zip(joints, limits_nm, passed, strict=True) if one]
    return (
        f"the robot file's torque limits of {', '.join(named)} are ignored: the torque reaches them in "
        f"{MOST_AT_LIMIT:.1%} of the free motion or more"
    )


def note_recordings(job: Job) -> None:
    """Note what the recordings leave open: torque constants that are guesses, joints that never moved."""
    if job.constants is not None:
        job.notes.extend(job.constants.sentences(job.joints))
    stand = standing_joints([*job.training, *job.validation])
    names = [name for name, stands in zip(job.joints, stand, strict=True) if stands]
    if names:
        job.notes.append(at_rest_sentence(names, len(job.joints)))
