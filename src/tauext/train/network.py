"""The network, on what observer and prior leave, and the bundle with it."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass

from tauext._core import Bundle, Tree
from tauext.files.staging import at_home
from tauext.fit.bundle_writing import make_bundle, set_signal_ranges
from tauext.fit.network_training import Progress, TrainedNetwork, train_network
from tauext.fit.training_set import Scaling, Setup, TooShort, build_windows, find_scaling
from tauext.train.preparation import Job

CHECKPOINT = ".checkpoint.npz"
"""Of a bundle's network, beside the bundle until that is written."""


@dataclass(frozen=True)
class ScaledNetwork:
    """A trained network, and what its inputs and outputs are scaled by."""

    scaling: Scaling
    trained: TrainedNetwork


def fit_network(job: Job, setup: Setup) -> ScaledNetwork | None:
    """Train the recipe's network; None: it has none, or the motion is too short and the prior can do without.

    Raises:
        TrainingError: too little data, or a loss that diverges.
    """
    if not job.motion.network:
        return None
    scaling = find_scaling(setup, job.motion.training)
    with job.report.progress(f"train {job.name}") as show:

        def report(p: Progress) -> None:
            show(p.step, p.steps, f"loss {p.loss:.3g} validation {p.validation_loss:.3g}")

        try:
            trained = train_network(
                setup,
                build_windows(setup, scaling, job.motion.training),
                build_windows(setup, scaling, job.motion.validation),
                job.config,
                checkpoint_path=at_home(job.out).with_suffix(CHECKPOINT),
                settings={key: job.run[key] for key in ("settings", "recordings")} | {"robot": model_digest(job.tree)},
                report=report,
            )
        except TooShort as error:
            if not job.config.row.gated:
                raise
            job.notes.append(f"prior only: {error}")
            return None
    return ScaledNetwork(scaling, trained)


def assemble(job: Job, setup: Setup, network: ScaledNetwork | None = None) -> Bundle:
    """The bundle of this setup, without limits yet.

    Raises:
        TrainingError: no recording is as long as a window.
    """
    learned = (network.scaling, network.trained) if network else ()
    bundle = make_bundle(job.name, setup, job.config.observer.near_stiction_rad_s, job.reference(setup), *learned)
    bundle.units = job.units
    # Before gate and limits, which judge by the same watch as the control loop.
    set_signal_ranges(bundle, job.training, job.possible.torque_limit_nm, job.possible.bounds)
    return bundle


def model_digest(tree: Tree) -> str:
    """A checkpoint of another estimated model must not be resumed: SHA-256 of the model's numbers."""
    fields = ("joint_name", "parent", "rotation", "translation", "mass", "com", "inertia", "rotor_inertia")
    numbers = [[getattr(link, field) for field in fields] for link in tree.links]
    return hashlib.sha256(json.dumps([numbers, tree.gravity]).encode()).hexdigest()
