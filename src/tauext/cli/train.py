"""`tauext train`: a bundle from recordings of free motion."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from tauext.cli.calibrate import NO_CALIBRATION, calibrate_bundle
from tauext.cli.dataset import Dataset
from tauext.config import PAPER_CASES, FreeMotionConfig, ModelCase, TrainConfig
from tauext.errors import ConfigError

if TYPE_CHECKING:
    from tauext._core import Tree
    from tauext.data import Recording

CaseName = Literal["exact", "mass", "com", "mass+com", "none"]


def train(
    data: Path,
    out: Path,
    case: CaseName = "exact",
    robot: Path | None = None,
    config: Annotated[TrainConfig, tyro.conf.arg(name="")] = TrainConfig(),  # noqa: B008
) -> None:
    """Train on a dataset's free motion, find the limits on its validation recordings, write one bundle.

    Args:
        data: dataset folder (`tauext simulate` makes one).
        out: bundle to write, NAME.tauext. An interrupted run goes on from its checkpoint beside it.
        case: the estimated model: the robot file as it is, mass and/or centre of mass halved, or no model at all.
        robot: URDF or MJCF of the arm; default: the dataset's own.
        config: recipe, seed and sizes.
    """
    if out.suffix != ".tauext":
        raise ConfigError(f"{out}: a bundle's name ends in .tauext")
    dataset = Dataset.open(data)
    training, validation = dataset.recordings("train"), dataset.recordings("validation")
    robot_file = dataset.robot_file(robot)
    if not training:
        raise ConfigError(f"{data}: split.json lists no training recording; one is enough")
    tree = estimated_model(robot_file, training[0], PAPER_CASES[case])
    calibration = dataset.loaders("calibration")
    train_bundle(tree, robot_file, PAPER_CASES[case], training, validation, config, out, calibration)
    print(out)


def estimated_model(robot: Path, recording: Recording, case: ModelCase) -> Tree:
    """The robot file's joints that the recording has, as the case's wrong or missing model."""
    from tauext.robot import empty, load, perturbed

    tree = load(robot, joints=recording.joints)
    return empty(tree) if case.no_model else perturbed(tree, case.mass_factor, case.com_factor)


def train_bundle(
    tree: Tree,
    robot: Path,
    case: ModelCase,
    training: list[Recording],
    validation: list[Recording],
    config: TrainConfig,
    out: Path,
    calibration: Sequence[Callable[[], Recording]] = (),
    on_step: Callable[[int, int], None] | None = None,
) -> None:
    """Train, calibrate and write the bundle, with its run file and wall time beside it.

    Args:
        on_step: called now and then with the network's steps that are done, and how many there will be.

    Raises:
        ConfigError: settings that the case or the recordings cannot serve.
    """
    import os

    from tauext.calibrate import Judged, at_rest_sentence, paper_limits, set_limits
    from tauext.cli.progress import ProgressBar
    from tauext.cli.run_files import provenance, write_json
    from tauext.cli.train_limits import left_out_of_fit, set_supported_limits
    from tauext.data import free_pieces, scaled_torque, standing_joints, total_s
    from tauext.learn import (
        PriorFit,
        Progress,
        apply_gate,
        build_chain,
        build_windows,
        find_scaling,
        fit_friction,
        fit_prior,
        fit_torque_constants,
        freeze_drift,
        make_bundle,
        reference_recording,
        set_drift,
        set_signal_ranges,
        training_parts,
        with_presliding,
    )
    from tauext.learn import train as train_network
    from tauext.learn.prior_facts import prior_facts
    from tauext.learn.training_set import TooShort
    from tauext.learn.widths import region_width
    from tauext.robot import torque_limits

    if impossible := why_impossible(config.recipe, case):
        raise ConfigError(impossible)
    training, validation = chosen_recordings(training, validation, config)
    constants = None
    if config.fit_torque_constants:
        constants = fit_torque_constants(tree, free_pieces(training, config.margins), config.observer)
        training, validation = ([scaled_torque(r, constants.used) for r in some] for some in (training, validation))
        calibration = [partial(scaled, load, constants.used) for load in calibration]
    parts = training_parts(training, validation, config)
    first = training[0]
    out.parent.mkdir(parents=True, exist_ok=True)
    run = provenance("tauext train", training_settings(case, config), config.seed)
    run["recordings"] = {"train": [r.name for r in training], "validation": [r.name for r in validation]}
    chain = build_chain(tree, first, config.observer, config.recipe, config.filters)
    threads = config.threads or os.cpu_count() or 1
    scaling = network = None
    learned: dict = {}

    def fitted(recordings: list[Recording]) -> PriorFit | None:
        if config.recipe in ("prior", "tauext"):
            return fit_prior(with_presliding(chain, config.prior.widths_rad), recordings, config.prior)
        return fit_friction(chain, recordings) if config.recipe == "friction" else None

    # Without steps there is nothing to validate: all of the motion is fitted, and left out in turn for the limits.
    fit = fitted(parts.training if config.recipe == "tauext" and parts.network else parts.uncut)
    bare = chain
    if fit is not None:
        chain = replace(chain, prior=fit.settings)
    if config.recipe in ("paper", "dense", "tauext", "feedforward") and parts.network:
        scaling = find_scaling(chain, parts.training)
        with ProgressBar(f"train {out.stem}") as bar:

            def show(p: Progress) -> None:
                bar.update(p.step, p.steps, f"loss {p.loss:.3g} validation {p.validation_loss:.3g}")
                if on_step is not None:
                    on_step(p.step, p.steps)

            try:
                network = train_network(
                    chain,
                    build_windows(chain, scaling, parts.training),
                    build_windows(chain, scaling, parts.validation),
                    config,
                    checkpoint_path=out.with_suffix(".checkpoint.npz"),
                    settings={key: run[key] for key in ("settings", "recordings")} | {"robot": model_digest(tree)},
                    report=show,
                )
            except TooShort as error:
                if config.recipe != "tauext":
                    raise
                parts.notes.append(f"prior only: {error}")
    reference = reference_recording(chain, [*validation, *training])
    bundle = make_bundle(out.stem, chain, config.observer.near_stiction_rad_s, reference, scaling, network)
    if config.recipe == "tauext":
        if network is not None:
            gate = apply_gate(bundle, parts.validation, config.gate_margin, threads)
            learned["gate"] = {link.joint_name: gate.reason(j, config.gate_margin) for j, link in enumerate(tree.links)}
        if not bundle.has_network and parts.network and not validation:
            fit = fitted(parts.uncut)
            chain = replace(bare, prior=fit.settings)
            bundle = make_bundle(out.stem, chain, config.observer.near_stiction_rad_s, reference)
            parts.notes.append("no joint has a network, so the prior was fitted to all of the motion in the end")
    if fit is not None:
        learned["prior"] = prior_facts(fit, first.joints)
    if fit is not None and chain.widths_rad:
        bundle.region_width = region_width(chain.widths_rad, config.prior)
    if config.recipe in ("prior", "tauext"):
        set_drift(bundle, fit, config.drift)  # behind the gate, which judges what the prior leaves, not what drifts
    by_fit = fit is not None and not bundle.has_network
    # What was cut off to validate was trained on in the end where no network ships.
    judged: list[Recording | Judged] = [] if by_fit and not validation else list(parts.limits)
    unseen = judged.copy()
    if by_fit:
        judged += left_out_of_fit(bundle, chain, fit, reference)
    if constants is not None:
        parts.notes.extend(constants.sentences(first.joints))
    stand = standing_joints([*training, *validation])
    names = [name for name, stands in zip(first.joints, stand, strict=True) if stands]
    if names:
        parts.notes.append(at_rest_sentence(names, len(first.joints)))
    kind = limits_kind(config, calibration)
    if kind == "promised":
        promised, learned["limits"] = calibrate_bundle(
            bundle, out.stem, calibration, config.alarm, threads, config.margins
        )
        print(promised.sentence(), file=sys.stderr)
    elif kind == "supported":
        words, learned["limits"] = set_supported_limits(bundle, judged, config, threads, fit)
        parts.notes.append(words)
    else:
        set_limits(bundle, paper_limits(bundle, unseen or judged, threads, config.margins), config.alarm)
    if fit is not None:
        freeze_drift(bundle, config.drift)
    set_signal_ranges(bundle, training, torque_limits(robot, first.joints))
    for note in parts.notes:
        print(f"{out.stem}: {note}", file=sys.stderr)
    resolved = config.resolved()
    facts = {"recipe": config.recipe, "case": case.name, "epochs": resolved.epochs, "batch": resolved.batch}
    facts["steps"] = network.steps if network else 0
    facts["training_minutes"] = round(total_s(parts.training if bundle.has_network else parts.uncut) / 60, 6)
    facts["robot_sha256"] = first.robot_sha256
    facts |= learned
    if constants is not None:
        facts["torque_constants"] = constants.facts(first.joints)
    if parts.notes:
        facts["notes"] = parts.notes
    bundle.provenance = json.dumps(facts | run, sort_keys=True)
    history = [list(entry) for entry in network.history] if network else []
    write_json(facts | run | {"loss_history": history}, out.with_suffix(".run.json"))
    write_json({"train_s": network.seconds if network else 0.0}, out.with_suffix(".wall_time_s.json"))
    bundle.save(str(out))


def scaled(load: Callable[[], Recording], nm_per_unit: Sequence[float]) -> Recording:
    """A loaded recording with its torque in N m."""
    from tauext.data import scaled_torque

    return scaled_torque(load(), nm_per_unit)


def limits_kind(config: TrainConfig, calibration: Sequence[object]) -> str:
    """How limits are found: promised, supported or paper.

    Raises:
        ConfigError: they shall follow from a budget, and there is nothing to find them on.
    """
    if config.limits == "promised" and not calibration:
        raise ConfigError(f"limits = promised {NO_CALIBRATION}")
    if config.limits != "auto":
        return config.limits
    if config.recipe in ("paper", "dense"):
        return "paper"
    return "promised" if calibration else "supported"


def why_impossible(recipe: str, case: ModelCase) -> str | None:
    """Why there is no such bundle; None: there is."""
    if recipe == "velocity" and case.no_model:
        return f"recipe = velocity needs a model, which the case '{case.name}' has not: it divides by the inertia"
    return None


def chosen_recordings(
    training: list[Recording], validation: list[Recording], config: TrainConfig
) -> tuple[list[Recording], list[Recording]]:
    """What config.minutes leaves of them: of validation at least a minute, or a window where that is longer.

    Raises:
        ConfigError: there are not so many minutes.
    """
    from tauext.data import first_seconds, total_s

    if config.minutes is None:
        return training, validation
    wanted_s, there_s = 60 * config.minutes, total_s(training)
    if wanted_s > there_s + 1e-6:
        most = int(there_s / 0.6) / 100
        raise ConfigError(
            f"minutes = {config.minutes:g} must be at most {most:g}: the training recordings hold no more"
        )
    window_s = 10 / config.observer.gain_per_s + config.observer.window_s  # with the observer's warm-up
    if not validation:
        return first_seconds(training, wanted_s), []
    return first_seconds(training, wanted_s), first_seconds(validation, max(wanted_s / 5, 60.0, window_s))


def training_settings(case: ModelCase, config: TrainConfig) -> dict:
    """What the trained bundle depends on beside the data; not the number of threads."""
    plain = asdict(config.resolved())
    network, sequences, filters = ("prior", "gate_margin", "drift"), ("threads", "epochs"), ("filters",)
    no_network = ("threads", "targets", *network)
    unused = {
        "tauext": (*sequences, *filters),
        "prior": ("threads", "targets", "gate_margin", *filters),
        "paper": ("threads", "targets", *network, *filters),
        "dense": (*sequences, *network, *filters),
        "feedforward": (*sequences, "targets", *network, *filters),
        "highpass": no_network,
        "bandpass": no_network,
    }.get(config.recipe, (*no_network, *filters))
    if config.backend == "core":
        del plain["backend"]
    if config.minutes is None:
        del plain["minutes"]
    if config.margins == FreeMotionConfig():
        del plain["margins"]
    if not config.fit_torque_constants:
        del plain["fit_torque_constants"]
    settings = {"case": asdict(case), "config": {k: v for k, v in plain.items() if k not in unused}}
    return json.loads(json.dumps(settings))  # as a file gives them back: lists, no tuples


def finished(bundle: Path, case: str, config: TrainConfig) -> bool:
    """Whether this bundle was already trained with these settings.

    Raises:
        ConfigError: a bundle of other settings stands there.
    """
    run = bundle.with_suffix(".run.json")
    if not bundle.exists() or not run.exists():
        return False
    settings = json.loads(run.read_text())["settings"]
    if settings == training_settings(PAPER_CASES[case], config):
        return True
    raise ConfigError(f"{bundle}: it was trained with other settings; choose another --out or remove it")


def model_digest(tree: Tree) -> str:
    """A checkpoint of another estimated model must not be resumed: SHA-256 of the model's numbers."""
    import hashlib

    fields = ("joint_name", "parent", "rotation", "translation", "mass", "com", "inertia", "rotor_inertia")
    numbers = [[getattr(link, field) for field in fields] for link in tree.links]
    return hashlib.sha256(json.dumps([numbers, tree.gravity]).encode()).hexdigest()
