"""The data check before training: faults of a dataset's recordings refuse the training."""

from __future__ import annotations

from collections.abc import Sequence

from tauext.check.preflight import CheckResult, check_calibration, check_training, expect_codes, refuse_faults
from tauext.config import TrainConfig
from tauext.data.dataset import Dataset
from tauext.data.servo import in_amperes
from tauext.progress import Reporter
from tauext.robot.torque_limits import torque_limits
from tauext.train.preparation import Given, chosen_recordings, wants_constants


def check_data(dataset: Dataset, given: Given, config: TrainConfig, accept: Sequence[str], report: Reporter) -> dict:
    """Check all that a training of the dataset would use; the facts for provenance: what was accepted, warnings.

    Args:
        accept: codes of findings that are accepted, CODE or CODE:joint.

    Raises:
        ConfigError: a code that does not exist, or a joint.
        FaultyDataError: a fault that is not accepted.
    """
    expect_codes(accept, given.training[0].joints)
    given.expect_joints()
    report.say("checking the data")
    results = check_results(dataset, given, config, report)
    return refuse_faults(results, str(dataset.folder), accept, report)


def check_results(dataset: Dataset, given: Given, config: TrainConfig, report: Reporter) -> dict[str, CheckResult]:
    """Findings in the recordings of the training, and in those of the limits.

    Without a model nothing is compared with the robot file: the training does not use it.
    """
    training, validation = chosen_recordings(given.training, given.validation, config)
    # constants that were given may be corrected, by a little: a larger correction is reported
    unknown = wants_constants(config, training, given.case) and (
        bool(config.fit_torque_constants) or in_amperes(training)
    )
    no_torque = in_amperes(training) or bool(config.fit_torque_constants)
    limits_nm = None if given.case.no_model or no_torque else torque_limits(given.robot, training[0].joints)
    model = None if given.case.no_model else given.robot
    results = {"training": check_training([*training, *validation], model, limits_nm, unknown, config.threads, report)}
    if uses_calibration(config) and dataset.split.calibration:
        results["calibration"] = check_calibration(dataset.files("calibration"), limits_nm, config.threads, report)
    return results


def uses_calibration(config: TrainConfig) -> bool:
    """Whether limits are found on calibration recordings where there are some."""
    return config.limits == "promised" or (config.limits == "auto" and not config.row.largest_error_limits)
