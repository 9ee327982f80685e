"""Which stretches of a dataset's recordings are trained on and which validate, and what that leaves out, in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tauext.config import TrainConfig
from tauext.data.first_seconds import total_s
from tauext.data.free_motion import free_pieces, free_samples, split_by_time
from tauext.data.recording import Recording
from tauext.data.standing import standing_joints
from tauext.errors import ConfigError, TrainingError

VALIDATION_SHARE = 0.2
NETWORK_LEAST_MIN = 30.0
"""With less motion, and no recordings to validate on, no network is tried behind a prior, [minutes]: the end of a
recording shows the same trajectory as its beginning, and what helps there may harm on another one."""


@dataclass(frozen=True)
class TrainingMotion:
    """What a training works on; notes are sentences for people and for the run file."""

    training: list[Recording]
    """Free motion; for a recipe that learns nothing the recordings as they are."""
    validation: list[Recording]
    """The same, for what is learned by steps."""
    for_limits: list[Recording]
    """Whole recordings that nothing is trained on: limits are found on their free motion."""
    uncut: list[Recording]
    """Free motion of the training recordings before any validation was cut off: all of it where none was."""
    notes: list[str]
    network: bool = False
    """Whether a network is tried."""


def training_motion(
    training: Sequence[Recording], validation: Sequence[Recording], config: TrainConfig
) -> TrainingMotion:
    """Leave out contacts, and cut validation off by time where the dataset has none.

    Raises:
        ConfigError: no training recording.
        TrainingError: nothing of free motion is left; or no joint moves, and the recipe is to learn from motion.
    """
    expect_some(training)
    stand = standing_joints(training)
    if not config.row.learns:
        return as_they_are(training, validation, left_out_sentences([*training, *validation], config))
    if stand.all():
        raise TrainingError(
            f"no joint moves in any of {len(training)} training recordings: friction and model cannot be learned, so "
            f"recipe {config.recipe} has nothing to say. What can be had is --recipe observer (or highpass), with "
            "limits that hold at rest only; or record motion of every joint"
        )
    notes = left_out_sentences([*training, *validation], config)
    uncut = free_pieces(training, config.margins)
    learned_on, validated_on = uncut, free_pieces(validation, config.margins)
    network = config.row.network is not None
    if not validation and config.row.gated and total_s(uncut) < 60 * NETWORK_LEAST_MIN:
        network = False
        notes.append(
            f"no network: {total_s(uncut) / 60:.1f} minutes without validation recordings cannot tell if it helps "
            f"({NETWORK_LEAST_MIN:g} minutes or a list of validation recordings can)"
        )
    if not validation and not network:
        validated_on = uncut
        notes.append(
            "the dataset has no validation recordings: for the limits every fifth of the motion is judged by a fit to "
            "the other four"
        )
    elif not validation:
        beginnings, validation = split_validation(training, config)
        learned_on, validated_on = (free_pieces(some, config.margins) for some in (beginnings, validation))
        notes.append(
            f"the dataset has no validation recordings: the last {VALIDATION_SHARE:.0%} of each training recording "
            f"({total_s(validation):.1f} s together) validate, {reach_s(config):g} s after what is trained on"
        )
    expect_motion(learned_on, "training", config)
    expect_motion(validated_on, "validation", config)
    if stand.any():
        names = ", ".join(np.array(training[0].joints)[stand])
        notes.append(f"{names} never moved in the training recordings: nothing is known of their friction")
    return TrainingMotion(learned_on, validated_on, list(validation), uncut, notes, network)


def expect_some(training: Sequence[Recording]) -> None:
    """Raise ConfigError where there is no training recording."""
    if not training:
        raise ConfigError("the dataset lists no training recording; one is enough")


def as_they_are(training: Sequence[Recording], validation: Sequence[Recording], notes: list[str]) -> TrainingMotion:
    """The recordings of a recipe that learns nothing: they serve for its limits alone."""
    if not validation:
        notes.append("the dataset has no validation recordings: limits are found on the training recordings")
    judged = list(validation or training)
    return TrainingMotion(list(training), judged, judged, list(training), notes)


def left_out_sentences(recordings: Sequence[Recording], config: TrainConfig) -> list[str]:
    """How much of the recordings is no free motion; nothing where all of it is."""
    left_out_s = sum(float((~free_samples(r, config.margins)).sum() / r.rate_hz) for r in recordings)
    if not left_out_s:
        return []
    return [
        f"{left_out_s:.1f} s are left out: in contact, {config.margins.before_s:g} s before one or "
        f"{config.margins.after_s:g} s after"
    ]


def expect_motion(pieces: Sequence[Recording], what: str, config: TrainConfig) -> None:
    """Raise TrainingError where no piece of free motion is left."""
    if not pieces:
        raise TrainingError(
            f"the {what} recordings hold no second of free motion that is {config.margins.before_s:g} s before and "
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
    """How far a bundle looks back: a window and the observer's warm-up, [s]."""
    return config.observer.window_s + config.warm_up_s
