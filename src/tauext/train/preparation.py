"""Preparation of a training: settings, recordings, free motion, bounds, and tau in N m."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from tauext._core import Bundle, TorqueUnit, TorqueUnits, Tree
from tauext.config import FreeMotionConfig, ModelCase, PriorConfig, TrainConfig
from tauext.data.free_motion import (
    LeftOut,
    NotFree,
    SignalBounds,
    first_seconds,
    free_pieces,
    possible_parts,
    split_by_time,
    standing_joints,
    total_s,
)
from tauext.data.labels import Label
from tauext.data.recording import Recording
from tauext.data.servo import from_amperes, in_amperes
from tauext.errors import ConfigError, TrainingError
from tauext.files.provenance import provenance
from tauext.fit.bundle_writing import build_setup, reference_recording
from tauext.fit.coverage import CoverageFit
from tauext.fit.network_training import ScaledNetwork
from tauext.fit.prior_terms import PriorFit
from tauext.fit.torque_constants import TorqueConstants, fit_torque_constants, with_constants
from tauext.fit.training_set import Setup, signal_bounds
from tauext.progress import Reporter, WallTimes
from tauext.recipes import Recipe
from tauext.robot.mesh_files import MeshFolders
from tauext.robot.model_case import estimated_model
from tauext.robot.torque_limits import torque_limits
from tauext.train.error_scale import ErrorRows
from tauext.train.suspects import Suspect

# --- Settings that determine a trained bundle besides the data.


TRAINING_ONLY = ("epochs", "max_steps", "batch", "learning_rate", "targets", "backend", "seed")
"""Settings of a network's training alone."""


def training_settings(case: ModelCase, config: TrainConfig, trains: bool = True) -> dict:
    """Settings that determine a trained bundle besides the data; without the number of threads.

    Args:
        trains: whether a network may be trained; False: TRAINING_ONLY have no effect.
    """
    plain = asdict(config.resolved())
    if config.backend == "core":
        del plain["backend"]
    for name in ("minutes", "load_frame", "fit_torque_constants", "torque_constants"):
        if plain[name] is None:
            del plain[name]
    if config.margins == FreeMotionConfig():
        del plain["margins"]
    unused = config.row.unused if trains else (*config.row.unused, *TRAINING_ONLY)
    settings = {"case": asdict(case), "config": {k: v for k, v in plain.items() if k not in unused}}
    return json.loads(json.dumps(settings))  # as read from a file: lists, no tuples


def why_impossible(recipe: Recipe, case: ModelCase) -> str | None:
    """Reason why the recipe does not support the case; None: it does."""
    if recipe.needs_model and case.no_model:
        return f"recipe = {recipe.name} needs a model, which the case '{case.name}' lacks: {recipe.needs_model}"
    return None


# --- Recordings of a training: the chosen minutes, and the unit of tau.


def chosen_recordings(
    training: Sequence[Recording], validation: Sequence[Recording], config: TrainConfig
) -> tuple[Sequence[Recording], Sequence[Recording]]:
    """Cut the recordings to config.minutes; validation keeps at least a minute, or a window if longer.

    Raises:
        ConfigError: the recordings are shorter.
    """
    if config.minutes is None:
        return training, validation
    wanted_s, there_s = 60 * config.minutes, total_s(training)
    if wanted_s > there_s + 1e-6:
        most = int(there_s / 0.6) / 100
        raise ConfigError(
            f"minutes = {config.minutes:g} must be at most {most:g}: the training recordings have no more"
        )
    window_s = config.warm_up_s + config.observer.window_s
    chosen = first_seconds(training, wanted_s)
    if not chosen:
        raise ConfigError(f"minutes = {config.minutes:g} must be longer than one sample of the recordings")
    if not validation:
        return chosen, []
    return chosen, first_seconds(validation, max(wanted_s / 5, 60.0, window_s))


def given_unit(config: TrainConfig, training: Sequence[Recording]) -> TorqueUnit:
    """Unit of the recordings' tau, which is the bundle's input unit."""
    if in_amperes(training):
        return TorqueUnit.ampere
    # Fitting constants of a tau that is no current means that it is no torque either.
    asked = config.fit_torque_constants and not from_amperes(training)
    return TorqueUnit.recorded if asked else TorqueUnit.newton_metre


def wants_constants(config: TrainConfig, training: Sequence[Recording], case: ModelCase) -> bool:
    """Whether to fit torque constants or correct given ones; by default for currents, if a model or half a minute of
    motion determines the constants."""
    if config.fit_torque_constants is not None:
        return config.fit_torque_constants
    if not case.no_model:
        return in_amperes(training) or from_amperes(training)
    determined = in_amperes(training) or (from_amperes(training) and config.row.finds_arm)
    return total_s(training) >= 30 and determined


# --- Stretches for training and for validation, and sentences about what is left out.


VALIDATION_SHARE = 0.2
"""Share of each training recording that validates where the dataset has no validation recordings."""
NETWORK_LEAST_MIN = 30.0
"""Least motion for a network behind a prior without validation recordings, [minutes]. The end of a recording shows the
same trajectory as its beginning; a network that helps there may harm on another one."""


@dataclass(frozen=True)
class TrainingMotion:
    """Motion of a training; notes are sentences for the user and the run file."""

    training: list[Recording]
    """Free motion for training; the whole recordings for a recipe without training."""
    validation: list[Recording]
    """Free motion that validates training by steps."""
    for_limits: list[Recording]
    """Whole recordings not used in training; limits are found on their free motion."""
    uncut: list[Recording]
    """Free motion of the training recordings before validation was cut off."""
    notes: list[str]
    network: bool = False
    """Whether a network is tried."""


def training_motion(
    training: Sequence[Recording], validation: Sequence[Recording], config: TrainConfig, learns: bool = True
) -> TrainingMotion:
    """Leave out contacts, and cut validation off by time where the dataset has none.

    Args:
        learns: see Start.

    Raises:
        ConfigError: no training recording.
        TrainingError: no free motion is left, or no joint moves and the recipe learns from motion.
    """
    expect_some(training)
    stand = standing_joints(training)
    left_out = list(filter(None, [NotFree(config.margins).add([*training, *validation]).sentence()]))
    if not (learns and config.row.learns):
        return as_they_are(training, validation, left_out)
    if stand.all():
        raise TrainingError(
            f"no joint moves in any of {len(training)} training recordings: friction and model cannot be learned, so "
            f"recipe {config.recipe} cannot be trained. Use --recipe observer (or highpass), with "
            "thresholds that hold at rest only; or record motion of every joint"
        )
    notes = left_out
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
            "the dataset has no validation recordings: for the thresholds each fifth of the motion is evaluated with a "
            "fit to the other four"
        )
    elif not validation:
        beginnings, validation = split_validation(training, config)
        learned_on, validated_on = (free_pieces(some, config.margins) for some in (beginnings, validation))
        notes.append(
            f"the dataset has no validation recordings: the last {VALIDATION_SHARE:.0%} of each training recording "
            f"({total_s(validation):.1f} s together) validate, {reach_s(config):g} s after the training motion"
        )
    expect_known(training)
    expect_motion(learned_on, "training", config)
    expect_motion(validated_on, "validation", config)
    if stand.any():
        names = ", ".join(np.array(training[0].joints)[stand])
        notes.append(f"{names} never moved in the training recordings: their friction is unknown")
    return TrainingMotion(learned_on, validated_on, list(validation), uncut, notes, network)


def expect_some(training: Sequence[Recording]) -> None:
    """Raise ConfigError where there is no training recording."""
    if not training:
        raise ConfigError("the dataset lists no training recording; one is enough")


def as_they_are(training: Sequence[Recording], validation: Sequence[Recording], notes: list[str]) -> TrainingMotion:
    """Recordings of a training that learns nothing from them, used for limits only."""
    if not validation:
        notes.append("the dataset has no validation recordings: thresholds are found on the training recordings")
    for_limits = list(validation or training)
    return TrainingMotion(list(training), for_limits, for_limits, list(training), notes)


def expect_known(recordings: Sequence[Recording]) -> None:
    """Raise TrainingError where labels are there, and all of them are -1: the contact is unknown."""
    if all(one.contact is not None and (one.contact == -1).all() for one in recordings):
        raise TrainingError(
            f"contact = -1, unknown, in all samples of {len(recordings)} training recordings, so none is known to be "
            "free motion; label them, or leave the contact out at import if nothing touched the arm"
        )


def expect_motion(pieces: Sequence[Recording], what: str, config: TrainConfig) -> None:
    """Raise TrainingError where no piece of free motion is left."""
    if not pieces:
        raise TrainingError(
            f"the {what} recordings have no second of free motion that is {config.margins.before_s:g} s before and "
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
    """Memory of a bundle: a window plus the observer's warm-up, [s]."""
    return config.observer.window_s + config.warm_up_s


# --- Bounds of the arm, and the recordings without samples beyond them.


MOST_AT_LIMIT = 2e-3
"""Largest share of saturated training samples of a joint; seven joints together reach 1.4 % at most."""


def leave_out_impossible(run: TrainingRun) -> list[str]:
    """Leave impossible samples out of a run's recordings, and find torque constants on the rest.

    Returns a sentence about limits of the robot file that are ignored, if some are.

    Bounds are in the unit of the bundle's estimates, which follows from the constants. Constants are fitted in the
    recordings' own unit, for which there is no drive limit.

    Raises:
        ConfigError: torque constants are not one a joint.
        TrainingError: too many samples are impossible, or the recordings' joints are not the model's.
    """
    config, training = run.config, run.training
    observer = build_setup(run.tree, training[0], config.observer, config.recipe, config.filters).observer
    if config.torque_constants is not None:
        run.constants = known_constants(config.torque_constants, training)
    elif wants_constants(config, training, run.given.case):
        parts = possible_parts(training, observer, signal_bounds(training), LeftOut("training"))
        free = free_pieces(parts, config.margins)
        run.constants = fit_torque_constants(run.tree, free, config.observer, from_amperes(training))
    factors = run.constants.used if run.constants else (1.0,)
    if run.constants:
        observer = with_constants(observer, run.constants)
    limits_nm = torque_limits(run.given.robot, run.joints)
    drives = np.where(in_newton_metres(run.constants, training, config), limits_nm, np.inf)
    passed = passed_limits(free_pieces(training, config.margins), drives, factors)
    run.torque_limit_nm = np.where(passed, np.inf, drives)
    run.bounds = signal_bounds(training, run.torque_limit_nm, factors)
    left_out = LeftOut("training and validation" if run.validation else "training")
    run.training, run.validation = (
        possible_parts(some, observer, run.bounds, left_out) for some in (training, run.validation)
    )
    if left_out.found:
        run.notes.append(left_out.sentence())
        run.facts["impossible"] = left_out.facts()
    return [passed_sentence(passed, training[0].joints, limits_nm)] if passed.any() else []


def passed_limits(free: Sequence[Recording], torque_limit_nm: np.ndarray, nm_per_unit: Sequence[float]) -> np.ndarray:
    """Joints, (n,) bool, whose torque is at or beyond the robot file's limit in MOST_AT_LIMIT of free motion or more.

    With such a limit the monitor would report its own training motion as saturated: the file is wrong, or the drive
    usually works at its limit. Contacts do not count, since a drive may reach a correct limit there.

    Args:
        free: free motion; if empty, no limit is passed.
    """
    if not free:
        return np.zeros(len(torque_limit_nm), dtype=bool)
    # A monitor reports saturation from 0.999 of the limit on (SignalWatch::kSaturated).
    at_limit = [np.abs(one.tau * nm_per_unit) >= 0.999 * torque_limit_nm for one in free]
    return np.asarray(np.concatenate(at_limit).mean(axis=0) >= MOST_AT_LIMIT)


def known_constants(nm_per_unit: Sequence[float], training: Sequence[Recording]) -> TorqueConstants:
    """Torque constants given by the user.

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


# --- Input and state of a training.


class Start:
    """What a training begins with besides recordings and robot file; this one: nothing.

    Packages derive starts from it, which they read from files: `tauext train --like`, `--network`.
    """

    learns = True
    """Whether the training learns from the motion, if its recipe does; False: limits alone follow from it."""

    def settings(self, config: TrainConfig) -> TrainConfig:
        """The settings of a training from here, before any recording is read.

        Raises:
            ConfigError: one of them contradicts the start.
        """
        return config

    def begin(self, run: TrainingRun, setup: Setup) -> None:
        """Add facts for provenance.

        Raises:
            ConfigError: the start is of another arm.
        """

    def fit(self, setup: Setup, recordings: Sequence[Recording], config: PriorConfig) -> PriorFit | None:
        """Fit a prior to free motion; None: the recipe's function fits it."""
        return None

    def network(self) -> ScaledNetwork | None:
        """The network; None: the recipe trains its own, if it has one."""
        return None

    def covered(self, fit: CoverageFit, setup: Setup, recordings: Sequence[Recording]) -> CoverageFit:
        """Familiar motion: that of these recordings, and what the start adds."""
        return fit

    def put_scale(self, run: TrainingRun, bundle: Bundle, rows: ErrorRows) -> dict | None:
        """Set the error scale for errors like these; returns its facts. None: it is fitted to them."""
        return None

    def put_limits(self, run: TrainingRun, bundle: Bundle, kind: str) -> tuple[str, dict] | None:
        """Set limits in place of those of this kind; returns their basis as text, and facts. None: it sets none."""
        return None


NOTHING = Start()


@dataclass(frozen=True)
class TrainingInput:
    """Input of a training: the arm's recordings and its estimated model."""

    robot: Path
    """URDF or MJCF of the arm; its drive torques are bounds."""
    case: ModelCase
    """How the estimated model differs from the robot file."""
    training: Sequence[Recording]
    """Recordings of the dataset, with contacts, of one robot, rate and torque timing."""
    validation: Sequence[Recording] = ()
    """Recordings for validation only; empty: the recipe needs none or cuts some off."""
    calibration: Sequence[Callable[[], Recording]] = ()
    """Loaders of the calibration recordings, from which promised limits follow."""
    model: Tree | None = None
    """Estimated model; None: the robot file's, changed according to the case."""
    start: Start = NOTHING
    meshes: MeshFolders = MeshFolders()
    """Folders of the robot file's meshes, which are searched first."""
    labels: Sequence[Label] = ()
    """Labels beside the recordings, already part of their `contact`: intervals answered with `nothing` are no
    suspects."""

    @cached_property
    def tree(self) -> Tree:
        """The estimated model."""
        if self.model is not None:
            return self.model
        return estimated_model(self.robot, self.training[0].joints, self.case)

    def expect_joints(self) -> None:
        """Raise RobotError where the robot file lacks a joint of the recordings, or cannot be read."""
        _ = self.tree  # cached for the training


@dataclass
class TrainingRun:
    """A training: what it is given, the settings, the data that it uses, and its results so far."""

    given: TrainingInput
    config: TrainConfig
    out: Path
    """The bundle to write, NAME.tauext."""
    report: Reporter
    times: WallTimes
    """Wall times of the training's phases."""
    provenance: dict
    """Settings, versions, seed and the recordings' names."""
    training: list[Recording]
    """Training recordings of the chosen minutes, contacts included, without impossible samples."""
    validation: list[Recording]
    """Validation recordings, contacts included, without impossible samples."""
    constants: TorqueConstants | None = None
    """Factors of the recordings' tau; None: tau is in N m, or its unit is unknown."""
    bounds: SignalBounds = field(init=False)
    """Signals that the arm can have."""
    torque_limit_nm: np.ndarray = field(init=False)
    """Torque limit of each drive, infinite where unknown."""
    motion: TrainingMotion = field(init=False)
    notes: list[str] = field(default_factory=list)
    """Sentences for the user and the run file; each step adds its own."""
    facts: dict = field(default_factory=dict)
    """Facts for provenance; each step adds its own."""
    suspects: Sequence[Suspect] = ()
    """Touches that nobody reported, left out of the motion."""

    @property
    def name(self) -> str:
        """Name of the bundle."""
        return self.out.stem

    @property
    def tree(self) -> Tree:
        """The estimated model."""
        return self.given.tree

    @property
    def start(self) -> Start:
        """What the training begins with."""
        return self.given.start

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints, in the recordings' order."""
        return self.training[0].joints

    @property
    def units(self) -> TorqueUnits:
        """Units of the bundle's inputs and estimates."""
        given = given_unit(self.config, self.training)
        return self.constants.units(given) if self.constants else TorqueUnits(given)

    @property
    def threads(self) -> int:
        """Number of threads, at least 1."""
        return self.config.threads or os.cpu_count() or 1

    def reference(self, setup: Setup) -> Recording:
        """Recording whose first window the bundle stores, to replay on loading."""
        return reference_recording(setup, [*self.validation, *self.training])

    def say(self, sentence: str) -> None:
        """Report a sentence under the bundle's name."""
        self.report.say(f"{self.name}: {sentence}")


def prepare(
    given: TrainingInput, config: TrainConfig, out: Path, report: Reporter, times: WallTimes | None = None
) -> TrainingRun:
    """Cut to the chosen minutes, leave out impossible samples and contacts, and find torque constants.

    See train_on_recordings for the arguments.

    Raises:
        ConfigError: the case or the recordings do not allow the settings.
        TrainingError: too little motion, or too much of it is impossible.
    """
    if impossible := why_impossible(config.row, given.case):
        raise ConfigError(impossible)
    training, validation = chosen_recordings(given.training, given.validation, config)
    expect_some(training)
    learns = given.start.learns
    made_by = provenance(
        "tauext train", training_settings(given.case, config, trains=learns), config.seed if learns else None
    )
    made_by["recordings"] = {"train": [r.name for r in training], "validation": [r.name for r in validation]}
    run = TrainingRun(given, config, out, report, times or WallTimes(), made_by, list(training), list(validation))
    ignored = leave_out_impossible(run)
    run.motion = training_motion(run.training, run.validation, config, learns)
    run.notes += [*run.motion.notes, *ignored]
    out.parent.mkdir(parents=True, exist_ok=True)
    return run


def passed_sentence(passed: np.ndarray, joints: Sequence[str], limits_nm: np.ndarray) -> str:
    """Sentence on the drive limits of the robot file that are ignored."""
    named = [f"{name} {limit:g}" for name, limit, one in zip(joints, limits_nm, passed, strict=True) if one]
    return (
        f"the robot file's torque limits of {', '.join(named)} are ignored: the torque reaches them in "
        f"{MOST_AT_LIMIT:.1%} of the free motion or more"
    )
