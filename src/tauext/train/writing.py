"""The bundle's file, with its run file and wall time beside it."""

from __future__ import annotations

import json
from typing import Any

from tauext._core import Bundle
from tauext.bundle.bundle_file import write_bundle
from tauext.data.first_seconds import total_s
from tauext.data.servo import servo_of_recordings
from tauext.files.staging import at_home
from tauext.train.bundle_limits import forget_half_done
from tauext.train.network import CHECKPOINT, ScaledNetwork
from tauext.train.preparation import Job


def write(job: Job, bundle: Bundle, network: ScaledNetwork | None) -> None:
    """Write all three, or none; the notes are told, too."""
    for note in job.notes:
        job.say(note)
    facts = facts_of(job, bundle, network)
    bundle.servo = servo_of_recordings(job.training)
    bundle.provenance = json.dumps(facts | job.run, sort_keys=True, allow_nan=False)
    history = [list(entry) for entry in network.trained.history] if network else []
    seconds = network.trained.seconds if network else 0.0
    run = facts | job.run | {"loss_history": history}
    write_bundle(bundle, job.out, run, {"train_s": seconds})
    forget_half_done(job.out)
    at_home(job.out).with_suffix(CHECKPOINT).unlink(missing_ok=True)  # not before: gate and limits take minutes, too


def facts_of(job: Job, bundle: Bundle, network: ScaledNetwork | None) -> dict:
    """What was trained and found, as plain JSON."""
    config = job.config.resolved()
    facts: dict[str, Any] = {
        "recipe": config.recipe,
        "case": job.case.name,
        "epochs": config.epochs,
        "batch": config.batch,
    }
    facts["steps"] = network.trained.steps if network else 0
    learned_on = job.motion.training if bundle.has_network else job.motion.uncut
    facts["training_minutes"] = round(total_s(learned_on) / 60, 6)
    facts["robot_sha256"] = job.training[0].robot_sha256
    facts |= job.facts
    if job.constants is not None:
        facts["torque_constants"] = job.constants.facts(job.joints)
    return facts | ({"notes": job.notes} if job.notes else {})
