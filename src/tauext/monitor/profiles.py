"""Profiles: named factors on the limits, for phases of a task; read from profiles.toml."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tauext._core import Load
from tauext.errors import ConfigError
from tauext.files.toml_file import Key, number, one_of, read_table, read_toml, refuse_unknown, tables
from tauext.monitor.loads import Expected, expected_of_table, load_of_table, load_of_text

LEVELS = ("contact", "collision")
LOWEST, HIGHEST = 0.1, 10.0
"""Bounds of factors in the core."""
OTHERS = "others"
FILE_KEYS = {"bounds": tables("[bounds]"), "start": tables("[start]", {}), "profiles": tables("[profiles.NAME]")}
BOUND_KEYS = {"lowest": number(LOWEST, 1.0), "highest": number(1.0, HIGHEST)}


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


def load_profiles(path: Path, joints: Sequence[str]) -> Profiles:
    """Read a profiles.toml for an arm of these joints.

    Raises:
        ConfigError: names the file, the key, the value and the rule that it breaks.
    """
    content = read_toml(path, "docs/running.md has an example")
    top = read_table(path, "", content, FILE_KEYS)
    bounds = read_table(path, "[bounds]", top["bounds"], BOUND_KEYS)
    factor = number(bounds["lowest"], bounds["highest"])
    found = {}
    for name, table in top["profiles"].items():
        where = f"profiles.{name}"
        refuse_unknown(path, f"[{where}]", table, (*LEVELS, "load", "expect"))
        if name != name.strip() or not name or any(character in name for character in "\r\n"):
            raise ConfigError(f"{path}: profile name {name!r} must be a word or words on one line")
        contact, collision = (_factors(path, where, table, level, joints, factor) for level in LEVELS)
        load = _load(path, where, table["load"]) if "load" in table else None
        expect = expected_of_table(path, f"[{where}.expect]", table["expect"]) if "expect" in table else None
        found[name] = Profile(name, contact, collision, load, expect)
    start = read_table(path, "[start]", top["start"], {"profile": one_of(tuple(found), next(iter(found)))})
    return Profiles(found, start["profile"])


def _load(path: Path, where: str, value: Any) -> Load:
    if isinstance(value, str):
        try:
            return load_of_text(value)
        except ConfigError as error:
            raise ConfigError(f"{path}: [{where}] {error}") from error
    return load_of_table(path, f"[{where}.load]", value)


def _factors(path: Path, where: str, table: Any, level: str, joints: Sequence[str], factor: Key) -> np.ndarray:
    value = table.get(level, 1.0)
    if not isinstance(value, dict):
        return np.full(len(joints), read_table(path, f"[{where}]", {level: value}, {level: factor})[level])
    keys = dict.fromkeys(joints, factor._replace(default=None)) | {OTHERS: factor._replace(default=1.0)}
    found = read_table(path, f"[{where}.{level}]", value, keys)
    return np.array([found[OTHERS] if found[joint] is None else found[joint] for joint in joints])
