"""Profiles: named factors on the limits, for phases of a task; read from profiles.toml."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tauext._core import Load
from tauext.data.description_file import refuse_unknown
from tauext.errors import ConfigError
from tauext.files.places import Place
from tauext.files.toml_file import number, read_toml
from tauext.monitor.loads import EXPECTED_KEYS, Expected, expected_of_table, load_of_table, load_of_text
from tauext.monitor.loads import KEYS as LOAD_KEYS

LEVELS = ("contact", "collision")
LOWEST, HIGHEST = 0.1, 10.0
"""The core takes no factor beyond."""
OTHERS = "others"

TEMPLATE = """\
# Factors on a bundle's limits, for phases of a task. Above 1 it takes more to raise an alarm, below 1 less.
# The false alarms that limits were calibrated for hold at factors from 1 on.

[bounds]                    # no profile may leave them; 0.1 to 10 at most
lowest = 0.5
highest = 3.0

[start]
profile = "normal"          # which one holds at first

[profiles.normal]
contact = 1.0               # one factor for every joint ...
collision = 1.0

[profiles.pressing]
contact = 3.0
collision = { others = 1.5 }    # ... or one a joint, by its name; `others` stands for those not named, else 1

# [profiles.carrying]
# load = { mass = 2.8, com = [0.0, 0.0, 0.05] }   # kg, m: what the arm carries from then on, or "none"; a profile
#                                                 # without load leaves it as it is

# [profiles.grasping]
# expect = { seconds = 3, at_most = 2.5 }         # the gripper closes: a load of at most 2.5 kg is no collision
"""


@dataclass(frozen=True, eq=False)
class Profile:
    """Factors, (joints,) each."""

    name: str
    contact: np.ndarray
    collision: np.ndarray
    load: Load | None = None
    """That the arm carries from then on; None: it stays as it is."""
    expect: Expected | None = None
    """What the gripper is about to do; None: nothing."""


@dataclass(frozen=True)
class Profiles:
    """All that a monitor may be switched to."""

    by_name: dict[str, Profile]
    start: str

    def named(self, name: str) -> Profile:
        """The profile of this name.

        Raises:
            ConfigError: there is none; says which there are.
        """
        if name not in self.by_name:
            raise ConfigError(f"profile {name!r} must be one of {', '.join(self.by_name)}")
        return self.by_name[name]


def load_profiles(path: Place, joints: Sequence[str]) -> Profiles:
    """Read a profiles.toml for an arm of these joints.

    Raises:
        ConfigError: names the file, the key, the value and the rule that it breaks.
    """
    content = read_toml(path, "--new-profiles")
    refuse_unknown(path, "", content, ("bounds", "start", "profiles"))
    bounds = content.get("bounds")
    if bounds is None:
        raise ConfigError(f"{path}: the table [bounds] is missing; it holds lowest and highest, within 0.1 to 10")
    refuse_unknown(path, "bounds", bounds, ("lowest", "highest"))
    for key in ("lowest", "highest"):
        if key not in bounds:
            raise ConfigError(f"{path}: [bounds] {key} is missing")
    lowest = number(f"{path}: [bounds] lowest", bounds["lowest"], LOWEST, 1.0)
    highest = number(f"{path}: [bounds] highest", bounds["highest"], 1.0, HIGHEST)
    tables = content.get("profiles", {})
    if not isinstance(tables, dict) or not tables:
        raise ConfigError(f"{path}: there are no profiles: a table [profiles.NAME] for each is missing")
    found = {}
    for name, table in tables.items():
        where = f"profiles.{name}"
        refuse_unknown(path, where, table, (*LEVELS, "load", "expect"))
        if name != name.strip() or not name or any(character in name for character in "\r\n"):
            raise ConfigError(f"{path}: profile name {name!r} must be a word or words on one line")
        factors = {
            level: _factors(f"{path}: [{where}] {level}", table.get(level, 1.0), joints, lowest, highest)
            for level in LEVELS
        }
        load = _load(path, where, table["load"]) if "load" in table else None
        expect = _expected(path, where, table["expect"]) if "expect" in table else None
        found[name] = Profile(name, factors["contact"], factors["collision"], load, expect)
    start = content.get("start", {})
    refuse_unknown(path, "start", start, ("profile",))
    first = start.get("profile", next(iter(found)))
    if not isinstance(first, str) or first not in found:
        raise ConfigError(f"{path}: [start] profile = {first!r} must be one of {', '.join(found)}")
    return Profiles(found, first)


def _load(path: Place, where: str, value: Any) -> Load:
    if isinstance(value, str):
        try:
            return load_of_text(value)
        except ConfigError as error:
            raise ConfigError(f"{path}: [{where}] {error}") from error
    refuse_unknown(path, f"{where}.load", value, LOAD_KEYS)
    return load_of_table(f"{path}: [{where}] load", value)


def _expected(path: Place, where: str, value: Any) -> Expected:
    refuse_unknown(path, f"{where}.expect", value, EXPECTED_KEYS)
    return expected_of_table(f"{path}: [{where}] expect", value)


def _factors(where: str, value: Any, joints: Sequence[str], lowest: float, highest: float) -> np.ndarray:
    if not isinstance(value, dict):
        return np.full(len(joints), number(where, value, lowest, highest))
    for key in value:
        if key not in (*joints, OTHERS):
            raise ConfigError(f"{where} names {key!r}, which is no joint; they are {', '.join(joints)}, and {OTHERS}")
    rest = value.get(OTHERS, 1.0)
    return np.array([number(f"{where}.{joint}", value.get(joint, rest), lowest, highest) for joint in joints])
