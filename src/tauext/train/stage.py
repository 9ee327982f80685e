"""One bundle from recordings of free motion: prepare, observe, fit, gate, calibrate, write."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from tauext._core import Tree
from tauext.config import ModelCase, TrainConfig
from tauext.data import Recording
from tauext.learn import set_signal_ranges
from tauext.progress import SILENT, Reporter
from tauext.robot import torque_limits
from tauext.train.fitting import fit_prior, observe, put_prior, with_fit
from tauext.train.gating import gate
from tauext.train.limits import calibrate
from tauext.train.network import assemble, fit_network
from tauext.train.preparation import note_recordings, prepare
from tauext.train.writing import write


def train_bundle(
    tree: Tree,
    robot: Path,
    case: ModelCase,
    training: Sequence[Recording],
    validation: Sequence[Recording],
    config: TrainConfig,
    out: Path,
    calibration: Sequence[Callable[[], Recording]] = (),
    report: Reporter = SILENT,
) -> None:
    """Train by the config's recipe, find limits, and write the bundle, with its run file and wall time beside it.

    An interrupted training of a network goes on from its checkpoint beside the bundle.

    Args:
        tree: the estimated model, that of the case.
        robot: URDF or MJCF, for what the drives can give at most.
        training: recordings as they stand in the dataset, contacts and all, of one robot, rate and torque timing.
        validation: others, which nothing is trained on; none: the recipe does without, or cuts some off.
        out: NAME.tauext; its folder is made.
        calibration: load the recordings on which a promise about false alarms is kept.
        report: is told how far it is, and what was found, in sentences.

    Raises:
        ConfigError: settings that the case or the recordings cannot serve.
        TrainingError: too little motion for the recipe, or a loss that diverges.
    """
    job = prepare(tree, case, training, validation, config, out, calibration, report)
    setup = observe(job)
    fit = fit_prior(job, setup, job.motion.training if job.motion.network else job.motion.uncut)
    network = fit_network(job, with_fit(setup, fit))
    bundle = assemble(job, with_fit(setup, fit), network)
    if config.row.gated:
        bundle, fit = gate(job, bundle, setup, fit)
    put_prior(job, bundle, fit)
    note_recordings(job)
    calibrate(job, bundle, setup, fit)
    set_signal_ranges(bundle, job.training, torque_limits(robot, job.joints))
    write(job, bundle, network)
