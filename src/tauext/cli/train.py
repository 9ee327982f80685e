"""`tauext train`: a bundle from recordings of free motion."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from tauext.cli.calibrate import calibrate_bundle
from tauext.cli.dataset import Dataset
from tauext.cli.model_case import CaseName, chosen_case, estimated_model, model_digest, why_impossible
from tauext.cli.train_settings import training_settings
from tauext.config import PAPER_CASES, ModelCase, TrainConfig
from tauext.errors import ConfigError

if TYPE_CHECKING:
    from tauext._core import Tree
    from tauext.data import Recording


def train(
    data: Path,
    out: Path,
    case: CaseName | None = None,
    robot: Path | None = None,
    config: Annotated[TrainConfig, tyro.conf.arg(name="")] = TrainConfig(),  # noqa: B008
) -> None:
    """Train on a dataset's free motion, find the limits on its validation recordings, write one bundle.

    Args:
        data: dataset folder (`tauext simulate` makes one).
        out: bundle to write, NAME.tauext. An interrupted run goes on from its checkpoint beside it.
        case: the estimated model: the robot file as it is (exact), mass and/or centre of mass halved, or no model at
            all (none). Left out: exact, or none where the dataset was imported without a model.
        robot: URDF or MJCF of the arm; default: the dataset's own.
        config: recipe, seed and sizes.
    """
    if out.suffix != ".tauext":
        raise ConfigError(f"{out}: a bundle's name ends in .tauext")
    dataset = Dataset.open(data)
    robot_file = dataset.robot_file(robot)
    model = PAPER_CASES[chosen_case(case, robot_file)]
    training, validation = dataset.training(), dataset.recordings("validation")
    tree = estimated_model(robot_file, training[0], model)
    train_bundle(tree, robot_file, model, training, validation, config, out, dataset.loaders("calibration"))
    print(out)


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
    from tauext.cli.train_limits import left_out_of_fit, limits_kind, set_supported_limits
    from tauext.cli.train_recordings import chosen_recordings, scaled, wants_constants
    from tauext.data import free_pieces, from_amperes, scaled_torque, standing_joints, total_s
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
    if wants_constants(config, training, case):
        free = free_pieces(training, config.margins)
        constants = fit_torque_constants(tree, free, config.observer, from_amperes(training))
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
            bent = with_presliding(chain, config.prior.widths_rad)
            tell = partial(print, f"{out.stem}:", file=sys.stderr)
            return fit_prior(bent, recordings, config.prior, tell, constants.kinematics if constants else None)
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
