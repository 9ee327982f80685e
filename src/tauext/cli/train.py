"""`tauext train`: a bundle from recordings of free motion."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from tauext.cli.calibrate import NO_CALIBRATION, calibrate_bundle
from tauext.cli.dataset import Dataset
from tauext.config import PAPER_CASES, ModelCase, TrainConfig
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
) -> None:
    """Train, calibrate and write the bundle, with its run file and wall time beside it.

    Raises:
        ConfigError: settings that the case or the recordings cannot serve.
    """
    import os

    from tauext.calibrate import paper_limits, set_limits
    from tauext.cli.progress import ProgressBar
    from tauext.cli.run_files import provenance, write_json
    from tauext.data import total_s
    from tauext.learn import (
        Progress,
        apply_gate,
        build_chain,
        build_windows,
        find_scaling,
        fit_friction,
        fit_prior,
        freeze_drift,
        make_bundle,
        set_drift,
        set_signal_ranges,
        with_presliding,
    )
    from tauext.learn import train as train_network
    from tauext.learn.prior_facts import prior_facts
    from tauext.learn.widths import region_width
    from tauext.robot import torque_limits

    if impossible := why_impossible(config.recipe, case):
        raise ConfigError(impossible)
    training, validation = chosen_recordings(training, validation, config)
    out.parent.mkdir(parents=True, exist_ok=True)
    run = provenance("tauext train", training_settings(case, config), config.seed)
    run["recordings"] = {"train": [r.name for r in training], "validation": [r.name for r in validation]}
    chain = build_chain(tree, training[0], config.observer, config.recipe, config.filters)
    threads = config.threads or os.cpu_count() or 1
    scaling = network = fit = None
    if config.recipe in ("prior", "tauext"):
        fit = fit_prior(with_presliding(chain, config.prior.widths_rad), training, config.prior)
    elif config.recipe == "friction":
        fit = fit_friction(chain, training)
    if fit is not None:
        chain = replace(chain, prior=fit.settings)
    if config.recipe in ("paper", "dense", "tauext", "feedforward"):
        scaling = find_scaling(chain, training)
        with ProgressBar(f"train {out.stem}") as bar:

            def show(p: Progress) -> None:
                bar.update(p.step, p.steps, f"loss {p.loss:.3g} validation {p.validation_loss:.3g}")

            network = train_network(
                chain,
                build_windows(chain, scaling, training),
                build_windows(chain, scaling, validation),
                config,
                checkpoint_path=out.with_suffix(".checkpoint.npz"),
                settings={key: run[key] for key in ("settings", "recordings")} | {"robot": model_digest(tree)},
                report=show,
            )
    bundle = make_bundle(out.stem, chain, config.observer.near_stiction_rad_s, validation[0], scaling, network)
    if fit is not None and chain.widths_rad:
        bundle.region_width = region_width(chain.widths_rad, config.prior)
    learned: dict = {} if fit is None else {"prior": prior_facts(fit, training[0].joints)}
    if config.recipe == "tauext":
        gate = apply_gate(bundle, validation, config.gate_margin, threads)
        learned["gate"] = {link.joint_name: gate.reason(j, config.gate_margin) for j, link in enumerate(tree.links)}
    if config.recipe in ("prior", "tauext"):
        set_drift(bundle, fit, config.drift)  # behind the gate, which judges what the prior leaves, not what drifts
    if promises(config, calibration):
        promised, learned["limits"] = calibrate_bundle(bundle, out.stem, calibration, config.alarm, threads)
        print(promised.sentence(), file=sys.stderr)
    else:
        set_limits(bundle, paper_limits(bundle, validation, threads), config.alarm)
    if fit is not None:
        freeze_drift(bundle, config.drift)
    set_signal_ranges(bundle, training, torque_limits(robot, training[0].joints))
    resolved = config.resolved()
    facts = {"recipe": config.recipe, "case": case.name, "epochs": resolved.epochs, "batch": resolved.batch}
    facts["steps"] = network.steps if network else 0
    facts["training_minutes"] = round(total_s(training) / 60, 6)
    facts["robot_sha256"] = training[0].robot_sha256
    facts |= learned
    bundle.provenance = json.dumps(facts | run, sort_keys=True)
    history = [list(entry) for entry in network.history] if network else []
    write_json(facts | run | {"loss_history": history}, out.with_suffix(".run.json"))
    write_json({"train_s": network.seconds if network else 0.0}, out.with_suffix(".wall_time_s.json"))
    bundle.save(str(out))


def promises(config: TrainConfig, calibration: Sequence[object]) -> bool:
    """Whether limits are to follow from a budget of false alarms.

    Raises:
        ConfigError: they shall, and there is nothing to find them on.
    """
    if config.limits == "promised" and not calibration:
        raise ConfigError(f"limits = promised {NO_CALIBRATION}")
    auto = bool(calibration) and config.recipe not in ("paper", "dense")
    return config.limits == "promised" or (config.limits == "auto" and auto)


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
