"""Reads TOML files whose keys are declared; an unknown key or a wrong value is reported in one line."""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from tauext.errors import ConfigError
from tauext.files.places import Place
from tauext.files.plain_file import read_text, toml_of
from tauext.files.whole_file import whole_file

REQUIRED = object()


class Key(NamedTuple):
    """A key of a table."""

    read: Callable[[Any], Any]
    """Converts the value; TypeError or ValueError where it breaks the rule."""
    rule: str
    """Follows "must be" in messages."""
    default: Any = REQUIRED

    def where(self, holds: Callable[[Any], bool], rule: str) -> Key:
        """The key with a narrower rule."""

        def read(value: Any) -> Any:
            if not holds(found := self.read(value)):
                raise ValueError
            return found

        return Key(read, rule, self.default)


def number(lowest: float = -math.inf, highest: float = math.inf, default: Any = REQUIRED, whole: bool = False) -> Key:
    """A finite number within the bounds."""

    def read(value: Any) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise TypeError
        if not lowest <= value <= highest or (whole and value != round(value)):
            raise ValueError
        return round(value) if whole else float(value)

    bounds = f" from {lowest:g} to {highest:g}" if math.isfinite(lowest) else ""
    return Key(read, f"a {'whole ' * whole}number{bounds}", default)


def numbers(counts: Sequence[int], of: Key, rule: str = "", default: Any = REQUIRED) -> Key:
    """A list of so many numbers, each as `of`."""

    def read(value: Any) -> tuple[float, ...]:
        if not isinstance(value, list) or len(value) not in counts:
            raise ValueError
        return tuple(map(of.read, value))

    return Key(read, rule or f"a list of {' or '.join(map(str, counts))} numbers", default)


def text(rule: str = "text", default: Any = REQUIRED, empty: bool = False) -> Key:
    """Text, not empty unless so declared."""

    def read(value: Any) -> str:
        if not isinstance(value, str) or not (value.strip() or empty):
            raise TypeError
        return value

    return Key(read, rule, default)


def one_of(choices: Sequence[Any], default: Any = REQUIRED, rule: str = "") -> Key:
    """One of these values, and of the same type: 1 is not true."""

    def read(value: Any) -> Any:
        if not any(value == choice and isinstance(value, bool) == isinstance(choice, bool) for choice in choices):
            raise ValueError
        return value

    return Key(read, rule or f"one of {', '.join(map(str, choices))}", default)


def flag(default: Any = REQUIRED) -> Key:
    """True or false."""
    return one_of((True, False), default, "true or false")


def names(known: Sequence[str], what: str, default: Any = REQUIRED) -> Key:
    """One of the known names, or a list of them."""

    def read(value: Any) -> tuple[str, ...]:
        listed = [value] if isinstance(value, str) else value
        if not isinstance(listed, list) or not listed or any(one not in known for one in listed):
            raise ValueError
        return tuple(listed)

    return Key(read, f"a list of {what}: {', '.join(known)}", default)


def tables(each: str, default: Any = REQUIRED) -> Key:
    """A table `[key]`, tables `[key.NAME]` or `[[key]]`; not empty unless there is a default."""
    kind = list if each.startswith("[[") else dict

    def read(value: Any) -> Any:
        if not isinstance(value, kind) or not (value or default is not REQUIRED):
            raise TypeError
        return value

    many = f"{'one or more ' * (default is REQUIRED)}tables"
    return Key(read, f"{many if 'NAME' in each or kind is list else 'a table'} {each}", default)


def read_table(path: Place | str, table: str, content: Any, keys: Mapping[str, Key]) -> dict[str, Any]:
    """The values of all keys, defaults for those left out.

    Args:
        path: of the file, for messages.
        table: as messages name it: `[bounds]`; "": the file's top.

    Raises:
        ConfigError: the content is no table, a key is unknown or missing, or a value breaks its rule.
    """
    refuse_unknown(path, table, content, keys)
    where = f"{path}: {table}{' ' * bool(table)}"
    values = {}
    for key, (read, rule, default) in keys.items():
        if key not in content:
            if default is REQUIRED:
                raise ConfigError(f"{where}{key} is missing; it must be {rule}")
            values[key] = default
            continue
        try:
            values[key] = read(content[key])
        except (TypeError, ValueError) as error:
            raise ConfigError(f"{where}{key} = {content[key]!r} must be {rule}") from error
    return values


def refuse_unknown(path: Place | str, table: str, content: Any, known: Iterable[str]) -> None:
    """ConfigError unless the content is a table and all of its keys are known."""
    if not isinstance(content, dict):
        raise ConfigError(f"{path}: {table} is {content!r}, must be a table")
    listed = tuple(known)
    for key in content:
        if key not in listed:
            near = difflib.get_close_matches(key, listed, 1, 0.0)
            nearest = f"the nearest known is '{near[0]}'" if near else "none is known"
            where = f"in {table}" if table else "at the top"
            raise ConfigError(f"{path}: unknown key '{key}' {where}; {nearest}; known are {', '.join(listed)}")


def read_toml(path: Place, advice: str = "") -> dict[str, Any]:
    """The content of the file.

    Args:
        advice: how to get such a file, for the message where there is none.

    Raises:
        ConfigError: no such file, or not TOML.
    """
    try:
        return parse_toml(read_text(path), path)
    except FileNotFoundError as error:
        raise ConfigError(f"{path}: there is no such file{advice and f'; {advice}'}") from error
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read ({error})") from error


def parse_toml(content: str, path: Place) -> dict[str, Any]:
    """As read_toml, from the text of the file."""
    try:
        return toml_of(content)
    except ValueError as error:
        raise ConfigError(f"{path}: not readable as TOML: {error}") from error


def write_template(path: Path, content: str) -> None:
    """Write a template; nothing is overwritten."""
    if path.exists():
        raise ConfigError(f"{path}: is there already; choose another name or remove it")
    try:
        with whole_file(path) as part:
            part.write_text(content, encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written ({error.strerror or error})") from error
