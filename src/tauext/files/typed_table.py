"""Tables of TOML and JSON files as frozen dataclasses.

A field is a key, its annotation the rule of its value, its docstring the help. Reader, messages and templates use the
same dataclass.
"""

from __future__ import annotations

import ast
import difflib
import inspect
import json
import math
import re
import textwrap
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import MISSING, Field, fields, is_dataclass
from enum import Enum
from itertools import pairwise
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

from tauext.config import NOT_EMPTY, Rule, annotations_of, described
from tauext.errors import ConfigError
from tauext.files.atomic_write import atomic_write
from tauext.files.plain_file import number_of
from tauext.progress import in_plain_letters

# --- Annotations of fields, beside Python's types and the rules of tauext.config.


class Mark(Enum):
    """What an annotation means in a file."""

    NAME = "the name of the table [tables.NAME] itself; no key"
    JOINT = "a joint of the arm"
    EACH_JOINT = "a list with one value a joint, or one value for all joints"
    OR_ONE = 'a list, or one value alone; "" is an empty list'


class Example(str):
    """A value in TOML for the template of a key that has no telling default."""


T = TypeVar("T")
Table = TypeVar("Table")
TableName = Annotated[str, Mark.NAME]
JointName = Annotated[str, Mark.JOINT]
EachJoint = Annotated[tuple[T, ...], Mark.EACH_JOINT]
OneOrMore = Annotated[tuple[T, ...], Mark.OR_ONE]
Text = Annotated[str, NOT_EMPTY]


# --- The reader.


def read_table(
    kind: type[Table],
    content: Any,
    where: str,
    joints: Sequence[str] = (),
    known: Collection[str] | None = None,
    name: str = "",
) -> Table:
    """The dataclass with the values of a table, and defaults for the others.

    Args:
        content: tables within are dataclasses, or dicts by their names.
        where: begins every message: `arm.toml: [robot]`, and `arm.toml:` at the top of the file.
        joints: names of the arm's joints; empty: not known, and any name is accepted.
        known: fields that are keys of this table; None: all.
        name: of the table, for the field that is a TableName.

    Raises:
        ConfigError: the content is no table, a key is unknown (the nearest is named) or missing, or a value breaks its
            rule.
    """
    values, hints = values_of(kind, content, where, joints, known), hints_of(kind)
    for one in keys_of(kind, known):
        if one.name not in values and one.default is MISSING and one.default_factory is MISSING:
            raise ConfigError(f"{where} {one.name} is missing; it must be {rule_words(hints[one.name], joints)}")
    values |= {key: name for key, hint in hints.items() if Mark.NAME in marks_of(hint)}
    try:
        return kind(**values)
    except ConfigError as error:
        raise ConfigError(f"{where} {error}") from None


def values_of(
    kind: type, content: Any, where: str, joints: Sequence[str] = (), known: Collection[str] | None = None
) -> dict[str, Any]:
    """The values of a table that are given, see read_table; rules that join several of them are not checked."""
    names = [one.name for one in keys_of(kind, known)]
    expect_known(where, content, names)
    hints = hints_of(kind)
    return {key: value_of(hints[key], value, where, key, joints) for key, value in content.items()}


def hints_of(kind: Any) -> dict[str, Any]:
    """The annotations of a dataclass; a field with `choices` in its metadata has one of these."""
    chosen = {one.name: one.metadata["choices"] for one in fields(kind) if "choices" in one.metadata}
    return annotations_of(kind) | {name: Literal[tuple(choices())] for name, choices in chosen.items()}


def keys_of(kind: Any, known: Collection[str] | None = None) -> list[Field]:
    """The fields of a dataclass that are keys of its table."""
    hints = hints_of(kind)
    shown = [one for one in fields(kind) if one.init and Mark.NAME not in marks_of(hints[one.name])]
    return [one for one in shown if known is None or one.name in known]


def expect_known(where: str, content: Any, known: Iterable[str]) -> None:
    """ConfigError unless the content is a table and all of its keys are known."""
    if not isinstance(content, dict):
        raise ConfigError(f"{where} is {content!r}, must be a table")
    names = list(known)
    for key in content:
        if key not in names:
            near = difflib.get_close_matches(key, names, 1, 0.0)
            nearest = f"the nearest known is '{near[0]}'" if near else "none is known"
            raise ConfigError(f"{where} unknown key '{key}'; {nearest}; known are {', '.join(names)}")


def value_of(hint: Any, value: Any, where: str, key: str, joints: Sequence[str] = ()) -> Any:
    """The value of a key by its annotation; raises as read_table."""
    choices = choices_of(hint)
    nested = [one for one in choices if is_table(one)]
    try:
        if not nested or not (isinstance(value, dict) or len(choices) == 1):
            return converted(value, hint, joints)
        found = table_of(base_of(nested[0]), value, inside(where, key), joints)
        expect_rules(hint, found)
    except (TypeError, ValueError, OverflowError):
        raise ConfigError(f"{where} {key} = {value!r} must be {rule_words(hint, joints)}") from None
    return found


def table_of(hint: Any, value: Any, where: str, joints: Sequence[str]) -> Any:
    """A table within a table: a dataclass, or a dict by names."""
    if is_dataclass(hint):
        return read_table(hint, value, where, joints)  # type: ignore[arg-type]
    if not isinstance(value, dict):
        raise TypeError
    inner = get_args(hint)[1]
    if is_dataclass(inner):
        return {name: read_table(inner, one, inside(where, name), joints, name=name) for name, one in value.items()}  # type: ignore[arg-type]
    return {name: value_of(inner, one, where, name, joints) for name, one in value.items()}


def inside(where: str, key: str) -> str:
    """Begins messages about a table within: `arm.toml: [contact.intervals]`."""
    return f"{where[:-1]}.{key}]" if where.endswith("]") else f"{where} [{key}]"


def is_table(hint: Any) -> bool:
    return is_dataclass(base_of(hint)) or get_origin(base_of(hint)) is dict


def base_of(hint: Any) -> Any:
    return get_args(hint)[0] if get_origin(hint) is Annotated else hint


def marks_of(hint: Any) -> tuple[Any, ...]:
    return get_args(hint)[1:] if get_origin(hint) is Annotated else ()


def choices_of(hint: Any) -> tuple[Any, ...]:
    """The types of a union, without None."""
    base = base_of(hint)
    is_union = get_origin(base) in (Union, UnionType)
    return tuple(one for one in get_args(base) if one is not NoneType) if is_union else (hint,)


def expect_rules(hint: Any, value: Any) -> None:
    if not all(rule.holds(value) for rule in marks_of(hint) if isinstance(rule, Rule)):
        raise ValueError


def converted(value: Any, hint: Any, joints: Sequence[str] = ()) -> Any:
    """The value as a field has it: whole numbers become floats, lists tuples.

    Raises:
        TypeError, ValueError: it is of another type, or breaks a rule.
    """
    base, marks = base_of(hint), marks_of(hint)
    if Mark.EACH_JOINT in marks or Mark.OR_ONE in marks:
        one = [value] * len(joints) if Mark.EACH_JOINT in marks else [value] * (value != "")
        listed = value if isinstance(value, list) else one
        found: Any = tuple(converted(each, get_args(base)[0], joints) for each in listed)
        if Mark.EACH_JOINT in marks and len(found) not in (0, len(joints)):
            raise ValueError
    else:
        found = plain_value(value, base, joints)
    if Mark.JOINT in marks and joints and found not in joints:
        raise ValueError
    expect_rules(hint, found)
    return found


def plain_value(value: Any, hint: Any, joints: Sequence[str]) -> Any:
    """As converted, for a type without marks."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        for choice in inner:
            try:
                return converted(value, choice, joints)
            except (TypeError, ValueError):
                continue
    elif origin is Literal:
        if value in inner and not isinstance(value, bool):
            return value
    elif origin is tuple and isinstance(value, list | tuple):
        each = inner[:1] * len(value) if inner[-1] is ... else inner
        return tuple(converted(one, kind, joints) for one, kind in zip(value, each, strict=True))
    elif hint is float and isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
        return float(value)
    elif hint is Any or (
        isinstance(hint, type) and isinstance(value, hint) and isinstance(value, bool) == (hint is bool)
    ):
        return value
    raise TypeError


def rule_words(hint: Any, joints: Sequence[str] = ()) -> str:
    """The rule of a value; follows "must be"."""
    base, marks = base_of(hint), marks_of(hint)
    rules = "".join(one.words for one in marks if isinstance(one, Rule))
    if Mark.JOINT in marks:
        return f"one of {', '.join(joints)}" if joints else "the name of a joint"
    if Mark.EACH_JOINT in marks:
        several = f", one for all joints or a list of {len(joints)}" if joints else ""
        return f"{rule_words(get_args(base)[0], joints)}{several}{rules}"
    if Mark.OR_ONE in marks:
        return f"{rule_words(get_args(base)[0], joints)}, or a list of such{rules}"
    if is_dataclass(base):
        return "a table"
    if choices_of(hint) != (hint,):
        return " or ".join(rule_words(one, joints) for one in choices_of(hint))
    return described(hint)


def table_of_line(kind: type, line: str, where: str) -> tuple[str, dict[str, Any]]:
    """The words before the first key of a line `words key=value key=value`, and its table for read_table.

    A value is a text where the field of its key is one, else a number, or a list of numbers between commas or spaces.

    Raises:
        ConfigError: a key is given twice.
    """
    head, *rest = re.split(r"(?:^|(?<=[\s,]))([a-z_]+)\s*=", line.strip())
    table: dict[str, Any] = {}
    for key, value in zip(rest[::2], rest[1::2], strict=True):
        if key in table:
            raise ConfigError(f"{where} {key} is given twice")
        text, hint = value.strip(" ,\t"), base_of(hints_of(kind).get(key, str))
        table[key] = text
        if hint is not str and get_origin(hint) is not Literal:
            with suppress(ValueError):  # the text breaks the rule, and is reported as it is
                numbers = [number_of(one) for one in re.split(r"[\s,]+", text.strip("[]() ,\t")) if one]
                table[key] = numbers[0] if len(numbers) == 1 else numbers
    return head.strip(" ,\t"), table


# --- Templates and help.


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


def key_help(kind: type) -> dict[str, str]:
    """Help of each key: its docstring, and its rule where the default does not show it."""
    found, helps = {}, field_help(kind)
    for one in keys_of(kind):
        hint = hints_of(kind)[one.name]
        words = [helps[one.name]] if one.name in helps else []
        if (has_rule(hint) or one.default is None) and not one.metadata.get("choices"):
            rule = rule_words(hint)
            words.append(f"{rule[0].upper()}{rule[1:]}.")
        found[one.name] = " ".join(words)
    return found


def has_rule(hint: Any) -> bool:
    """Whether an annotation, or one within it, has a rule beyond its type."""
    own = any(isinstance(one, Rule) and one is not NOT_EMPTY for one in marks_of(hint))
    base = base_of(hint)
    return own or get_origin(base) is Literal or (not is_table(base) and any(map(has_rule, get_args(base))))


def table_lines(
    kind: type,
    table: str,
    about: str = "",
    found: Mapping[str, Any] | None = None,
    helps: Mapping[str, str] | None = None,
    evidence: Mapping[str, str] | None = None,
    in_force: bool = True,
) -> list[str]:
    """Lines of a table for a template: every key with its help; a key that is not found is a comment.

    Args:
        found: values to set.
        helps: keys to show, with their help; None: all.
        evidence: why values are set, by key.
        in_force: False: the whole table is a comment.
    """
    lines, values = comment_lines(about), found or {}
    lines += [f"{'' if in_force else '# '}[{table}]"] if table else []
    for name, words in (key_help(kind) if helps is None else helps).items():
        if in_force and evidence and name in evidence:
            lines += comment_lines(f"Evidence: {evidence[name]}.")
        value = toml_value(values[name]) if name in values else example_of(kind, name)
        line = f"{'' if in_force and name in values else '# '}{name} = {value}".rstrip()
        beside = f"{line}  # {words}".removesuffix(".") if words else line
        lines += [beside] if len(beside) <= 120 else [*comment_lines(words), line]
    return [*lines, ""]


def toml_value(value: Any) -> str:
    """A value as TOML has it: JSON's text, with the characters that TOML refuses in place as escapes."""
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(toml_value, value))}]"
    if not isinstance(value, str):
        return json.dumps(value)
    # TOML has no surrogates, neither as escapes of other characters nor alone.
    text = json.dumps(value.encode("utf-8", "replace").decode(), ensure_ascii=False)
    return "".join(one if one.isprintable() else f"\\U{ord(one):08x}" for one in text)


def example_of(kind: Any, name: str) -> str:
    """A key's value in a template: its example, else its default."""
    for mark in marks_of(hints_of(kind)[name]):
        if isinstance(mark, Example):
            return mark
    default = {one.name: one.default for one in fields(kind)}[name]
    return "" if default is None else json.dumps(default)


def settings_text(kind: Any, table: str = "", about: str = "") -> str:
    """Every key of the settings in TOML, as a comment with its default and its help; tables within follow."""
    helps = key_help(kind)
    within = {name: hint for name, hint in hints_of(kind).items() if is_dataclass(hint)}
    text = "\n".join(table_lines(kind, table, about, helps={k: v for k, v in helps.items() if k not in within}))
    tables = (settings_text(hint, f"{table}.{name}".strip("."), helps[name]) for name, hint in within.items())
    return "\n".join([text, *tables])


def comment_lines(words: str, start: str = "# ") -> list[str]:
    """The words as comments of a TOML file."""
    words = in_plain_letters(" ".join(words.split()))  # names of columns may have control characters
    return textwrap.wrap(words, 110, initial_indent=start, subsequent_indent=start)


def write_template(path: Path, content: str) -> None:
    """Write a template; nothing is overwritten."""
    if path.exists():
        raise ConfigError(f"{path}: already exists; choose another name or remove it")
    try:
        with atomic_write(path) as part:
            part.write_text(content, encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written ({error.strerror or error})") from error
