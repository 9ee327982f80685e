"""One bundle from recordings of free motion: prepare, observe, fit, gate, calibrate, write."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from tauext import plugins
from tauext._core import Bundle
from tauext.bundle.bundle_file import load_bundle, write_bundle
from tauext.check.before_training import Rejected, expect_codes
from tauext.config import PAPER_CASES, CaseName, TrainConfig, checked
from tauext.data.dataset import Dataset
from tauext.data.free_motion import total_s
from tauext.data.labels import Label, read_labels
from tauext.data.recording import Recording
from tauext.data.servo import makes_torque, servo_of_recordings
from tauext.errors import ConfigError
from tauext.files.preflight import expect_memory, expect_new_file, expect_time
from tauext.fit.bundle_writing import set_drift
from tauext.fit.network_training import ScaledNetwork, apply_gate
from tauext.fit.prior_terms import PriorFit
from tauext.fit.training_set import Setup
from tauext.progress import SILENT, Reporter, WallTimes
from tauext.robot.mesh_files import MeshFolders, expect_meshes
from tauext.robot.model_case import chosen_case
from tauext.train.data_check import check_data
from tauext.train.declared_spread import noticed_standing
from tauext.train.error_scale import collect_rows, scale_of
from tauext.train.fitting import (
    CHECKPOINT,
    assemble,
    choose_gain,
    fit_network,
    fit_prior,
    observe,
    put_coverage,
    put_prior,
    put_region,
    with_fit,
)
from tauext.train.limits import limits_kind, put_limits, refuse_limits
from tauext.train.load_frame import put_load, put_wrench
from tauext.train.preparation import NOTHING, Start, TrainingInput, TrainingRun, prepare
from tauext.train.promised_limits import remove_checkpoint
from tauext.train.suspects import (
    Suspect,
    are_same,
    is_unreported,
    search,
    suspect_facts,
    suspect_sentences,
    without_suspects,
)

# --- Least time and memory of a training, checked before anything is loaded.


def accepted_settings(
    config: TrainConfig, calibration: Sequence[object], start: Start = NOTHING, folder: Path | None = None
) -> TrainConfig:
    """Resolve the settings of a training and refuse impossible ones before any recording is read.

    Args:
        calibration: the calibration recordings, which promised limits need.
        folder: of the dataset, for messages; None: its recordings are in memory.

    Raises:
        ConfigError: see Start.settings, expect_size and limits_kind.
    """
    config = start.settings(config)
    if start.learns:
        expect_size(config)
        if config.row.network is not None and config.backend != "core":
            plugins.part(config.backend)  # what is missing is named before a long training
    limits_kind(config, calibration, folder)
    return config


def expect_size(config: TrainConfig) -> None:
    """Refuse a training that takes over a month or exceeds the memory.

    Raises:
        ConfigError: names the setting, what it needs, and what is available.
    """
    config = config.resolved()
    if config.row.network is None or config.batch is None:
        return
    expect_memory(24 * config.batch, f"batch = {config.batch}")
    window = max(1, int(config.observer.window_s / config.observer.network_period_s))
    length = window
    if config.row.draws:
        length += max(0, (config.targets or 1) - round(config.row.drawing.early_targets * window))
    # An epoch has at least one batch.
    steps = min(config.epochs or config.max_steps or 1, config.max_steps or config.epochs or 1)
    a_step = 3 * 2 * 4 * config.hidden * (config.hidden + 3)  # backward costs twice forward
    flops = float(steps) * config.batch * length * a_step
    work = f"a training of {steps} steps of {config.batch} sequences of {length} with {config.hidden} hidden units"
    expect_time(flops / (2e11 * (os.cpu_count() or 1)), work)


# --- A network behind a prior is used only where it helps.


def gate(run: TrainingRun, bundle: Bundle, setup: Setup, fit: PriorFit | None) -> tuple[Bundle, PriorFit | None]:
    """Disable the network for joints where it does not help; returns the final bundle and its prior.

    If no joint keeps a network that was validated on motion cut off from training, the prior is refitted to all motion.

    Args:
        setup: without the prior.
    """
    if bundle.has_network:
        gate = apply_gate(bundle, run.motion.validation, run.config.gate_margin, run.threads)
        run.facts["gate"] = {name: gate.reason(j, run.config.gate_margin) for j, name in enumerate(run.joints)}
    if bundle.has_network or not run.motion.network or run.validation:
        return bundle, fit
    fit = fit_prior(run, setup, run.motion.uncut)
    run.notes.append("no joint has a network, so the prior was fitted to all of the motion in the end")
    return assemble(run, with_fit(setup, fit)), fit


# --- One bundle from recordings of free motion: prepare, observe, fit, gate, calibrate, write.


@checked
def train_bundle(
    dataset: Dataset,
    out: Path | str,
    case: CaseName | None = None,
    robot: Path | None = None,
    config: TrainConfig = TrainConfig(),  # noqa: B008
    report: Reporter = SILENT,
    accept: Sequence[str] = (),
    check: bool = True,
    start: Start = NOTHING,
    meshes: MeshFolders = MeshFolders(),
) -> Bundle:
    """Train on a dataset's free motion, find thresholds on validation or calibration recordings, and write one bundle.

    All data are checked first (tauext.check): faults are refused, warnings are reported and stored in the bundle.

    Args:
        out: NAME.tauext; its run file and wall time are written beside it. An interrupted training of a network resumes
            from its checkpoint there.
        case: the estimated model; None: the robot file's, or none if the dataset was imported without one.
        robot: URDF or MJCF of the arm; None: the dataset's own.
        config: recipe, seed and sizes.
        report: receives progress and sentences about results.
        accept: codes of findings that are accepted, CODE or CODE:joint; they are stored in the bundle.
        check: False skips the checks, for recordings known to be good.
        start: what the training begins with, read from a file by a package.
        meshes: folders of the robot file's meshes (tauext.robot.mesh_files.mesh_folders), which are searched first.

    Raises:
        FaultyDataError: recordings, robot file or limits have a fault that is not accepted.
        ConfigError: a name that does not end in .tauext, no training recording, no robot file, or settings that the
            case or the recordings cannot serve.
        TrainingError: too little motion for the recipe, or a loss that diverges.
    """
    out = Path(out)
    expect_codes(accept)
    if out.suffix != ".tauext":
        raise ConfigError(f"{out}: a bundle's name ends in .tauext")
    expect_new_file(out)
    config = accepted_settings(config, dataset.split.calibration, start, dataset.folder)
    robot_file = dataset.robot_file(robot)
    expect_meshes(robot_file, meshes)
    case, note = chosen_case(case, robot_file)
    if note:
        report.say(note)
    times = WallTimes()
    with times.phase("read"):
        training, validation = dataset.training(), dataset.recordings("validation")
    calibration = dataset.stretches("calibration")
    labels = read_labels(dataset.folder, to_train=True)
    given = TrainingInput(
        robot_file, PAPER_CASES[case], training, validation, calibration, start=start, meshes=meshes, labels=labels
    )
    checked = None
    if check:
        with times.phase("check"):
            checked = check_data(dataset, given, config, accept, report)
    train_on_recordings(given, config, out, report, checked, accept, times, signals=True)
    return load_bundle(out)


def train_on_recordings(
    given: TrainingInput,
    config: TrainConfig,
    out: Path,
    report: Reporter = SILENT,
    checked: dict | None = None,
    accept: Sequence[str] | None = None,
    times: WallTimes | None = None,
    signals: bool = False,
) -> list[Suspect]:
    """Train on recordings in memory by the config's recipe, find limits, and write the bundle.

    Returns the suspects: touches that nobody reported, left out of the training.

    Its run file and wall time are written beside it. While a network is trained, so is a checkpoint, from which an
    interrupted training resumes.

    Args:
        config: from accepted_settings.
        out: NAME.tauext; its folder is created.
        report: receives progress and sentences about results.
        checked: findings of the checks (check_data), for provenance; None: none were made.
        accept: codes of faults that are accepted: those of the limits, and `rejected`, with which the training goes on
            if a monitor rejects more than a fifth of the training motion. None: those of the limits, for a caller that
            judges the bundle itself.
        times: wall times of the phases before, such as the checks; those of the training are added.
        signals: whether to train with other recorded signals of servos too, where the promise does not hold.

    Raises:
        ConfigError: the case or the recordings do not allow the settings.
        TrainingError: too little motion for the recipe, a monitor rejects the motion, or the loss diverges.
        FaultyDataError: the limits have a fault that is not accepted; a checkpoint stays.
    """
    times = WallTimes() if times is None else times
    run, setup, fit = fitted_without_suspects(given, config, out, report, times)
    if checked is not None:
        run.facts["checks"] = checked
    # Check before a long training: rejected motion does not depend on the network.
    with times.phase("observe"):
        rejected = Rejected.of(assemble(run, with_fit(setup, fit)), run.training, run.threads)
    if words := rejected.warning("its own training motion", accept or ()):
        run.facts["rejected"] = asdict(rejected.summary())
        run.notes.append(words)
    network = fit_network(run, with_fit(setup, fit))
    with times.phase("gate"):
        bundle = assemble(run, with_fit(setup, fit), network)
        if config.row.gated:
            bundle, fit = gate(run, bundle, setup, fit)
    with times.phase("calibrate"):
        complete(run, bundle, setup, fit)
    if signals and given.start is NOTHING and not bundle.has_network:
        with times.phase("signals"):
            compare_signals(run, bundle, given)
    if accept is not None:
        refuse_limits(run.facts, str(out), accept)
    write(run, bundle, network)
    return list(run.suspects)


def fitted_without_suspects(
    given: TrainingInput, config: TrainConfig, out: Path, report: Reporter, times: WallTimes
) -> tuple[TrainingRun, Setup, PriorFit | None]:
    """A fitted run without touches that nobody reported; see train_on_recordings.

    They are searched twice at most: touches distort the first fit, and the second finds them more exactly.
    """
    run, setup, fit = fitted(given, config, out, report, times)
    suspects, searched = list[Suspect](), [*run.training, *run.validation]
    for _ in range(2):
        with times.phase("suspects"):
            found = training_suspects(run, setup, fit, searched, given.labels)
        if are_same(found, suspects):
            break
        suspects = found
        run.say("fitting again without unlabelled contacts")
        training, validation = (without_suspects(some, suspects) for some in (given.training, given.validation))
        free = replace(given, training=training, validation=validation)
        run, setup, fit = fitted(free, config, out, report, times)
    if suspects:
        run.suspects = suspects
        run.notes.extend(suspect_sentences(suspects))
        run.facts["suspects"] = suspect_facts(suspects)
    return run, setup, fit


def fitted(
    given: TrainingInput, config: TrainConfig, out: Path, report: Reporter, times: WallTimes
) -> tuple[TrainingRun, Setup, PriorFit | None]:
    """The prepared run, its setup without the prior, and the prior; see train_on_recordings."""
    with times.phase("prepare"):
        run = prepare(given, config, out, report, times)
    run.say("observing the motion")
    with times.phase("observe"):
        setup = observe(run)
    run.start.begin(run, setup)
    if config.row.fit is not None:
        run.say("fitting friction and model")
    with times.phase("fit"):
        setup, fit = fit_with_gain(run, setup)
    return run, setup, fit


def training_suspects(
    run: TrainingRun, setup: Setup, fit: PriorFit | None, recordings: Sequence[Recording], labels: Sequence[Label]
) -> list[Suspect]:
    """Touches that nobody reported in the motion of a training; none for recipes without a prior, whose errors are
    those of friction.

    Args:
        setup: without the prior.
        recordings: without impossible samples, suspects included.
        labels: see TrainingInput.
    """
    if fit is None or not any(map(is_unreported, recordings)):
        return []
    bundle = assemble(run, with_fit(setup, fit))
    put_region(run, bundle, fit)
    if run.config.row.drift:
        set_drift(bundle, fit, run.config.drift)
    if run.config.resolved().error_scale == "on":
        bundle.error_scale = scale_of(collect_rows(bundle, run.motion.uncut, run.threads, run.config.margins))
    return search(bundle, recordings, labels, run.threads, run.config.margins)


def fit_with_gain(run: TrainingRun, setup: Setup) -> tuple[Setup, PriorFit | None]:
    """Fit the recipe's prior, and choose the observer gain where the settings leave it open."""
    fit = fit_prior(run, setup, run.motion.training if run.motion.network else run.motion.uncut)
    if fit is None or run.config.resolved().observer.gain_per_s != "auto":
        return setup, fit
    run.say("choosing the observer gain")
    return choose_gain(run, setup, fit)


def compare_signals(run: TrainingRun, bundle: Bundle, given: TrainingInput) -> None:
    """Note which signal of servos keeps the promise best, or which package compares them.

    Args:
        given: with suspected touches: each signal would suspect other moments, those of its own errors among them.
    """
    if not makes_torque(run.training[0]):
        return
    try:
        compare = plugins.part("servo-signals")
    except ConfigError as missing:
        run.notes.append(f"The servos' recorded signals are not compared: {missing}.")
        return
    compare(run, bundle, given)


def complete(run: TrainingRun, bundle: Bundle, setup: Setup, fit: PriorFit | None) -> None:
    """Complete a fitted bundle: limits, drift, load and forces; each step depends on those before.

    Args:
        setup: without the prior.
    """
    put_prior(run, bundle, fit)  # region and drift: the errors from which limits follow depend on both
    put_coverage(run, bundle, setup)
    put_load(run, bundle, with_fit(setup, fit), fit)  # the frame at which put_limits fits errors of forces
    put_wrench(run, bundle)  # settings and facts of forces, to which put_limits adds
    if run.constants is not None:
        run.notes.extend(run.constants.sentences(run.joints))
    run.say("finding the thresholds")
    put_limits(run, bundle, setup, fit)  # last: replays motion through the bundle, and caches peaks by its content
    if found := noticed_standing(bundle, run.facts.get("wrench", {}).get("poses", [])):
        run.facts["standing"] = found
        run.notes.append(found["sentence"])


# --- The bundle's file, with its run file and wall time beside it.


def write(run: TrainingRun, bundle: Bundle, network: ScaledNetwork | None) -> None:
    """Write bundle, run file and wall time, all or none, and report notes and wall times."""
    for note in run.notes:
        run.say(note)
    bundle.servo = servo_of_recordings(run.training)
    history = [list(entry) for entry in network.trained.history] if network else []
    write_bundle(bundle, run.out, facts_of(run, bundle, network) | run.provenance, history, run.times)
    remove_checkpoint(run.out)
    run.out.with_suffix(CHECKPOINT).unlink(missing_ok=True)  # kept until here: gate and limits take minutes
    run.say(run.times.sentence())


def facts_of(run: TrainingRun, bundle: Bundle, network: ScaledNetwork | None) -> dict:
    """Results of the training, as plain JSON."""
    config = run.config.resolved() if run.start.learns else run.config  # nothing is trained: no epochs, no batch
    facts: dict[str, Any] = {
        "recipe": config.recipe,
        "case": run.given.case.name,
        "epochs": config.epochs,
        "batch": config.batch,
    }
    facts["steps"] = network.trained.steps if network else 0
    learned_on = run.motion.training if bundle.has_network else run.motion.uncut
    facts["training_minutes"] = round(total_s(learned_on) / 60, 6) if run.start.learns else 0.0
    facts["robot_sha256"] = run.training[0].robot_sha256
    facts |= run.facts
    if run.constants is not None:
        facts["torque_constants"] = run.constants.facts(run.joints)
    return facts | ({"notes": run.notes} if run.notes else {})
