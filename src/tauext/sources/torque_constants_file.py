"""Torque constants of an arm that reports motor currents, from a file."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tauext.data.description_file import refuse_unknown
from tauext.errors import ConfigError
from tauext.files.place import Place
from tauext.files.toml_file import number, read_toml

LARGEST = 1e6


def load_torque_constants(path: Place, joints: Sequence[str]) -> np.ndarray:
    """Joint torque a unit of current, after the gear, (joints,) [N m/A], from a TOML file of one table:

        [nm_per_ampere]
        shoulder_pan_joint = 12.2

    A negative constant says that the current's sign is the other way round.

    Raises:
        ConfigError: names the file, the joint and the rule that is broken.
    """
    content = read_toml(path)
    refuse_unknown(path, "", content, ("nm_per_ampere",))
    table = content.get("nm_per_ampere", {})
    refuse_unknown(path, "nm_per_ampere", table, tuple(joints))
    constants = []
    for joint in joints:
        where = f"{path}: [nm_per_ampere] {joint}"
        if joint not in table:
            raise ConfigError(f"{where} is missing")
        constants.append(number(where, table[joint], -LARGEST, LARGEST))
        if constants[-1] == 0:
            raise ConfigError(f"{where} = 0 must not be 0")
    return np.array(constants)
