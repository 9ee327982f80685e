"""Settings that make no sense are refused, and the message names the setting and its rule."""

from __future__ import annotations

import pytest

from tauext.config import DriftConfig, FilterConfig, PriorConfig
from tauext.errors import ConfigError

FILTERS = [
    ({"high_pass_per_s": 0.0}, "high_pass_per_s = 0.0 must be a number > 0"),
    ({"low_pass_per_s": float("nan")}, "low_pass_per_s = nan must be a number > 0"),
    ({"low_pass_per_s": 4.0}, "low_pass_per_s = 4.0 must be > high_pass_per_s = 5"),
]
DRIFT = [
    ({"time_constant_s": 0.5}, "time_constant_s = 0.5 must be a number: 0 "),
    ({"size_share": -1.0}, "size_share = -1.0 must be a number from 0"),
    ({"rate_share_per_s": 0.0}, "rate_share_per_s = 0.0 must be a number > 0, at most 1"),
    ({"freeze_share": 0.0}, "freeze_share = 0.0 must be a number > 0, at most 1"),
    ({"freeze_s": float("nan")}, "freeze_s = nan must be a number from 0 to 60"),
    ({"friction_share": 10.0}, "friction_share = 10.0 must be a number from 0 to 9"),
]
PRIOR = [
    ({"widths_rad": (1e-3, 1e-3)}, "widths_rad = .* must be a list, each a number, at most 8, rising"),
    ({"widths_rad": (0.0, 1e-3)}, "widths_rad"),
    ({"widths_rad": tuple(range(1, 10))}, "widths_rad"),
    ({"coulomb_speeds_rad_s": (0.1, 0.05)}, "coulomb_speeds_rad_s = .* rising"),
    ({"coulomb_speeds_rad_s": ()}, "coulomb_speeds_rad_s = .* must be a list, .*, not empty"),
    ({"region_width_rad": 0.0}, "region_width_rad = 0.0 must be a number > 0"),
    ({"most_ripples": -1}, "most_ripples = -1 must be a whole number from 0 to 10"),
    ({"most_ripples": 11}, "most_ripples = 11 must be a whole number from 0 to 10"),
    ({"widths_rad": (1e-3, float("nan"))}, "widths_rad"),
    ({"widths_rad": (1e-3, float("inf"))}, "widths_rad"),
    ({"region_width_rad": float("nan")}, "region_width_rad"),
]
KINDS = [(FilterConfig, FILTERS), (DriftConfig, DRIFT), (PriorConfig, PRIOR)]


@pytest.mark.parametrize("config, changes, message", [(config, *case) for config, cases in KINDS for case in cases])
def test_settings_that_make_no_sense_are_refused(config, changes, message):
    with pytest.raises(ConfigError, match=message):
        config(**changes)
