"""Limits, and the claims they support."""

from tauext.calibrate.limits import Limits, paper_limits, set_limits
from tauext.calibrate.promise import FalseAlarmBudget, Promise, is_consistent, rate_interval
from tauext.calibrate.promised_limits import PromisedLimits, apply_promised, promised_limits

__all__ = [
    "FalseAlarmBudget",
    "Limits",
    "Promise",
    "PromisedLimits",
    "apply_promised",
    "is_consistent",
    "paper_limits",
    "promised_limits",
    "rate_interval",
    "set_limits",
]
