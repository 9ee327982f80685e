"""The file of a cell: profiles of the limits, reactions, phases of the task, joints of a servo bus."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np

from tauext._core import Bundle, Load, Monitor
from tauext.bundle.estimates import TOUCHES
from tauext.config import NOT_EMPTY, Rule, within
from tauext.errors import ConfigError
from tauext.files.plain_file import read_toml
from tauext.files.typed_table import JointName, OneOrMore, TableName, expect_known, read_table, value_of
from tauext.monitor.loads import Expected, LoadTable, load_of_text
from tauext.monitor.phases import Phase, Phases
from tauext.monitor.sink import EventKind

if TYPE_CHECKING:
    TouchKind = str
else:
    TouchKind = Literal[TOUCHES[1:]]


def is_function(words: str) -> bool:
    """Whether it names a function of a module."""
    module, _, function = words.partition(":")
    return bool(module) and function.isidentifier()


ACTIONS = ("command", "python", "publish", "stop")


@dataclass(frozen=True)
class Reaction:
    """Condition and action: a table [reactions.NAME]."""

    name: TableName
    on: Annotated[OneOrMore[EventKind], NOT_EMPTY]
    joints: Annotated[OneOrMore[JointName], NOT_EMPTY] | None = None
    """Joints; None: all."""
    min_interval_s: Annotated[float, within(0, 86400)] = 0.0
    timeout_s: Annotated[float, within(0.01, 3600)] = 5.0
    command: Annotated[tuple[str, ...], Rule(': ["program", "argument"]', lambda words: any(words[:1]))] = ()
    python: Annotated[str, Rule(': "module:function"', is_function)] = ""
    publish: bool = False
    stop: bool = False
    touch: Annotated[OneOrMore[TouchKind], NOT_EMPTY] | None = None
    """Kinds of touch; None: react at the alarm, else when the kind is known to be one of these."""
    links: Annotated[OneOrMore[JointName], NOT_EMPTY] | None = None
    """Joints that carry the links. None: any; else react when one of them is touched with probability over 0.5."""
    newtons_over: Annotated[float, within(0, 1e4)] | None = None
    """Least force at the most probable place, [N]; None: any."""

    def __post_init__(self) -> None:
        of_touch = [key for key in ("touch", "links", "newtons_over") if getattr(self, key) is not None]
        if of_touch and not {"collision", "contact"} & set(self.on):
            raise ConfigError(
                f"{' and '.join(of_touch)} cannot apply to {', '.join(self.on)}; on needs collision or contact"
            )
        given = [key for key in ACTIONS if getattr(self, key)]
        if len(given) != 1:
            what = f"{' and '.join(given)} are given" if given else "no action is given"
            raise ConfigError(f"{what}; it must be one of {', '.join(ACTIONS)}")


# --- Profiles: named factors on the limits, for phases of a task.


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


# --- The file.


@dataclass(frozen=True)
class Cell:
    """Content of a cell's file; a table that is left out is empty."""

    path: Path = Path("cell.toml")
    profiles: Profiles | None = None
    reactions: tuple[Reaction, ...] = ()
    phases: Phases | None = None
    bus: dict[str, Any] | None = None
    """Content of [bus], which the source of a servo bus reads."""

    def unmonitored(self, bundle: Bundle) -> list[str]:
        """What is not monitored during each phase, in sentences; ConfigError: the bundle refuses a contact."""
        return [] if self.phases is None else self.phases.check(Monitor(bundle))


def load_cell(path: Path, joints: Sequence[str] = ()) -> Cell:
    """Read the file of a cell.

    Args:
        joints: of the arm; empty: they are not known yet, and any name is accepted.

    Raises:
        ConfigError: names the file, the table, the key, the value and the rule that it breaks.
    """
    content = read_toml(path, "docs/running.md has an example")
    expect_known(f"{path}:", content, ("profiles", "reactions", "phases", "bus"))
    hints = {"profiles": dict, "reactions": dict[str, Reaction], "phases": dict[str, Phase], "bus": dict}
    tables = {name: value_of(hints[name], table, f"{path}:", name, joints) for name, table in content.items()}
    profiles, phases = tables.get("profiles"), tables.get("phases")
    return Cell(
        path,
        profiles_of(profiles, f"{path}: [profiles]", joints) if profiles is not None else None,
        tuple(tables.get("reactions", {}).values()),
        Phases(phases) if phases else None,
        tables.get("bus"),
    )
