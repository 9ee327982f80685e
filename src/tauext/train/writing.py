"""Writes a bundle with its run file; frames, shapes and torque constants for forces."""

from __future__ import annotations

from typing import Any

import numpy as np

from tauext._core import Bundle
from tauext.bundle.bundle_file import write_bundle
from tauext.data.free_motion import total_s
from tauext.data.servo import servo_of_recordings
from tauext.errors import RobotError
from tauext.fit.network_training import ScaledNetwork
from tauext.robot.capsules import link_capsules
from tauext.robot.frames import wrench_frames
from tauext.train.network import CHECKPOINT
from tauext.train.preparation import TrainingRun
from tauext.train.promised_limits import remove_checkpoint

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


# --- Accuracy of forces: the robot file's frames, and errors of the torque constants.


def put_wrench(run: TrainingRun, bundle: Bundle) -> None:
    """Add the robot file's frames for forces, and the errors of the torque constants.

    Fitted constants have individual standard errors and a common one. Known constants, and torques recorded in N m, may
    be off by config.torque_share each. The friction of gears under a push is part of `contact_sigma_nm`.
    """
    settings = bundle.wrench_settings
    share = np.full(len(run.joints), run.config.torque_share)
    if run.constants is not None:
        found = run.constants.shares
        share = np.where(np.isfinite(found) & (found > 0), np.minimum(found, 1.0), share)
        settings.common_share = min(run.constants.common_share, 1.0)
    settings.torque_share = share.tolist()
    if any(link.mass > 0 for link in bundle.links):
        try:
            settings.frames = wrench_frames(run.given.robot, run.tree)
            put_shapes(run, bundle)
        except RobotError as error:
            run.notes.append(f"forces are available at links only: {error}")
    bundle.wrench_settings = settings
    run.facts["wrench"] = {"torque_share": [round(one, 4) for one in share.tolist()]}
    run.facts["wrench"] |= {"common_share": round(settings.common_share, 4)} if settings.common_share else {}


def put_shapes(run: TrainingRun, bundle: Bundle) -> None:
    """Add capsules of the robot file's links to the bundle; links without a shape get estimated capsules on use."""
    bundle.capsules, notes = link_capsules(run.given.robot, run.tree, run.given.meshes)
    shaped = {one.link for one in bundle.capsules}
    guessed = [link.joint_name for number, link in enumerate(bundle.links) if number not in shaped]
    run.facts["shapes"] = {"capsules": len(bundle.capsules), "guessed": guessed, "notes": notes}
    if notes:
        run.notes.append(f"the shape of {len(guessed)} of {len(bundle.links)} links is guessed: {notes[0]}")
