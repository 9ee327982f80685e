"""Limits, and the claims they support."""

from tauext.calibrate.bundle_limits import NO_CALIBRATION, calibrate_bundle, forget_half_done, recalibrate
from tauext.calibrate.error_scale import (
    LeftOutErrors,
    Rows,
    add_friction,
    collect_rows,
    fit_error_scale,
    freeze_floor_nm,
    left_out_errors,
    put_constant_error,
)
from tauext.calibrate.judged import Judged, whole_recordings
from tauext.calibrate.limits import (
    LevelLimits,
    at_rest_sentence,
    paper_limits,
    raise_limits,
    set_limits,
    usual_speed_rad_s,
)
from tauext.calibrate.moments import Moment
from tauext.calibrate.other_motion import NOT_MEASURED, OtherMotion, other_motion
from tauext.calibrate.promise import FalseAlarmBudget, Promise, is_consistent, rate_interval
from tauext.calibrate.promised_limits import PromisedLimits, apply_promised, promised_limits
from tauext.calibrate.wrench import fit_wrench

__all__ = [
    "NOT_MEASURED",
    "NO_CALIBRATION",
    "FalseAlarmBudget",
    "Judged",
    "LeftOutErrors",
    "LevelLimits",
    "Moment",
    "OtherMotion",
    "Promise",
    "PromisedLimits",
    "Rows",
    "add_friction",
    "apply_promised",
    "at_rest_sentence",
    "calibrate_bundle",
    "collect_rows",
    "forget_half_done",
    "fit_error_scale",
    "put_constant_error",
    "fit_wrench",
    "freeze_floor_nm",
    "is_consistent",
    "left_out_errors",
    "other_motion",
    "paper_limits",
    "promised_limits",
    "raise_limits",
    "rate_interval",
    "recalibrate",
    "set_limits",
    "usual_speed_rad_s",
    "whole_recordings",
]
