"""Recordings as a training takes them: as many minutes as it shall, and what their tau is."""

from __future__ import annotations

from collections.abc import Sequence

from tauext._core import TorqueUnit
from tauext.config import ModelCase, TrainConfig
from tauext.data.amperes import from_amperes, in_amperes
from tauext.data.first_seconds import first_seconds, total_s
from tauext.data.recording import Recording
from tauext.errors import ConfigError

LEAST_S = 30.0
"""Of motion, before an arm is looked for in it to tell torque constants, [s]."""


def chosen_recordings(
    training: Sequence[Recording], validation: Sequence[Recording], config: TrainConfig
) -> tuple[Sequence[Recording], Sequence[Recording]]:
    """What config.minutes leaves of them: of validation at least a minute, or a window where that is longer.

    Raises:
        ConfigError: there are not so many minutes.
    """
    if config.minutes is None:
        return training, validation
    wanted_s, there_s = 60 * config.minutes, total_s(training)
    if wanted_s > there_s + 1e-6:
        most = int(there_s / 0.6) / 100
        raise ConfigError(
            f"minutes = {config.minutes:g} must be at most {most:g}: the training recordings hold no more"
        )
    window_s = config.warm_up_s + config.observer.window_s
    chosen = first_seconds(training, wanted_s)
    if not chosen:
        raise ConfigError(f"minutes = {config.minutes:g} must be longer than one sample of the recordings")
    if not validation:
        return chosen, []
    return chosen, first_seconds(validation, max(wanted_s / 5, 60.0, window_s))


def given_unit(config: TrainConfig, training: Sequence[Recording]) -> TorqueUnit:
    """What a number of the recordings' tau stands for: that is what the bundle takes."""
    if in_amperes(training):
        return TorqueUnit.ampere
    # Who asks for constants of what was no current says that it is no torque either.
    asked = config.fit_torque_constants and not from_amperes(training)
    return TorqueUnit.recorded if asked else TorqueUnit.newton_metre


def wants_constants(config: TrainConfig, training: Sequence[Recording], case: ModelCase) -> bool:
    """Whether torque constants are to be fitted or, where they were given, corrected; unless said, where the recordings
    were currents and a model or half a minute of motion tells them."""
    if config.fit_torque_constants is not None:
        return config.fit_torque_constants
    if not case.no_model:
        return in_amperes(training) or from_amperes(training)
    told = in_amperes(training) or (from_amperes(training) and config.row.finds_arm)
    return total_s(training) >= LEAST_S and told
