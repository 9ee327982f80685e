"""Converts a leader's positions from LeRobot's units to radians."""

from __future__ import annotations

import math
from typing import Any

from tauext.errors import ConfigError

UNITS = {"deg": math.pi / 180, "rad": 1.0}


def radians_a_unit(leader: Any, joints: tuple[str, ...], unit: str) -> dict[str, float]:
    """Radians per unit of `<joint>.pos`.

    LeRobot's buses report degrees, or shares of a calibrated range from -100 or 0 to 100.

    Args:
        unit: unit of a leader without such a bus, "deg" or "rad".

    Raises:
        ConfigError: a range is not calibrated, or the unit is invalid.
    """
    bus = getattr(leader, "bus", None)
    motors = getattr(bus, "motors", {})
    if unit not in UNITS:
        raise ConfigError(f"position_unit = {unit!r} must be one of {', '.join(UNITS)}")
    return {joint: _of_motor(bus, joint) if joint in motors else UNITS[unit] for joint in joints}


def _of_motor(bus: Any, joint: str) -> float:
    mode = getattr(bus.motors[joint].norm_mode, "value", bus.motors[joint].norm_mode)
    if mode == "degrees":
        return math.pi / 180
    if joint not in bus.calibration:
        raise ConfigError(f"joint '{joint}' reports its position as a share of a range that is not calibrated")
    spans = {"range_m100_100": 200, "range_0_100": 100}
    if mode not in spans:
        raise ConfigError(f"joint '{joint}' reports its position as {mode}, not one of degrees, {', '.join(spans)}")
    calibration, resolution = bus.calibration[joint], bus.model_resolution_table[bus.motors[joint].model]
    return (calibration.range_max - calibration.range_min) / spans[mode] * 2 * math.pi / resolution
