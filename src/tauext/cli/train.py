"""`tauext train`: a bundle from recordings of free motion."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from tauext.cli.dataset import Dataset
from tauext.config import PAPER_CASES, ModelCase, TrainConfig
from tauext.errors import ConfigError

if TYPE_CHECKING:
    from tauext._core import Tree
    from tauext.cli.progress import ProgressBar
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
    """Train, calibrate and write the bundle, with its run file and wall time beside it."""
    import os

    from tauext.calibrate import apply_promised, paper_limits, promised_limits, set_limits
    from tauext.cli.progress import ProgressBar
    from tauext.cli.run_files import provenance, write_json
    from tauext.learn import (
        Progress,
        apply_gate,
        build_chain,
        build_windows,
        find_scaling,
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

    out.parent.mkdir(parents=True, exist_ok=True)
    run = provenance("tauext train", training_settings(case, config), config.seed)
    run["recordings"] = {"train": [r.name for r in training], "validation": [r.name for r in validation]}
    chain = build_chain(tree, training[0], config.observer)
    threads = config.threads or os.cpu_count() or 1
    scaling = network = fit = None
    if config.recipe in ("prior", "tauext"):
        fit = fit_prior(with_presliding(chain, config.prior.widths_rad), training, config.prior)
        chain = replace(chain, prior=fit.settings)
    if config.recipe in ("paper", "dense", "tauext"):
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
    if fit is not None:
        bundle.region_width = region_width(chain.widths_rad, config.prior)
    learned: dict = {} if fit is None else {"prior": prior_facts(fit, training[0].joints)}
    if config.recipe == "tauext":
        gate = apply_gate(bundle, validation, config.gate_margin, threads)
        learned["gate"] = {link.joint_name: gate.reason(j, config.gate_margin) for j, link in enumerate(tree.links)}
    if fit is not None:
        set_drift(bundle, fit, config.drift)  # behind the gate, which judges what the prior leaves, not what drifts
    if promises(config, calibration):
        with ProgressBar(f"calibrate {out.stem}") as bar:
            shown = shown_one_by_one(calibration, bar)
            promised = promised_limits(bundle, shown, config.alarm, threads)
        apply_promised(bundle, promised, config.alarm)
        learned["limits"] = promised.facts()
        print(promised.sentence(), file=sys.stderr)
    else:
        set_limits(bundle, paper_limits(bundle, validation, threads), config.alarm)
    if fit is not None:
        freeze_drift(bundle, config.drift)
    set_signal_ranges(bundle, training, torque_limits(robot, training[0].joints))
    resolved = config.resolved()
    facts = {"recipe": config.recipe, "case": case.name, "epochs": resolved.epochs, "batch": resolved.batch}
    facts["steps"] = network.steps if network else 0
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
        raise ConfigError(
            "limits = promised needs calibration recordings, which the dataset has none of; "
            "`tauext simulate --calibration-hours 24` makes some"
        )
    auto = bool(calibration) and config.recipe not in ("paper", "dense")
    return config.limits == "promised" or (config.limits == "auto" and auto)


def shown_one_by_one(loaders: Sequence[Callable[[], Recording]], bar: ProgressBar) -> Callable[[], Iterator[Recording]]:
    """Loads one recording after the other and moves the bar."""

    def load_all() -> Iterator[Recording]:
        for done, load in enumerate(loaders, start=1):
            yield load()
            bar.update(done, len(loaders), "recordings")

    return load_all


def training_settings(case: ModelCase, config: TrainConfig) -> dict:
    """What the trained bundle depends on beside the data; not the number of threads."""
    plain = asdict(config.resolved())
    network, sequences = ("prior", "gate_margin", "drift"), ("threads", "epochs")
    unused = {
        "tauext": sequences,
        "prior": ("threads", "targets", "gate_margin"),
        "paper": ("threads", "targets", *network),
        "dense": (*sequences, *network),
        "observer": ("threads", "targets", *network),
    }
    if config.backend == "core":
        del plain["backend"]
    settings = {"case": asdict(case), "config": {k: v for k, v in plain.items() if k not in unused[config.recipe]}}
    return json.loads(json.dumps(settings))  # as a file gives them back: lists, no tuples


def model_digest(tree: Tree) -> str:
    """A checkpoint of another estimated model must not be resumed: SHA-256 of the model's numbers."""
    import hashlib

    fields = ("joint_name", "parent", "rotation", "translation", "mass", "com", "inertia", "rotor_inertia")
    numbers = [[getattr(link, field) for field in fields] for link in tree.links]
    return hashlib.sha256(json.dumps([numbers, tree.gravity]).encode()).hexdigest()
