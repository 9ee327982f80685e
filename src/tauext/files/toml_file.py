"""TOML files: declared keys, settings of a dataclass, templates. A wrong key or value is reported in one line."""

from __future__ import annotations

import ast
import difflib
import inspect
import json
import math
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from itertools import pairwise
from pathlib import Path
from types import UnionType
from typing import Any, Literal, NamedTuple, TypeVar, Union, get_args, get_origin, get_type_hints

from tauext.config import described
from tauext.errors import ConfigError
from tauext.files.atomic_write import atomic_write
from tauext.files.kind import is_bundle
from tauext.files.plain_file import read_text, toml_of

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


def read_table(path: Path | str, table: str, content: Any, keys: Mapping[str, Key]) -> dict[str, Any]:
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


def refuse_unknown(path: Path | str, table: str, content: Any, known: Iterable[str]) -> None:
    """ConfigError unless the content is a table and all of its keys are known."""
    if not isinstance(content, dict):
        raise ConfigError(f"{path}: {table} is {content!r}, must be a table")
    listed = tuple(known)
    for key in content:
        if key not in listed:
            raise unknown_key(str(path), key, listed, f" in {table}" if table else " at the top")


def read_toml(path: Path, advice: str = "") -> dict[str, Any]:
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
    except UnicodeDecodeError as error:
        kind = "is a bundle, not a TOML file" if is_bundle(path) else "is not a text file in UTF-8"
        raise ConfigError(f"{path}: {kind}") from error
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error})") from error


def parse_toml(content: str, path: Path) -> dict[str, Any]:
    """Content of a TOML text; raises as read_toml."""
    try:
        return toml_of(content)
    except ValueError as error:
        raise ConfigError(f"{path}: not readable as TOML: {error}") from error


def write_template(path: Path, content: str) -> None:
    """Write a template; nothing is overwritten."""
    if path.exists():
        raise ConfigError(f"{path}: already exists; choose another name or remove it")
    try:
        with atomic_write(path) as part:
            part.write_text(content, encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written ({error.strerror or error})") from error


# --- Settings from a table: every key is a field of the dataclass, every value of its type, or one clear message.


Settings = TypeVar("Settings")


def settings_of(kind: type[Settings], content: Any, where: str, left_out: Mapping[str, str] | None = None) -> Settings:
    """The dataclass with these values, and defaults for the others.

    Args:
        content: a TOML table; nested tables are nested dataclasses.
        where: for messages, as `train.toml: [alarm]`.
        left_out: fields that are not to be set here, and why.

    Raises:
        ConfigError: an unknown key (the nearest is named), a value of another type or against the rule of its field.
    """
    values = values_of(kind, content, where, left_out)
    try:
        return kind(**values)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None


def values_of(kind: type, content: Any, where: str, left_out: Mapping[str, str] | None = None) -> dict[str, Any]:
    """Arguments for the dataclass, as of settings_of; rules that join several of its fields are not checked yet."""
    if not isinstance(content, dict):
        raise ConfigError(f"{where} = {content!r} must be a table")
    hints = hints_of(kind)
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
    return values


def hints_of(kind: type) -> dict[str, Any]:
    """Types of the fields of a dataclass; a field with `choices` in its metadata has one of these."""
    chosen = {one.name: one.metadata["choices"] for one in fields(kind) if "choices" in one.metadata}
    return get_type_hints(kind) | {name: Literal[tuple(choices())] for name, choices in chosen.items()}


def field_help(kind: type) -> dict[str, str]:
    """The docstring under each field of a dataclass, without line breaks, and the choices in the field's metadata."""
    found: dict[str, str] = {}
    for owner in reversed(kind.__mro__[:-1]):
        (definition,) = ast.parse(textwrap.dedent(inspect.getsource(owner))).body
        assert isinstance(definition, ast.ClassDef)
        for one, text in pairwise(definition.body):
            if isinstance(one, ast.AnnAssign) and isinstance(text, ast.Expr):
                found[ast.unparse(one.target)] = " ".join(ast.literal_eval(text.value).split())
    for name, choices in ((one.name, one.metadata.get("choices")) for one in fields(kind)):
        if choices:
            found[name] += f" {'; '.join(f'{choice}: {words}' for choice, words in choices().items())}."
    return found


def settings_text(kind: type) -> str:
    """Every key of the settings in TOML, as a comment with its default, its type and its help."""
    return "\n".join(key_lines(kind(), ""))


def key_lines(settings: Any, table: str) -> Iterator[str]:
    """Keys of one table, then those of the tables within."""
    hints, words = hints_of(type(settings)), field_help(type(settings))
    inner = [one.name for one in fields(settings) if is_dataclass(getattr(settings, one.name))]
    for name in (one.name for one in fields(settings) if one.name not in inner):
        yield from comment_lines(words[name])
        default = getattr(settings, name)
        yield f"# {name} = {'' if default is None else json.dumps(default)}  # {described(hints[name])}"
        yield ""
    for name in inner:
        yield from comment_lines(words[name])
        yield f"[{table}{name}]"
        yield ""
        yield from key_lines(getattr(settings, name), f"{table}{name}.")


def comment_lines(words: str, start: str = "# ") -> list[str]:
    """The words as comments of a TOML file."""
    return textwrap.wrap(" ".join(words.split()), 110, initial_indent=start, subsequent_indent=start)


def unknown_key(where: str, key: str, known: Iterable[str], within: str = "") -> ConfigError:
    """The error for an unknown key."""
    names = list(known)
    near = difflib.get_close_matches(key, names, 1, 0.0)
    nearest = f"the nearest known is '{near[0]}'" if near else "none is known"
    return ConfigError(f"{where}: unknown key '{key}'{within}; {nearest}; known are {', '.join(names)}")


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


def plain(settings: Any) -> dict[str, Any]:
    """The settings as a table that settings_of reads: without what is None, as TOML has no such value."""
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
