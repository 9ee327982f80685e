"""A bundle's friction brought up to date by a minute of the arm's ordinary motion."""

from tauext.refit.report import JointReport, Refitted
from tauext.refit.stage import Span, refit_bundle, refit_motion, refit_recordings

__all__ = ["JointReport", "Refitted", "Span", "refit_bundle", "refit_motion", "refit_recordings"]
