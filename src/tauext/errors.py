"""The errors that tauext raises for bad input: what, the value, the rule, the choices, in one message.

The C++ core's own error, `tauext._core.CoreError`, is a TauextError too.
"""

from __future__ import annotations

from collections.abc import Sequence


class TauextError(Exception):
    """Base of every error that a user can cause; the command line prints its message and exits with 2."""


class RobotError(TauextError):
    """A robot file, joint choice or model perturbation that cannot be used."""


class RecordingError(TauextError):
    """A recording that is damaged, incomplete or breaks the format's rules."""


class ConfigError(TauextError):
    """An invalid setting, path or combination of settings."""


class AwayError(ConfigError):
    """An arm that does not answer, or sends nothing usable yet: the same call may succeed later."""


class BundleError(TauextError):
    """A bundle that is damaged, of a newer version, or does not fit the recording it is used on."""


class TrainingError(TauextError):
    """Training that cannot succeed: constant target, diverging loss, too little data."""


class TooLittleMotionError(TrainingError):
    """Recordings contain too little motion that can be trusted."""


class FaultyDataError(TauextError):
    """Faults of recordings or robot file that were not accepted; the message lists them, a few lines each."""

    def __init__(self, message: str, findings: Sequence[object] = ()) -> None:
        super().__init__(message)
        self.findings = list(findings)
        """Each a `tauext.check.finding.Finding`."""
