"""Data check before training: faults in a dataset's recordings stop it."""

from __future__ import annotations

from collections.abc import Sequence

from tauext.check.before_training import check_calibration, check_training, expect_codes, refuse_faults
from tauext.check.finding import Finding
from tauext.config import TrainConfig
from tauext.data.dataset import Dataset
from tauext.data.servo import in_amperes
from tauext.progress import Reporter
from tauext.robot.torque_limits import torque_limits
from tauext.train.limits import limits_kind
from tauext.train.preparation import TrainingInput, chosen_recordings, wants_constants


def check_data(
    dataset: Dataset, given: TrainingInput, config: TrainConfig, accept: Sequence[str], report: Reporter
) -> dict:
    """Check all data of a training; returns accepted faults and warnings as facts for provenance.

    Args:
        accept: codes of findings that are accepted, CODE or CODE:joint.

    Raises:
        ConfigError: an unknown code or joint.
        FaultyDataError: a fault is not accepted.
    """
    expect_codes(accept, given.training[0].joints)
    given.expect_joints()
    report.say("checking the data")
    results = check_results(dataset, given, config, report)
    return refuse_faults(results, str(dataset.folder), accept, report)


def check_results(
    dataset: Dataset, given: TrainingInput, config: TrainConfig, report: Reporter
) -> dict[str, list[Finding]]:
    """Findings in the recordings for training and for limits.

    Without a model nothing is compared with the robot file: the training does not use it.
    """
    training, validation = chosen_recordings(given.training, given.validation, config)
    # given constants may be corrected slightly; larger corrections are reported
    unknown = wants_constants(config, training, given.case) and (
        bool(config.fit_torque_constants) or in_amperes(training)
    )
    no_torque = in_amperes(training) or bool(config.fit_torque_constants)
    limits_nm = None if given.case.no_model or no_torque else torque_limits(given.robot, training[0].joints)
    model = None if given.case.no_model else given.robot
    results = {"training": check_training([*training, *validation], model, limits_nm, unknown, config.threads, report)}
    if dataset.split.calibration and limits_kind(config, dataset.split.calibration) in ("asked", "promised"):
        results["calibration"] = check_calibration(dataset.files("calibration"), limits_nm, config.threads, report)
    return results
