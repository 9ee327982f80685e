"""Settings from a table of TOML: every key a field of the dataclass, every value of its type, or one clear message."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from tauext.errors import ConfigError

Settings = TypeVar("Settings")
PLAIN = {bool: "true or false", int: "a whole number", float: "a number", str: "text"}


def settings_of(kind: type[Settings], content: Any, where: str, left_out: Mapping[str, str] | None = None) -> Settings:
    """The dataclass with these values, and defaults for the others.

    Args:
        content: a table as TOML has it; a table within stands for a dataclass within.
        where: for messages, as `fleet.toml: [train]`.
        left_out: fields that are not to be set here, and why.

    Raises:
        ConfigError: an unknown key (the nearest is named), a value of another type or against the rule of its field.
    """
    if not isinstance(content, dict):
        raise ConfigError(f"{where} = {content!r} must be a table")
    hints = get_type_hints(kind)
    refused = left_out or {}
    for key in content:
        if key in refused:
            raise ConfigError(f"{where}: {key} is not set here: {refused[key]}")
        if key not in hints:
            raise unknown_key(where, key, [name for name in hints if name not in refused])
    values = {}
    for key, value in content.items():
        hint = hints[key]
        if isinstance(hint, type) and is_dataclass(hint):
            values[key] = settings_of(hint, value, f"{where} {key}")
            continue
        try:
            values[key] = converted(value, hint)
        except TypeError:
            raise ConfigError(f"{where}: {key} = {value!r} must be {described(hint)}") from None
    try:
        return kind(**values)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None


def unknown_key(where: str, key: str, known: Iterable[str]) -> ConfigError:
    """What is said of a key that nobody knows."""
    names = list(known)
    near = difflib.get_close_matches(key, names, 1, 0.0)
    nearest = f"the nearest known is '{near[0]}'" if near else "none is known"
    return ConfigError(f"{where}: unknown key '{key}'; {nearest}; known are {', '.join(names)}")


def converted(value: Any, hint: Any) -> Any:
    """The value as the field has it: whole numbers become floats, lists tuples.

    Raises:
        TypeError: it is of another type.
    """
    origin = get_origin(hint)
    if origin in (Union, UnionType):
        for choice in get_args(hint):
            try:
                return converted(value, choice)
            except TypeError:
                continue
        raise TypeError
    if origin is Literal:
        if value in get_args(hint) and not isinstance(value, bool):
            return value
        raise TypeError
    if origin is tuple:
        if not isinstance(value, list | tuple):
            raise TypeError
        return tuple(converted(one, get_args(hint)[0]) for one in value)
    if hint is float and isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
        return float(value)
    if hint is int and isinstance(value, int) and not isinstance(value, bool):
        return value
    if hint in (bool, str) and isinstance(value, hint):
        return value
    raise TypeError


def described(hint: Any) -> str:
    """The type of a field for a message."""
    origin = get_origin(hint)
    if origin in (Union, UnionType):
        return " or ".join(described(choice) for choice in get_args(hint) if choice is not NoneType)
    if origin is Literal:
        return f"one of {', '.join(map(str, get_args(hint)))}"
    if origin is tuple:
        return f"a list ({described(get_args(hint)[0])} each)"
    return PLAIN.get(hint, str(hint))


def plain(settings: Any) -> dict[str, Any]:
    """The settings as a table that settings_of reads: without what is None, as TOML knows no such value."""
    found: dict[str, Any] = {}
    for one in fields(settings):
        value = getattr(settings, one.name)
        if is_dataclass(value):
            found[one.name] = plain(value)
        elif value is not None:
            found[one.name] = list(value) if isinstance(value, tuple) else value
    return found


def flat(table: Mapping[str, Any], before: str) -> dict[str, str]:
    """Values as words by dotted names: {"train.alarm.in_hours": "8.0"}."""
    found: dict[str, str] = {}
    for key, value in table.items():
        if isinstance(value, dict):
            found |= flat(value, f"{before}{key}.")
        else:
            found[f"{before}{key}"] = repr(value)
    return found
