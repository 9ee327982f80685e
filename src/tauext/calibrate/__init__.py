"""Limits, and the claims they support."""

from tauext.calibrate.limits import Limits, paper_limits, set_limits

__all__ = ["Limits", "paper_limits", "set_limits"]
