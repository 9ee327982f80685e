"""Recordings as a training takes them: as many minutes as it shall, torque in N m."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from tauext.config import ModelCase, TrainConfig
from tauext.errors import ConfigError

if TYPE_CHECKING:
    from tauext.data import Recording


def chosen_recordings(
    training: list[Recording], validation: list[Recording], config: TrainConfig
) -> tuple[list[Recording], list[Recording]]:
    """What config.minutes leaves of them: of validation at least a minute, or a window where that is longer.

    Raises:
        ConfigError: there are not so many minutes.
    """
    from tauext.data import first_seconds, total_s

    if config.minutes is None:
        return training, validation
    wanted_s, there_s = 60 * config.minutes, total_s(training)
    if wanted_s > there_s + 1e-6:
        most = int(there_s / 0.6) / 100
        raise ConfigError(
            f"minutes = {config.minutes:g} must be at most {most:g}: the training recordings hold no more"
        )
    window_s = config.warm_up_s + config.observer.window_s
    if not validation:
        return first_seconds(training, wanted_s), []
    return first_seconds(training, wanted_s), first_seconds(validation, max(wanted_s / 5, 60.0, window_s))


def scaled(load: Callable[[], Recording], nm_per_unit: Sequence[float]) -> Recording:
    """A loaded recording with its torque in N m."""
    from tauext.data import scaled_torque

    return scaled_torque(load(), nm_per_unit)


def wants_constants(config: TrainConfig, training: list[Recording], case: ModelCase) -> bool:
    """Whether torque constants are to be fitted or, where they were given, corrected; unless said, where the recordings
    were currents and a model or half a minute of motion tells them."""
    from tauext.data import from_amperes, in_amperes, total_s

    if config.fit_torque_constants is not None:
        return config.fit_torque_constants
    if not case.no_model:
        return in_amperes(training) or from_amperes(training)
    arm_serves = config.recipe in ("prior", "tauext")  # others take each joint by itself, in whatever unit
    return total_s(training) >= 30 and (in_amperes(training) or (from_amperes(training) and arm_serves))
