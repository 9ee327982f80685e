"""Profiles: named factors on the limits, for phases of a task; read from the cell's file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from tauext._core import Load
from tauext.config import within
from tauext.errors import ConfigError
from tauext.files.typed_table import expect_known, read_table, value_of
from tauext.monitor.loads import Expected, LoadTable, load_of_text

LOWEST, HIGHEST = 0.1, 10.0
"""Bounds of factors in the core."""
OTHERS = "others"
Factors = float | dict[str, float]


@dataclass(frozen=True)
class Bounds:
    """Keys of [profiles] beside the tables of the profiles."""

    lowest: Annotated[float, within(LOWEST, 1)]
    """Bounds of every factor."""
    highest: Annotated[float, within(1, HIGHEST)]
    start: str = ""
    """Profile at the start; "": the first."""


@dataclass(frozen=True)
class ProfileTable:
    """Keys of a profile, [profiles.NAME]: a factor of all joints, or of single ones and `others`."""

    contact: Factors = 1.0
    collision: Factors = 1.0
    load: str | LoadTable | None = None
    expect: Expected | None = None


@dataclass(frozen=True, eq=False)
class Profile:
    """Factors, (joints,) each."""

    name: str
    contact: np.ndarray
    collision: np.ndarray
    load: Load | None = None
    """The load from the switch on; None: unchanged."""
    expect: Expected | None = None
    """The load that the gripper is about to pick up or release; None: none."""


@dataclass(frozen=True)
class Profiles:
    """The profiles of a monitor."""

    by_name: dict[str, Profile]
    start: str

    def named(self, name: str) -> Profile:
        """The profile of this name.

        Raises:
            ConfigError: there is none; the message lists the profiles.
        """
        if name not in self.by_name:
            raise ConfigError(f"profile {name!r} must be one of {', '.join(self.by_name)}")
        return self.by_name[name]


def profiles_of(content: dict[str, Any], where: str, joints: Sequence[str]) -> Profiles:
    """The profiles of the table [profiles], for an arm of these joints; empty: they are not known.

    Raises:
        ConfigError: names the key, the value and the rule that it breaks.
    """
    named = {name: table for name, table in content.items() if isinstance(table, dict)}
    bounds = read_table(Bounds, {key: value for key, value in content.items() if key not in named}, where)
    found = {name: _profile(name, table, f"{where[:-1]}.{name}]", bounds, joints) for name, table in named.items()}
    start = bounds.start or next(iter(found), "")
    if start not in found:
        raise ConfigError(
            f"{where} start = {start!r} must be one of {', '.join(found) or 'the tables [profiles.NAME]'}"
        )
    return Profiles(found, start)


def _profile(name: str, content: Any, where: str, bounds: Bounds, joints: Sequence[str]) -> Profile:
    if name != name.strip() or not name or any(character in name for character in "\r\n"):
        raise ConfigError(f"{where} profile name {name!r} must be a word or words on one line")
    table = read_table(ProfileTable, content, where)
    load = table.load.load if isinstance(table.load, LoadTable) else table.load
    try:
        load = load_of_text(load) if isinstance(load, str) else load
    except ConfigError as error:
        raise ConfigError(f"{where} {error}") from error
    contact, collision = (
        _factors(getattr(table, level), where, level, bounds, joints) for level in ("contact", "collision")
    )
    return Profile(name, contact, collision, load, table.expect)


def _factors(value: Factors, where: str, level: str, bounds: Bounds, joints: Sequence[str]) -> np.ndarray:
    factor = Annotated[float, within(bounds.lowest, bounds.highest)]
    if not isinstance(value, dict):
        return np.full(len(joints), value_of(factor, value, where, level))
    inside = f"{where[:-1]}.{level}]"
    expect_known(inside, value, (*joints, OTHERS) if joints else value)
    given = {joint: value_of(factor, one, inside, joint) for joint, one in value.items()}
    return np.array([given.get(joint, given.get(OTHERS, 1.0)) for joint in joints])
