"""What a training begins with: settings, recordings, free motion, bounds, and tau in N m."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from tauext._core import TorqueUnit, TorqueUnits, Tree
from tauext.config import FreeMotionConfig, ModelCase, TrainConfig
from tauext.data.free_motion import (
    LeftOut,
    SignalBounds,
    first_seconds,
    free_pieces,
    free_samples,
    possible_parts,
    split_by_time,
    standing_joints,
    total_s,
)
from tauext.data.recording import Recording
from tauext.data.servo import from_amperes, in_amperes
from tauext.errors import ConfigError, TrainingError
from tauext.files.places import Place
from tauext.files.plain_file import json_of, read_text
from tauext.files.provenance import provenance
from tauext.fit.bundle_writing import build_setup, reference_recording
from tauext.fit.fleet_prior import FleetPrior
from tauext.fit.torque_constants import TorqueConstants, fit_torque_constants, with_constants
from tauext.fit.training_set import Setup, signal_bounds
from tauext.progress import Reporter, WallTimes
from tauext.recipes import Recipe
from tauext.robot.model_case import estimated_model
from tauext.robot.torque_limits import torque_limits
from tauext.train.error_scale import at_rest_sentence

# --- What a trained bundle depends on beside the data, so that it is distinguished from one of other settings.


def training_settings(case: ModelCase, config: TrainConfig) -> dict:
    """What the trained bundle depends on beside the data; not the number of threads."""
    plain = asdict(config.resolved())
    if config.backend == "core":
        del plain["backend"]
    if config.minutes is None:
        del plain["minutes"]
    if config.margins == FreeMotionConfig():
        del plain["margins"]
    if config.load_frame is None:
        del plain["load_frame"]
    if config.fit_torque_constants is None:
        del plain["fit_torque_constants"]
    if config.torque_constants is None:
        del plain["torque_constants"]
    settings = {"case": asdict(case), "config": {k: v for k, v in plain.items() if k not in config.row.unused}}
    return json.loads(json.dumps(settings))  # as a file gives them back: lists, no tuples


def finished(bundle: Path, case: ModelCase, config: TrainConfig) -> bool:
    """Whether this bundle was already trained with these settings.

    Raises:
        ConfigError: a bundle of other settings stands there.
    """
    run = bundle.with_suffix(".run.json")
    if not bundle.exists() or not run.exists():
        return False
    settings = run_settings(run)
    if settings == training_settings(case, config):
        return True
    raise ConfigError(f"{bundle}: it was trained with other settings; choose another --out or remove it")


def run_settings(run: Path) -> dict:
    """The settings in a run file.

    Raises:
        ConfigError: it is damaged.
    """
    try:
        return json_of(read_text(run))["settings"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(
            f"{run}: not a readable run file ({error}); remove it and the bundle, or train elsewhere"
        ) from error


def why_impossible(recipe: Recipe, case: ModelCase) -> str | None:
    """Why there is no such bundle; None: there is."""
    if recipe.needs_model and case.no_model:
        return f"recipe = {recipe.name} needs a model, which the case '{case.name}' has not: {recipe.needs_model}"
    return None


# --- Recordings as a training takes them: as many minutes as it shall, and what their tau is.


LEAST_S = 30.0
"""Of motion, before an arm is searched in it for torque constants, [s]."""


def chosen_recordings(
    training: Sequence[Recording], validation: Sequence[Recording], config: TrainConfig
) -> tuple[Sequence[Recording], Sequence[Recording]]:
    """What config.minutes leaves of them: of validation at least a minute, or a window where that is longer.

    Raises:
        ConfigError: there are not so many minutes.
    """
    if config.minutes is None:
        return training, validation
    wanted_s, there_s = 60 * config.minutes, total_s(training)
    if wanted_s > there_s + 1e-6:
        most = int(there_s / 0.6) / 100
        raise ConfigError(
            f"minutes = {config.minutes:g} must be at most {most:g}: the training recordings hold no more"
        )
    window_s = config.warm_up_s + config.observer.window_s
    chosen = first_seconds(training, wanted_s)
    if not chosen:
        raise ConfigError(f"minutes = {config.minutes:g} must be longer than one sample of the recordings")
    if not validation:
        return chosen, []
    return chosen, first_seconds(validation, max(wanted_s / 5, 60.0, window_s))


def given_unit(config: TrainConfig, training: Sequence[Recording]) -> TorqueUnit:
    """What a number of the recordings' tau stands for: that is what the bundle takes."""
    if in_amperes(training):
        return TorqueUnit.ampere
    # To ask for constants of what was no current means that it is no torque either.
    asked = config.fit_torque_constants and not from_amperes(training)
    return TorqueUnit.recorded if asked else TorqueUnit.newton_metre


def wants_constants(config: TrainConfig, training: Sequence[Recording], case: ModelCase) -> bool:
    """Whether torque constants are to be fitted or, where they were given, corrected; by default where the recordings
    were currents and a model or half a minute of motion determines them."""
    if config.fit_torque_constants is not None:
        return config.fit_torque_constants
    if not case.no_model:
        return in_amperes(training) or from_amperes(training)
    determined = in_amperes(training) or (from_amperes(training) and config.row.finds_arm)
    return total_s(training) >= LEAST_S and determined


# --- Which stretches of a dataset's recordings are trained on and which validate, and what that leaves out, in words.


VALIDATION_SHARE = 0.2
NETWORK_LEAST_MIN = 30.0
"""With less motion, and no recordings to validate on, no network is tried behind a prior, [minutes]: the end of a
recording shows the same trajectory as its beginning, and what helps there may harm on another one."""


@dataclass(frozen=True)
class TrainingMotion:
    """What a training works on; notes are sentences for people and for the run file."""

    training: list[Recording]
    """Free motion; for a recipe that learns nothing the recordings as they are."""
    validation: list[Recording]
    """The same, for what is learned by steps."""
    for_limits: list[Recording]
    """Whole recordings that nothing is trained on: limits are found on their free motion."""
    uncut: list[Recording]
    """Free motion of the training recordings before any validation was cut off: all of it where none was."""
    notes: list[str]
    network: bool = False
    """Whether a network is tried."""


def training_motion(
    training: Sequence[Recording], validation: Sequence[Recording], config: TrainConfig
) -> TrainingMotion:
    """Leave out contacts, and cut validation off by time where the dataset has none.

    Raises:
        ConfigError: no training recording.
        TrainingError: nothing of free motion is left; or no joint moves, and the recipe is to learn from motion.
    """
    expect_some(training)
    stand = standing_joints(training)
    if not config.row.learns:
        return as_they_are(training, validation, left_out_sentences([*training, *validation], config))
    if stand.all():
        raise TrainingError(
            f"no joint moves in any of {len(training)} training recordings: friction and model cannot be learned, so "
            f"recipe {config.recipe} has nothing to say. What can be had is --recipe observer (or highpass), with "
            "limits that hold at rest only; or record motion of every joint"
        )
    notes = left_out_sentences([*training, *validation], config)
    uncut = free_pieces(training, config.margins)
    learned_on, validated_on = uncut, free_pieces(validation, config.margins)
    network = config.row.network is not None
    if not validation and config.row.gated and total_s(uncut) < 60 * NETWORK_LEAST_MIN:
        network = False
        notes.append(
            f"no network: {total_s(uncut) / 60:.1f} minutes without validation recordings cannot show whether it helps "
            f"({NETWORK_LEAST_MIN:g} minutes or a list of validation recordings can)"
        )
    if not validation and not network:
        validated_on = uncut
        notes.append(
            "the dataset has no validation recordings: for the limits every fifth of the motion is judged by a fit to "
            "the other four"
        )
    elif not validation:
        beginnings, validation = split_validation(training, config)
        learned_on, validated_on = (free_pieces(some, config.margins) for some in (beginnings, validation))
        notes.append(
            f"the dataset has no validation recordings: the last {VALIDATION_SHARE:.0%} of each training recording "
            f"({total_s(validation):.1f} s together) validate, {reach_s(config):g} s after what is trained on"
        )
    expect_motion(learned_on, "training", config)
    expect_motion(validated_on, "validation", config)
    if stand.any():
        names = ", ".join(np.array(training[0].joints)[stand])
        notes.append(f"{names} never moved in the training recordings: nothing is known of their friction")
    return TrainingMotion(learned_on, validated_on, list(validation), uncut, notes, network)


def expect_some(training: Sequence[Recording]) -> None:
    """Raise ConfigError where there is no training recording."""
    if not training:
        raise ConfigError("the dataset lists no training recording; one is enough")


def as_they_are(training: Sequence[Recording], validation: Sequence[Recording], notes: list[str]) -> TrainingMotion:
    """The recordings of a recipe that learns nothing: they serve for its limits alone."""
    if not validation:
        notes.append("the dataset has no validation recordings: limits are found on the training recordings")
    judged = list(validation or training)
    return TrainingMotion(list(training), judged, judged, list(training), notes)


def left_out_sentences(recordings: Sequence[Recording], config: TrainConfig) -> list[str]:
    """How much of the recordings is no free motion; nothing where all of it is."""
    left_out_s = sum(float((~free_samples(r, config.margins)).sum() / r.rate_hz) for r in recordings)
    if not left_out_s:
        return []
    return [
        f"{left_out_s:.1f} s are left out: in contact, {config.margins.before_s:g} s before one or "
        f"{config.margins.after_s:g} s after"
    ]


def expect_motion(pieces: Sequence[Recording], what: str, config: TrainConfig) -> None:
    """Raise TrainingError where no piece of free motion is left."""
    if not pieces:
        raise TrainingError(
            f"the {what} recordings hold no second of free motion that is {config.margins.before_s:g} s before and "
            f"{config.margins.after_s:g} s after every contact"
        )


def split_validation(training: Sequence[Recording], config: TrainConfig) -> tuple[list[Recording], list[Recording]]:
    """The beginnings of the training recordings, and their last fifths, which validate.

    Raises:
        TrainingError: none is long enough.
    """
    least_s = reach_s(config) + 1
    beginnings, ends = split_by_time(training, VALIDATION_SHARE, reach_s(config), least_s)
    if not ends:
        longest_s = max(recording.duration_s for recording in training)
        raise TrainingError(
            f"there is no validation recording, and the longest training recording, {longest_s:.1f} s, is too short to "
            f"cut some off: {least_s / VALIDATION_SHARE:.1f} s are needed; recipe prior needs no validation"
        )
    return beginnings, ends


def reach_s(config: TrainConfig) -> float:
    """How far a bundle looks back: a window and the observer's warm-up, [s]."""
    return config.observer.window_s + config.warm_up_s


# --- Bounds of the arm, and the recordings without samples beyond them.


AT_LIMIT = 0.999
"""Share of a drive's limit from which on a monitor calls it saturated (SignalWatch::kSaturated)."""
MOST_AT_LIMIT = 2e-3
"""Share of the training samples: of seven joints together, 1.4 % of the samples would be saturated at most."""


@dataclass(frozen=True)
class PossibleMotion:
    """The recordings as a monitor of this bundle would see them."""

    training: list[Recording]
    validation: list[Recording]
    bounds: SignalBounds
    torque_limit_nm: np.ndarray
    """Of each drive, infinite where unknown."""
    constants: TorqueConstants | None
    """That tau is to be multiplied by; None: it is in N m, or unknown."""
    left_out: LeftOut
    passed: np.ndarray
    """Joints whose drive limit of the robot file does not hold, (n,) bool; see passed_limits."""


def possible_motion(
    tree: Tree,
    case: ModelCase,
    training: Sequence[Recording],
    validation: Sequence[Recording],
    torque_limit_nm: np.ndarray,
    config: TrainConfig,
) -> PossibleMotion:
    """Leave impossible samples out, and find torque constants on what is left.

    Bounds are in the unit of the bundle's answers, which follows from the constants: those are fitted in the
    recordings' own unit, for which there is no drive limit.

    Args:
        training: at least one.
        torque_limit_nm: the robot file's limit of each drive, infinite where it has none.

    Raises:
        ConfigError: torque constants are not one a joint.
        TrainingError: too many samples are impossible, or the recordings' joints are not the model's.
    """
    observer = build_setup(tree, training[0], config.observer, config.recipe, config.filters).observer
    constants = None
    if config.torque_constants is not None:
        constants = known_constants(config.torque_constants, training)
        observer = with_constants(observer, constants.used)
    elif wants_constants(config, training, case):
        parts = possible_parts(training, observer, signal_bounds(training), LeftOut("training"))
        free = free_pieces(parts, config.margins)
        constants = fit_torque_constants(tree, free, config.observer, from_amperes(training))
        observer = with_constants(observer, constants.used)
    drives = np.where(in_newton_metres(constants, training, config), torque_limit_nm, np.inf)
    free = free_pieces(training, config.margins)
    passed = passed_limits(free, drives, constants.used if constants else (1.0,))
    drives = np.where(passed, np.inf, drives)
    bounds = signal_bounds(training, drives, constants.used if constants else (1.0,))
    left_out = LeftOut("training and validation" if validation else "training")
    learned_on = possible_parts(training, observer, bounds, left_out)
    validated_on = possible_parts(validation, observer, bounds, left_out)
    return PossibleMotion(learned_on, validated_on, bounds, drives, constants, left_out, passed)


def passed_limits(free: Sequence[Recording], torque_limit_nm: np.ndarray, nm_per_unit: Sequence[float]) -> np.ndarray:
    """Joints, (n,) bool, whose torque is at or beyond the robot file's limit in MOST_AT_LIMIT of free motion or more.

    With such a limit the monitor would report its own training motion as saturated: the file is wrong, or the drive
    usually works at its limit. During a contact a drive may well reach a limit that is right.

    Args:
        free: free motion; none of it passes no limit.
    """
    if not free:
        return np.zeros(len(torque_limit_nm), dtype=bool)
    at_limit = [np.abs(one.tau * nm_per_unit) >= AT_LIMIT * torque_limit_nm for one in free]
    return np.asarray(np.concatenate(at_limit).mean(axis=0) >= MOST_AT_LIMIT)


def known_constants(nm_per_unit: Sequence[float], training: Sequence[Recording]) -> TorqueConstants:
    """Constants on a person's word.

    Raises:
        ConfigError: they are not one a joint.
    """
    joints = training[0].joints
    if len(nm_per_unit) != len(joints):
        raise ConfigError(
            f"torque_constants = {', '.join(f'{k:g}' for k in nm_per_unit)}: must be {len(joints)}, one for each of "
            f"{', '.join(joints)}"
        )
    sure = np.ones(len(joints), dtype=bool)
    return TorqueConstants(np.array(nm_per_unit), np.zeros(len(joints)), sure, given=not in_amperes(training))


def in_newton_metres(
    constants: TorqueConstants | None, training: Sequence[Recording], config: TrainConfig
) -> np.ndarray | bool:
    """Whether a joint's torque is known in N m, so that it can be compared with the robot file's limits."""
    if constants is None:
        return given_unit(config, training) == TorqueUnit.newton_metre
    return constants.given or (constants.determined & (constants.relative_to is None))


# --- What a training begins with: settings that can be served, recordings, and what their tau is in N m.


@dataclass(frozen=True)
class Given:
    """What a training starts from: the arm's recordings and its estimated model."""

    robot: Path
    """URDF or MJCF of the arm; its drives' torques are bounds."""
    case: ModelCase
    """How the estimated model differs from the robot file."""
    training: Sequence[Recording]
    """As in the dataset, contacts included, of one robot, rate and torque timing."""
    validation: Sequence[Recording] = ()
    """Others, which nothing is trained on; none: the recipe does without, or cuts some off."""
    calibration: Sequence[Callable[[], Recording]] = ()
    """Load the recordings that a promise about false alarms is based on."""
    model: Tree | None = None
    """None: the robot file's, changed as the case says."""

    @cached_property
    def tree(self) -> Tree:
        """The estimated model."""
        if self.model is not None:
            return self.model
        return estimated_model(self.robot, self.training[0].joints, self.case)

    def expect_joints(self) -> None:
        """Raise RobotError where the robot file lacks a joint of the recordings, or cannot be read."""
        _ = self.tree  # which is kept for the training


@dataclass(frozen=True)
class Job:
    """State of a training: settings, data, and results of the steps so far."""

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
    """The fleet prior of this type; None: the arm is by itself."""
    times: WallTimes = field(default_factory=WallTimes)
    """Wall times of the training's phases."""

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
        """That the recordings' tau is to be multiplied by; None: it is in N m, or unknown."""
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


def prepare(given: Given, config: TrainConfig, out: Place, report: Reporter, like: FleetPrior | None = None) -> Job:
    """Choose the minutes, leave out what is impossible, find torque constants, leave contacts out.

    See train_on_recordings for the arguments.

    Raises:
        ConfigError: settings that the case or the recordings cannot serve.
        TrainingError: too little motion, or too much of it is impossible.
    """
    if impossible := why_impossible(config.row, given.case):
        raise ConfigError(impossible)
    training, validation = chosen_recordings(given.training, given.validation, config)
    expect_some(training)
    limits_nm = torque_limits(given.robot, training[0].joints)
    possible = possible_motion(given.tree, given.case, training, validation, limits_nm, config)
    motion = training_motion(possible.training, possible.validation, config)
    out.parent.mkdir(parents=True, exist_ok=True)
    run = provenance("tauext train", training_settings(given.case, config), config.seed)
    run["recordings"] = {"train": [r.name for r in training], "validation": [r.name for r in validation]}
    job = Job(given.tree, given.case, config, out, possible, list(given.calibration), motion, report, run, like=like)
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
