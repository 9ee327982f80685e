"""reactions.toml: actions at a collision, a contact, a fault, and when all is clear again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tauext.bundle.estimates import TOUCHES
from tauext.errors import ConfigError
from tauext.files.toml_file import Key, flag, names, number, read_table, read_toml, tables, text
from tauext.monitor.sink import EVENT_KINDS, EventKind


@dataclass(frozen=True)
class Reaction:
    """One entry of the file: condition and action."""

    name: str
    on: tuple[EventKind, ...]
    joints: tuple[str, ...] | None = None
    """Joints; None: all."""
    min_interval_s: float = 0.0
    timeout_s: float = 5.0
    command: tuple[str, ...] = ()
    python: str = ""
    publish: bool = False
    stop: bool = False
    touch: tuple[str, ...] | None = None
    """Kinds of touch; None: react at the alarm, else when the kind is known to be one of these."""
    links: tuple[str, ...] | None = None
    """Joints that carry the links. None: any; else react when one of them is touched with probability over 0.5."""
    newtons_over: float | None = None
    """Least force at the most probable place, [N]; None: any."""


ACTIONS = ("command", "python", "publish", "stop")


def load_reactions(path: Path, joints: Sequence[str] | None) -> list[Reaction]:
    """Read a reactions.toml for an arm of these joints; None: they are not known yet, and any name is accepted.

    Raises:
        ConfigError: names the file, the key, the value and the rule that it breaks.
    """
    content = read_toml(path, "docs/running.md has an example")
    keys = {
        "name": text("text, not empty"),
        "on": names(EVENT_KINDS, "events"),
        "joints": _joints(joints, "joints"),
        "min_interval_s": number(0.0, 86400.0, 0.0),
        "timeout_s": number(0.01, 3600.0, 5.0),
        "command": Key(_command, 'a list of texts: ["program", "argument"]', ()),
        "python": Key(_function, '"module:function"', ""),
        "publish": flag(False),
        "stop": flag(False),
        "touch": names(TOUCHES[1:], "kinds of touch", None),
        "links": _joints(joints, "joints that carry the links"),
        "newtons_over": number(0.0, 1e4, None),
    }
    found: list[Reaction] = []
    for table in read_table(path, "", content, {"reaction": tables("[[reaction]]")})["reaction"]:
        found.append(_reaction(path, table, keys))
        if found[-1].name in [other.name for other in found[:-1]]:
            raise ConfigError(f"{path}: [[reaction]] name = {found[-1].name!r} is given twice; names must differ")
    return found


def _reaction(path: Path, table: Any, keys: dict[str, Key]) -> Reaction:
    named = isinstance(table, dict) and isinstance(table.get("name"), str)
    where = f"[[reaction]] {table['name']!r}:" if named else "[[reaction]]"
    reaction = Reaction(**read_table(path, where, table, keys))
    here = f"{path}: {where}"
    of_touch = [key for key in ("touch", "links", "newtons_over") if getattr(reaction, key) is not None]
    if of_touch and not {"collision", "contact"} & set(reaction.on):
        raise ConfigError(
            f"{here} {' and '.join(of_touch)} cannot apply to {', '.join(reaction.on)}; on needs collision or contact"
        )
    given = [key for key in ACTIONS if table.get(key) not in (None, False)]
    if len(given) != 1:
        what = f"{' and '.join(given)} are given" if given else "no action is given"
        raise ConfigError(f"{here} {what}; it must be one of {', '.join(ACTIONS)}")
    return reaction


def _joints(known: Sequence[str] | None, what: str) -> Key:
    return Key(_some_names, f"a list of {what}", None) if known is None else names(known, what, None)


def _some_names(value: Any) -> tuple[str, ...]:
    """One name, or a list of them."""
    return _command([value] if isinstance(value, str) else value)


def _command(value: Any) -> tuple[str, ...]:
    if not isinstance(value, list) or not value or any(not isinstance(word, str) for word in value) or not value[0]:
        raise TypeError
    return tuple(value)


def _function(value: Any) -> str:
    module, _, function = value.partition(":") if isinstance(value, str) else ("", "", "")
    if not module or not function.isidentifier():
        raise ValueError
    return value
