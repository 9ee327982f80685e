"""The torque constants of a UR source: a file that breaks a rule is refused, and the message names the rule."""

from __future__ import annotations

import pytest

from tauext.errors import ConfigError
from tauext.sources.ur import load_torque_constants

BROKEN = [
    ("", "nm_per_ampere is missing"),
    ("[nm_per_ampere]\nbase = 0\n", "base = 0 must be a number .*, not 0"),
    ("[nm_per_ampere]\nbase = 'x'\n", "base = 'x' must be a number"),
    ("[nm_per_ampere]\nbasis = 1\n", ".nm_per_ampere. unknown key 'basis'; the nearest known is 'base'"),
    ("[nm_per_amp]\n", "unknown key 'nm_per_amp'"),
]


@pytest.mark.parametrize("text, message", BROKEN)
def test_a_file_that_breaks_a_rule_is_refused_by_the_rule(tmp_path, text, message):
    path = tmp_path / "constants.toml"
    with pytest.raises(ConfigError, match="there is no such file$"):
        load_torque_constants(path, ("base",))
    path.write_text(text)
    with pytest.raises(ConfigError, match=message):
        load_torque_constants(path, ("base",))
