"""The look before training: what a dataset's recordings have wrong, before anything is learned from them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from tauext.check.look import Look, expect_codes, judge, look_at_calibration, look_at_training
from tauext.config import ModelCase, TrainConfig
from tauext.data.dataset import Dataset
from tauext.data.recording import Recording
from tauext.data.servo import in_amperes
from tauext.progress import Reporter
from tauext.robot.torque_limits import torque_limits
from tauext.train.preparation import chosen_recordings, wants_constants


def look_first(
    dataset: Dataset,
    robot: Path,
    case: ModelCase,
    training: Sequence[Recording],
    validation: Sequence[Recording],
    config: TrainConfig,
    accept: Sequence[str],
    report: Reporter,
) -> dict:
    """Look at all that a training of the dataset would use; the facts for provenance: what was accepted, warnings.

    Args:
        training: of the dataset, all of it, as validation.
        accept: codes of findings that are no fault on a person's word, CODE or CODE:joint.

    Raises:
        ConfigError: a code that does not exist, or a joint.
        FaultyDataError: a fault that nobody accepted.
    """
    expect_codes(accept, training[0].joints)
    looks = view_dataset(dataset, robot, case, training, validation, config, report)
    return judge(looks, str(dataset.folder), accept, report)


def view_dataset(
    dataset: Dataset,
    robot: Path,
    case: ModelCase,
    training: Sequence[Recording],
    validation: Sequence[Recording],
    config: TrainConfig,
    report: Reporter,
) -> dict[str, Look]:
    """What is found in the recordings that are learned from, and in those that limits are found on.

    Without a model nothing is held against the robot file: it is not trained on.
    """
    training, validation = chosen_recordings(training, validation, config)
    # constants that were given may be corrected, by a little: a larger correction is reported
    unknown = wants_constants(config, training, case) and (bool(config.fit_torque_constants) or in_amperes(training))
    no_torque = in_amperes(training) or bool(config.fit_torque_constants)
    limits_nm = None if case.no_model or no_torque else torque_limits(robot, training[0].joints)
    model = None if case.no_model else robot
    looks = {"training": look_at_training([*training, *validation], model, limits_nm, unknown, config.threads, report)}
    if uses_calibration(config) and dataset.split.calibration:
        looks["calibration"] = look_at_calibration(dataset.files("calibration"), limits_nm, config.threads, report)
    return looks


def uses_calibration(config: TrainConfig) -> bool:
    """Whether limits are found on calibration recordings where there are some."""
    return config.limits == "promised" or (config.limits == "auto" and not config.row.largest_error_limits)
